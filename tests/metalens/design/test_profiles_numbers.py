"""Phases of lenses at sites off both axes, by distances between points."""

import math

import numpy as np
import pytest
from scipy.optimize import brentq

from metalens.cell import Film, Index
from metalens.design import profiles
from metalens.design.profiles import Cubic, DoubleHelix, Focus, PhaseMap
from metalens.ground.errors import ConfigError, LensError
from metalens.lens import Layers

X, Y = np.array([30.0, -120.0, 7.5]), np.array([-45.0, 20.0, 160.0])
NEAR, FAR, WAVE = 700.0, 2300.0, 0.85


def away(z, x0=0.0):
    """Distance from (x0, 0) in a plane at z to every site, less that to the middle."""
    return np.sqrt((X - x0) ** 2 + Y**2 + z**2) - math.hypot(x0, z)


def test_a_path_is_that_on_both_sides_and_its_phase_is_taken_off():
    both, one = Focus(WAVE, NEAR, FAR), Focus(WAVE, NEAR)
    assert both.path_um(X**2 + Y**2) == pytest.approx(
        away(NEAR) + away(FAR), rel=1e-11
    )  # digits of the distances
    assert one.path_um(X**2 + Y**2) == pytest.approx(away(NEAR), rel=1e-11)
    want = -2 * math.pi / WAVE * (away(NEAR) + away(FAR))
    assert profiles.hyperbolic(X, Y, both) == pytest.approx(want, rel=1e-11)
    assert one.aperture(250.0) == pytest.approx(250 / math.hypot(250, NEAR))


@pytest.mark.parametrize("far", [FAR, math.inf])
def test_paths_of_a_field_angle_come_from_one_side_and_go_to_the_other(far):
    """Light that travels towards +x: from a source at -x, to a sensor point at +x."""
    sensor, source = Focus(WAVE, NEAR, far).paths_from(X, Y, 0.31)
    sine = 0.31 / math.hypot(1, 0.31)
    assert sensor == pytest.approx(away(NEAR, 0.31 * NEAR), rel=1e-10)
    assert source == pytest.approx(
        away(FAR, -0.31 * FAR) if far == FAR else X * sine, rel=1e-10
    )


@pytest.mark.parametrize("exponent", [0.5, 0.8])
def test_rings_of_a_double_helix_end_where_their_power_says(exponent):
    """Ring l of 3 ends at R (l / 3)^e and winds 2 l - 1 times; beyond the rim goes on
    the last.
    """
    shape, focus = DoubleHelix(3, exponent), Focus(WAVE, NEAR)
    ends = 200.0 * (np.arange(1, 4) / 3) ** exponent
    radius = np.array(
        [
            0.99 * ends[0],
            1.01 * ends[0],
            0.99 * ends[1],
            1.01 * ends[1],
            0.99 * ends[2],
            1.2 * ends[2],
        ]
    )
    x, y = radius * math.cos(2.1), radius * math.sin(2.1)
    turns = (
        profiles.double_helix(x, y, focus, shape, radius_um=200.0)
        - profiles.hyperbolic(x, y, focus)
    ) / 2.1
    assert turns == pytest.approx([1, 3, 3, 5, 5, 5], rel=1e-9)
    middle = profiles.double_helix(
        np.zeros(1), np.zeros(1), focus, shape, radius_um=200.0
    )
    assert middle == pytest.approx(0, abs=1e-12)
    below = profiles.double_helix(x[:1], -y[:1], focus, shape, radius_um=200.0)
    assert below - profiles.hyperbolic(x[:1], y[:1], focus) == pytest.approx([-2.1])


def test_a_cubic_phase_is_the_sum_of_both_cubes():
    focus = Focus(WAVE, NEAR)
    found = profiles.cubic(
        X, Y, focus, Cubic(37.0), radius_um=180.0
    ) - profiles.hyperbolic(X, Y, focus)
    assert found == pytest.approx(37.0 * (X**3 + Y**3) / 180.0**3, abs=1e-9)
    assert Cubic().strength_rad == 60.0


@pytest.mark.parametrize("wrong", [{"zones": 0}, {"exponent": 0.0}, {"exponent": -1.0}])
def test_a_helix_without_rings_is_refused(wrong):
    with pytest.raises(ConfigError, match="need both above 0"):
        DoubleHelix(**wrong)


def test_lengths_of_nothing_are_refused(tmp_path):
    for wrong in ((0.0, NEAR, FAR), (WAVE, 0.0, FAR), (WAVE, NEAR, 0.0)):
        with pytest.raises(LensError, match="need a length above 0"):
            Focus(*wrong)
    with pytest.raises(ConfigError, match="pitch_um = 0"):
        PhaseMap(tmp_path / "a.npy", pitch_um=0.0)


def films(index):
    """40 um on the source's side and 90 um on the sensor's, of an index; air beside
    them.
    """
    return Layers(front=(Film(Index(index), 40.0),), behind=(Film(Index(index), 90.0),))


def slowed(thickness, z, index, radius):
    """Path through a film and air to a point at z on the axis, by Snell's law, less
    that along the axis.
    """

    def missed(sine):
        return (
            thickness * sine / math.sqrt(index**2 - sine**2)
            + (z - thickness) * sine / math.sqrt(1 - sine**2)
            - radius
        )

    sine = brentq(missed, 0, 0.999, xtol=1e-14)
    film, air = (n / math.sqrt(1 - (sine / n) ** 2) for n in (index, 1.0))
    return thickness * (film - index) + (z - thickness) * (air - 1)


def test_films_of_air_change_nothing_and_others_bend_every_ray():
    plain, through = Focus(WAVE, NEAR, FAR), Focus(WAVE, NEAR, FAR, films(1.0))
    assert through.path_um(X**2 + Y**2) == pytest.approx(
        plain.path_um(X**2 + Y**2), rel=1e-9
    )
    assert through.aperture(250.0) == pytest.approx(plain.aperture(250.0), rel=1e-9)
    for far in (FAR, math.inf):
        pairs = (
            Focus(WAVE, NEAR, far, layers).paths_from(X, Y, 0.31)
            for layers in (films(1.0), Layers())
        )
        for found, want in zip(*pairs, strict=True):
            assert found == pytest.approx(want, rel=1e-9)
    radius = np.hypot(X, Y)
    want = [
        slowed(90.0, NEAR, 1.5, r) + slowed(40.0, FAR, 1.5, r) for r in radius.tolist()
    ]
    assert Focus(WAVE, NEAR, FAR, films(1.5)).path_um(radius**2) == pytest.approx(
        want, rel=1e-9
    )
