"""Light of pillars on other lattices than the square, against the sum written out over
their sites.
"""

import numpy as np
import pytest
import torch

from metalens import propagate, psf

PITCH, ROW, WAVELENGTH, DISTANCE = 0.43, 0.372, 0.85, 37.0
SITE = 2 * PITCH / 2 * ROW
GRID = {"pitch_um": PITCH / 2, "row_um": ROW, "site_um2": SITE}
VIEW = {
    "wavelength_um": WAVELENGTH,
    "sensor_distance_um": DISTANCE,
    "window_um": 9.0,
    "samples": 18,
}


def lens(rows=61, columns=97):
    """(phase, transmission) with every other site empty, no symmetry, and a focus at
    (1.7, -0.9).
    """
    y, x = (
        (np.arange(n) - (n - 1) / 2) * s for n, s in ((rows, ROW), (columns, PITCH / 2))
    )
    phase = (
        -2
        * np.pi
        / WAVELENGTH
        * np.sqrt((x - 1.7) ** 2 + (y[:, None] + 0.9) ** 2 + DISTANCE**2)
    )
    level = np.random.default_rng(5).uniform(0.6, 1, phase.shape) * (
        (np.arange(rows)[:, None] + np.arange(columns)) % 2 == 0
    )
    return np.mod(phase, 2 * np.pi), level, x, y


def summed(phase, level, x, y, at, *, depth=4e3, tangent=0.05):
    """Sum over sites of area exp(ikr) d (1/r - ik) / (2 pi r^2), the source at (-depth
    tangent, 0, -depth).
    """
    k = 2 * np.pi / WAVELENGTH
    rows, columns = np.nonzero(level)
    px, py = x[columns], y[rows]
    source = np.sqrt((px + depth * tangent) ** 2 + py**2 + depth**2) - depth * np.sqrt(
        1 + tangent**2
    )
    light = level[rows, columns] * np.exp(1j * (phase[rows, columns] + k * source))
    r = np.sqrt((at[:, :1] - px) ** 2 + (at[:, 1:] - py) ** 2 + DISTANCE**2)
    return SITE * (
        light * np.exp(1j * k * r) * DISTANCE / (2 * np.pi * r**2) * (1 / r - 1j * k)
    ).sum(1)


def test_the_exact_sum_counts_every_site_once_at_its_place():
    phase, level, x, y = lens()
    case = propagate.make_case(
        phase.shape, **GRID, **VIEW, depths_um=4e3, angle_rad=np.arctan(0.05)
    )
    at = np.random.default_rng(1).uniform(-6, 6, (20, 2))
    want = summed(phase, level, x, y, at)
    got = propagate.field_at(phase, level, case, at)[0]
    assert abs(got - want).max() < 1e-10 * np.abs(want).max()


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_the_windowed_method_meets_its_tolerance_there_too(dtype):
    phase, level, x, y = lens()
    maps = (
        torch.tensor(phase, dtype=dtype, requires_grad=True),
        torch.tensor(level, dtype=dtype),
    )  # never the exact sum
    stack = psf.psf_stack(
        *maps,
        **GRID,
        **VIEW,
        depths_um=4e3,
        angle_rad=np.arctan(0.05),
        tolerance=1e-5,
        integrate=False,
    )
    middle = stack.centres_um[0] if np.ndim(stack.centres_um) == 2 else stack.centres_um
    axis = (np.arange(18) - 8.5) * 0.5
    at = np.stack(np.meshgrid(axis + middle[0], axis + middle[1]), -1).reshape(-1, 2)
    want = np.abs(summed(phase, level, x, y, at).reshape(18, 18)) ** 2
    light = (
        stack.intensity[0].detach().numpy()
        * float(stack.energy_um2.detach()[0])
        / stack.step_um**2
    )
    # the tolerance; energies hold the area of a site
    assert np.linalg.norm(light - want) < 1e-5 * np.linalg.norm(want)


def test_energy_of_a_hexagonal_lens_is_that_which_leaves_it():
    """A window of the lens' size catches what leaves it; beyond lies the light that the
    rim and grazing rays take.
    """
    phase, level, *_ = lens()
    level = 0.87 * (level > 0)
    stack = psf.psf_stack(
        phase,
        level,
        **GRID,
        **VIEW | {"window_um": 60.0, "samples": 150},
        depths_um=np.inf,
    )
    assert 0.96 < float(stack.energy_um2[0]) / ((level**2).sum() * SITE) < 1.01
