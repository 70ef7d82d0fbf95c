"""Errors at few samples of a window: how often an estimate that looks at some of them
states less than the truth.

The truth of a synthetic window is Σδ² over ΣI², both of sum 1, at places drawn evenly.
"""

import numpy as np
import pytest
import torch
from scipy import stats

from metalens import propagate
from metalens.propagate import estimate
from metalens.psf import compute

SIDE = 96
COUNT = SIDE * SIDE  # 9216 samples, 288 of which are looked at
CASE = propagate.make_case(
    (30, 30),
    pitch_um=0.4,
    wavelength_um=0.8,
    sensor_distance_um=90.0,
    depths_um=[1e3],
    window_um=96.0,
    samples=SIDE,
)
LIGHT = np.ones((1, COUNT)) + 0.05 * np.sin(
    np.arange(COUNT) / 700
)  # nearly even: a sample is drawn as any other


def stated_over_true(monkeypatch, draw, wrong, size):
    """What is stated of a window with errors of ``size`` times the light at ``wrong``
    samples, and the truth.
    """
    off = np.zeros((1, COUNT))
    at = draw.choice(COUNT, wrong, replace=False)
    off[0, at] = draw.choice([-1.0, 1.0], wrong) * size * LIGHT[0, at]
    seen = LIGHT + off

    def direct(windows, depths, points):
        assert (
            1 / 48 < len(points) / COUNT < 1 / 24
        )  # an estimate costs a thirtieth of a plain sum of the window
        return seen[:, points]

    monkeypatch.setattr(estimate, "_direct_light", direct)
    one = estimate.ErrorSample(CASE, 1.0, np.zeros((5, 6), complex), 0.0, 1)
    stated = estimate.relative_error([[one]], [LIGHT.reshape(1, SIDE, SIDE).copy()])
    return stated, float(np.linalg.norm(off) / np.linalg.norm(LIGHT))


def test_errors_at_one_sample_in_fourteen_are_understated_as_rarely_as_288_points_let_them(
    monkeypatch,
):
    """Hits are Poisson's, of mean 288 / 14 = 20.6; what is stated is 1.7 times the root
    of their share: 7 hits or
    fewer are too few, a chance of 5e-4. Of half as many points 3 hits or fewer would
    be, 1 %: 6 of 600 windows."""
    assert stats.poisson(288 / 14).cdf(20.6 / 1.7**2) < 1e-3
    assert stats.poisson(144 / 14).cdf(10.3 / 1.7**2) > 8e-3
    draw = np.random.default_rng(12)
    found = [stated_over_true(monkeypatch, draw, COUNT // 14, 1e-3) for _ in range(600)]
    assert sum(stated < true for stated, true in found) <= 2


def test_errors_as_large_as_the_setting_at_one_sample_in_three_thousand_are_reckoned_with_unseen(
    monkeypatch,
):
    """288 points meet none of three samples with a chance of nine in ten; what is
    stated is no less than the truth.
    """
    setting, draw = 3e-4, np.random.default_rng(5)
    blind = 0
    for _ in range(40):
        stated, true = stated_over_true(monkeypatch, draw, 3, setting)
        assert true == pytest.approx(setting * (3 / COUNT) ** 0.5, rel=0.2)
        blind += stated < true
        seen = compute.IntensityResult(torch.ones(1), stated, "", 1.0)
        told = compute._few_seen(seen, setting).error
        assert true < told < max(3 * stated, 0.1 * setting)
    assert blind > 25
