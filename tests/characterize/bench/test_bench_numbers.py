"""Blur and cell means of the virtual bench in closed form."""

import numpy as np
import pytest

from characterize.bench.bench import _blur, _cell_means

X = np.arange(81) - 40.0


def moments(light):
    total = light.sum()
    return total, *((light.sum(1 - axis) * X**2).sum() / total for axis in (0, 1))


def test_cell_means_of_a_wave_are_the_sinc_of_its_frequency():
    """The mean over a cell is sinc(f) times the wave; the stencil keeps the first two
    terms: f⁴ is left out.
    """
    for axis, frequency in ((0, 0.08), (1, 0.05)):
        wave = 7.3 + np.cos(2 * np.pi * frequency * X + 0.4)
        light = wave[:, None] + 0 * X if axis == 0 else wave + 0 * X[:, None]
        want = 7.3 + np.sinc(frequency) * np.cos(2 * np.pi * frequency * X + 0.4)
        got = _cell_means(light)[40] if axis == 1 else _cell_means(light)[:, 40]
        assert got[3:-3] == pytest.approx(
            want[3:-3], abs=(np.pi * frequency) ** 4 / 20
        )  # 16 / 288 - 1 / 120


def test_blur_adds_the_variance_of_disc_and_gaussian():
    """A uniform disc of diameter D adds D² / 16 along each axis, a Gaussian its own;
    the light is kept.
    """
    spot = np.exp(-(X[:, None] ** 2) / 18 - X**2 / 8)
    total, *before = moments(spot)
    for disc, gauss in ((9.0, 0.0), (0.0, 2.3), (6.5, 1.7)):
        after = moments(_blur(spot, disc, gauss))
        assert after[0] == pytest.approx(total, rel=1e-6)
        for one, other in zip(after[1:], before, strict=True):
            # the disc is drawn in eighths of a pixel and averaged over pixels, which
            # adds 1/12
            assert one - other == pytest.approx(
                disc**2 / 16 + gauss**2, abs=0.15 if disc else 1e-3
            )
    assert _blur(spot, 0.1, 0.0) == pytest.approx(spot)
