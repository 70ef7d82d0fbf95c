"""What means over cells leave of a perfect lens's light, by its modulation transfer function."""

import math

import numpy as np
import pytest
import torch

from metalens import propagate
from metalens.psf.cells import FINER, cells, integrated


@pytest.mark.parametrize("finer", FINER)
def test_the_error_of_cells_is_told_from_the_second_differences(finer):
    """Mean over a cell of h: sinc(pi f h); midpoint with δ²/24: 1 - sin²(pi f h) / 6; rms over an aperture's MTF.

    A wave at the highest frequency alone leaves 3.6 times as much; no lens sends all its light there.
    """
    axis = np.linspace(-1, 1, 401)
    fx, fy = np.meshgrid(axis, axis)
    r = np.clip(np.hypot(fx, fy), 0, 1)
    mtf = (np.arccos(r) - r * np.sqrt(1 - r**2)) * 2 / np.pi
    x, y = (np.pi * f / (2 * finer) for f in (fx, fy))  # h is the finer-th part of 1 / (2 B)
    bent = (np.sin(x) ** 2 + np.sin(y) ** 2) / 6
    left = 1 - bent - np.sinc(x / np.pi) * np.sinc(y / np.pi)
    ratio = math.sqrt(((left * mtf) ** 2).sum() / ((bent * mtf) ** 2).sum())
    case = propagate.case((60, 60), pitch_um=0.4, wavelength_um=0.85, sensor_distance_um=30.0, depths_um=[np.inf],
                          window_um=30.0, samples=12)  # fmt: skip
    assert ratio < cells(case, finer).left < 1.5 * ratio


def test_cells_of_a_parabola_are_exact_and_its_bend_is_told():
    """x² over a cell of three points 0.4 apart: the middle's square + (3 x 0.4)² / 12; plain points miss 0.4² / 12."""
    case = propagate.case((60, 60), pitch_um=0.4, wavelength_um=0.85, sensor_distance_um=30.0, depths_um=[np.inf],
                          window_um=30.0, samples=12)  # fmt: skip
    fine = cells(case, 2)
    fine = type(fine)(3, fine.case, fine.left)
    at = (np.arange(3 * 4 + 2) - 6.5) * 0.4
    light = torch.from_numpy(7.0 + at[None, :] ** 2 - 0.3 * at[:, None] ** 2 + 0.5 * at[:, None] * at[None, :])
    got, error = integrated(light[None], fine)
    middle = (np.arange(4) - 1.5) * 1.2
    want = 7.0 + middle[None, :] ** 2 - 0.3 * middle[:, None] ** 2 + 0.5 * middle[:, None] * middle[None, :]
    plain = want + 0.7 * (1.2**2 - 0.4**2) / 12
    assert got[0].numpy() == pytest.approx(want + 0.7 * 1.2**2 / 12, rel=1e-12)
    bent = 0.7 * 0.4**2 / 12
    assert error == pytest.approx(fine.left * bent * 4 / np.linalg.norm(plain), rel=1e-9)
    assert integrated(0 * light[None], fine)[1] == 0
