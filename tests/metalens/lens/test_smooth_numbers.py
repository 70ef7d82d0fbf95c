"""When a polynomial stands for a function of many places: how often it is asked, by
series that are given.
"""

import math

import numpy as np
import pytest

from metalens.lens import smooth

PLACES = np.linspace(2.0, 5.0, 1000)  # the middle is 3.5, the reach 1.5


def series(asked, *terms):
    """A function whose Chebyshev series over the places is given, and which counts what
    it is asked.
    """

    def one(u):
        asked.append(u.size)
        return np.polynomial.chebyshev.Chebyshev(np.array(terms), domain=[2.0, 5.0])(u)

    return one


@pytest.mark.parametrize(("last", "places"), [(3e-15, 9), (6e-15, 9 + 17)])
def test_the_last_coefficients_are_to_be_rounding(last, places):
    """4e-15 of the largest, which is that of the second degree; coefficients are known
    to 2e-16 of it.
    """
    asked = []
    found = smooth.over(series(asked, 0.1, 0, 2.0, 0, 0, 0, 0, 0, 2 * last), PLACES)
    assert sum(asked) == places
    want = 0.1 + 2 * (2 * ((PLACES - 3.5) / 1.5) ** 2 - 1)
    assert np.abs(found - want).max() < 3e-14


@pytest.mark.parametrize("degree", [7, 8])
def test_both_of_the_last_two_count(degree):
    """One of them is 0 in a function that is even or odd about the middle."""
    asked, terms = [], np.zeros(9)
    terms[1], terms[degree] = 1.5, 1e-3
    smooth.over(series(asked, *terms), PLACES)
    assert sum(asked) == 9 + 17


def test_a_thousand_places_are_enough_and_fewer_are_asked_each():
    for places, count in ((PLACES, 9), (PLACES[1:], 999)):
        asked = []
        found = smooth.over(series(asked, 0.4, -1.1, 0.3), places)
        assert sum(asked) == count
        unit = (places - 3.5) / 1.5
        assert found == pytest.approx(
            0.4 - 1.1 * unit + 0.3 * (2 * unit**2 - 1), abs=1e-14
        )


def test_places_may_lie_close_together():
    asked = []

    def cosine(u):
        asked.append(u.size)
        return np.cos(u)

    close = np.linspace(2.0, 2.02, 1000)
    assert smooth.over(cosine, close) == pytest.approx(np.cos(close), abs=1e-14)
    assert asked == [9]


def test_what_no_degree_reaches_is_asked_at_every_place():
    asked = []

    def root(u):
        asked.append(u.size)
        return np.sqrt(u - 2.0)

    assert np.array_equal(smooth.over(root, PLACES), np.sqrt(PLACES - 2.0))
    assert asked == [9, 17, 25, 1000]
    same = np.full(1000, 2.7)
    asked = []
    assert smooth.over(series(asked, 1.0), same).tolist() == [1.0] * 1000
    assert asked == [1000]


def test_powers_are_summed_as_horner_does():
    unit = np.array([0.3, -0.8])
    want = 0.5 - 1.2 * unit + 3.1 * unit**2 + 0.7 * unit**3
    assert smooth._horner(np.array([0.5, -1.2, 3.1, 0.7]), unit) == pytest.approx(want)
    assert smooth._horner(np.array([0.5, -1.2]), unit) == pytest.approx(
        0.5 - 1.2 * unit
    )
    assert math.isclose(
        float(smooth._horner(np.array([0.5, -1.2]), np.float64(0.3))), 0.14
    )
