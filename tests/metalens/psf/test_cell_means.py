"""What means over cells leave of a perfect lens's light, by its modulation transfer
function.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch

from metalens import propagate
from metalens.psf.cells import (
    BORDER,
    FINER,
    PixelCells,
    integrate_cells,
    nyquist_um,
    plan_pixel_cells,
)

CASE = propagate.make_case((60, 60), pitch_um=0.4, wavelength_um=0.85, sensor_distance_um=30.0, depths_um=[np.inf],
                      window_um=30.0, samples=12)  # fmt: skip


@pytest.mark.parametrize("finer", FINER)
def test_what_is_left_of_the_shortest_wave_is_told(finer):
    """cos(2 pi f x) along x and along y at f = B: the mean over a cell, sinc(pi f w),
    against what is made of it.
    """
    fine = plan_pixel_cells(CASE, finer)
    wide = 12 * fine.points
    at = (
        np.arange(wide + 2 * BORDER) - (wide + 2 * BORDER - 1) / 2
    ) * fine.case.step_um
    band = 1 / (2 * nyquist_um(CASE))
    middle = (np.arange(12) - 5.5) * CASE.step_um
    for phase in (0.0, 0.7):
        wave, mean = (np.cos(2 * np.pi * band * a + phase) for a in (at, middle))
        light = torch.from_numpy(3 + wave[None, :] + wave[:, None] * 0.5)
        shrunk = np.sinc(band * CASE.step_um) * mean
        got, error = integrate_cells(light[None], fine)
        want = 3 + shrunk[None, :] + 0.5 * shrunk[:, None]
        true = np.linalg.norm(got[0].numpy() - want) / np.linalg.norm(want)
        assert (
            0.4 * error < true <= error
        )  # told twice, and for points as far apart as Nyquist's step allows


@pytest.mark.parametrize("along", ["x", "y", "both"])
def test_the_second_correction_vouches_where_the_fourth_is_nothing(along):
    """Of a parabola, which means meet exactly: 1/12 of its bend is put on, of which the
    estimate takes its shares.
    """
    fine = PixelCells(3, CASE, (0.11, 0.23))
    at = np.arange(12 + 2 * BORDER) - 5.5 - BORDER
    y, x = (
        (at[:, None], at)
        if along == "both"
        else (0 * at[:, None], at)
        if along == "x"
        else (at[:, None], 0 * at)
    )
    got, error = integrate_cells(
        torch.from_numpy(40 + 0.7 * x**2 + 0.4 * y**2)[None], fine
    )
    bend = (0.7 if along != "y" else 0) / 12 + (0.4 if along != "x" else 0) / 12
    inside = (np.arange(12) - 5.5).reshape(4, 3) ** 2
    means = inside.mean(1)
    first = (
        40
        + 0.7 * means * (along != "y")
        + 0.4 * means[:, None] * (along != "x")
        + np.zeros((4, 4))
    )
    assert got[0].numpy() == pytest.approx(first + bend, rel=1e-12)
    assert error == pytest.approx(
        0.11 * 0.23 * bend * 4 / np.linalg.norm(first), rel=1e-9
    )


def drawn(seed, finer):
    """(light on fine samples, means over the cells) of a lens of random pupil: |sum of
    rays|², beat by beat.
    """
    draw = np.random.default_rng(seed)
    down, across = draw.integers(1, 6, 2).tolist()
    case = replace(
        CASE, samples=(down, across), step_um=nyquist_um(CASE) * draw.uniform(1.1, 6.0)
    )
    fine, half = plan_pixel_cells(case, finer), 1 / (4 * nyquist_um(case))
    axis = np.linspace(-half, half, 9)
    rays = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    rays = rays[np.hypot(*rays.T) <= half]
    bent = np.exp(
        1j
        * (
            draw.normal(size=2) @ rays.T / half * 6
            + 4 * draw.normal() * (rays**2).sum(1) / half**2
        )
    )
    level = bent * draw.uniform(0.3, 1, len(rays))
    beats, weight = rays[:, None] - rays, level[:, None] * level.conj()

    def light(y, x, shrink=1.0):
        waves = [
            np.exp(2j * np.pi * np.multiply.outer(a, beats[..., i]))
            for i, a in enumerate((x, y))
        ]
        return np.einsum("ypq,xpq,pq->yx", waves[1], waves[0], weight * shrink).real

    y, x = ((np.arange(n) - (n - 1) / 2) * fine.case.step_um for n in fine.case.samples)
    wide = np.prod(np.sinc(beats * case.step_um), -1)
    at = ((np.arange(n) - (n - 1) / 2) * case.step_um for n in case.samples)
    return torch.from_numpy(light(y, x))[None], light(*at, wide), fine


def test_the_error_of_few_cells_holds():
    """Windows of 1 to 25 cells anywhere in the light of random pupils: at most 1 of 60
    above its estimate, by a half at
    most (cells are few, and what is left of them has another sign in each)."""
    ratios = []
    for seed in range(60):
        light, want, fine = drawn(seed, FINER[0])
        got, error = integrate_cells(light, fine)
        ratios.append(
            np.linalg.norm(got[0].numpy() - want) / np.linalg.norm(want) / error
        )
    assert sum(ratio > 1 for ratio in ratios) <= 1
    assert max(ratios) < 1.5
    assert np.median(ratios) > 0.02  # and is of use


def test_cells_of_polynomials_of_fifth_degree_are_exact():
    """x⁴ y and x² y² and x⁵ over cells of three points 0.4 apart: integrals of each
    over the cell by hand.
    """
    fine = PixelCells(3, CASE, (0.3, 0.2))
    at = (np.arange(3 * 4 + 2 * BORDER) - 7.5) * 0.4
    y, x = at[:, None], at[None, :]
    light = torch.from_numpy(90 + x**4 * y + x**2 * y**2 - 0.3 * x**5 + 0 * y)
    ends = (np.arange(5) - 2) * 1.2
    mean = {n: np.diff(ends ** (n + 1)) / (n + 1) / 1.2 for n in (1, 2, 4, 5)}
    want = 90 + np.outer(mean[1], mean[4]) + np.outer(mean[2], mean[2]) - 0.3 * mean[5]
    got, error = integrate_cells(light[None], fine)
    assert got[0].numpy() == pytest.approx(want, rel=1e-12)
    assert error > 0
    assert integrate_cells(0 * light[None], fine)[1] == 0
