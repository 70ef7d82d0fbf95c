"""The least of a quadratic between bounds: against answers that are known by how the
quadratic was made.
"""

import numpy as np
import pytest

from characterize.inference import constrained

EPS = np.finfo(float).eps
LOW, HIGH, FREE, CORNER, SHUT = range(
    5
)  # a corner: on a bound that does not hold it; shut: bounds that touch


def curved(rng, p, condition):
    """(p, p) of a condition number, in units that differ a hundredfold."""
    turned = np.linalg.qr(rng.standard_normal((p, p)))[0]
    size = 10 ** rng.uniform(-1, 1, p)
    made = (turned * np.logspace(0, -np.log10(condition), p)) @ turned.T
    return (made + made.T) / 2 / np.outer(size, size), size


def made(seed, p, condition, *, shares):
    """(curvature, gradient, low, high, answer, kinds): the answer drawn first, then all
    that makes it one.

    Where it is on a bound, the slope draws it outwards; where it is free or in a
    corner, there is none.
    """
    rng = np.random.default_rng([seed, p])
    curvature, size = curved(rng, p, condition)
    kinds = rng.choice(5, p, p=shares)
    answer = rng.standard_normal(p) * size
    slack = rng.exponential(1.0, (2, p)) * size
    low = np.where(np.isin(kinds, (LOW, CORNER, SHUT)), answer, answer - slack[0])
    high = np.where(np.isin(kinds, (HIGH, SHUT)), answer, answer + slack[1])
    high[(kinds == FREE) & (rng.random(p) < 0.3)] = np.inf
    outward = (
        rng.exponential(1.0, p)
        / size
        * np.select([kinds == LOW, kinds == HIGH], [1, -1], 0)
    )
    return curvature, outward - curvature @ answer, low, high, answer, kinds


def slopes(curvature, gradient, x):
    """(p,) of the quadratic, in 64 bits of mantissa, and what its terms add up to
    without regard to sign.
    """
    wide = np.longdouble
    terms = np.abs(curvature) @ np.abs(x) + np.abs(gradient)
    return np.asarray(curvature.astype(wide) @ x.astype(wide) + gradient, float), terms


def assert_least(curvature, gradient, low, high, found):
    """No slope where it is free, none inwards where it is held (Karush, Kuhn, Tucker):
    to rounding of the factors.
    """
    assert ((found >= low) & (found <= high)).all()
    slope, terms = slopes(curvature, gradient, found)
    own = np.sqrt(np.diag(curvature))
    rounding = (
        10 * len(own) * EPS * (terms / own).max()
    )  # of an eigenvalue problem and of its use, in equal units
    assert (slope / own)[found > low].max(initial=0) <= rounding
    assert (-slope / own)[found < high].max(initial=0) <= rounding


MIXED, CORNERS, HELD = (
    (0.2, 0.2, 0.4, 0.1, 0.1),
    (0.05, 0.05, 0.2, 0.7, 0.0),
    (0.45, 0.45, 0.05, 0.0, 0.05),
)


@pytest.mark.parametrize("condition", [30.0, 1e6, 1e12])
@pytest.mark.parametrize("shares", [MIXED, CORNERS, HELD])
@pytest.mark.parametrize("p", [3, 23, 60])
def test_least_is_where_it_was_put(p, shares, condition):
    for seed in range(12):
        *problem, answer, kinds = made(seed, p, condition, shares=shares)
        found = constrained.bounded_quadratic_step(*problem)
        assert_least(*problem, found)
        held = np.isin(kinds, (LOW, HIGH, SHUT))
        size = 1 / np.sqrt(np.diag(problem[0]))
        # what a slope of rounding moves, which the least eigenvalue of equal units
        # makes large
        equal = problem[0] * np.outer(size, size)
        loose = 30 * p * EPS * np.linalg.cond(equal) * (np.abs(answer) / size).max()
        assert (np.abs(found - answer) / size).max() <= loose
        if loose < 1e-6:
            assert (found == answer)[held].all()


@pytest.mark.parametrize("seed", range(20))
def test_least_does_not_depend_on_units_nor_on_the_weight_of_all(seed):
    """To the last bit: powers of two change no mantissa."""
    curvature, gradient, low, high, *_ = made(seed, 17, 1e8, shares=MIXED)
    unit = 2.0 ** np.random.default_rng(seed).integers(-9, 9, 17)
    weight = 4.0 ** (seed - 10)
    want = constrained.bounded_quadratic_step(curvature, gradient, low, high)
    found = constrained.bounded_quadratic_step(
        curvature * np.outer(unit, unit) * weight,
        gradient * unit * weight,
        low / unit,
        high / unit,
    )
    assert np.array_equal(found * unit, want)


@pytest.mark.parametrize("seed", range(20))
def test_combinations_that_are_not_known_end_between_the_bounds_all_the_same(seed):
    """Each column there twice: the two share a step as they like, and their sum is that
    of one with both bounds.
    """
    curvature, gradient, low, high, answer, _ = made(seed, 9, 1e3, shares=MIXED)
    twice = [np.tile(a, 2) for a in (gradient, low / 2, high / 2)]
    found = constrained.bounded_quadratic_step(np.tile(curvature, (2, 2)), *twice)
    assert_least(np.tile(curvature, (2, 2)), *twice, found)
    own = np.sqrt(np.diag(curvature))
    assert (np.abs(found[:9] + found[9:] - answer) * own).max() < 1e-9 * (
        np.abs(answer) * own
    ).max()  # 1e3, twice


def test_a_start_with_all_held_that_would_leave_is_left_again():
    """The free least (4, -3) leaves by both bounds; with x at its own, y does not leave
    but is drawn inside.
    """
    curvature = np.array([[1.0, 0.9], [0.9, 1.0]])
    gradient = -curvature @ np.array([4.0, -3.0])
    found = constrained.bounded_quadratic_step(
        curvature, gradient, np.array([-9.0, -1.0]), np.array([0.5, 9.0])
    )
    assert found == pytest.approx([0.5, 0.15], abs=1e-12)  # y = -3 + 0.9 (4 - 0.5)
