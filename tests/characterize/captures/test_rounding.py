"""Counts coarser than their noise, against scipy's normal distribution, draws, and the
likelihood maximised by hand.
"""

import numpy as np
import pytest
from scipy import optimize, stats

from characterize.captures import quantization_score
from characterize.captures.rounding import DarkStatistics
from characterize.inference import leastsquares, prepare
from characterize.inference.leastsquares import FitImages


def chances(light, noise):
    """Counts and the chance of each, by the distribution's own function."""
    counts = np.arange(-40, 41)
    return counts, stats.norm.cdf((counts + 0.5 - light) / noise) - stats.norm.cdf(
        (counts - 0.5 - light) / noise
    )


@pytest.mark.parametrize("noise", [0.07, 0.21, 0.48, 0.97, 1.9])
@pytest.mark.parametrize("light", [0.03, 0.31, 0.5, 0.84])
def test_score_and_information_are_those_of_the_normal_distribution(noise, light):
    """Score: ln P by central differences; on average 0, with the information as its
    variance.
    """
    counts, chance = chances(light, noise)
    some, step = chance > 1e-4, 1e-4 * noise
    slope = (
        np.log(chances(light + step, noise)[1][some])
        - np.log(chances(light - step, noise)[1][some])
    ) / (2 * step)
    score, _ = quantization_score((counts - light)[some], np.full(some.sum(), noise))
    assert score == pytest.approx(
        slope, rel=5e-3, abs=1e-6
    )  # the step: 1e-7; above a count of noise a line stands for it
    some = chance > 1e-14
    score, information = quantization_score(
        (counts - light)[some], np.full(some.sum(), noise)
    )
    weight = chance[some]
    assert float(weight @ score) == pytest.approx(0, abs=1e-8 / noise)
    wanted = max(float(weight @ score**2), 1e-6)
    assert information[0] == pytest.approx(
        wanted, rel=1e-6
    )  # above one count of noise: 1 / (s² + 1/12) to 1e-8


@pytest.mark.parametrize(("level", "noise"), [(9.31, 0.13), (9.5, 0.21), (8.72, 0.27)])
def test_dark_level_and_noise_are_found_below_a_count(level, noise):
    rng = np.random.default_rng(3)
    true = level + 0.08 * rng.standard_normal((31, 27))
    found = DarkStatistics.of(np.rint(true + noise * rng.standard_normal((9, 31, 27))))
    off = found.level - true
    assert found.noise == pytest.approx(
        noise, abs=0.025
    )  # 7500 draws, of which a sixth tell: 0.01
    assert (
        abs(off.mean()) < 0.05
    )  # the mean of the counts is off by 0.1 to 0.27 but at 9.5
    assert off.std() < 1.25 * np.sqrt((found.error**2).mean())


def test_dark_frames_that_all_read_the_same_leave_the_level_open():
    counts = np.full((4, 9, 8), 7.0)
    counts[:, 3, 4] = 61.0  # a hot pixel stays as it reads
    found = DarkStatistics.of(counts)
    assert found.level[3, 4] == 61.0
    assert np.abs(np.delete(found.level, 3 * 8 + 4) - 7).max() < 0.1
    assert 0.05 < found.noise < 0.3
    assert 0.04 < found.error[0, 0] < 0.2


def seen(rng, light, gain, read):
    electrons = rng.poisson(light) + read * rng.standard_normal(light.shape)
    return gain * np.rint(electrons / gain)


def test_fit_of_rounded_counts_ends_where_their_likelihood_is_greatest():
    """One spot on a background below a count: (brightness, background), by Nelder and
    Mead on the exact likelihood.
    """
    rng, gain, read = np.random.default_rng(13), 29.0, 4.3
    y, x = np.mgrid[-6:7, -6:7]
    shape = np.stack([np.exp(-(x**2 + y**2) / s) for s in (3.1, 7.7)])
    truth = np.array([411.0, 9.7])  # a third of a count
    electrons = seen(rng, truth[0] * shape + truth[1], gain, read)
    full = np.ones(shape.shape, bool)
    floor = np.full(shape.shape, read**2 + gain**2 / 12)
    counts = FitImages(
        electrons, full, ~full, floor, np.ones(shape.shape), count_e=gain
    )

    def model(value, jacobian):
        return value[0] * shape + value[1], np.stack(
            [shape, np.ones_like(shape)]
        ) if jacobian else None

    found = leastsquares.fit_levenberg_marquardt(model, counts, truth)
    plain = found
    for _ in range(6):
        noise = np.sqrt(read**2 + found.image)  # held, as the weights of a fit are
        found = leastsquares.fit_levenberg_marquardt(
            model, prepare.correct_quantization(counts, found.image), found.value
        )

    def unlikely(value):
        off = (electrons - model(value, False)[0]) / gain
        upper, lower = (
            stats.norm.logcdf((half - np.abs(off)) * gain / noise)
            for half in (0.5, -0.5)
        )
        return -float((upper + np.log1p(-np.exp(lower - upper))).sum())

    best = optimize.minimize(
        unlikely, truth, method="Nelder-Mead", options={"xatol": 1e-5, "fatol": 1e-9}
    ).x
    sigma = np.sqrt(np.diag(found.covariance))
    assert (np.abs(found.value - best) < 0.05 * sigma).all()
    assert (np.abs(found.value - truth) < 3 * sigma).all()
    assert (
        abs(plain.value[1] - truth[1]) > 4 * sigma[1]
    )  # a third of a count reads as less
    assert found.chi2_per_dof == pytest.approx(
        1, abs=0.3
    )  # 338 pixels: 0.08, and their scores are no normal numbers
