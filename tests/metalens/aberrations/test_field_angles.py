"""Distortion, vignetting and illumination by rays counted one at a time; refusals by
name.
"""

import functools
import math

import numpy as np
import pytest

from metalens.aberrations import frequencies_per_mm, over_field
from metalens.aberrations.angles import vignetted_share
from metalens.core.errors import PropagationError
from metalens.optics import Layers, Stop
from tests.metalens.aberrations.hyperbolic import CASES, PITCH, RADIUS, WAVE, made

ANGLES = (-14.0, 0.0, 9.0)


def _landing(case, angle):
    rays, depth = CASES[case]
    return rays.lands(rays.middle(angle, depth), angle, depth)


def _place(case, angle):
    """Of the source along x: um, or its tangent."""
    rays, depth = CASES[case]
    return (
        math.tan(math.radians(angle))
        if math.isinf(depth)
        else float(rays.source(angle, depth)[0])
    )


@functools.cache
def seen(case):
    depth = CASES[case][1]
    return over_field(made(case), ANGLES, depth_um=depth, frequencies=(41.0,))


@pytest.mark.parametrize(
    "case",
    [
        "plain",
        "off-centre",
        "glass",
        "stop",
        pytest.param("all", marks=pytest.mark.slow),
    ],
)
def test_distortion_is_by_how_much_a_traced_image_is_not_linear(case):
    """Landing places of traced rays over the line through those of ± 0.02 degrees."""
    ends = [(_landing(case, a), _place(case, a)) for a in (-0.02, 0.02)]
    line = (ends[1][0] - ends[0][0]) / (ends[1][1] - ends[0][1])
    for n, angle in enumerate(ANGLES):
        assert seen(case).chief_um[n] == pytest.approx(_landing(case, angle), abs=6e-4)
        if angle:
            linear = line * (_place(case, angle) - _place(case, 0.0))
            want = (_landing(case, angle) - _landing(case, 0.0)) @ linear / (
                linear @ linear
            ) - 1
            assert seen(case).distortion[n] == pytest.approx(want, abs=5e-5)
    assert seen(case).distortion[1] == 0.0
    if case == "plain":
        assert np.abs(seen(case).distortion).max() < 1e-5
    else:
        assert np.abs(seen(case).distortion).max() > 1e-3


def _counted(case, angle, step_um):
    """(all, on the pillars) rays through the stop's hole, by places of the pillars'
    plane.
    """
    rays, depth = CASES[case]
    middle, out = rays.middle(angle, depth), np.zeros(2)
    # about the middle of what the hole lights
    reach = np.arange(-60.0, 60.1, step_um) + 0.137
    for x in reach + middle[0]:
        for y in reach + middle[1]:
            u = rays.crossing((x, y), angle, depth)
            if math.hypot(*(u - rays.stop[2])) <= rays.stop[0]:
                out += 1.0, float(math.hypot(x, y) <= RADIUS)
    return out


@pytest.mark.parametrize(
    ("case", "angle"), [("stop", -22.0), ("all", 24.0), ("beside", 21.0)]
)
def test_vignetting_is_the_share_of_counted_rays_that_miss_the_pillars(case, angle):
    """800 to 1300 rays: the border of either circle is 1 % of them, and the grid cuts
    it at random.
    """
    through, on = _counted(case, angle, 1.8)
    got = vignetted_share(made(case), (math.radians(angle), 0.0), CASES[case][1])
    assert got == pytest.approx(1 - on / through, abs=0.008)
    assert got > 0.04


def test_without_a_stop_nothing_is_vignetted():
    assert seen("plain").vignetting.tolist() == [0.0, 0.0, 0.0]
    assert seen("stop").vignetting[1] == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("case", ["plain", "off-centre", "glass", "stop"])
def test_illumination_is_light_by_light_of_an_even_plane(case):
    """Light of a square of the plane on every eleventh (third) pillar, cos⁴ / z² each,
    over the area of its image.

    An element of a plane at infinity: cos⁴ of its angle. The pillars' own angles count
    here, which differ over the
    aperture by (62 / 1900)²; faces of the glass behind are as Fresnel has them, 0.2 %
    at 14 degrees.
    """
    rays, depth = CASES[case]
    level = made(case).diameters
    # the border of the stop's light is cut at random: 0.15 % of it
    each = 3 if rays.stop else 11
    place = [
        (x, y)
        for x in level.x_um[1::each]
        for y in level.y_um[1::each]
        if math.hypot(x, y) <= RADIUS
    ]

    def irradiance(angle):
        if math.isinf(depth):
            steep = math.cos(math.radians(angle)) ** 4
            light = sum(steep for x in place if rays.stop is None or
                        math.hypot(*rays.crossing(x, angle, depth)) <= rays.stop[0])  # fmt: skip
        else:
            sx, sy = rays.source(angle, depth)
            light = sum(
                (depth**2 / (depth**2 + (x - sx) ** 2 + (y - sy) ** 2)) ** 2
                for x, y in place
            )
        near = [
            (_landing(case, a), _place(case, a)) for a in (angle - 0.02, angle + 0.02)
        ]
        along = math.hypot(*(near[1][0] - near[0][0])) / abs(near[1][1] - near[0][1])
        return light / (along * _across(case, angle))

    for n in (0, 2):
        want = irradiance(ANGLES[n]) / irradiance(0.0)
        assert seen(case).illumination[n] == pytest.approx(want, abs=0.004)
    assert seen(case).illumination[1] == pytest.approx(1.0, rel=1e-6)


def _across(case, angle):
    """Growth of the image across the field: of a source moved by a small turn of the
    field about the axis, or, of a
    lens that is not round about the axis, by tracing a source beside."""
    rays, depth = CASES[case]
    x, aside = rays.middle(angle, depth), 1e-3
    if math.isinf(depth):
        tangent = math.tan(math.radians(angle))
        p = np.array([tangent, aside]) / math.sqrt(1 + tangent**2 + aside**2)
    if rays.stop:  # round about the axis: the image turns with the source
        ratio = _landing(case, angle or 0.01)[0] / _place(case, angle or 0.01)
        return abs(ratio)
    if math.isinf(depth):
        out = p + rays.slope(x)
    else:
        away = x - rays.source(angle, depth) - (0.0, aside * depth)
        out = away / math.sqrt(away @ away + depth**2) + rays.slope(x)
    gap = [(1.0, rays.sensor_um - sum(t for _, t in rays.behind)), *rays.behind]
    moved = x + sum(t * out / math.sqrt(n * n - out @ out) for n, t in gap)
    return math.hypot(*(moved - _landing(case, angle))) / (
        aside if math.isinf(depth) else aside * depth
    )


def test_angles_of_either_sign_are_mirrored_by_a_centred_lens_alone():
    both = {
        case: over_field(made(case), (-8.0, 8.0), depth_um=CASES[case][1])
        for case in ("stop", "off-centre")
    }
    centred, aside = both["stop"], both["off-centre"]
    for name in ("distortion", "close_um", "illumination", "vignetting", "mtf"):
        first, last = getattr(centred, name)
        assert last == pytest.approx(first, rel=1e-3, abs=2e-3)
    assert abs(aside.distortion[1] - aside.distortion[0]) > 1e-3
    assert abs(aside.close_um[1, 0] - aside.close_um[0, 0]) > 1.0


def test_what_has_no_chief_ray_has_its_mtf_and_says_so():
    found = over_field(made("plain", turns=1), (0.0, 6.0))
    assert np.isnan(found.distortion).all()
    assert np.isnan(found.close_um).all()
    assert np.isnan(found.illumination).all()
    assert "no wave front" in found.left_out[0]
    assert len(found.left_out) == 2
    assert np.isfinite(found.mtf).all()
    assert np.isfinite(found.vignetting).all()


def test_frequencies_left_out_are_shares_of_the_cutoff():
    lens = made("plain")
    assert np.array(frequencies_per_mm(lens)) == pytest.approx(
        np.array([1, 2, 4]) / 8 * 2e3 * 0.2 / WAVE, rel=0.03
    )
    assert over_field(lens, (3.0,)).frequencies_per_mm.tolist() == list(
        frequencies_per_mm(lens)
    )


@pytest.mark.parametrize(
    ("changes", "named"),
    [({"angles_deg": ()}, "angles_deg"), ({"angles_deg": (3.0, 85.0)}, "between -85 and 85"),
     ({"angles_deg": (math.nan,)}, "between -85 and 85"), ({"frequencies": (50.0, 0.0)}, "all above 0"),
     ({"frequencies": ()}, "one or more"), ({"depth_um": -3.0}, "depth of the sources"),
     ({"depth_um": math.nan}, "depth of the sources")],
)  # fmt: skip
def test_impossible_wishes_are_refused_by_name(changes, named):
    with pytest.raises(PropagationError, match=named):
        over_field(made("plain"), **({"angles_deg": (0.0,)} | changes))


def test_sources_behind_the_stop_are_refused():
    lens = made("stop")
    with pytest.raises(PropagationError, match="lies behind the stop"):
        over_field(lens, (0.0,), depth_um=130.0)
    assert isinstance(lens.layers, Layers)
    assert lens.layers.stop == Stop(35.0, 130.0)
    assert lens.diameters.pitch_um == PITCH
