"""Terms of phase against closed forms, and one phase for pillars and training."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from codesign.optics import stack
from codesign.optics.stack import OpticsConfig
from metalens.core.errors import ConfigError
from metalens.design import Focus, profiles

FOCUS = Focus(0.85, 2000.0, 30_000.0)
PLAIN = OpticsConfig(
    aperture_mm=0.5, focus_mm=30.0, depths_mm=(30.0, 30.1), depth_count=2, sample_um=6.0, window_samples=41,
    polynomials=0,
)  # fmt: skip


def test_radial_terms_know_no_azimuth_and_free_ones_do():
    x, y = np.array([0.6, -0.28, 0.0]), np.array([0.0, 0.53, -0.6])
    places = torch.from_numpy(x), torch.from_numpy(y)
    radial = stack.phase_terms(*places, 3, "radial")
    for power, term in zip((2, 4, 6), radial, strict=True):
        assert term.numpy() == pytest.approx(np.hypot(x, y) ** power)


@pytest.mark.parametrize(
    "change",
    [
        {"family": "radial"}, {"zones": 2},
    ],
)  # fmt: skip
def test_pillars_and_training_see_one_phase(change):
    settings = replace(PLAIN, polynomials=4, **change)
    moved = torch.tensor([0.7, -0.4, 0.3, 1.1], dtype=torch.float64)
    x, y = np.array([31.0, -77.0, 204.0]), np.array([-15.0, 66.0])
    grid = [
        torch.from_numpy(np.broadcast_to(a, (2, 3)).copy()) for a in (x, y[:, None])
    ]
    pillars = stack.pillar_phase(settings, moved)(x, y)
    training = stack.phase_at(
        settings, moved, *grid
    ).numpy() + profiles.hyperbolic_phase(x, y[:, None], settings.focus)
    apart = np.angle(np.exp(1j * (pillars - training)))
    assert np.abs(apart).max() < 1e-8  # thousands of radians in float64


@pytest.mark.parametrize("change", [{"zones": -1}, {"polynomials": -1}])
def test_impossible_starts_are_refused(change):
    with pytest.raises(ConfigError, match="need 0 or more"):
        replace(PLAIN, **change)
