"""Errors of a basis of kernels, recomputed from the PSFs in numpy."""

import numpy as np
import pytest
import torch

from metalens.image import pupil, scene

RNG = np.random.default_rng(12)
DEPTHS = torch.tensor([18e3, 20e3, 23e3, 29e3], dtype=torch.float64)


def stack(h=6, w=9):
    """Four unlike PSFs of sum 1."""
    psfs = RNG.uniform(0, 1, (4, h, w)) ** 3
    return psfs / psfs.sum((1, 2), keepdims=True)


def texture(image):
    """Power of what a 1/f texture shows of a transfer function, by the whole transform
    and its power spectrum.
    """
    h, w = image.shape
    fy, fx = np.fft.fftfreq(2 * h)[:, None], np.fft.fftfreq(2 * w)
    power = 1 / (fy**2 + fx**2 + (1 / (8 * max(h, w))) ** 2)
    return float((np.abs(np.fft.fft2(image, s=(2 * h, 2 * w))) ** 2 * power).sum())


@pytest.mark.parametrize("tolerance", [0.5, 0.05])
def test_error_and_bound_are_of_the_worst_psf(tolerance):
    psfs = stack()
    made = scene.basis(torch.from_numpy(psfs), DEPTHS, tolerance=tolerance)
    kept = made.weights.reshape(4, -1).numpy() @ made.kernels.flatten(1).numpy()
    left = psfs - kept.reshape(psfs.shape)
    missing = [
        np.sqrt(texture(rest) / texture(psf))
        for rest, psf in zip(left, psfs, strict=True)
    ]
    assert made.error == pytest.approx(max(missing), rel=1e-6)
    assert made.error <= tolerance
    assert made.bound == pytest.approx(np.abs(left).sum((1, 2)).max(), rel=1e-9)
    fewer = len(made.kernels) - 1
    if fewer:  # one kernel less would not have done
        left_over = psfs.reshape(4, -1) - made.weights.reshape(4, -1)[
            :, :fewer
        ].numpy() @ (made.kernels[:fewer].flatten(1).numpy())
        worse = [
            texture(a.reshape(6, 9)) / texture(b)
            for a, b in zip(left_over, psfs, strict=True)
        ]
        assert np.sqrt(max(worse)) > tolerance


def test_depths_that_hold_nothing_are_left_out_up_to_the_next_node():
    psfs = torch.from_numpy(stack())
    made = scene.basis(psfs, DEPTHS, tolerance=1e-9, occupied_um=(20.5e3, 22e3))
    assert made.depths_um.tolist() == [20e3, 23e3]
    assert made.weights.shape[2] == 2
    whole = scene.basis(psfs, DEPTHS, tolerance=1e-9, occupied_um=(1e3, 99e3))
    assert whole.depths_um.tolist() == DEPTHS.tolist()


def test_weights_between_depths_are_linear_in_their_inverse():
    psfs = torch.from_numpy(stack())
    made = scene.basis(psfs, DEPTHS, tolerance=1e-9)
    at = 1 / (0.3 / 20e3 + 0.7 / 23e3)
    maps = scene.weight_maps(
        made, torch.tensor([[at, 29e3], [10e3, 99e3]], dtype=torch.float64)
    )
    rows = made.weights.reshape(4, -1)
    step = float((rows[2] - rows[1]).abs().max())
    assert torch.allclose(
        maps[:, 0, 0], 0.3 * rows[1] + 0.7 * rows[2], atol=0.02 * step
    )  # steps of the table
    assert torch.allclose(maps[:, 0, 1], rows[3])
    assert torch.allclose(maps[:, 1, 0], rows[0])
    assert torch.allclose(maps[:, 1, 1], rows[3])


def test_the_gradient_through_a_basis_is_that_of_finite_differences():
    """Kernels mixed by the first stack against a basis of nearly all kernels of the
    changed ones: of 24 depths, by the root mean square of four aberrations.
    """
    lens = pupil.Pupil(nodes=128)
    depths = 1 / torch.linspace(1 / 12e3, 1 / 50e3, 24, dtype=torch.float64)
    x, y = (c / lens.radius_um for c in pupil.coordinates(lens))
    r2 = x * x + y * y
    terms = (3 * x * r2 - 2 * x, x * x - y * y, 2 * r2 - 1, 6 * r2 * r2 - 6 * r2 + 1)

    def stack_at(strength):
        phase = 1.3 * terms[0] + 0.8 * terms[1]
        phase = phase + torch.einsum("n,nyx->yx", strength, torch.stack(terms))
        about = {"depths_um": depths, "focus_um": 20e3, "sample_um": 4.5, "samples": 23}
        made = pupil.psf(phase, lens, **about)
        return made / made.sum((1, 2), keepdim=True)

    draw = np.random.default_rng(2)
    light = torch.from_numpy(draw.uniform(0.4, 1.6, (40, 40))).float()
    depth = torch.linspace(13e3, 44e3, 40).expand(40, 40)
    sheets = [torch.stack([0 * a, a])[None] for a in (light, 0 * light + 1, depth)]
    frames = scene.Frames(*sheets)
    weight = torch.from_numpy(draw.standard_normal((1, 40, 40))).float()

    def merit(strength, **about):
        made = scene.basis(stack_at(strength), depths, **about)
        optics = scene.uniform_imager(made, (40, 40))
        return (weight * scene.image(frames, optics)).sum(), made

    at = torch.zeros(4, dtype=torch.float64, requires_grad=True)
    value, made = merit(at)
    value.backward()
    step = 5e-3 * torch.eye(4, dtype=torch.float64)
    with torch.no_grad():
        want = [
            merit(s, tolerance=1e-9)[0] - merit(-s, tolerance=1e-9)[0] for s in step
        ]
    want = torch.stack(want).double() / 1e-2
    assert made.gradient_error <= 0.02
    assert float((at.grad - want).norm() / want.norm()) < 0.03
    with torch.no_grad():
        plain = merit(at.detach())[1]
    assert plain.gradient_error > 0.05  # fewer kernels keep the image alone
    assert len(plain.kernels) < len(made.kernels)
