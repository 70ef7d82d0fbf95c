"""Distortion, brightness, vignetting and the scan for the sharpest line by hand; shares
of the cut-off.
"""

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest

from metalens.aberrations import angles, frequencies_per_mm
from metalens.aberrations.angles import vignetting
from metalens.lens import Layers, Stop
from tests.metalens.aberrations.hyperbolic import RADIUS, made


def test_frequencies_are_an_eighth_a_quarter_and_a_half_of_the_cut_off():
    """2 NA / λ, paraxial: 2 · 62 / 310 / 0.85 = 471 per mm: 58.8, 117.6 and 235.3;
    through 90 um of 1.51 and 30 of 1.38
    the lens is 190 + 59.6 + 21.7 = 271.3 um away: 67.2, 134 and 269."""
    assert frequencies_per_mm(made("plain")) == (59.0, 120.0, 240.0)
    assert frequencies_per_mm(made("glass")) == (67.0, 130.0, 270.0)


def ray(meets, source, moves):
    return SimpleNamespace(
        meets_um=np.array(meets), source=np.array(source), moves=np.array(moves)
    )


def test_distortion_is_along_the_linear_image():
    """A source 2 and -1 aside moves by M s = (6, -4) in first order, and lands (6.6,
    -4.1) away, 56 of 52 along it.
    """
    origin = ray([3.0, 5.0], [0.5, 0.25], [[4.0, 2.0], [-1.0, 2.0]])
    there = ray([9.6, 0.9], [2.5, -0.75], np.eye(2))
    along = (6.6 * 6 + 4.1 * 4) / (36 + 16)
    assert angles._distortion(origin, there) == pytest.approx(along - 1, rel=1e-12)
    assert angles._distortion(origin, origin) == 0.0
    assert math.isnan(angles._distortion(None, there))
    assert math.isnan(angles._distortion(origin, None))


@pytest.mark.parametrize("angle", [-17.0, 11.0])
def test_brightness_is_light_of_a_piece_over_its_image(angle):
    """cos⁴ over |det M| of sources at infinity; of a plane at 1900 um cos⁴ / 1900²."""
    chief = ray([0, 0], [0, 0], [[280.0, 11.0], [-7.0, 340.0]])
    cosine, size = math.cos(math.radians(angle)), 280.0 * 340.0 + 77.0
    got = angles._brightness(made("plain"), angle, math.inf, chief)
    assert got == pytest.approx(cosine**4 / size, rel=1e-9)
    near = angles._brightness(made("plain"), angle, 1900.0, chief)
    assert near == pytest.approx(cosine**4 / 1900.0**2 / size, rel=1e-9)
    mirrored = ray([0, 0], [0, 0], [[-280.0, 11.0], [7.0, 340.0]])
    assert angles._brightness(
        made("plain"), angle, math.inf, mirrored
    ) == pytest.approx(cosine**4 / (280.0 * 340.0 + 77.0), rel=1e-9)


def common(r, big, apart):
    """Area common to circles of two radii."""
    if apart <= big - r:
        return math.pi * r * r
    a = (apart**2 + r * r - big * big) / (2 * apart * r)
    b = (apart**2 + big * big - r * r) / (2 * apart * big)
    kite = (
        math.sqrt(
            (-apart + r + big)
            * (apart + r - big)
            * (apart - r + big)
            * (apart + r + big)
        )
        / 2
    )
    return r * r * math.acos(a) + big * big * math.acos(b) - kite


@pytest.mark.parametrize(
    ("angle", "depth"),
    [
        ((0.31, 0.12), math.inf),
        ((-0.22, -0.35), 1100.0),
        ((0.0, 0.45), 700.0),
        ((0.05, 0.0), 1100.0),
    ],
)
def test_vignetting_is_what_circles_do_not_share(angle, depth):
    """A hole of 35 um 130 um before the pillars, in air: from z it lights 35 z / (z -
    130) about t z 130 / (z - 130).
    Sites of 0.42 um at the rim of the lens: 1e-3 of its area."""
    lens = dataclasses.replace(made("plain"), layers=Layers(stop=Stop(35.0, 130.0)))
    grown = 1.0 if math.isinf(depth) else depth / (depth - 130.0)
    apart = 130.0 * grown * math.hypot(*np.tan(angle))
    want = 1 - common(35.0 * grown, RADIUS, apart) / (math.pi * (35.0 * grown) ** 2)
    assert vignetting(lens, angle, depth) == pytest.approx(want, abs=2e-3)
    if angle == (0.05, 0.0):
        assert vignetting(lens, angle, depth) == pytest.approx(0.0, abs=3e-4)


def test_a_scan_is_settled_between_its_neighbours_and_has_no_best_at_an_end(
    monkeypatch,
):
    """A parabola about 12.37 along x and 30.9 along y, looked at in steps of 2."""
    tops = {0: 12.37, 1: 30.9}
    monkeypatch.setattr(
        angles,
        "sharpness_per_um",
        lambda light, field, axis: 5 - (field - tops[axis]) ** 2 * 1e-3,
    )
    light = SimpleNamespace(at=lambda z: z)
    places = np.arange(0.0, 40.0, 2.0)
    for axis, top in tops.items():
        sharp = 5 - (places - top) ** 2 * 1e-3
        assert angles._settled(light, places, sharp, axis, 1.0) == pytest.approx(
            top, abs=2e-3
        )
    for top in (-3.0, 41.0):
        assert math.isnan(
            angles._settled(light, places, -((places - top) ** 2), 0, 1.0)
        )


def scan(monkeypatch, lens, close, angle=0.0, aperture=(0.3, 0.2)):
    """Places that are looked at, of a light that tells them."""
    seen = []

    class Light:
        def __init__(self):
            self.aperture = aperture

        def at(self, z, like=None):
            return np.array([[z]]) if like is None else np.ones((1, 1))

    def sharp(light, field, axis):
        return 0.0

    def settled(light, places, found, axis, deep):
        seen.append((places, deep, axis, found.shape))
        return float(axis)

    monkeypatch.setattr(angles, "sharpness_per_um", sharp)
    monkeypatch.setattr(angles, "_settled", settled)
    out = angles._sharpest(lens, Light(), angle, np.array(close))
    assert out.tolist() == [0.0, 1.0]
    assert [one[2] for one in seen] == [0, 1]
    return seen[0]


def test_the_sharpest_line_is_looked_for_four_depths_of_focus_about_all_that_is_known(
    monkeypatch,
):
    """λ / NA² = 0.85 / 0.04 = 21.25 um, of the narrower side; about the sensor at 310,
    the foci 40 behind and 25 before
    it and 310 cos³ 0.3 = 270.3; two steps a depth of focus."""
    places, deep, _, shape = scan(monkeypatch, made("plain"), [40.0, -25.0], angle=0.3)
    assert deep == pytest.approx(21.25, rel=1e-9)
    assert places[0] == pytest.approx(310 * math.cos(0.3) ** 3 - 85.0, rel=1e-9)
    assert places[-1] == pytest.approx(350.0 + 85.0, rel=1e-9)
    assert len(places) == math.ceil((places[-1] - places[0]) / 21.25 * 2)
    assert shape == (len(places),)
    far, *_ = scan(
        monkeypatch, made("plain"), [1e4, math.nan]
    )  # foci beyond the lens's own distance are not looked for
    assert (far[0], far[-1]) == pytest.approx((310.0 - 85.0, 310.0 + 85.0), rel=1e-9)


def test_the_scan_ends_at_the_films_and_has_four_hundred_places_at_most(monkeypatch):
    """120 um of films: 120 + 0.05 · 190 = 129.5; of an aperture of 1e-6 no more than
    the same; a wide one is fine.
    """
    low, *_ = scan(monkeypatch, made("glass"), [-5.0, 5.0], aperture=(0.1, 0.08))
    assert low[0] == pytest.approx(129.5, rel=1e-9)
    assert low[-1] == pytest.approx(315.0 + 4 * 0.85 / 0.0064, rel=1e-9)
    coarse, deep, *_ = scan(monkeypatch, made("plain"), [0.0, 0.0], aperture=(0.0, 0.5))
    assert deep == pytest.approx(0.85e12, rel=1e-9)
    assert (
        len(coarse) == 9
    )  # two a depth of focus, four of these and the way from the films
    assert coarse[0] == pytest.approx(0.05 * 310.0, rel=1e-9)
    fine, *_ = scan(monkeypatch, made("plain"), [300.0, -300.0], aperture=(0.9, 0.95))
    assert len(fine) == 400
