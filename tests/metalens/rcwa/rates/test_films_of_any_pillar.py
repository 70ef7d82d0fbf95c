"""Derivatives of pillars without a half turn between films, and of films in which waves
fade, beside the values.
"""

import numpy as np
import pytest

from metalens import rcwa
from metalens.cell import Cell, Film, Index
from metalens.cell.shapes import Ellipse, Polygon
from metalens.rcwa.derivative import film_layer
from metalens.rcwa.orders import basis
from metalens.rcwa.orders.waves import waves

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


@pytest.mark.parametrize(
    ("angle_rad", "polarization"), [(0.0, "x"), (0.2, "s"), (0.2, "p")]
)
def test_round_pillars_between_films_in_which_waves_fade_have_the_t_of_solve(
    angle_rad, polarization
):
    """And its differences by the thickness of nothing but the pillar: 1e-5 um, of
    fourth order.
    """
    about = {"angle_rad": angle_rad, "polarization": polarization, "harmonics": 3}
    cell = Cell(0.41, **THICK, **ABOUT)
    found = rcwa.derivatives(cell, SIZE, WAVE, **about)
    assert found.t == pytest.approx(rcwa.solve(cell, SIZE, WAVE, **about).t, abs=1e-11)

    def at(height_um):
        return rcwa.solve(
            Cell(0.41, **THICK, **(ABOUT | {"height_um": height_um})),
            SIZE,
            WAVE,
            **about,
        ).t

    ends = [at(0.53 + k * 1e-4) - at(0.53 - k * 1e-4) for k in (1, 2)]
    assert found.height_um == pytest.approx((8 * ends[0] - ends[1]) / 12e-4, rel=1e-6)


def test_waves_of_a_film_stand_by_how_long_they_live_and_keep_its_operators():
    """P V = W q and Q W = V q, column by column, in the order of fading."""
    ways = waves(
        basis.basis(2, "none"),
        pitch_um=0.41,
        wavelength_um=WAVE,
        kx=0.15,
        ky=0.07,
        azimuth_rad=0.4,
    )
    for index in (1.6, 1.9 + 0.1j):
        film = film_layer(ways, index)
        assert (np.diff(film.q.imag) >= 0).all()
        assert (
            np.abs(film.P @ film.V - film.W * film.q).max() < 1e-12
        )  # of 3.6, to rounding
        assert np.abs(film.Q @ film.W - film.V * film.q).max() < 1e-12
        assert film.symmetric
