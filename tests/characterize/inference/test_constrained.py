"""Steps inside limits: against an independent solver, a closed form, and a fit that
clipping cannot finish.
"""

import numpy as np
import pytest
from scipy import optimize

from characterize.inference import constrained, leastsquares
from characterize.inference.constrained import BallConstraint
from characterize.inference.leastsquares import FitImages, GaussianPrior, SolverSettings

FREE = np.full(4, np.inf)


def problem(seed=0, p=4):
    random = np.random.default_rng(seed)
    jacobian = (
        random.standard_normal((30, p))
        @ np.linalg.cholesky(np.full((p, p), 0.95) + 0.05 * np.eye(p)).T
    )
    return jacobian, random.standard_normal(30) * 3


def test_bounded_step_is_that_of_an_independent_solver():
    jacobian, target = problem()
    low, high = np.full(4, -0.4), np.array([0.3, 0.2, 0.5, 0.1])
    want = optimize.lsq_linear(jacobian, target, (low, high), tol=1e-12).x
    free = np.linalg.lstsq(jacobian, target, rcond=None)[0]
    found = constrained.constrained_step(
        jacobian.T @ jacobian,
        -jacobian.T @ target,
        np.zeros(4),
        low=low,
        high=high,
        tolerance=1e-8,
    )
    assert np.abs(found - want).max() < 1e-6
    assert (
        np.abs(np.clip(free, low, high) - want).max() > 0.05
    )  # clipping the free minimum is something else


def test_step_into_a_ball_of_equal_curvature_is_the_projection():
    goal = np.array([3.0, 4.0, 0.5, 0.0])
    ball = BallConstraint(np.array([0, 1]), 1.0)
    found = constrained.constrained_step(
        np.eye(4), -goal, np.zeros(4), low=-FREE, high=FREE, ball=ball, tolerance=1e-8
    )
    assert np.abs(found - [0.6, 0.8, 0.5, 0.0]).max() < 1e-6
    assert ball.inside(found)


def test_a_step_goes_as_far_as_the_ball():
    """Of numbers 0 and 2 alone, from inside and from the rim: outwards no farther,
    across its own way.
    """
    ball = BallConstraint(np.array([0, 2]), 1.5)
    x, step = np.array([0.4, 9.0, -0.7]), np.array([2.0, -3.0, -1.1])
    share = ball.share(x, step)
    assert 0 < share < 1
    assert np.linalg.norm((x + share * step)[[0, 2]]) == pytest.approx(1.5, rel=1e-12)
    rim = np.array([0.9, 2.0, -1.2])
    assert ball.share(rim, step) == pytest.approx(0.0, abs=1e-12)
    across = ball.share(rim, np.array([-4.0, 0.0, 0.3]))
    assert across == pytest.approx(
        2 * (0.9 * 4.0 + 1.2 * 0.3) / (4.0**2 + 0.3**2), rel=1e-12
    )  # a chord


def test_a_bounded_fit_reaches_the_minimum_between_the_bounds():
    jacobian, target = problem(3)
    shape = (1, 5, 6)
    data = FitImages(
        target.reshape(shape),
        np.ones(shape, bool),
        np.zeros(shape, bool),
        np.ones(shape),
        np.full(shape, 1e9),
    )

    def model(x, wanted):
        return (jacobian @ x).reshape(shape), jacobian.T.reshape(
            4, *shape
        ) if wanted else None

    low, high = np.full(4, -0.3), np.full(4, 0.3)
    prior = GaussianPrior(np.zeros(4), FREE, low, high)
    settings = SolverSettings(huber=1e9, bounded=True, iterations=5)
    found = leastsquares.fit_levenberg_marquardt(
        model, data, np.zeros(4), prior=prior, settings=settings
    ).value
    want = optimize.lsq_linear(jacobian, target, (low, high), tol=1e-12).x
    assert (
        np.abs(found - want).max() < 1e-3
    )  # damping of 1e-3, then a fifth of it with every step


def test_limits_that_leave_no_room_give_no_step():
    found = constrained.constrained_step(
        np.eye(4), np.ones(4), np.zeros(4), low=np.zeros(4), high=np.zeros(4)
    )
    assert not found.any()


@pytest.mark.parametrize("far", [1e-3, 1.0, 1e5])
def test_a_step_is_found_to_a_share_of_sigma_however_long_it_is(far):
    """Of the default tolerance: between bounds of 0.4 sigma to 40 000, against an
    independent solver.
    """
    jacobian, target = problem(5)
    target, low, high = (
        far * target,
        np.full(4, -0.4 * far),
        far * np.array([0.3, 0.2, 0.5, 0.1]),
    )
    want = optimize.lsq_linear(jacobian, target, (low, high), tol=1e-14).x
    found = constrained.constrained_step(
        jacobian.T @ jacobian, -jacobian.T @ target, np.zeros(4), low=low, high=high
    )
    sigma = 1 / np.sqrt(np.diag(jacobian.T @ jacobian))
    assert (
        np.abs((found - want) / sigma).max() < 3e-3
    )  # it ends where a further step is below 1e-3


def test_derivatives_of_the_ball_are_differences():
    """Steps in units of unlike sizes, two of three parameters in the ball; of a
    parabola differences are exact.
    """
    x, size, s = (
        np.array([0.3, -0.8, 1.1]),
        np.array([2.3, 0.7, 4.1]),
        np.array([0.9, -0.4, 1.7]),
    )
    excess = constrained._limit(BallConstraint(np.array([0, 2]), 1.3), x, size)
    slope, h = np.full(3, 9.0), 1e-3
    value = excess(s, slope)
    assert value == pytest.approx(
        ((0.3 + 0.9 / 2.3) ** 2 + (1.1 + 1.7 / 4.1) ** 2) / 1.3**2 - 1, rel=1e-12
    )
    none = np.zeros(0)
    want = [
        (excess(s + h * unit, none) - excess(s - h * unit, none)) / (2 * h)
        for unit in np.eye(3)
    ]
    assert slope == pytest.approx(want, abs=1e-9)
