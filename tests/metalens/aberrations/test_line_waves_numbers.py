"""Plane waves and line images of few waves, summed over places, and a lens's waves as
sums over pillars.
"""

import dataclasses
import math

import numpy as np
import pytest

from metalens.aberrations.waves import (
    Waves,
    line_image,
    sharpness_per_um,
    transfer,
    waves,
)
from metalens.lens import Media
from metalens.lens import media as through
from tests.metalens.aberrations.hyperbolic import CASES, PITCH, WAVE, made

rng = np.random.default_rng(9)
K = 2 * math.pi / WAVE
AFTER = Media((1.0, 1.6), (70.0, 25.0))


def few():
    """Five by three waves about (0.11, -0.07), unlike spacings."""
    dx, dy = 0.013, 0.021
    p_x, p_y = 0.11 + dx * np.arange(-2, 3), -0.07 + dy * np.arange(-1, 2)
    amplitude = rng.normal(size=(3, 5)) + 1j * rng.normal(size=(3, 5))
    light = 1.7 * float((np.abs(amplitude) ** 2).sum())
    return Waves(amplitude, p_x, p_y, (dx, dy), light, 3.0, (0.02, 0.03), WAVE, AFTER)


def test_held_is_the_share_of_the_light_in_the_waves():
    assert few().held == pytest.approx(1 / 1.7, rel=1e-12)


def test_waves_at_a_distance_keep_the_films_and_change_the_gap():
    """exp(ik [z √(1 - p²) + 25 √(1.6² - p²)]), z what is left of the distance; farther
    by a step, in air alone.
    """
    made_ = few()
    w = made_.p_x**2 + made_.p_y[:, None] ** 2
    for distance in (95.0, 60.0, 143.0):
        way = (distance - 25.0) * np.sqrt(1 - w) + 25.0 * np.sqrt(1.6**2 - w)
        assert made_.at(distance) == pytest.approx(
            made_.amplitude * np.exp(1j * K * way), rel=1e-9
        )
    ones = np.full_like(made_.amplitude, 2.0 - 1j)
    assert made_.at(7.5, ones) == pytest.approx(
        (2 - 1j) * np.exp(7.5j * K * np.sqrt(1 - w)), rel=1e-9
    )
    assert made_.at(95.0 + 7.5) == pytest.approx(
        made_.at(7.5, made_.at(95.0)), rel=1e-9
    )


@pytest.mark.parametrize("axis", [0, 1])
def test_a_line_image_is_the_light_along_a_line_across_its_axis(axis):
    """|Σ A exp(ik p X)|² over a period of the other axis, at its samples; of sum 1
    where all is there.
    """
    made_ = few()
    field = made_.at(110.0)
    line, step = line_image(made_, field, axis)
    own, other = (made_.p_x, made_.p_y) if axis == 0 else (made_.p_y, made_.p_x)
    spread = made_.spacing[axis], made_.spacing[1 - axis]
    assert step * len(line) == pytest.approx(WAVE / spread[0], rel=1e-12)
    assert len(line) >= 2 * len(own)
    x, y = np.arange(len(line)) * step, np.arange(16) * (WAVE / spread[1] / 16)
    a = field if axis == 0 else field.T
    u = np.exp(1j * K * np.outer(y, other)) @ a @ np.exp(1j * K * np.outer(own, x))
    want = (np.abs(u) ** 2).mean(0) / made_.light / len(line)
    assert line == pytest.approx(want, rel=1e-9)
    assert line.sum() == pytest.approx(made_.held, rel=1e-9)
    # sharpness: of the continuous line, whose squares the samples hold exactly
    fine = np.arange(997) * (WAVE / spread[0] / 997)
    u = np.exp(1j * K * np.outer(y, other)) @ a @ np.exp(1j * K * np.outer(own, fine))
    smooth = (np.abs(u) ** 2).mean(0)
    assert sharpness_per_um(made_, field, axis) == pytest.approx(
        (smooth**2).sum() / smooth.sum() ** 2 / (fine[1] - fine[0]), rel=1e-9
    )


@pytest.mark.parametrize("axis", [0, 1])
def test_transfer_is_the_autocorrelation_of_the_waves(axis):
    """At multiples of their spacing over the wavelength; of all light."""
    made_ = few()
    field = made_.at(80.0)
    a = field if axis == 0 else field.T
    step = made_.spacing[axis] / WAVE
    got = transfer(
        made_, field, axis, np.array([0.0, step, 2 * step, a.shape[1] * step])
    )
    want = [
        abs((a[:, k:] * a[:, : a.shape[1] - k].conj()).sum()) / made_.light
        for k in range(3)
    ]
    assert got[:3] == pytest.approx(want, rel=1e-9)
    assert got[3] < 1e-9
    assert got[0] == pytest.approx(made_.held, rel=1e-9)


@pytest.mark.parametrize("case", ["off-centre", "glass"])
def test_amplitudes_of_a_lens_are_sums_over_its_pillars(case):
    """√T Σ t exp(ik source path - ik p x), x from the first pillar: at waves from all
    over, of light along both axes;
    light and its share of an evenly lit lens, by what the faces let through in the
    middle of the directions."""
    lens, (rays, depth) = made(case), CASES[case]
    angle = (math.radians(6.0), math.radians(-4.0))
    found = waves(lens, angle, depth)
    d = lens.diameters
    x, y = np.meshgrid(d.x_um, d.y_um)
    t = lens.transmission() * np.exp(1j * lens.phase_rad()) * (d.diameter_um > 0)
    tangents = np.tan(angle)
    if math.isinf(depth):
        p = tangents / math.sqrt(1 + tangents @ tangents)
        way = p[0] * x + p[1] * y
    else:
        source = -depth * tangents
        way = np.sqrt((x - source[0]) ** 2 + (y - source[1]) ** 2 + depth**2)
    t = t * np.exp(1j * K * way)
    order = (1.0, *(n for n, _ in rays.behind))
    rows, columns = (
        np.linspace(3, n - 4, 5).astype(int) for n in found.amplitude.shape
    )
    whole = np.abs(found.amplitude).max()
    own = np.zeros((5, 5), complex)
    for i, row in enumerate(rows):
        for k, column in enumerate(columns):
            a, b = found.p_x[column], found.p_y[row]
            share = (
                1.0
                if len(order) == 1
                else float(through.passed_at(order, a * a + b * b))
            )
            own[i, k] = (
                math.sqrt(share)
                * (t * np.exp(-1j * K * (a * (x - x[0, 0]) + b * (y - y[0, 0])))).sum()
            )
    got = found.amplitude[np.ix_(rows, columns)]
    turn = np.vdot(own, got) / abs(np.vdot(own, got))
    assert got / whole == pytest.approx(
        own * turn / whole, abs=1e-5
    )  # to a phase common to all
    assert np.diff(found.p_x) == pytest.approx(
        np.full(len(found.p_x) - 1, found.spacing[0]), rel=1e-9
    )
    power = float((np.abs(t) ** 2).sum())
    ends = [found.aperture, (found.p_x.mean(), found.p_y.mean())]
    middle = ends[1][0] ** 2 + ends[1][1] ** 2
    faces = 1.0 if len(order) == 1 else float(through.passed_at(order, middle))
    assert found.passed_um2 == pytest.approx(power * PITCH**2 * faces, rel=1e-4)
    period = [WAVE / s / PITCH for s in found.spacing]
    assert found.light == pytest.approx(power * faces * period[0] * period[1], rel=1e-4)


def test_waves_reach_a_twentieth_beyond_the_rays_and_the_field_repeats_after_eighty_lines():
    """A lens of sine 0.196 at its rim: 80 · 0.85 / 0.196 = 347 um, more than 1.05 maps;
    1.05 · 0.196 and 14 fringes of
    the map, 0.85 / 124 each, on either side of the middle of the directions."""
    lens = made("plain")
    found = waves(lens, (0.0, 0.0), math.inf)
    sine = math.sin(math.atan(62.0 / 310.0))
    assert found.aperture == pytest.approx(
        (sine, sine), rel=0.02
    )  # pieces of a 48th of the map: half of one
    count = len(lens.diameters.x_um)
    for p, spacing, wide in zip(
        (found.p_x, found.p_y), found.spacing, found.aperture, strict=True
    ):
        period = WAVE / spacing
        assert (
            80 * WAVE / wide <= period < 1.03 * 80 * WAVE / wide
        )  # a length that factorises
        reach = 1.05 * wide + 14 * WAVE / (count * PITCH)
        assert reach - 1e-9 <= (p[-1] - p[0]) / 2 < reach + spacing
        assert p[0] == pytest.approx(-p[-1], abs=2.1 * spacing)
    aside = waves(lens, (0.2, -0.1), math.inf)
    at = np.tan([0.2, -0.1]) / math.sqrt(1 + np.tan(0.2) ** 2 + np.tan(0.1) ** 2)
    assert (aside.p_x.mean(), aside.p_y.mean()) == pytest.approx(tuple(at), abs=0.005)


def test_slow_lenses_have_a_field_of_eight_maps_at_most():
    """310 um of focal length become 30 mm: 80 λ / NA = 17 mm, of a map of 124 um."""
    place = made("plain").diameters
    lens = made("plain")
    d = np.where(place.diameter_um > 0, 0.2, 0.0)
    flat = dataclasses.replace(lens, diameters=type(place)(d, PITCH))
    found = waves(flat, (0.05, 0.0), math.inf)
    width = len(place.x_um) * PITCH
    for spacing in found.spacing:
        assert 8 * width <= WAVE / spacing < 1.03 * 8 * width
    assert found.held > 0.9
