"""Profiles and draws where the answer is a formula: a straight model, a bent one, and
one with two lenses alike.
"""

import dataclasses
import math

import numpy as np
import pytest

from characterize.inference.identifiability import profile_density
from characterize.inference.leastsquares import (
    FitImages,
    FitProblem,
    GaussianPrior,
    SolverSettings,
)
from characterize.inference.uncertainty import (
    REACH,
    draw_posterior,
    mode_probabilities,
    profile_parameters,
    shared_calibration,
)

NOISE = 0.7
SHAPES = np.random.default_rng(0).standard_normal((2, 3, 11, 13))


def data(images, seed=1):
    """Noise of one size on noise-free images."""
    noise = NOISE * np.random.default_rng(seed).standard_normal(images.shape)
    everywhere = np.ones(images.shape, bool)
    return FitImages(
        images + noise,
        everywhere,
        ~everywhere,
        np.full(images.shape, NOISE**2),
        np.full(images.shape, 1e12),
    )


def straight(x, jacobian):
    return np.tensordot(x, SHAPES, 1), SHAPES if jacobian else None


def bent(x, jacobian):
    """The first parameter acts as x + x² / 4: its valley is a parabola only close to a
    mode.
    """
    f = x[0] + 0.25 * x[0] ** 2
    image = f * SHAPES[0] + x[1] * SHAPES[1]
    return image, np.stack(
        [(1 + 0.5 * x[0]) * SHAPES[0], SHAPES[1]]
    ) if jacobian else None


def double(x, jacobian):
    image = x[0] ** 2 * SHAPES[0] + x[1] * SHAPES[1]
    return image, np.stack([2 * x[0] * SHAPES[0], SHAPES[1]]) if jacobian else None


def best(seen):
    """Amplitudes of the two shapes by least squares, and their covariance."""
    columns = SHAPES.reshape(2, -1).T
    return np.linalg.lstsq(columns, seen.electrons.ravel(), rcond=None)[
        0
    ], NOISE**2 * np.linalg.inv(columns.T @ columns)


def settled(model, seen, start, prior=None):
    """The problem, and its fit from close by."""
    start = np.asarray(start, float)
    problem = FitProblem(model, seen, prior or GaussianPrior.none(start))
    return problem, problem.fit(start, SolverSettings(step_tolerance=1e-4))


def profile(problem, mode, i):
    """95 % profile of one parameter."""
    return profile_parameters(problem, mode, [i], REACH**2)[i]


def test_a_straight_model_has_the_parabola_s_interval():
    seen = data(straight(np.array([1.3, -0.4]), False)[0])
    value, covariance = best(seen)
    found = profile(*settled(straight, seen, value), 1)
    reach = REACH * np.sqrt(covariance[1, 1])
    assert not found.stops
    assert found.low == pytest.approx(value[1] - reach, rel=1e-6)
    assert found.high == pytest.approx(value[1] + reach, rel=1e-6)


def test_errors_of_dark_and_flat_spread_the_estimate_as_the_whole_covariance_of_the_pixels_says():
    """C AᵀW (noise + common errors) W A C with the dense matrix of all pixels, against
    the sums over frames.
    """
    x, floor, light = np.array([1.3, -0.4]), 0.21, 0.17
    images = 3.0 + straight(x, False)[0]
    seen = dataclasses.replace(data(images), common_floor=floor, common_light=light)
    problem, mode = settled(
        lambda x, j: (3.0 + straight(x, j)[0], SHAPES if j else None), seen, x
    )
    n = images[0].size
    alike = np.kron(np.ones((3, 3)), np.eye(n))
    lit = np.maximum(mode.image, 0).ravel()
    common = (
        floor * NOISE**2 * (alike - np.eye(3 * n))
        + light**2 * np.outer(lit, lit) * alike
    )
    gain = mode.covariance @ SHAPES.reshape(2, -1) / NOISE**2
    want = gain @ common @ gain.T
    assert shared_calibration(problem, mode) == pytest.approx(want, rel=1e-6)


def test_a_prior_narrows_the_interval_as_information_adds():
    seen = data(straight(np.array([1.3, -0.4]), False)[0])
    flat, covariance = best(seen)
    wide = np.full(2, np.inf)
    prior = GaussianPrior(np.array([0.0, -0.35]), np.array([np.inf, 0.03]), -wide, wide)
    information = np.linalg.inv(covariance) + np.diag([0, 0.03**-2])
    found = profile(*settled(straight, seen, flat, prior), 1)
    assert (found.high - found.low) / 2 == pytest.approx(
        REACH * np.sqrt(np.linalg.inv(information)[1, 1]), rel=1e-6
    )


def test_a_bent_valley_is_followed_to_its_ends():
    """x + x²/4 is linear in the data: its ends are those of a parabola, and x follows
    by the root.
    """
    seen = data(bent(np.array([-1.1, 0.8]), False)[0])
    amplitude, covariance = best(seen)

    def back(f):
        return -2 + 2 * np.sqrt(1 + f)

    problem, mode = settled(bent, seen, [back(amplitude[0]), amplitude[1]])
    found = profile(problem, mode, 0)
    reach = REACH * np.sqrt(covariance[0, 0])
    ends = back(amplitude[0] - reach), back(amplitude[0] + reach)
    close = 0.06 * (ends[1] - ends[0])  # a parabola within 15 % is left as it is
    assert found.low == pytest.approx(ends[0], abs=close)
    assert found.high == pytest.approx(ends[1], abs=close)
    assert len(found.stops) <= 8


def test_a_bound_ends_an_interval():
    seen = data(straight(np.array([1.3, -0.4]), False)[0])
    value, covariance = best(seen)
    sigma = np.sqrt(covariance[0, 0])
    wide = np.full(2, np.inf)
    low = np.array([value[0] - 0.7 * sigma, -np.inf])
    prior = GaussianPrior(value, wide, low, wide)
    found = profile(*settled(straight, seen, value, prior), 0)
    assert found.low == pytest.approx(low[0], rel=1e-12)
    assert found.high == pytest.approx(value[0] + REACH * sigma, abs=0.02 * sigma)


def test_draws_of_a_bent_valley_have_the_data_s_spread():
    seen = data(bent(np.array([-1.1, 0.8]), False)[0])
    amplitude, covariance = best(seen)
    problem, mode = settled(bent, seen, [-2 + 2 * np.sqrt(1 + amplitude[0]), 0.8])
    stops = profile(problem, mode, 0).stops
    some, size = draw_posterior(problem, [mode, *stops], count=400, seed=3)
    # uniform in x, so that f = x + x² / 4 has its density over 1 + x / 2
    x = np.linspace(-1.9, 3.0, 20001)
    f = x + 0.25 * x**2
    density = np.exp(-((f - amplitude[0]) ** 2) / (2 * covariance[0, 0]))
    density /= density.sum()
    mean = (density * x).sum()
    sigma = math.sqrt((density * (x - mean) ** 2).sum())
    assert size > 200
    assert some[:, 0].mean() == pytest.approx(mean, abs=4 * sigma / math.sqrt(200))
    assert some[:, 0].std() == pytest.approx(sigma, rel=0.2)  # 4 of 5 %


def test_two_lenses_alike_are_drawn_alike():
    seen = data(double(np.array([1.4, -0.6]), False)[0])
    amplitude, _ = best(seen)
    ends = [
        settled(double, seen, [sign * np.sqrt(amplitude[0]), amplitude[1]])
        for sign in (1, -1)
    ]
    modes = [mode for _, mode in ends]
    assert mode_probabilities(modes) == pytest.approx([0.5, 0.5], abs=1e-4)
    some, _ = draw_posterior(ends[0][0], modes, count=200, seed=4)
    assert 70 < (some[:, 0] > 0).sum() < 130  # binomial: 7 is one sigma


def test_a_mode_weighs_by_its_height_and_its_volume():
    """exp(-rise / 2) times the root of the determinant of its covariance."""
    seen = data(straight(np.array([1.3, -0.4]), False)[0])
    _, one = settled(straight, seen, best(seen)[0])
    other = dataclasses.replace(
        one, merit=one.merit + 1.7, covariance=4.0 * one.covariance
    )
    share = mode_probabilities([one, other])
    assert share[1] / share[0] == pytest.approx(4.0 * math.exp(-0.85), rel=1e-9)


def test_the_density_of_a_parabola_is_the_normal_one_and_of_a_bent_profile_two_halves():
    at = np.linspace(2.0, 6.0, 41)
    z = np.array([-2.5, -1.0, 0.0, 1.0, 2.5])
    want = np.exp(-(((at - 4.1) / 0.7) ** 2) / 2) / (0.7 * math.sqrt(2 * math.pi))
    assert profile_density(np.array([4.1 + 0.7 * z, z**2]), at) == pytest.approx(
        want, rel=0.014
    )  # tails beyond 2.5 sigma: 1.2 %
    bent = np.array([4.1 + np.where(z > 0, 1.1, 0.3) * z, z**2])
    left, middle, right = profile_density(bent, np.array([4.1 - 0.6, 4.1, 4.1 + 2.2]))
    assert left == pytest.approx(right, rel=1e-12)  # two sigma of its own side each
    assert left / middle == pytest.approx(math.exp(-2), rel=1e-12)
    assert middle == pytest.approx(2 / (1.4 * math.sqrt(2 * math.pi)), rel=0.014)


def test_a_profile_ends_right_where_the_slopes_of_the_mode_have_turned_round():
    """Two amplitudes turned by 0.45 x, and x itself on a third picture: whatever x, the
    two fit, so that its profile is
    that of the third alone; at its ends the slopes of the others point 100 degrees from
    those at the mode."""
    turn = 0.45
    shapes = np.linalg.qr(np.random.default_rng(3).standard_normal((3 * 11 * 13, 3)))[
        0
    ].T
    shapes = shapes.reshape(3, 3, 11, 13)

    def turned(x, jacobian):
        c, s = math.cos(turn * x[0]), math.sin(turn * x[0])
        first, second = c * x[1] - s * x[2], s * x[1] + c * x[2]
        image = first * shapes[0] + second * shapes[1] + 0.35 * x[0] * shapes[2]
        by_x = turn * (-second * shapes[0] + first * shapes[1]) + 0.35 * shapes[2]
        slopes = by_x, c * shapes[0] + s * shapes[1], -s * shapes[0] + c * shapes[1]
        return image, np.stack(slopes) if jacobian else None

    mode = np.array([0.3, 7.0, -4.0])
    seen = data(turned(mode, False)[0])
    exact = dataclasses.replace(seen, electrons=turned(mode, False)[0])
    found = profile(*settled(turned, exact, mode), 0)
    reach = REACH * NOISE / 0.35
    assert turn * reach > math.radians(90)
    assert (found.low, found.high) == pytest.approx(
        (mode[0] - reach, mode[0] + reach), abs=0.05 * reach
    )  # a place within 5 % of the root ends a side
