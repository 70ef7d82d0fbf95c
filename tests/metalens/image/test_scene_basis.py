"""PSFs of the shift-invariant imager, by points of light: errors, depths, gradients."""

import numpy as np
import pytest
import torch

from metalens.image import Grid, uniform_imager

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
