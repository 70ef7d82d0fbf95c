"""Counts coarser than their noise: sums over all counts, and levels of pixels by a
plain search of their likelihood.
"""

import math

import numpy as np
import pytest
from scipy import optimize, stats

from characterize.captures.rounding import DarkStatistics, quantization_score


def by_sum(off, noise):
    """Score of a count and the information of all, from the normal distribution's own
    functions.
    """

    def chance(distance):
        """Of a count so far from the light, from the tail that it lies in."""
        low, high = (abs(distance) - 0.5) / noise, (abs(distance) + 0.5) / noise
        return stats.norm.sf(low) - stats.norm.sf(high)

    def slope(distance):
        return (
            stats.norm.pdf((distance - 0.5) / noise)
            - stats.norm.pdf((distance + 0.5) / noise)
        ) / noise

    nearest = off - round(off)
    every = [nearest + k for k in range(-30, 31)]
    information = sum(slope(d) ** 2 / chance(d) for d in every if chance(d) > 1e-290)
    return slope(off) / chance(off), max(information, 1e-6)


def test_counts_of_unlike_noise_are_told_each_by_its_own():
    """Below a count of noise exactly, from one count on as if rounding were a variance
    of 1/12.
    """
    off = np.array([[0.2, -1.3, 0.45], [2.6, 0.0, -0.7], [0.31, -0.31, 1.9]])
    noise = np.array([[0.06, 0.9, 0.2], [0.99, 0.31, 0.5], [1.0, 3.7, 1.2]])
    score, information = quantization_score(off, noise)
    for at in np.ndindex(2, 3):
        want = by_sum(off[at], noise[at])
        assert score[at] == pytest.approx(want[0], rel=1e-9, abs=1e-12)
        assert information[at] == pytest.approx(want[1], rel=1e-9)
    assert score[2] == pytest.approx(off[2] / (noise[2] ** 2 + 1 / 12), rel=1e-12)
    assert information[2] == pytest.approx(1 / (noise[2] ** 2 + 1 / 12), rel=1e-12)
    assert [float(part) for part in quantization_score(0.45, 0.2)] == [
        score[0, 2],
        information[0, 2],
    ]  # plain numbers
    one = quantization_score(np.array([0.45, -0.2]), 0.2)[1]  # one noise for all
    assert one == pytest.approx([by_sum(0.45, 0.2)[1], by_sum(-0.2, 0.2)[1]], rel=1e-9)


def test_what_says_nothing_has_a_millionth():
    """In the middle of a count with 0.05 counts of noise: 1e-18 of information;
    half-way to the next 255.
    """
    found = quantization_score(np.array([0.0, 0.5]), np.array([0.05, 0.05]))[1]
    # of two counts whose chances are one half each: twice phi(0)² / s² over a half
    assert found == pytest.approx([1e-6, 2 / math.pi / 0.05**2], rel=1e-9)


def drawn(seed, level, scatter, noise, shape=(12, 40, 41)):
    rng = np.random.default_rng(seed)
    truth = level + scatter * rng.standard_normal(shape[1:])
    return truth, np.rint(truth + noise * rng.standard_normal(shape))


@pytest.mark.parametrize(("level", "noise"), [(9.31, 0.2), (-4.4, 0.27), (120.5, 0.15)])
def test_errors_of_dark_levels_are_as_large_as_the_levels_are_off(level, noise):
    """1640 pixels: 2 % of the scatter, without their common error; and their noise is
    told to a twentieth.
    """
    truth, counts = drawn(5, level, 0.09, noise)
    found = DarkStatistics.of(counts)
    off = found.level - truth
    assert (off - off.mean()).std() == pytest.approx(
        np.sqrt((found.error**2).mean()), rel=0.12
    )
    assert found.noise == pytest.approx(noise, rel=0.15)
    assert abs(off.mean()) < 0.03


def test_pixels_that_read_alike_have_one_level_and_its_error_by_their_likelihood():
    """The mean and the spread of a level among pixels' levels, by sums over a fine grid
    at the noise that was found.

    The common level and scatter are those that make all counts likeliest, told by their
    own mean and spread."""
    _, counts = drawn(8, 6.4, 0.1, 0.22)
    found = DarkStatistics.of(counts)
    often = np.stack([(counts == k).sum(0) for k in (5, 6, 7, 8)], -1)
    kinds = np.unique(often.reshape(-1, 4), axis=0)
    levels = {
        tuple(k): np.unique(found.level[(often == k).all(-1)].round(12)) for k in kinds
    }
    assert all(len(v) == 1 for v in levels.values())
    grid = np.linspace(5.5, 7.5, 4001)
    counted = np.array([5, 6, 7, 8])
    edges = [
        stats.norm.cdf((counted[:, None] + side - grid) / found.noise)
        for side in (0.5, -0.5)
    ]
    chance = np.log(np.maximum(edges[0] - edges[1], 1e-300))

    def posterior(common, scatter):
        weight = kinds @ chance - ((grid - common) / scatter) ** 2 / 2
        share = np.exp(weight - weight.max(1, keepdims=True))
        share /= share.sum(1, keepdims=True)
        mean = share @ grid
        return mean, np.sqrt(share @ grid**2 - mean**2)

    many = np.array([(often == k).all(-1).sum() for k in kinds])
    common, scatter = 6.4, 0.1
    for _ in range(200):  # expectation and maximisation
        mean, spread = posterior(common, scatter)
        common = float(many @ mean / many.sum())
        scatter = math.sqrt(
            float(many @ ((mean - common) ** 2 + spread**2) / many.sum())
        )
    mean, spread = posterior(common, scatter)
    for k, (want, error) in enumerate(zip(mean, spread, strict=True)):
        if many[k] < 5:
            continue
        place = (often == kinds[k]).all(-1)
        assert found.level[place] == pytest.approx(
            want, abs=0.01
        )  # the search also knows what noise is usual
        assert found.error[place] == pytest.approx(error, rel=0.06)


def test_hot_pixels_read_as_they_are_with_the_scatter_of_all():
    """Those with a single count four or more off the middle."""
    _, counts = drawn(3, 7.2, 0.05, 0.2, (9, 11, 12))
    counts[:, 2, 3] = 40.0
    counts[4, 5, 6] = 11.0
    counts[1, 7, 8] = 10.0  # three off: one of them all
    found = DarkStatistics.of(counts)
    assert found.level[2, 3] == 40.0
    assert found.level[5, 6] == pytest.approx(counts[:, 5, 6].mean())
    assert found.error[2, 3] == found.error[5, 6] == pytest.approx(counts.std() / 3)
    assert found.error[7, 8] < 0.5 * counts.std() / 3
    assert found.level.shape == found.error.shape == (11, 12)


def test_frames_that_read_alike_leave_what_is_usual_to_a_factor_of_two():
    """72 pixels, four times 7 each: noise about 0.15 and scatter about 0.1 counts, and
    the chance that all read so.
    """
    level = np.linspace(-1, 1, 2001)

    def unlikely(x):
        noise, scatter = np.exp(x)
        alike = stats.norm.cdf((0.5 - level) / noise) - stats.norm.cdf(
            (-0.5 - level) / noise
        )
        chance = np.trapezoid(stats.norm.pdf(level, scale=scatter) * alike**4, level)
        away = (x - np.log([0.15, 0.1])) / math.log(2)
        return away @ away / 2 - 72 * math.log(chance)

    best = optimize.minimize(
        unlikely,
        np.log([0.15, 0.1]),
        method="Nelder-Mead",
        options={"xatol": 1e-4, "fatol": 1e-6},
    )
    noise, scatter = np.exp(best.x)
    found = DarkStatistics.of(np.full((4, 9, 8), 7.0))
    assert found.noise == pytest.approx(
        noise, rel=0.02
    )  # the search ends at 1e-3, on 61 levels
    assert found.level == pytest.approx(np.full((9, 8), 7.0), abs=0.01)
    assert found.error[2, 3] == pytest.approx(
        scatter, rel=0.1
    )  # of levels whose ends are a little less likely
