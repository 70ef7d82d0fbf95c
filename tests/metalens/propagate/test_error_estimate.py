"""The sampled error of a window, against the sum over all of its pixels."""

import numpy as np
import pytest

from metalens.propagate import draw_pixels, sampled_square_error


def drawn(rng):
    """(depth, pixel) light of sum 1, and errors δ/S that grow with it."""
    y, x = (np.arange(n) - c for n, c in zip((29, 37), (9.1, 20.4), strict=True))
    spot = np.exp(-(y[:, None] ** 2 / 20 + x**2 / 50)).ravel() + 0.02
    light = spot * rng.uniform(0.6, 1.4, (3, spot.size))
    light /= light.sum(1, keepdims=True)
    return light, light * (0.03 + 0.1 * rng.standard_normal(light.shape))


def whole(light, difference):
    """Σ (δ/S - (I/S) Σδ/S)²."""
    gain = difference.sum(1, keepdims=True)
    return ((difference - light * gain) ** 2).sum()


def test_all_pixels_give_the_sum_itself_and_a_sample_its_mean():
    rng = np.random.default_rng(1)
    light, difference = drawn(rng)
    points, chance = draw_pixels(light.mean(0), light.shape[1])
    assert sampled_square_error(light[:, points], chance, difference) == pytest.approx(
        whole(light, difference), rel=1e-12
    )
    ratios = []
    for _ in range(200):
        light, difference = drawn(rng)
        points, chance = draw_pixels(light.mean(0), 128)
        found = sampled_square_error(light[:, points], chance, difference[:, points])
        ratios.append(found / whole(light, difference))
    # 3 x 128 squares of normal errors scatter by 10 %: their mean over 200 by 1 %
    assert np.mean(ratios) == pytest.approx(1, abs=0.04)
