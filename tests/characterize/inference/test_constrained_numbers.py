"""Steps inside limits from places that are no middle, in units a million apart: SciPy,
Lagrange's equation, by hand.
"""

import numpy as np
import pytest
from scipy import optimize

from characterize.inference import constrained
from characterize.inference.constrained import BallConstraint, ProfiledQuadratic


def drawn(seed, p, *, far=1.0):
    """(J, t, x, low, high) of |J s - t|: columns that go together, units from 1e-3 to
    1e3, x inside but not amid.

    Bounds lie 0.1 to 0.9 sigma off, times ``far``, as the free step is.
    """
    rng = np.random.default_rng([seed, p])
    unit = 10 ** rng.uniform(-3, 3, p)
    mixed = np.linalg.cholesky(np.full((p, p), 0.9) + 0.1 * np.eye(p)).T
    columns = rng.standard_normal((3 * p, p)) @ mixed * unit
    x = far * rng.uniform(2.0, 5.0, p) / unit  # far from 0 beside what the bounds leave
    low, high = (
        x - far * rng.uniform(0.1, 0.7, p) / unit,
        x + far * rng.uniform(0.3, 0.9, p) / unit,
    )
    return columns, 3 * far * rng.standard_normal(3 * p), x, low, high


def independent(columns, target, low, high):
    """The step by SciPy's bounded variables, in equal units."""
    size = np.sqrt((columns**2).sum(0))
    found = optimize.lsq_linear(
        columns / size, target, (low * size, high * size), tol=1e-14, method="bvls"
    )
    return found.x / size


@pytest.mark.parametrize("p", [4, 12])
def test_a_step_from_beside_the_middle_is_that_of_an_independent_solver_in_any_units(p):
    """Tolerance 1e-8 sigma; a share 0.1 of what goes together is known by itself, and
    SLSQP leaves some steps of it.
    """
    for seed in range(5):
        columns, target, x, low, high = drawn(seed, p)
        want = independent(columns, target, low - x, high - x)
        on = np.isclose(x + want, low, rtol=1e-12) | np.isclose(
            x + want, high, rtol=1e-12
        )
        found = constrained.constrained_step(
            columns.T @ columns,
            -columns.T @ target,
            x,
            low=low,
            high=high,
            tolerance=1e-8,
        )
        own = np.sqrt((columns**2).sum(0))
        assert on.any()
        assert np.abs((found - want) * own).max() < 1e-6
        assert ((x + found >= low) & (x + found <= high)).all()


@pytest.mark.parametrize("far", [1.0, 1e3])
def test_25_parameters_step_to_a_thousandth_of_sigma_however_far_apart_the_bounds_are(
    far,
):
    """Without regard to the length of the step it would end 0.1 sigma off where the
    bounds are 1 sigma apart.
    """
    for seed in range(4):
        columns, target, x, low, high = drawn(seed, 25, far=far)
        want = independent(columns, target, low - x, high - x)
        found = constrained.constrained_step(
            columns.T @ columns, -columns.T @ target, x, low=low, high=high
        )
        own = np.sqrt((columns**2).sum(0))
        assert (
            np.abs((found - want) * own).max() < 0.02
        )  # 1e-3, times some steps that are each a share of the last


@pytest.mark.parametrize("side", [-1, 1])
def test_a_place_that_rounding_put_beyond_its_bound_steps_along_it(side):
    """(s - 3)² and (s - 2)² of parameters at 0.7 and 0.2: the first may go to 0.7
    itself, the second is free.
    """
    wall = np.array([0.7, 9.0])
    x = np.array([np.nextafter(0.7, 1.0), 0.2])
    goal = np.array([3.0, 2.0])
    low, high = (-np.full(2, 9.0), wall) if side > 0 else (-wall, np.full(2, 9.0))
    found = constrained.constrained_step(
        np.eye(2), -side * (goal - x), side * x, low=low, high=high, tolerance=1e-8
    )
    assert side * x + found == pytest.approx(side * np.array([0.7, 2.0]), abs=1e-6)
    assert low[0] <= (side * x + found)[0] <= high[0]


def lagrange(curvature, gradient, x, ball):
    """The step onto the ball: (C + λD) s = -g - λDx for the λ at which |x + s| is its
    radius, D of its numbers.
    """
    of_ball = np.zeros(len(x))
    of_ball[ball.index] = 1

    def at(weight):
        return np.linalg.solve(
            curvature + weight * np.diag(of_ball), -gradient - weight * of_ball * x
        )

    def excess(log):
        return np.linalg.norm((x + at(np.exp(log)))[ball.index]) - ball.radius

    return at(np.exp(optimize.brentq(excess, -30, 30, xtol=1e-13)))


@pytest.mark.parametrize("seed", range(4))
def test_a_step_onto_a_ball_solves_the_equation_of_lagrange(seed):
    """Two numbers of four in the ball, from a place beside its middle; curvature that
    is not alike in any two.
    """
    rng = np.random.default_rng([seed, 8])
    columns = rng.standard_normal((9, 4)) * np.array([0.2, 3.0, 0.7, 40.0])
    curvature, ball = columns.T @ columns, BallConstraint(np.array([0, 2]), 1.3)
    x, goal = np.array([0.4, -5.0, -0.6, 2.0]), np.array([4.0, 1.0, 2.5, 2.2])
    gradient = curvature @ (x - goal)
    assert not ball.inside(goal)
    wide = np.full(4, np.inf)
    found = constrained.constrained_step(
        curvature, gradient, x, low=-wide, high=wide, ball=ball, tolerance=1e-9
    )
    own = np.sqrt(np.diag(curvature))
    assert found * own == pytest.approx(
        lagrange(curvature, gradient, x, ball) * own, abs=1e-5
    )
    assert np.linalg.norm((x + found)[[0, 2]]) == pytest.approx(1.3, rel=1e-6)
    wider = BallConstraint(
        ball.index, float(np.linalg.norm(goal[[0, 2]])) + 0.01
    )  # the free least lies inside
    found = constrained.constrained_step(
        curvature, gradient, x, low=-wide, high=wide, ball=wider, tolerance=1e-9
    )
    assert found * own == pytest.approx((goal - x) * own, abs=1e-5)


def test_a_ball_and_a_bound_hold_at_once():
    """|s - (3, 4, 5)|² inside |(s₀, s₁)| = 2, s₁ at most 1.2 and s₂ at most 0.5: s₀ = √(4 - 1.44) = 1.6."""
    goal, far = np.array([3.0, 4.0, 5.0]), np.full(3, 99.0)
    ball = BallConstraint(np.array([0, 1]), 2.0)
    high = np.array([99.0, 1.2, 0.5])
    x = np.array([0.3, 0.9, -1.0])
    found = constrained.constrained_step(
        np.eye(3), x - goal, x, low=-far, high=high, ball=ball, tolerance=1e-9
    )
    assert x + found == pytest.approx([1.6, 1.2, 0.5], abs=1e-6)


@pytest.mark.parametrize("radius", [0.3, 50.0])
def test_a_ball_holds_to_a_thousand_millionth_of_its_radius(radius):
    """Direction (0.6, 0.8) of numbers 2 and 0; the one between counts for nothing."""
    ball = BallConstraint(np.array([2, 0]), radius)

    def at(share):
        return np.array([0.8 * radius * share, 1e9, 0.6 * radius * share])

    assert ball.inside(at(1 + 0.9e-9))
    assert not ball.inside(at(1 + 1.1e-9))
    assert not ball.inside(-at(1.001))


def test_nothing_to_gain_is_no_step():
    """At the least itself, in the middle of the bounds."""
    far = np.array([3.0, 7.0])
    curvature = np.array([[2.0, 0.4], [0.4, 5.0]])
    assert not constrained.constrained_step(
        curvature, np.zeros(2), np.array([1.0, 2.0]), low=-far, high=far
    ).any()


CURVATURE, GRADIENT = np.array([[4.0, 2.0], [2.0, 3.0]]), np.array([1.0, -2.0])


def led(low=-9.0, high=9.0, i=0):
    """4t² + 4tu + 3u² + 2t - 4u, t led and u between bounds."""
    return ProfiledQuadratic(
        CURVATURE, GRADIENT, i, low=np.array([-9.0, low]), high=np.array([9.0, high])
    )


def test_what_is_not_led_follows_to_its_own_least():
    """u = (2 - 2t) / 3, and -0.25 or 0.5 where that is beyond these; t itself to -9 at
    the least.
    """
    assert led().others(0.7) == pytest.approx([0.7, 0.2])
    assert led(high=0.5).others(-0.4) == pytest.approx([-0.4, 0.5])
    assert led(low=-0.25).others(2.0) == pytest.approx([2.0, -0.25])
    assert led().others(-40.0) == pytest.approx([-9.0, 20 / 3])
    assert led(i=1).others(0.5) == pytest.approx(
        [-0.5, 0.5]
    )  # u led: t = -(1 + 2u) / 4
    assert led().change(np.array([0.7, 0.2])) == pytest.approx(
        1.96 + 0.56 + 0.12 + 1.4 - 0.8
    )


def test_on_a_bound_are_those_that_a_step_puts_there_but_for_the_led_one():
    one = led(low=-0.25, high=0.5)
    assert one.held(np.array([9.0, 0.5])).tolist() == [False, True]
    assert one.held(np.array([-9.0, -0.25])).tolist() == [False, True]
    assert one.held(np.array([1.0, 0.1])).tolist() == [False, False]


@pytest.mark.parametrize("sign", [-1, 1])
def test_the_led_one_goes_as_far_as_the_quadratic_has_room(sign):
    """With u = (2 - 2t) / 3 it is 8/3 t² + 14/3 t - 4/3; with u kept at 0.5, 4t² + 4t -
    1.25; to the least at -7/8 and
    at -1/2, where it is more everywhere."""
    free, kept, step = np.zeros(2, bool), np.array([False, True]), np.array([8.0, 0.5])
    for room in (-1.0, 2.5):
        want = (
            -14 / 3 + sign * np.sqrt((14 / 3) ** 2 + 4 * 8 / 3 * (4 / 3 + room))
        ) / (2 * 8 / 3)
        assert led().way(sign, room, step, free) == pytest.approx(want, rel=1e-12)
        want = (-4 + sign * np.sqrt(16 + 16 * (1.25 + room))) / 8
        assert led(high=0.5).way(sign, room, step, kept) == pytest.approx(
            want, rel=1e-12
        )
        assert led().change(
            led().others(led().way(sign, room, step, free))
        ) == pytest.approx(room, rel=1e-12)
    assert led().way(sign, -10.0, step, free) == pytest.approx(-7 / 8)
    assert led(high=0.5).way(sign, -10.0, step, kept) == pytest.approx(-1 / 2)
