"""Chief rays, and rays close to them, against rays traced one at a time through the
phase's closed form.
"""

import math

import numpy as np
import pytest

from metalens.aberrations import chief_ray
from metalens.core.errors import PropagationError
from metalens.optics import Stop
from tests.metalens.aberrations.hyperbolic import CASES, PITCH, WAVE, made

ANGLES = (0.0, 7.0, -16.0)
TURN = np.arange(8) * math.pi / 4
CIRCLE = np.stack([np.cos(TURN), np.sin(TURN)], -1)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("angle", ANGLES)
def test_it_lands_where_a_traced_ray_does(case, angle):
    """The slope of the phase is that of pillars about the ray: what a polynomial of
    fourth degree leaves of it.
    """
    rays, depth = CASES[case]
    found = chief_ray(made(case), (math.radians(angle), 0.0), depth)
    at = rays.middle(angle, depth)
    assert found.at_um == pytest.approx(at, abs=1e-6)
    # 2e-6 of the distance
    assert found.meets_um == pytest.approx(rays.lands(at, angle, depth), abs=6e-4)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("angle", ANGLES)
def test_close_rays_meet_where_traced_ones_spread_least(case, angle):
    """Eight rays a hundredth of a um about the chief ray; least sum of squares along x,
    along y, over the distance.

    The phase's sixth degree, which the polynomial lacks, moves the foci by a twentieth
    of a wavelength; a lens of this
    aperture is sharp over wavelength / NA² = 21 um.
    """
    rays, depth = CASES[case]
    found = chief_ray(made(case), (math.radians(angle), 0.0), depth)
    at = rays.middle(angle, depth)
    near, far = (
        np.array([rays.lands(at + 0.01 * c, angle, depth, z) for c in CIRCLE])
        for z in (250.0, 300.0)
    )
    near, far = near - near.mean(0), far - far.mean(0)
    rate = (far - near) / 50.0
    want = 250.0 - (near * rate).sum(0) / (rate**2).sum(0)
    assert found.focus_um == pytest.approx(want, abs=0.07 * WAVE)


@pytest.mark.parametrize("case", CASES)
def test_the_linear_image_is_the_change_of_traced_rays(case):
    rays, depth = CASES[case]
    found = chief_ray(made(case), (math.radians(7.0), 0.0), depth)
    ends = []
    for angle in (6.99, 7.01):
        ends.append((rays.lands(rays.middle(angle, depth), angle, depth), rays.source(angle, depth) if depth < 1e9 else
                     np.array([math.tan(math.radians(angle)), 0.0])))  # fmt: skip
    change = (ends[1][0] - ends[0][0]) / (ends[1][1] - ends[0][1])[0]
    assert found.moves[:, 0] == pytest.approx(
        change, rel=5e-5, abs=5e-5 * abs(change[0])
    )
    assert found.source == pytest.approx((ends[0][1] + ends[1][1]) / 2, rel=1e-5)


def test_foci_of_scattered_phases_differ_by_their_error():
    """0.2 rad of every pillar, 40 draws: over its stated error the change of a focus
    has an rms of 1; that of 80 such
    numbers is known within 8 %. No scatter, no error to speak of."""
    angle = (0.12, -0.05)
    even, off = chief_ray(made("off-centre"), angle, 1900.0), []
    for seed in range(40):
        rough = chief_ray(made("off-centre", scatter_rad=0.2, seed=seed), angle, 1900.0)
        off.append((rough.focus_um - even.focus_um) / rough.focus_error_um)
    # 11 % each, three of them
    assert np.sqrt(np.mean(np.square(off), 0)) == pytest.approx([1.0, 1.0], abs=0.34)
    assert np.sqrt(np.mean(np.square(off))) == pytest.approx(1.0, abs=0.24)
    assert rough.focus_error_um.min() > 20 * even.focus_error_um.max()


@pytest.mark.parametrize("depth", [97.0, 240.0])
def test_sources_far_from_the_one_of_the_design_have_their_own_foci(depth):
    """1/f = 1/z + 1/s on the axis: nearer than f it is behind the lens, a virtual one."""
    found = chief_ray(made("plain"), (0.0, 0.0), depth)
    assert found.focus_um == pytest.approx(1 / (1 / 310.0 - 1 / depth), rel=3e-4)


def test_a_plate_without_a_lens_has_its_foci_at_infinity_and_a_tilt_bends_its_ray():
    lens = made("plain")
    place = lens.diameters.x_um
    for slope in (0.0, 0.13):
        turns = np.mod(slope * place / WAVE, 1.0) + np.zeros((len(place), 1))
        even = np.where(lens.diameters.diameter_um > 0, 0.2 + 0.12 * 2 * turns / 3, 0.0)
        flat = type(lens)(
            type(lens.diameters)(even, PITCH),
            lens.cell,
            lens.proxy,
            WAVE,
            310.0,
            math.inf,
            "map",
        )
        found = chief_ray(flat, (0.1, 0.0))
        sine = math.sin(0.1) + slope
        assert found.meets_um[0] == pytest.approx(
            310.0 * math.tan(math.asin(sine)), rel=1e-5
        )
        assert np.abs(found.focus_um).min() > 1e8


def test_a_vortex_has_no_wave_front():
    with pytest.raises(
        PropagationError, match=r"chief ray of \(3, 0\) degrees.*no wave front.*rad rms"
    ):
        chief_ray(made("plain", turns=1), (math.radians(3.0), 0.0))


def test_rays_beside_the_lens_are_refused_with_where_they_are():
    lens = made("stop")
    far = type(lens.layers)(front=lens.layers.front, stop=Stop(41.0, 400.0))
    with pytest.raises(
        PropagationError,
        match=r"middle of its stop, comes to the pillars' plane at \(1\d\d",
    ):
        chief_ray(type(lens)(lens.diameters, lens.cell, lens.proxy, WAVE, 310.0, math.inf, "map", layers=far),
                  (math.radians(20.0), 0.0))  # fmt: skip


def test_the_middle_of_a_lens_is_that_of_its_pillars():
    """Half of the map is empty: the chief ray goes through the middle of the other
    half, and is bent there.
    """
    lens = made("plain")
    d = lens.diameters.diameter_um.copy()
    d[:, : d.shape[1] // 2] = 0.0
    half = type(lens)(
        type(lens.diameters)(d, PITCH),
        lens.cell,
        lens.proxy,
        WAVE,
        310.0,
        math.inf,
        "map",
    )
    found = chief_ray(half)
    # centroid of half a disc
    assert found.at_um == pytest.approx([4 * 62.0 / (3 * math.pi), 0.0], abs=0.3)
    assert found.meets_um == pytest.approx([0.0, 0.0], abs=2e-3)


def test_phases_that_scatter_by_more_than_three_fifths_of_a_radian_are_no_wave_front():
    """rms about the polynomial, of hundreds of pillars: 3 % of it; 11 terms of it are
    fitted.
    """
    chief_ray(made("plain", scatter_rad=0.54), (0.1, 0.0))
    with pytest.raises(
        PropagationError, match=r"no wave front: phases scatter by 0\.6\d rad rms"
    ):
        chief_ray(made("plain", scatter_rad=0.66), (0.1, 0.0))
