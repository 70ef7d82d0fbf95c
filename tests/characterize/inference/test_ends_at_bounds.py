"""Ends of intervals where others sit on their bounds: against every way to hold them,
one after the other.
"""

import itertools

import numpy as np
import pytest
from scipy import optimize

from characterize.inference import constrained, ends
from characterize.inference.leastsquares import FitImages, GaussianPrior
from characterize.inference.posterior import REACH, LocalMode

ROUNDING = 1e-9
COUNT = 4


def enumerated(curvature, gradient, low, high):
    """The least between bounds: of all ways to hold each low, high or not at all, the
    least that stays inside.
    """
    best, lowest = None, np.inf
    for way in itertools.product((-1, 0, 1), repeat=len(low)):
        way = np.array(way)
        step = np.where(way < 0, low, np.where(way > 0, high, 0.0))
        if not np.isfinite(step).all():
            continue
        free = way == 0
        pull = gradient + curvature @ step
        step[free] = -np.linalg.solve(curvature[np.ix_(free, free)], pull[free])
        value = step @ (curvature @ step / 2 + gradient)
        if (
            (step >= low - ROUNDING) & (step <= high + ROUNDING)
        ).all() and value < lowest:
            best, lowest = step, value
    return best


def drawn(seed, *, close=0.9):
    """Columns that are nearly alike, so that all go together; data; bounds, some of
    them none or on the start.
    """
    rng = np.random.default_rng([seed, 5])
    mixed = np.linalg.cholesky(
        np.full((COUNT, COUNT), close) + (1 - close) * np.eye(COUNT)
    )
    columns = rng.standard_normal((12, COUNT)) @ mixed.T * rng.uniform(0.3, 3, COUNT)
    low, high = -rng.exponential(0.4, COUNT), rng.exponential(0.4, COUNT)
    low[rng.random(COUNT) < 0.25], high[rng.random(COUNT) < 0.25] = 0.0, np.inf
    return columns, rng.standard_normal(12), low, high


@pytest.mark.parametrize("seed", range(40))
def test_least_between_bounds_is_the_best_of_all_ways_to_hold_them(seed):
    columns, target, low, high = drawn(seed)
    high[seed % COUNT] = low[seed % COUNT] = (
        0.07 if seed % 3 == 0 else low[seed % COUNT]
    )
    curvature, gradient = columns.T @ columns, -columns.T @ target
    found = constrained.bounded_quadratic_step(curvature, gradient, low, high)
    assert found == pytest.approx(enumerated(curvature, gradient, low, high), abs=1e-12)
    assert ((found >= low) & (found <= high)).all()


def test_what_is_not_known_at_all_does_not_move():
    curvature = np.diag([2.0, 0.0, 1.0])
    found = constrained.bounded_quadratic_step(
        curvature,
        np.array([2.0, 0.0, -3.0]),
        np.full(3, -5.0),
        np.array([5.0, 5.0, 1.0]),
    )
    assert found == pytest.approx([-1.0, 0.0, 1.0], abs=1e-12)


def valley(seed):
    """Of a straight model whose mode lies on bounds that hold it back."""
    columns, target, low, high = drawn(seed)
    wide = np.full(COUNT, np.inf)
    curvature, gradient = columns.T @ columns, -columns.T @ target
    mode = enumerated(curvature, gradient, low, high)
    everywhere = np.ones((1, 3, 4), bool)
    data = FitImages(
        target.reshape(1, 3, 4),
        everywhere,
        ~everywhere,
        np.ones((1, 3, 4)),
        np.full((1, 3, 4), 1e15),
    )

    def model(x, jacobian):
        return (columns @ x).reshape(1, 3, 4), columns.T.reshape(
            COUNT, 1, 3, 4
        ) if jacobian else None

    return LocalMode(
        model, data, mode, GaussianPrior(np.zeros(COUNT), wide, low, high)
    ), (curvature, gradient, low, high)


def profile(i, place, curvature, gradient, low, high):
    """Least misfit, less that at 0, with one parameter at a place."""
    others = np.arange(COUNT) != i
    step = np.zeros(COUNT)
    step[i] = place
    pull = (gradient + curvature[:, i] * place)[others]
    step[others] = enumerated(
        curvature[np.ix_(others, others)], pull, low[others], high[others]
    )
    return step @ (curvature @ step + 2 * gradient)


@pytest.mark.parametrize("seed", range(24))
def test_ends_reach_as_far_as_the_best_way_to_hold_the_others_lets_them(seed):
    about, problem = valley(seed)
    low, high = problem[2:]
    held = (np.abs(about.mode - low) < ROUNDING) | (
        np.abs(about.mode - high) < ROUNDING
    )
    assert held.any()
    for i in range(COUNT):
        least = profile(i, about.mode[i], *problem)
        for sign, bound in ((-1, low[i]), (1, high[i])):
            far = bound if np.isfinite(bound) else about.mode[i] + 40 * about.sigma[i]

            def above(place, i=i, least=least):
                return profile(i, place, *problem) - least - REACH**2

            want = bound
            if far != about.mode[i] and above(far) > 0:
                want = optimize.brentq(above, about.mode[i], far, xtol=1e-12)
            found = ends.find_limit(about, i, sign, REACH)
            assert found.lower is None
            assert found.place == pytest.approx(want, abs=1e-6 * about.sigma[i])
            for place, rise in found.seen:
                assert rise == pytest.approx(
                    profile(i, place, *problem) - least, abs=ROUNDING
                )
