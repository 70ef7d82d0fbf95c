"""Chunked polynomials against numpy's own, their slopes against the complex step, their
bounds against samples.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.polynomial import chebyshev

from metalens.library import polynomial

LOW, HIGH = 0.08, 0.21
COEFFICIENTS = np.array([3.0, 2.5, 0.8, -0.2, 0.05, 0.02, -0.01, 0.003, 0.001])


def reference(diameter, power):
    """The Chebyshev sum by numpy; also for complex diameters."""
    x = (2 * diameter**power - LOW**power - HIGH**power) / (HIGH**power - LOW**power)
    return sum(
        c * np.polynomial.chebyshev.chebval(x, np.eye(9)[k])
        for k, c in enumerate(COEFFICIENTS)
    )


@pytest.mark.parametrize("power", [1, 2, 3])
@pytest.mark.parametrize("shape", [(), (7, 5), (3, 40_000)])
def test_value_and_slope(power, shape):
    d = np.random.default_rng(0).uniform(LOW, HIGH, shape)
    p = polynomial.chebyshev_curve(COEFFICIENTS, (LOW, HIGH), power)
    # monomials up to 40: 40 eps
    assert abs(polynomial.evaluate_curve(p, d) - reference(d, power)).max() < 1e-12
    step = np.imag(reference(d + 1e-30j, power)) / 1e-30
    assert (
        abs(polynomial.evaluate_slope(p, d) - step).max() < 1e-12 * np.abs(step).max()
    )  # monomials of the slope up to 300


@given(st.lists(st.floats(-1, 1), min_size=1, max_size=24), st.integers(1, 3))
def test_bounds_hold_everywhere_and_are_tight(terms, rows):
    c = np.resize(np.array(terms), (rows, max(1, len(terms) // rows)))
    x, y = np.linspace(-1, 1, 301), np.linspace(-1, 1, 41)
    sampled = chebyshev.chebgrid2d(y, x, c)
    low, high = polynomial.certified_bounds(c)
    assert low <= sampled.min() + 1e-12
    assert high >= sampled.max() - 1e-12
    span = np.abs(c).sum()
    # 301 samples of degree 23 miss up to (pi 23/301)²/8 of the range
    assert low >= sampled.min() - 0.02 * span
    assert high <= sampled.max() + 0.02 * span
