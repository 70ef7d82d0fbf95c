"""Training by the diameters of all pillars (paper Eq. 2): its gradient against
differences, a loss that falls, and a lens file that is the trained lens.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch

from codesign.optics import image_formation
from codesign.optics.stack import OpticsConfig, count_parameters, trained_lens
from codesign.train.trainer import make_model
from metalens import lens
from metalens.core.errors import ConfigError
from metalens.image import Grid, imager, textured_frames
from metalens.library import proxy_of, sweep

SMALL = OpticsConfig(
    aperture_mm=0.06, sensor_distance_mm=0.3, focus_mm=3.0, depths_mm=(2.0, 5.0),
    depth_count=3, sample_um=5.0, window_samples=11, angle_deg=2.0,
    parameters="diameters", image_tolerance=0.05,
)  # fmt: skip
FRAME, MARGIN = 30, 4


def _smooth(count):
    """A change of the pillars that is smooth over the lens and has no symmetry."""
    place = trained_lens(SMALL, torch.zeros(count)).diameters
    x, y = (a / place.radius_um for a in (place.x_um, place.y_um[:, None]))
    wave = 0.7 * x + 0.4 * y**2 - 0.5 * x * y + 0.3 * x**3
    return torch.from_numpy(wave[place.diameter_um > 0])


def test_the_gradient_is_that_of_differences():
    """Of a weighted sum of one node's light, along a smooth change of all pillars: cells
    of a few pillars are read as they change, 2 %.
    """
    count = count_parameters(SMALL)
    start, way = torch.zeros(count, dtype=torch.float64), _smooth(count)
    weight = torch.randn(3, 11, 11, generator=torch.Generator().manual_seed(4))

    def value(coefficients):
        psfs = image_formation.lens.lens_psf_stack(SMALL, coefficients).intensity
        return (psfs * weight).sum()

    moving = start.clone().requires_grad_()
    value(moving).backward()
    step = 2e-2
    ends = [float(value(start + sign * step * way)) for sign in (1, -1)]
    want = (ends[0] - ends[1]) / (2 * step)
    assert float(moving.grad @ way) == pytest.approx(want, rel=0.02)


def test_three_steps_lower_a_loss_and_the_file_holds_the_trained_lens(tmp_path):
    """Light that a circle about the middle holds at the nearest depth; pillars of the
    file are those of training: their image is that of training, by another builder.
    """
    moving = make_model(SMALL, pitch_um=10.0, seed=0).coefficients_rad
    optimiser = torch.optim.Adam([moving], lr=0.02)
    losses = []
    for _ in range(4):
        optimiser.zero_grad()
        psfs = image_formation.lens.lens_psf_stack(SMALL, moving).intensity
        loss = -psfs[0, 4:7, 4:7].sum()
        loss.backward()
        losses.append(float(loss.detach()))
        optimiser.step()
    assert losses[3] < losses[2] < losses[1] < losses[0]

    trained = moving.detach()
    lens.save(tmp_path / "lens.h5", trained_lens(SMALL, trained))
    file = lens.load(tmp_path / "lens.h5")
    there = file.diameters.diameter_um > 0
    proxy = proxy_of(sweep(SMALL.cell, wavelengths_um=(0.85,)))
    first = trained_lens(SMALL, 0 * trained).diameters.diameter_um[there]
    last = file.diameters.diameter_um[there]
    low, high = proxy.domain_um
    assert low - 1e-6 <= last.min() <= last.max() <= high + 1e-6
    # 1 is a radian of mean slope
    slope = np.diff(proxy.phase_rad(np.array([low, high]), 0.85))[0] / (high - low)
    inside = (last > low + 1e-6) & (last < high - 1e-6)
    moved = slope * (last - first)[inside]
    assert moved == pytest.approx(trained.numpy()[inside], abs=1e-4)

    side = FRAME - 2 * MARGIN
    grid = Grid((side, side), 5.0, (2e3, 5e3), MARGIN, 11)
    field = (np.radians(2.0), 0.0)
    other = imager(file, grid, field=field, tolerance=0.05)
    mine = image_formation.make_imager(SMALL, trained, FRAME, margin=MARGIN)
    frames = textured_frames(other.grid)
    want = other(frames)
    assert float((mine(frames) - want).norm() / want.norm()) < 1e-3


@pytest.mark.parametrize(
    "change", [{"image": "uniform"}, {"spread": {"bias_nm": 3.0}}], ids=str
)
def test_what_diameters_cannot_be_trained_with_is_refused(change):
    if "spread" in change:
        change = {"spread": replace(SMALL.spread, **change["spread"])}
    with pytest.raises(ConfigError, match="parameters = 'diameters'"):
        replace(SMALL, **change)
