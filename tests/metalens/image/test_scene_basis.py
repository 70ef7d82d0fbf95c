"""PSFs of the shift-invariant imager, by points of light: errors, depths, gradients."""

import numpy as np
import pytest
import torch

from metalens.image import Frames, Grid, pupil, uniform_imager

DEPTHS = torch.tensor([18e3, 20e3, 23e3, 29e3], dtype=torch.float64)
RNG = np.random.default_rng(12)


def stack(size=9):
    """Four unlike PSFs of sum 1."""
    psfs = RNG.uniform(0, 1, (4, size, size)) ** 3
    return psfs / psfs.sum((1, 2), keepdims=True)


def point_images(made, depths_um):
    """What the imager shows of a point, one frame a depth."""
    side = made.grid.samples[0]
    light = torch.zeros(len(depths_um), side, side, dtype=torch.float64)
    light[:, side // 2, side // 2] = 1
    return made.surface(light, torch.as_tensor(depths_um)[:, None, None] + 0 * light)


def texture(image):
    """Power of what a 1/f texture shows of a transfer function, by the whole transform
    and its power spectrum.
    """
    h, w = image.shape
    fy, fx = np.fft.fftfreq(2 * h)[:, None], np.fft.fftfreq(2 * w)
    power = 1 / (fy**2 + fx**2 + (1 / (8 * max(h, w))) ** 2)
    return float((np.abs(np.fft.fft2(image, s=(2 * h, 2 * w))) ** 2 * power).sum())


GRID = Grid((9, 9), 9.0, (18e3, 29e3), window=9)


@pytest.mark.parametrize("tolerance", [0.5, 0.05])
def test_error_is_of_the_texture_through_the_worst_psf(tolerance):
    """PSFs of a point in the middle, less those that were given; depths lie within half
    a step of the table, 1/8192 of their range.
    """
    psfs = stack()
    made = uniform_imager(torch.from_numpy(psfs), DEPTHS, GRID, tolerance=tolerance)
    left = point_images(made, DEPTHS).numpy() - psfs
    missing = [
        np.sqrt(texture(rest) / texture(psf))
        for rest, psf in zip(left, psfs, strict=True)
    ]
    assert made.error <= tolerance
    assert max(missing) == pytest.approx(made.error, abs=3e-4)


def test_psfs_between_depths_are_linear_in_their_inverse():
    psfs = stack()
    made = uniform_imager(torch.from_numpy(psfs), DEPTHS, GRID, tolerance=1e-9)
    at = 1 / (0.3 / 20e3 + 0.7 / 23e3)
    got = point_images(made, torch.tensor([at, 29e3, 10e3, 99e3]).double()).numpy()
    want = [0.3 * psfs[1] + 0.7 * psfs[2], psfs[3], psfs[0], psfs[3]]
    step = np.abs(psfs[2] - psfs[1]).max()
    assert got[0] == pytest.approx(want[0], abs=0.02 * step)  # steps of the table
    assert got[1:] == pytest.approx(np.stack(want[1:]), abs=1e-9)


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
    frames = Frames(*sheets)
    grid = Grid((40, 40), 4.5, (12e3, 50e3), window=23)
    weight = torch.from_numpy(draw.standard_normal((1, 40, 40))).float()

    def merit(strength, **about):
        made = uniform_imager(stack_at(strength), depths, grid, **about)
        return (weight * made(frames)).sum()

    at = torch.zeros(4, dtype=torch.float64, requires_grad=True)
    merit(at).backward()
    step = 5e-3 * torch.eye(4, dtype=torch.float64)
    with torch.no_grad():
        want = [merit(s, tolerance=1e-9) - merit(-s, tolerance=1e-9) for s in step]
    want = torch.stack(want).double() / 1e-2
    assert float((at.grad - want).norm() / want.norm()) < 0.03
