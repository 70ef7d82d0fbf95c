"""How far rays may spread, how many there must be and how dark a focus may be: phases
on either side of each bound.
"""

import math

import numpy as np
import pytest

from metalens import design
from metalens.cell.record import Cell, Film, Index
from metalens.design import Focus, focusing, meeting_um
from metalens.lens import Layers
from metalens.pillars.proxy import Proxy

WAVE = 1.31
K, R = 2 * math.pi / WAVE, 130.0
ABOUT = {"radius_um": R, "pitch_um": 0.6}


def astigmatic(across_um, down_um):
    """Curvatures along x and y of a thin lens, of focal lengths in um."""
    return lambda x, y: -K * (x**2 / (2 * across_um) + y[:, None] ** 2 / (2 * down_um))


@pytest.mark.parametrize(
    ("share", "meets"),
    [(0.1, True), (0.19, True), (0.2, True), (0.21, False), (0.3, False)],
)
@pytest.mark.parametrize("sign", [1, -1])
def test_rays_of_two_curvatures_pass_closest_where_both_spread_alike(
    share, meets, sign
):
    """(1 ± e) / f: least squares at f / (1 + e²), e / √(1 + e²) of the lens wide, up to
    a fifth: e up to 0.2041.

    Of rays of slopes up to 0.02: 2e-4 of their cube."""
    found = meeting_um(
        astigmatic(6e3 / (1 + sign * share), 6e3 / (1 - sign * share)),
        Focus(WAVE, 900.0),
        **ABOUT,
    )
    if meets:
        assert found == pytest.approx(6e3 / (1 + share**2), rel=3e-4)
    else:
        assert found is None


@pytest.mark.parametrize("source", [math.inf, 9e3])
def test_rays_of_a_near_source_come_apart(source):
    """1 / z = 1 / f - 1 / source, wherever the sensor is said to be."""
    found = meeting_um(astigmatic(4e3, 4e3), Focus(WAVE, 700.0, source), **ABOUT)
    assert found == pytest.approx(1 / (1 / 4e3 - 1 / source), rel=5e-4)


def test_rays_that_part_or_are_parallel_meet_nowhere():
    assert meeting_um(astigmatic(-4e3, -4e3), Focus(WAVE, 700.0), **ABOUT) is None
    assert (
        meeting_um(astigmatic(math.inf, math.inf), Focus(WAVE, 700.0), **ABOUT) is None
    )
    weak = meeting_um(
        astigmatic(4e7, 4e7), Focus(WAVE, 700.0), **ABOUT
    )  # slopes of 3e-6
    assert weak == pytest.approx(4e7, rel=1e-4)


def opening(x, y):
    """A lens whose rays part: no focus."""
    return K * (x**2 + y[:, None] ** 2) / (2 * 900.0)


@pytest.mark.parametrize(("pitch", "few"), [(16.0, True), (15.4, False)])
def test_fewer_than_25_rays_tell_nothing(pitch, few):
    """On a radius of 20, 0.98764 · 40 / 25 = 1.58 apart: 21 lie within 4 um of the
    middle, 25 within 4.6.
    """
    about = {"radius_um": 20.0, "pitch_um": pitch}
    assert focusing.focuses(opening, Focus(WAVE, 900.0), **about) is few
    closing = meeting_um(lambda x, y: -opening(x, y), Focus(WAVE, 900.0), **about)
    assert closing is None if few else closing == pytest.approx(900.0, rel=1e-3)


def steep(share, p=1.05):
    """A lens of 900 um up to where the outer share of its area begins; there slopes of
    p, beyond 1: no ray leaves.
    """
    border = R * math.sqrt(1 - share)

    def phase(x, y):
        r = np.hypot(x, y[:, None])
        return np.where(r < border, -K * (np.hypot(r, 900.0) - 900.0), -p * K * r)

    return phase


@pytest.mark.parametrize(("share", "meets"), [(0.13, True), (0.28, False)])
def test_a_fifth_of_the_rays_may_be_lost(share, meets):
    """λ / 2 pitches = 1.09 is the steepest slope that a map tells."""
    assert focusing.focuses(steep(share), Focus(WAVE, 900.0), **ABOUT) is meets


def test_rays_through_glass_meet_where_snell_has_them():
    """A lens whose focus lies behind 600 um of index 1.5, as 600 / 1.5 = 400 um of air
    does: of slopes up to 0.14.
    """
    layers = Layers(behind=(Film(Index(1.5), 600.0),))
    focus = Focus(WAVE, 1300.0, layers=layers)
    for focal, meets in ((1100.0, True), (1100 / 0.78, False), (1100 / 1.25, False)):
        phase = lambda x, y, f=focal: -K * np.hypot(np.hypot(x, y[:, None]), f)  # noqa: E731
        assert focusing.focuses(phase, focus, **ABOUT) is meets
    assert meeting_um(lambda x, y: -opening(x, y), focus, **ABOUT) is None


def ringed(share):
    """A focus of which the outer share of the area is in antiphase."""
    border = R * math.sqrt(1 - share)

    def phase(x, y):
        r = np.hypot(x, y[:, None])
        return -K * (np.hypot(r, 900.0) - 900.0) + math.pi * (r > border)

    return phase


@pytest.mark.parametrize(
    ("share", "bright"), [(0.3, True), (0.45, True), (0.5, False), (0.55, True)]
)
def test_a_focus_whose_middle_is_dark_is_none(share, bright):
    """(1 - 2 share)² of the light of a perfect one: 0.16 and 0.01; near half less than
    1e-3. No ray of these
    lies on the border itself, where half a turn in a pitch is a slope."""
    assert focusing.focuses(ringed(share), Focus(WAVE, 900.0), **ABOUT) is bright


@pytest.mark.parametrize(
    ("v", "focus"), [(0.0, False), (0.8, False), (1.25, True), (-1.25, True)]
)
@pytest.mark.parametrize("axis", [0, 1])
def test_rays_that_meet_aside_are_not_asked_for_light_on_the_axis(v, focus, axis):
    """Three turns are dark in their middle, which lies v λ d / 2πR aside, on the axis
    up to 1: there it has
    (v³ / 120)² of the light, 2e-5 and 3e-4."""
    tilt = v / (K * R)

    def phase(x, y):
        x, y = np.meshgrid(x, y)
        lens = -K * (np.hypot(np.hypot(x, y), 900.0) - 900.0)
        return lens + 3 * np.arctan2(y, x) + K * tilt * (x, y)[axis]

    assert focusing.focuses(phase, Focus(WAVE, 900.0), **ABOUT) is focus


def test_pillars_beside_each_other_tell_the_slope_of_their_own_place():
    """A lens of 13 by 13 um whose focus lies aside along x alone: rows and columns are
    not each other's.
    """
    cell = Cell(pitch_um=0.6, pillar=Index(3.4), substrate=Index(1.45))
    proxy = Proxy(
        np.array([[0.0, 3 * np.pi]]),
        np.array([[1.0]]),
        (0.1, 0.5),
        (WAVE, WAVE),
        1e-6,
        1e-6,
    )
    for across, down, meets in (
        (60.0, 60.0, True),
        (60.0, 140.0, False),
        (140.0, 60.0, False),
    ):
        made, _ = design.make(
            astigmatic(across, down),
            Focus(WAVE, 60.0),
            aperture_um=26.0,
            cell=cell,
            proxy=proxy,
        )
        assert design.focused(made) is meets


@pytest.mark.parametrize(
    ("aside", "source"), [(0.0, math.inf), (23.0, math.inf), (-17.0, 240.0)]
)
def test_steep_rays_of_an_ideal_lens_meet_in_its_focus(aside, source):
    """Hyperbolic in 190 um, sines up to 0.6, its middle aside along y alone, of light
    from near by; the slope of the
    phase is its difference over a pitch: 0.6² / 24 of its third derivative, 1e-5 of the
    distance."""

    def phase(x, y):
        x, y = np.meshgrid(x, y)
        before = (
            np.hypot(np.hypot(x, y), source) - source if math.isfinite(source) else 0.0
        )
        return -K * (np.hypot(np.hypot(x, y - aside), 190.0) + before)

    assert meeting_um(phase, Focus(WAVE, 700.0, source), **ABOUT) == pytest.approx(
        190.0, rel=3e-5
    )


def test_rays_that_do_not_leave_are_left_out_where_the_others_meet():
    assert meeting_um(steep(0.13), Focus(WAVE, 900.0), **ABOUT) == pytest.approx(
        900.0, rel=1e-5
    )


def test_a_lens_is_looked_at_out_to_the_edges_of_its_pillars(monkeypatch):
    seen = []
    monkeypatch.setattr(
        focusing,
        "focuses",
        lambda phase, focus, **about: seen.append((focus, about)) or True,
    )
    cell = Cell(pitch_um=0.6, pillar=Index(3.4), substrate=Index(1.45))
    proxy = Proxy(
        np.array([[0.0, 3 * np.pi]]),
        np.array([[1.0]]),
        (0.1, 0.5),
        (WAVE, WAVE),
        1e-6,
        1e-6,
    )
    made, _ = design.make(
        astigmatic(60.0, 60.0),
        Focus(WAVE, 60.0, 1e3),
        aperture_um=12.0,
        cell=cell,
        proxy=proxy,
    )
    focusing.focused(made)
    focus, about = seen[0]
    assert (
        focus.wavelength_um,
        focus.sensor_distance_um,
        focus.source_distance_um,
    ) == (WAVE, 60.0, 1e3)
    farthest = np.hypot(*np.meshgrid(made.diameters.x_um, made.diameters.y_um))[
        made.diameters.diameter_um > 0
    ].max()
    assert about == {
        "radius_um": pytest.approx(farthest + 0.3, rel=1e-9),
        "pitch_um": 0.6,
    }
