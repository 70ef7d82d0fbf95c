"""How many terms, samples and degrees the fast model takes: as many as its tolerance
asks for, and hardly more.
"""

import numpy as np
import pytest
from numpy.polynomial import legendre

from characterize.model import pillar_slopes
from characterize.model.kernel import _terms
from characterize.model.window import _resampled

POINT, WEIGHT = legendre.leggauss(400)


def missed(slope, count):
    """Root mean square over [-1, 1] of what ``count`` Legendre terms leave of exp(i
    slope t), by quadrature.
    """
    wave, rest = np.exp(1j * slope * POINT), 1.0
    for n in range(count):
        one = legendre.legval(POINT, np.eye(count)[n])
        rest -= (2 * n + 1) / 4 * abs((WEIGHT * wave * one).sum()) ** 2
    return np.sqrt(max(rest, 0.0))


@pytest.mark.parametrize(
    ("slope", "tolerance"), [(3.7, 1e-3), (41.0, 1e-2), (0.4, 1e-4)]
)
def test_legendre_terms_of_a_wave_leave_a_fiftieth_of_the_tolerance(slope, tolerance):
    """One more than needed is taken: two fewer are too few."""
    count = _terms(slope, tolerance)
    assert missed(slope, count) <= tolerance / 50
    assert missed(slope, count - 2) > tolerance / 50


def test_the_degree_is_that_of_the_polynomial():
    x = np.cos(np.pi * (np.arange(31) + 0.5) / 31)
    rows = np.stack([2.3 * x**3 - x + 0.2, 0.4 * x**2 + 1j * x])
    degree, error = pillar_slopes._degree(x, rows, 1e-9)
    assert degree == 3
    assert error < 1e-12  # rounding of a fit to 20 points


def test_degrees_up_to_fourteen_are_tried():
    x = np.cos(np.pi * (np.arange(31) + 0.5) / 31)
    degree, error = pillar_slopes._degree(x, np.cos(14 * np.arccos(x))[None], 1e-9)
    assert degree == 14
    assert error < 1e-11


def test_a_degree_that_is_never_enough_comes_with_its_error():
    """|x| by polynomials of degree n is missed by 0.28 / n (Bernstein), of which the
    held-out points see a part.
    """
    x = np.cos(np.pi * (np.arange(301) + 0.5) / 301)
    degree, error = pillar_slopes._degree(x, np.abs(x)[None], 1e-9)
    size = np.abs(np.abs(x) - np.abs(x).mean()).max()
    assert 0.1 / degree / size < error < 1.0 / degree / size


@pytest.mark.parametrize("tolerance", [1e-2, 1e-4])
def test_coarse_samples_carry_every_wave_of_the_band(tolerance):
    at, band = (np.arange(120) - 55.0) * 0.4, 1.3
    coarse, weights = _resampled(at[0], at[-1], len(at), band, tolerance)
    assert len(coarse) < len(at)
    waves = np.linspace(-0.97 * band, band, 23)
    error = np.abs(
        weights @ np.exp(1j * coarse[:, None] * waves)
        - np.exp(1j * at[:, None] * waves)
    )
    assert np.sqrt((error**2).mean()) < tolerance


def test_a_window_with_fewer_samples_than_taps_is_left_alone():
    at = (np.arange(9) - 4.0) * 0.4
    coarse, weights = _resampled(at[0], at[-1], len(at), 1.3, 1e-3)
    assert coarse == pytest.approx(at, abs=1e-12)
    assert np.array_equal(weights, np.eye(9))
