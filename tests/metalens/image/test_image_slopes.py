"""The gradient from single field points and wavelengths: its mean over all draws is the
whole one, exactly.
"""

import numpy as np
import pytest
import torch

from metalens.design import Focus
from metalens.image import (
    Frames,
    Grid,
    Optics,
    SmoothWave,
    imager,
    node_light,
    node_psfs,
    normalise_psfs,
    with_psfs,
)
from metalens.image.slopes import gradient_term
from metalens.optics import Layers
from metalens.psf import SpectralNodes

RADIUS = 40.0
WAVES = SpectralNodes(np.array([0.842, 0.867]), np.array([0.41, 0.59]), 0.0)


def _optics(strength):
    def added(x, y):
        return (
            strength * (x / RADIUS) * ((x / RADIUS) ** 2 + (y / RADIUS) ** 2)
            + 0.3 * y / RADIUS
        )

    return Optics(
        SmoothWave(Focus(0.85, 210.0, 5000.0), RADIUS, added), Layers(), 210.0
    )


@pytest.fixture(scope="module")
def case():
    made = imager(
        _optics(torch.tensor(0.9, dtype=torch.float64)).wave,
        Grid((5, 4), 5.1, (3e3, 5e3), window=7),
        spectrum=WAVES,
        tolerance=8e-2,
    )
    draw = np.random.default_rng(3)
    light = torch.from_numpy(np.stack([np.zeros((5, 4)), draw.random((5, 4))])[None])
    cover = torch.from_numpy(np.stack([np.zeros((5, 4)), np.ones((5, 4))])[None])
    return made, Frames(
        light, cover, torch.full((1, 2, 5, 4), 3.7e3, dtype=torch.float64)
    )


def _pulled(made, frames):
    """(phase strength, optics, gradient to the light of the nodes) after the first half
    of a step.
    """
    strength = torch.tensor(0.9, dtype=torch.float64, requires_grad=True)
    optics = _optics(strength)
    light = node_light(optics, made.plan)
    (
        with_psfs(made, *normalise_psfs(light, optics, made.plan))(frames) ** 2
    ).sum().backward()
    return strength, optics, light.grad


def test_the_mean_over_all_draws_is_the_gradient_of_the_loss(case):
    made, frames = case
    strength, optics, gradient = _pulled(made, frames)
    points = len(made.plan.y_um) * len(made.plan.x_um)
    share = WAVES.weights / WAVES.weights.sum()
    mean = sum(
        gradient_term(optics, made.plan, gradient, p, w) * (float(share[w]) / points)
        for p in range(points)
        for w in range(2)
    )
    mean.backward()
    whole = torch.tensor(0.9, dtype=torch.float64, requires_grad=True)
    (
        with_psfs(made, *node_psfs(_optics(whole), made.plan))(frames) ** 2
    ).sum().backward()
    assert abs(float(whole.grad)) > 1e-3
    # float32 sums in another order
    assert float(strength.grad) == pytest.approx(float(whole.grad), rel=1e-4)
