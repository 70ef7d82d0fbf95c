"""Eqs. 4 to 6 in training beside plain sums, and their gradient beside differences."""

import math

import numpy as np
import pytest
import torch

from codesign.batches import EyeScenes, SceneConfig, sensor_irradiance
from codesign.optics import stack as lens
from codesign.optics.stack import OpticsConfig
from codesign.train.separability import (
    SeparabilityConfig,
    fisher_separability,
    triplet_frames,
)
from metalens.image import Sensor, encircled_energy

OPTICS = OpticsConfig(
    aperture_mm=0.3, sensor_distance_mm=1.0, polynomials=4, depth_count=4,
    sample_um=9.0, window_samples=9, image="uniform",
)  # fmt: skip
SCENES = EyeScenes(SceneConfig(pixels=48, margin=4), 9.0, 1000.0, seed=5)
CONFIG = SeparabilityConfig(
    every=1, triplets=2, motions="all", gaze_step_deg=0.2, slip_step_um=40.0,
    orthogonality=0.7, compactness=1.3,
)  # fmt: skip
SENSOR = Sensor(pitch_um=18.0, base_pitch_um=7.0)


def _pinhole(frames):
    return frames.radiance.sum(1)[:, 4:-4, 4:-4]


def test_the_fisher_matrix_is_the_plain_sum_over_pixels():
    """Pixels of two samples are means of four; images in units of the anchor's mean;
    per degree and mm; float32 differences of 1e-3 of the light: 1e-3 of the entries.
    """
    frames = triplet_frames(SCENES, CONFIG, 3)
    light = [_pinhole(f).double().numpy() for f in frames]
    pixels = [f.reshape(2, 24, 2, 24, 2).mean((2, 4)) for f in light]
    level = pixels[0].mean((1, 2), keepdims=True)
    steps = (0.2, 0.04, 0.04, 0.04)
    fields = [
        (one - pixels[0]) / level / step
        for one, step in zip(pixels[1:], steps, strict=True)
    ]
    want = np.array([[(a * b).sum() / 2 for b in fields] for a in fields])
    shares = torch.tensor([0.3, 0.5])
    found = fisher_separability(
        frames, _pinhole, shares, CONFIG, sensor=SENSOR, sample_um=9.0
    )
    assert found.fisher.numpy() == pytest.approx(want, rel=2e-3, abs=2e-3 * want.max())
    off = sum(
        want[i, j] ** 2 / (want[i, i] * want[j, j])
        for i in range(4)
        for j in range(4)
        if i != j
    )
    loss = -np.log(np.diag(want)).sum() + 0.7 * off + 1.3 * (1 - 0.4)
    assert float(found.loss.value) == pytest.approx(loss, rel=5e-3)
    cosine = want[0, 3] / math.sqrt(want[0, 0] * want[3, 3])
    assert float(found.angle_rad) == pytest.approx(math.acos(cosine), abs=0.01)


def test_the_loss_has_the_gradient_that_differences_say():
    """Central differences of 1e-2 rad; images in single precision: 2 %."""
    frames = triplet_frames(SCENES, CONFIG, 1)

    def loss(coefficients):
        made = lens.lens_psf_stack(OPTICS, coefficients)
        imager = lens.stack_imager(OPTICS, made, 56, margin=4)
        shares = encircled_energy(made.intensity, 9.0, radius_um=18.0)
        return fisher_separability(
            frames, lambda f: sensor_irradiance(f, imager), shares, CONFIG,
            sensor=SENSOR, sample_um=9.0,
        ).loss.value  # fmt: skip

    here = torch.tensor([0.4, -0.3, 0.2, 0.5], dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(loss(here), here)
    for k in range(4):
        step = torch.zeros(4, dtype=torch.float64)
        step[k] = 1e-2
        with torch.no_grad():
            want = float(loss(here + step) - loss(here - step)) / 2e-2
        assert float(slope[k]) == pytest.approx(want, rel=0.02, abs=0.02)
    assert float(slope.abs().max()) > 0.1
