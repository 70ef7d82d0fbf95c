"""Fields that stand off: the second-order expansion on quadratics, the centroid of a
window.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from layout.study import stitching
from layout.study.focus import FocusWindow

RNG = np.random.default_rng(10)


def test_derivatives_of_a_quadratic_are_its_own():
    """Light a + b x + c y + d x²/2 + e y²/2 + g xy of every field, offsets in um, terms
    in steps of 20 nm.
    """
    a, b, c, d, e, g = RNG.normal(size=(6, 3, 2, 4)) + 1j * RNG.normal(
        size=(6, 3, 2, 4)
    )

    def light(moments, place):
        x, y = place
        return (a + b * x + c * y + d * x**2 / 2 + e * y**2 / 2 + g * x * y)[:, None]

    h = 0.02
    still, terms = stitching._expansion(SimpleNamespace(light=light), None, h)
    assert still == pytest.approx(a.sum(0), rel=1e-12)
    want = np.stack([b * h, c * h, d * h**2, e * h**2, g * h**2])
    assert np.abs(terms - want).max() < 1e-12


def test_the_centroid_of_a_window_is_the_mean_place_of_its_light():
    where = FocusWindow(
        np.array([-1.0, 0.5, 3.0]), np.array([2.0, 7.0]), 500.0, 0.85, np.ones(1)
    )
    psf = np.array([[[1.0, 0.0, 3.0], [2.0, 4.0, 0.0]]])
    x = (-1 + 9 - 2 + 2) / 10
    y = (2 * 4 + 7 * 6) / 10
    assert stitching._centroid(psf, where).ravel() == pytest.approx([x, y])
