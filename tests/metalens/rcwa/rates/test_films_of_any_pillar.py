"""Derivatives of pillars without a half turn between films, and of films in which waves
fade, beside the values.
"""

import numpy as np
import pytest

from metalens import rcwa
from metalens.cell import Cell, Film, Index
from metalens.cell.shapes import Ellipse, Polygon

WAVE, SIZE = 0.73, 0.25
ABOUT = {
    "height_um": 0.53,
    "pillar": Index(2.7),
    "substrate": Index(1.45),
    "between": Index(1.1),
}
TRIANGLE, OVAL = Polygon(((-0.5, -0.3), (0.5, -0.3), (0.0, 0.6))), Ellipse(0.7, 0.2)
THIN = {
    "under": (Film(Index(1.9), 0.07), Film(Index(1.6), 0.05)),
    "over": (Film(Index(1.3), 0.11),),
}
THICK = {
    "under": (Film(Index(1.9), 7.0), Film(Index(1.6), 12.0)),
    "over": (Film(Index(1.3), 5.0),),
}


@pytest.mark.parametrize(
    ("shape", "films", "sidewall_rad", "angle_rad"),
    [
        (TRIANGLE, THIN, 0.0, 0.0),
        (TRIANGLE, THIN, 0.04, 0.2),
        (TRIANGLE, THICK, 0.0, 0.2),
        (OVAL, THICK, 0.0, 0.0),
    ],
)
def test_the_value_beside_derivatives_is_that_of_jones_and_power_is_kept(
    shape, films, sidewall_rad, angle_rad
):
    """Nothing absorbs: 1 in all orders, to rounding, which the collocation of a tilted
    wall keeps too.
    """
    cell = Cell(0.41, shape=shape, sidewall_rad=sidewall_rad, **films, **ABOUT)
    about = {
        "angle_rad": angle_rad,
        "azimuth_rad": 0.4,
        "harmonics": 1,
        "tolerance": 1e-2,
    }
    found = rcwa.jones_derivatives(
        cell, SIZE, WAVE, by=["under.1.thickness_um", "over.0.thickness_um"], **about
    )
    want = rcwa.jones(cell, SIZE, WAVE, **about)
    assert found.jones.t == pytest.approx(want.t, abs=1e-11)
    assert found.jones.r == pytest.approx(want.r, abs=1e-11)
    assert found.jones.energy == pytest.approx([1.0, 1.0], abs=1e-11)
    value = np.concatenate([found.jones.t, found.jones.r])
    for rate in (
        found.by.values()
    ):  # one order on either side: every column of (t, r) keeps its length
        change = np.concatenate([rate.t, rate.r])
        assert np.abs(change).max() > 0.1
        assert (
            np.abs((np.conj(value) * change).real.sum(0)).max()
            < 1e-9 * np.abs(change).max()
        )
