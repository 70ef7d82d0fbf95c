"""The bench of a small lens and its estimator: what is seen, by which optics, and what
it is compared with.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from codesign.budget import task
from codesign.budget.prepared import finest_of, same_lens
from codesign.eye import POPULATION, CameraRig, PinholeCamera, render
from codesign.optics import (
    OpticsConfig,
    OpticsNumerics,
    gather_lens_plane,
    image_difference,
    make_device,
)
from metalens.core.errors import LensError
from metalens.image import Frames, Grid
from metalens.psf import Source
from tests.codesign.budget import small_bench as small

RNG = np.random.default_rng(31)


@pytest.mark.parametrize("make", [small.bare, small.filmed])
def test_a_bench_looks_at_its_eyes_through_the_device_and_has_twice_the_depths(make):
    """The eyes are seen as behind the films: 300 um less 45 of an index of 1.52."""
    bench = make()
    line = bench.given.fwhm_nm > 0
    assert bench.setting.sensor_distance_um == pytest.approx(
        300.0 - line * 45.0 * (1 - 1 / 1.52)
    )
    assert bench.finest == OpticsNumerics(8, 7 if line else 1, 1e-5, 1e-4)
    near, far = bench.eyes.depths_um
    assert (bench.window.near_um, bench.window.far_um, bench.window.pitch_um) == (
        near,
        far,
        4.1,
    )
    lens, source = bench.lens, Source(850.0, 24.0) if line else None
    wave = gather_lens_plane(
        lens, *bench.aperture.maps(bench.aperture.designed()), window_um=7 * 4.1
    )
    want = make_device(
        wave, Grid((16, 16), 4.1, (near, far), 3, 7), layers=lens.layers, distance_um=300.0, spectrum=source
    ).whole  # fmt: skip
    assert image_difference(bench.device.whole, want) < 1e-6
    assert bench.device.whole.energy.numpy() == pytest.approx(
        want.energy.numpy(), rel=1e-6
    )
    assert bench.reader.image.numpy() == pytest.approx(
        task.expected_electrons(bench.eyes.anchor, want, bench.setting).numpy(),
        rel=1e-5,
    )


def test_finest_settings_end_at_64_depths_and_are_never_coarser_than_a_setting_of_their_own():
    coarse = finest_of(OpticsNumerics(12, 3, 1e-3, 1e-2), fwhm_nm=30.0)
    fine = finest_of(OpticsNumerics(40, 3, 2e-5, 3e-4), fwhm_nm=0.0)
    for got, want in (
        (coarse, OpticsNumerics(24, 9, 1e-5, 1e-4)),
        (fine, OpticsNumerics(64, 1, 2e-6, 3e-5)),
    ):
        assert (got.depth_count, got.wavelength_count) == (
            want.depth_count,
            want.wavelength_count,
        )
        assert (got.psf_tolerance, got.basis_tolerance) == pytest.approx(
            (want.psf_tolerance, want.basis_tolerance)
        )


@pytest.mark.parametrize(
    ("off", "refused"),
    [
        ((1.019, 1, 1), False), ((1.021, 1, 1), True), ((1, 0.979, 1), True), ((1, 1, 1.021), True),
        ((1, 1, 0.981), False),
    ],
)  # fmt: skip
def test_a_reader_of_another_lens_is_refused_beyond_two_per_cent(off, refused):
    """Sensor distance, wavelength and aperture of the run against those of the lens, in
    its units.
    """
    lens = small.lens()
    aperture = 2e-3 * lens.diameters.radius_um
    its = OpticsConfig(
        aperture / off[2], 0.3 / off[0], 850.0 / off[1], 3.0, polynomials=0
    )
    if refused:
        with pytest.raises(LensError, match="trained before another lens"):
            same_lens(lens, its)
    else:
        same_lens(lens, its)


def rendered(setting, states, lit):
    """Radiance, coverage and depth of every pixel, from its nine rays, in numpy."""
    camera = PinholeCamera(
        3 * (setting.pixels + 2 * setting.margin), setting.pitch_um / 3
    )
    rig = CameraRig(sensor_distance_um=setting.sensor_distance_um)
    fine = render(states, rig=rig, camera=camera, exposed=lit).frames
    return averaged(
        *(
            v.numpy().astype(float)
            for v in (fine.radiance, fine.coverage, fine.depth_um)
        )
    )


def averaged(radiance, coverage, depth):
    def mean(v):
        *lead, y, x = v.shape
        return v.reshape(*lead, y // 3, 3, x // 3, 3).mean((-3, -1))

    cover = mean(coverage)
    seen = mean(coverage * depth) / np.where(cover > 0, cover, 1)
    return mean(radiance), cover, np.where(cover > 0, seen, mean(depth))


def test_views_are_of_both_sides_of_every_unknown_at_the_exposure_of_the_still_eye():
    bench = small.bare()
    states, steps = bench.setting.states, task.view_derivatives()
    assert len(bench.eyes.moved) == len(steps) == len(task.NAMES) - 1
    cases = [(bench.eyes.anchor, states)]
    for unknown in (0, 4, 5, len(steps) - 1):
        for seen, sign in zip(bench.eyes.moved[unknown], (1, -1), strict=True):
            cases.append(
                (seen, task.shift_states(states, unknown, sign * steps[unknown]))
            )
    for seen, moved in cases:
        want = rendered(bench.setting, moved, states)
        for got, plain in zip(
            (seen.radiance, seen.coverage, seen.depth_um), want, strict=True
        ):
            assert got.numpy() == pytest.approx(plain, rel=1e-5, abs=1e-6 * plain.max())


def test_other_exposures_and_states_are_those_given():
    setting = replace(small.SETTING, pixels=6, margin=1, scenes=1)
    states = setting.states
    darker = replace(
        states,
        slip_um=states.slip_um
        + torch.tensor([0.0, 0.0, -6000.0], dtype=states.slip_um.dtype),
    )
    moved = task.shift_states(states, 0, 0.02)
    seen = task.render_views(setting, moved, exposed=darker)
    want = rendered(setting, moved, darker)[0]
    assert seen.anchor.radiance.numpy() == pytest.approx(
        want, rel=1e-5, abs=1e-6 * want.max()
    )
    other = rendered(setting, moved, moved)[0]
    assert np.abs(other - want).max() > 0.02 * want.max()  # the exposure differs


def test_a_pixel_has_the_depth_of_what_covers_it_or_of_nothing_where_nothing_does():
    light, cover = (
        torch.from_numpy(RNG.uniform(0, 1, (1, 2, 12, 12))) for _ in range(2)
    )
    depth = torch.from_numpy(RNG.uniform(15e3, 30e3, (1, 2, 12, 12)))
    cover[0, 0, :3, :3] = 0  # nothing covers the first pixel of the near sheet
    got = task.pixels_of(Frames(light, cover, depth))
    for found, want in zip(
        (got.radiance, got.coverage, got.depth_um),
        averaged(light.numpy(), cover.numpy(), depth.numpy()),
        strict=True,
    ):
        assert found.numpy() == pytest.approx(want)


def test_every_unknown_is_moved_alone_by_its_step():
    """Gaze, slippage, size, then every trait that varies."""
    still = small.SETTING.states
    places = [
        ("gaze_rad", 0),
        ("gaze_rad", 1),
        ("slip_um", 0),
        ("slip_um", 1),
        ("slip_um", 2),
        ("scale", None),
    ]
    places += [("traits", list(POPULATION).index(name)) for name in task.TRAITS]
    assert len(places) == len(task.NAMES) - 1
    for unknown, (field, column) in enumerate(places):
        amount = 0.03 + 0.01 * unknown
        moved = task.shift_states(still, unknown, amount)
        for name in ("gaze_rad", "slip_um", "scale", "traits"):
            off = getattr(moved, name) - getattr(still, name)
            want = torch.zeros_like(off)
            if name == field:
                want[... if column is None else (slice(None), column)] = amount
            assert off.numpy() == pytest.approx(
                want.numpy(), abs=1e-3 if name in ("slip_um", "traits") else 1e-6
            )


def test_steps_and_priors_are_those_of_the_population():
    steps, widths = task.view_derivatives(), task.unknown_priors()
    assert len(steps) + 1 == len(widths) == len(task.NAMES)
    assert steps[:6] == pytest.approx((3.4906585e-4, 3.4906585e-4, 5, 5, 5, 1e-3))
    assert widths[:6] == (0.18, 0.13, 1200.0, 900.0, 2000.0, 0.12)
    assert widths[-1] == 0.3
    assert steps[6:] == pytest.approx(
        [0.005 * POPULATION[name].sd for name in task.TRAITS]
    )
    assert widths[6:-1] == tuple(POPULATION[name].sd for name in task.TRAITS)


def test_what_is_seen_spans_the_depths_that_something_covers():
    depth = torch.tensor([3e3, 7e3, 22e3, 90e3]).reshape(1, 2, 1, 2)
    cover = torch.tensor([0.0, 0.1, 1.0, 0.0]).reshape(1, 2, 1, 2)
    assert task.RenderedViews(Frames(cover, cover, depth), ()).depths_um == (7e3, 22e3)
    near = torch.tensor([3e3, 4e3, 3e3, 5e3]).reshape(1, 2, 1, 2)
    assert task.RenderedViews(Frames(cover, cover + 0.1, near), ()).depths_um == (
        5e3,
        6e3,
    )


def test_a_mean_gaze_error_is_of_angles_over_eyes():
    shift = torch.tensor([[0.3, -0.4, 9.0], [0.0, 1.2, 9.0]])
    assert task.gaze_mean(shift) == pytest.approx((0.5 + 1.2) / 2)
    draws = torch.stack([shift, 2 * shift, 5 * shift])
    assert task.gaze_mean(draws) == pytest.approx(8 / 3 * (0.5 + 1.2) / 2)
    assert task.gaze_rms(draws) == pytest.approx(math.sqrt(30 / 3 * (0.25 + 1.44) / 2))
