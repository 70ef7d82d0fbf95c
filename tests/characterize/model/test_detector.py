"""From light to pixels: transfers as integrals over what blurs, places of fine samples,
waves of known phase.
"""

import math

import numpy as np
import pytest
from scipy import integrate

from characterize.model import detector
from characterize.model.detector import DetectorGrid

FX, FY = np.array([[0.13, 0.31, 0.02]]), np.array([[0.07], [-0.22]])
F = np.hypot(FX, FY)


def test_transfers_are_fourier_integrals_of_what_blurs():
    """A pixel over its square; disc and ball, in projection, along the direction of the
    wave; a Gaussian.
    """
    pixel, size = 2.3, 3.1

    def over(profile, reach, f):
        def wave(t):
            return profile(t) * math.cos(2 * math.pi * f * t)

        whole = integrate.quad(profile, -reach, reach, limit=200)[0]
        return integrate.quad(wave, -reach, reach, limit=200)[0] / whole

    def chord(t):
        return math.sqrt(max(size**2 / 4 - t * t, 0.0))

    def slab(t):  # area of a ball's slice
        return size**2 / 4 - t * t

    box = detector.pixel_transfer(FY, FX, pixel)
    spread = detector.gaussian_transfer(FY, FX, 0.9)[0]
    lit = detector.disc_transfer(FY, FX, size)
    glow = detector.ball_transfer(FY, FX, size)
    for (i, j), f in np.ndenumerate(F):
        one = over(lambda t: 1.0, pixel / 2, FX[0, j]) * over(
            lambda t: 1.0, pixel / 2, FY[i, 0]
        )
        assert box[i, j] == pytest.approx(one, rel=1e-9)
        assert spread[i, j] == pytest.approx(
            over(lambda t: math.exp(-t * t / 1.62), 9.0, f), rel=1e-7
        )
        assert lit[i, j] == pytest.approx(over(chord, size / 2, f), rel=1e-6)
        assert glow[i, j] == pytest.approx(over(slab, size / 2, f), rel=1e-7)
    zero = np.zeros((1, 1))
    assert detector.disc_transfer(zero, zero, size) == 1
    assert detector.ball_transfer(zero, zero, size) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("over", [1, 2, 3, 4])
def test_waves_arrive_at_pixel_centres_with_the_transfer_of_their_frequency(over):
    """Waves that close on the grid: the pixel at (r, c) sees cos(2π f·place), turned
    and weakened by the transfer.
    """
    grid = DetectorGrid(6, 9, 1.7, over, margin=2)
    y, x = grid.axes_um()
    fy, fx = 2 / (10 * 1.7), 3 / (13 * 1.7)
    light = 5 + np.cos(2 * math.pi * (fx * x + fy * y[:, None]) + 0.4)
    gy, gx = grid.frequencies()
    assert gx.shape[1] == 13 * over // 2 + 1
    transfer = np.exp(-2 * (gy**2 + 3 * gx**2)) * np.exp(
        -2j * math.pi * (gx * 0.31 - gy * 0.17)
    )
    seen = grid.sample(np.stack([light, 2 * light]), transfer)
    rows, columns = (np.arange(6) - 2.5) * 1.7, (np.arange(9) - 4) * 1.7
    moved = 2 * math.pi * (fx * (columns - 0.31) + fy * (rows[:, None] + 0.17)) + 0.4
    want = 5 + math.exp(-2 * (fy**2 + 3 * fx**2)) * np.cos(moved)
    assert seen[0] == pytest.approx(want, abs=1e-9)
    assert seen[1] == pytest.approx(2 * want, abs=1e-9)


def test_a_point_source_is_the_limit_of_small_discs():
    grid, shrink = DetectorGrid(6, 5, 2.4, 2), np.array([0.7, 1.2])
    light = np.random.default_rng(0).random((2, 20, 18))
    point, small = (
        detector.detector_transfer(grid, 0.4, size * shrink) for size in (0.0, 1e-4)
    )
    assert grid.sample(light, point) == pytest.approx(
        grid.sample(light, small), abs=1e-9
    )
