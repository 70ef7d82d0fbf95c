"""Low-rank PSF fields: the certificate is the truth, the rank is that of the stack,
gradients pass.
"""

import numpy as np
import pytest
import torch

from benchmarks.rivals import lowrank
from metalens import psf
from metalens.ground.errors import PropagationError

K = 2 * np.pi / 0.85


def stack(depths, angles=0.0, n=96, as_torch=False):
    x = (np.arange(n) - (n - 1) / 2) * 0.4
    r2 = x**2 + x[:, None] ** 2
    phase = -K * (r2 / (np.sqrt(r2 + 120.0**2) + 120) + r2 / 2600)
    level = (r2 < x[-1] ** 2).astype(float)
    if as_torch:
        phase = torch.tensor(phase, requires_grad=True)
    made = psf.psf_stack(
        phase,
        level,
        pitch_um=0.4,
        wavelength_um=0.85,
        sensor_distance_um=120.0,
        depths_um=depths,
        angle_rad=angles,
        window_um=16.0,
        samples=20,
    )
    return made, phase


@pytest.mark.parametrize("tolerance", [1e-1, 1e-2, 1e-4, 1e-8])
def test_every_psf_is_within_tolerance_and_errors_are_measured(tolerance):
    made, _ = stack(np.linspace(900, 2500, 12))
    found = lowrank.compress(made, tolerance=tolerance)
    error = np.linalg.norm(found.psf() - made.intensity, axis=(1, 2)) / np.linalg.norm(
        made.intensity, axis=(1, 2)
    )
    assert found.errors == pytest.approx(error, rel=1e-6, abs=1e-14)
    assert error.max() <= tolerance
    whole = np.linalg.norm(found.psf() - made.intensity) / np.linalg.norm(
        made.intensity
    )
    assert found.error == pytest.approx(whole, rel=1e-6, abs=1e-14)


def test_rank_falls_with_tolerance_and_not_with_more_depths():
    few, many = (stack(np.linspace(900, 2500, n))[0] for n in (12, 36))
    ranks = [lowrank.compress(few, tolerance=t).rank for t in (1e-1, 1e-2, 1e-4)]
    assert ranks == sorted(ranks)
    assert ranks[-1] < 12
    assert lowrank.compress(many, tolerance=1e-2).rank <= ranks[1] + 1


def test_field_angles_share_the_basis():
    made, _ = stack(np.linspace(900, 2500, 5), angles=[[0.0, 0.0], [0.2, 0.0]])
    found = lowrank.compress(made, tolerance=1e-3)
    assert found.weights.shape == (2, 5, found.rank)
    assert np.abs(found.psf() - made.intensity).max() < 1e-3 * made.intensity.max() * 3
    middle = found.at((found.weights[0, 0] + found.weights[0, 1]) / 2)
    assert middle.shape == (20, 20)


def test_gradient_of_the_compressed_stack_is_that_of_the_stack_within_its_span():
    made, phase = stack(np.linspace(900, 2500, 8), as_torch=True)
    weight = torch.rand(
        made.intensity.shape,
        generator=torch.Generator().manual_seed(0),
        dtype=torch.float64,
    )
    compressed = lowrank.compress(made, tolerance=1e-12).psf()
    (got,) = torch.autograd.grad((compressed * weight).sum(), phase, retain_graph=True)
    basis = lowrank.compress(made, tolerance=1e-12).basis.flatten(1)
    inside = (weight.flatten(1) @ basis.T @ basis).view_as(weight)
    (exact,) = torch.autograd.grad((made.intensity * inside).sum(), phase)
    assert torch.allclose(
        got, exact, atol=1e-12 * float(exact.abs().max()) + 1e-18, rtol=1e-8
    )


def test_a_tolerance_of_zero_is_refused():
    with pytest.raises(PropagationError, match="tolerance"):
        lowrank.compress(stack([1000.0])[0], tolerance=0.0)
