"""Flat frames: exact for one surface, close to two sheets, exact gradients in the
kernels; pools draw from the seed.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch

from codesign.batches import pool
from codesign.batches.pool import PoolScenes
from codesign.batches.scenes import EyeScenes, SceneConfig, draw_depth_scales
from codesign.batches.surface_frames import (
    SingleSurfaceFrames,
    flatten_layers,
    sensor_irradiance,
)
from codesign.optics import stack as optics
from codesign.optics.stack import OpticsConfig
from metalens.image import Frames, image_direct
from tests.elsewhere import AWAY, elsewhere

SCENES = EyeScenes(
    SceneConfig(pixels=64, margin=8, slip_mm=(2.0, 1.5, 3.0)), 18.0, 2000.0, 3
)
OPTICS = OpticsConfig(
    aperture_mm=0.5,
    depth_count=12,
    sample_um=18.0,
    window_samples=17,
    polynomials=0,
    focus_mm=28.0,
)


def _imager(size=80, margin=8):
    made = optics.lens_psf_stack(OPTICS, torch.zeros(0, dtype=torch.float64))
    return optics.stack_imager(OPTICS, made, size, margin=margin)


def test_one_surface_is_imaged_by_the_psf_of_each_depth():
    """Beside a direct sum, every source with a PSF of its own, linear in 1/z."""
    generator = torch.Generator().manual_seed(0)
    light = (torch.rand(1, 80, 80, generator=generator) * 255).round() / 255
    depth = (15_000 + 15_000 * torch.rand(1, 80, 80, generator=generator)).round()
    sheets = Frames(
        *(torch.stack([0 * a, a], 1) for a in (light, 0 * light + 1, depth))
    )
    one = flatten_layers(sheets, torch.ones(1))
    made = optics.lens_psf_stack(OPTICS, torch.zeros(0, dtype=torch.float64))
    fine = replace(OPTICS, tolerance=1e-5)
    imager = optics.stack_imager(fine, made, 80, margin=8)
    nodes = 1 / OPTICS.depths_um
    place = (nodes[0] - 1 / depth[0].double()) / (nodes[0] - nodes[1])
    first = place.floor().long()
    share = (place - first)[..., None, None]
    psfs = made.intensity / made.intensity.sum((1, 2), keepdim=True)
    own = (1 - share) * psfs[first] + share * psfs[first + 1]
    want = image_direct(light[0].double(), own)
    got = sensor_irradiance(one, imager)[0]
    assert float((got - want).abs().max()) < 2e-4  # one code of 4096, and float32


def test_eyes_as_one_surface_are_near_their_two_sheets():
    made = SCENES.rendered(0, 8)
    exact = sensor_irradiance(made.frames, _imager())
    quick = sensor_irradiance(
        flatten_layers(made.frames, SCENES.states(0, 8).scale), _imager()
    )
    error = (quick - exact).norm() / (exact - exact.mean((1, 2), keepdim=True)).norm()
    # of the contrast: occlusion at the lids, where the sheets are millimetres apart
    assert float(error) < 0.05


def test_spare_rows_continue_the_border():
    constant = SingleSurfaceFrames(
        np.full((1, 67, 67), 100, np.uint8),
        np.full((1, 67, 67), 20_000, np.uint16),
        np.ones(1),
    )
    imager = _imager(67, margin=0)
    assert imager.light.shape[0] > 67
    inside = sensor_irradiance(constant, imager)
    torch.testing.assert_close(
        inside, torch.full_like(inside, 100 / 255), rtol=2e-3, atol=0.0
    )  # tolerance of the basis


def test_gradient_in_the_phase_agrees_with_a_finite_difference():
    settings = replace(OPTICS, polynomials=6, tolerance=1e-5)
    frames = flatten_layers(SCENES.rendered(0, 2).frames, SCENES.states(0, 2).scale)
    weight = torch.randn(2, 64, 64, generator=torch.Generator().manual_seed(2))

    def value(coefficients):
        made = optics.lens_psf_stack(settings, coefficients)
        return (
            sensor_irradiance(frames, optics.stack_imager(settings, made, 80, margin=8))
            * weight
        ).sum()

    at = 0.3 * torch.randn(
        6, generator=torch.Generator().manual_seed(1), dtype=torch.float64
    )
    way = torch.randn(
        6, generator=torch.Generator().manual_seed(3), dtype=torch.float64
    )
    slope = torch.autograd.functional.jvp(value, at, way)[1]
    step = 5e-3
    ahead, behind = (float(value(at + s * way)) for s in (step, -step))
    # what the kept kernels do not show
    assert float(slope) == pytest.approx((ahead - behind) / (2 * step), rel=0.02)


def test_a_pool_gives_the_same_batch_for_a_step_and_every_frame_once_a_pass():
    made, again = (pool.render_pool(SCENES, 12) for _ in range(2))
    draws = PoolScenes(made, 8, 0.2, seed=1)
    same = PoolScenes(again, 8, 0.2, seed=1).batch(1, 4)
    batch = draws.batch(1, 4)
    assert np.array_equal(batch.frames.light, same.frames.light)
    assert torch.equal(batch.slip_mm, same.slip_mm)
    seen = np.concatenate(
        [draws.batch(step, 4).frames.light.sum((1, 2)) for step in range(3)]
    )
    assert sorted(seen) == sorted(made.light.astype(int).sum((1, 2)))
    other = draws.batch(4, 4)
    assert not np.array_equal(other.frames.light, batch.frames.light)


def test_slippage_of_a_pool_is_that_of_the_renderer_at_its_scale():
    made = pool.render_pool(SCENES, 4)
    states = SCENES.states(0, 4)
    batch = PoolScenes(made, 8, 0.0, seed=1).rows(
        np.arange(4), np.random.default_rng(0)
    )
    torch.testing.assert_close(
        batch.slip_mm.double(), states.slip_um * 1e-3, rtol=1e-6, atol=1e-6
    )


def test_scaled_depth_has_nothing_to_do_with_the_size_of_what_is_seen():
    depth = torch.linspace(18_000, 24_000, 4000, dtype=torch.float64)
    factor = draw_depth_scales(depth, (18e3, 24e3), 0.4, np.random.default_rng(0))
    # 3 / sqrt(4000)
    assert abs(float(torch.corrcoef(torch.stack([depth, depth * factor]))[0, 1])) < 0.05
    assert torch.equal(
        draw_depth_scales(depth, (18_000.0, 24_000.0), 0.0, np.random.default_rng(0)),
        torch.ones(4000).double(),
    )


def test_frames_of_another_device_are_weighed_by_the_depth_of_every_pixel():
    """Tensors that a device would hold, against the loop of the processor: depths from
    before the nearest plane to
    behind the farthest, scales of their own."""
    random = np.random.default_rng(7)
    light = random.integers(0, 256, (2, 80, 80)).astype(np.uint8)
    depth = random.integers(9_000, 60_000, (2, 80, 80)).astype(np.uint16)
    frames = SingleSurfaceFrames(light, depth, np.array([1.0, 0.83]))
    imager = _imager()
    want = sensor_irradiance(frames, imager)
    with elsewhere():
        got = sensor_irradiance(frames, imager.to(AWAY)).cpu()
    contrast = (want - want.mean((1, 2), keepdim=True)).norm()
    # single precision, and a pixel between two codes of 4096
    assert float((got - want).norm() / contrast) < 1e-3
    near = SingleSurfaceFrames(light, np.full_like(depth, 16_000), frames.scale)
    assert float((sensor_irradiance(near, imager) - want).norm() / contrast) > 0.05


def test_closed_lids_come_in_their_share_and_change_nothing_else():
    plain, blinking = (
        EyeScenes(SceneConfig(pixels=32, margin=0, blinks=share), 36.0, 2000.0, seed=4)
        for share in (0.0, 0.4)
    )
    before, after = plain.states(2, 400), blinking.states(2, 400)
    shut = after.aperture == 0
    # four sigma of 400 draws
    assert float(shut.double().mean()) == pytest.approx(0.4, abs=0.1)
    assert torch.equal(before.aperture[~shut], after.aperture[~shut])
    assert torch.equal(before.slip_um, after.slip_um)
    masks = blinking.batch(2, 40).mask.amax((1, 2))
    assert float(masks[blinking.states(2, 40).aperture == 0].max()) == 0
