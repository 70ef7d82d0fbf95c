"""Cones of rays that arrive in another medium than air: sines and obliquities as a
sensor under glass sees them.
"""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import optimize

from metalens.cell import Film, Index
from metalens.optics import Layers, Media
from metalens.propagate import PropagationCase
from metalens.psf import lens_psfs, vector

# a filter on the pillars, a gel to the sensor
EDGE, DISTANCE, FILM, GLASS, GEL = (200.2, 700.0, 210.0, 1.52, 1.37)


def lens():
    return SimpleNamespace(
        layers=Layers(behind=(Film(Index(GLASS), FILM),), cover=Index(GEL)),
        sensor_distance_um=DISTANCE,
        wavelength_um=0.85,
        diameters=SimpleNamespace(radius_um=200.0, pitch_um=0.4),
        proxy=SimpleNamespace(max_angle_rad=0.0),
    )


def order():
    """Indices behind the pillars, the medium at the sensor last, with their
    thicknesses.
    """
    media = lens().layers.after(DISTANCE, 0.85)
    return list(zip(media.index, media.thickness_um, strict=True))


def reach(p):
    """Lateral distance of the ray with n sin θ = p, by Snell's law."""
    return sum(t * math.tan(math.asin(p / n)) for n, t in order())


def sine(distance):
    """Of the ray that reaches so far, at the sensor."""
    p = optimize.brentq(lambda p: reach(p) - abs(distance), 0, 1.3, xtol=1e-14)
    return math.copysign(p, distance) / order()[-1][0]


def test_the_medium_at_the_sensor_is_the_last():
    assert {n: t for n, t in order() if t > 0} == {GLASS: FILM, GEL: DISTANCE - FILM}


@pytest.mark.parametrize("angle", [(0.0, 0.0), (0.3, 0.0), (0.2, -0.15)])
def test_the_aperture_is_that_of_the_medium_at_the_sensor(angle):
    slope = math.hypot(math.tan(angle[0]), math.tan(angle[1]))
    centre = reach(math.sin(math.atan(slope)))
    want = (sine(centre + EDGE) - sine(centre - EDGE)) / 2
    assert lens_psfs.sine_aperture(lens(), angle) == pytest.approx(want, rel=1e-9)


def test_obliquity_is_that_of_the_medium_at_the_sensor():
    """Over rings of equal area seen from the axis: standard deviation over mean of 1 /
    cos θ.
    """
    steep = [
        1 / math.sqrt(1 - sine(EDGE * math.sqrt((i + 0.5) / 400)) ** 2)
        for i in range(400)
    ]
    assert lens_psfs.obliquity_variation(lens(), (0.0, 0.0)) == pytest.approx(
        np.std(steep) / np.mean(steep), rel=1e-4
    )


def snell(pairs, far):
    """n sin θ of the ray that reaches so far through media (index, thickness)."""
    return optimize.brentq(
        lambda p: sum(t * p / math.sqrt(n * n - p * p) for n, t in pairs) - far,
        0,
        0.999,
        xtol=1e-15,
    )


@pytest.mark.parametrize(
    "behind", [None, Media((GEL,), (62.0,)), Media((GEL, GLASS), (40.0, 22.0))]
)
def test_rays_to_the_window_have_the_directions_of_the_last_medium(behind):
    """Straight in one medium, whatever its index; through two by Snell's law."""
    case = PropagationCase(
        (30, 41),
        0.37,
        0.85,
        62.0,
        (0.0, 0.0),
        (1 / 400,),
        (14.0, -8.5),
        0.6,
        (3, 3),
        behind=behind,
    )
    y, x = np.array([-11.0, 3.0]), np.array([-7.0, 0.5, 20.0])
    got = vector.rays_to(case, (y, x)).numpy()
    pairs = (
        [(1.0, 62.0)]
        if behind is None
        else list(zip(behind.index, behind.thickness_um, strict=True))
    )
    last = pairs[-1][0]
    for i, j in np.ndindex(2, 3):
        away = np.array([14.0 - x[j], -8.5 - y[i]])
        far = math.hypot(*away)
        p = snell(pairs, far)
        want = [*(away / far * p / last), math.sqrt(1 - (p / last) ** 2)]
        assert got[:, i, j] == pytest.approx(want, rel=1e-9)


def test_light_behind_a_face_is_parted_into_s_and_p_by_what_passes():
    """Fresnel's powers of both: their shares of the sum, times the light; halves in one
    medium. Waves about the ray add
    1/(kL), 2e-3, of which a few percent are not common to both."""
    case = PropagationCase(
        (30, 41), 0.37, 0.85, 62.0, (0.0, 0.0), (1 / 400,), (14.0, -8.5), 0.6, (3, 3)
    )
    y, x = np.array([-41.0, 3.0]), np.array([-27.0, 0.5, 30.0])
    signs, alone = vector.s_and_p(case)(y, x)
    assert signs.tolist() == [1, 1]
    assert alone.shape == (2, 1, 2, 3)
    assert alone == pytest.approx(np.full((2, 1, 2, 3), math.sqrt(0.5)))
    films = replace(case, behind=Media((GEL, GLASS), (40.0, 22.0)))
    _, both = vector.s_and_p(films)(y, x)
    for i, j in np.ndindex(2, 3):
        p = snell([(GEL, 40.0), (GLASS, 22.0)], math.hypot(14.0 - x[j], -8.5 - y[i]))
        one, two = math.asin(p / GEL), math.asin(p / GLASS)
        ahead = math.sin(2 * one) * math.sin(2 * two) / math.sin(one + two) ** 2
        powers = np.array([ahead, ahead / math.cos(one - two) ** 2])
        assert np.abs(both[:, 0, i, j]) ** 2 == pytest.approx(
            powers / powers.sum(), abs=2e-4
        )
