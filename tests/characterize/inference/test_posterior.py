"""Profiles and draws where the answer is a formula: a straight model, a bent one, and
one with two lenses alike.
"""

import dataclasses
import math

import numpy as np
import pytest

from characterize.inference.knowable import profile_density
from characterize.inference.leastsquares import FitImages, GaussianPrior
from characterize.inference.posterior import (
    REACH,
    LocalMode,
    draw_posterior,
    log_evidence,
    mode_probabilities,
)
from tests.referees.one_profile import profile

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


def test_a_straight_model_has_the_parabola_s_interval():
    seen = data(straight(np.array([1.3, -0.4]), False)[0])
    mode, covariance = best(seen)
    valley = LocalMode(straight, seen, mode, GaussianPrior.none(mode))
    found, better = profile(valley, 1)
    reach = REACH * np.sqrt(covariance[1, 1])
    assert better is None
    assert found.parabolic
    assert found.low == pytest.approx(mode[1] - reach, rel=1e-9)
    assert found.high == pytest.approx(mode[1] + reach, rel=1e-9)


def test_half_the_volume_of_a_valley_is_that_of_its_covariance():
    """ln det C / 2 of two shapes that are alike in part: by the two sigmas and their
    correlation.
    """
    alike = np.stack([SHAPES[0], SHAPES[0] + 0.6 * SHAPES[1]])
    seen = data(np.tensordot([1.3, -0.4], alike, 1))
    mode = np.array([1.3, -0.4])
    valley = LocalMode(
        lambda x, j: (np.tensordot(x, alike, 1), alike),
        seen,
        mode,
        GaussianPrior.none(mode),
    )
    a, b, both = (
        (one * other).sum() / NOISE**2
        for one, other in ((alike[0],) * 2, (alike[1],) * 2, alike)
    )
    assert both**2 / (a * b) > 0.5
    assert log_evidence(valley) == pytest.approx(
        -math.log(a * b - both**2) / 2, rel=1e-9
    )


def test_moved_by_one_sigma_a_parameter_takes_the_others_to_their_best():
    """Of a straight model: the rest fitted by least squares with one amplitude held a
    sigma beside its best.
    """
    seen = data(straight(np.array([1.3, -0.4]), False)[0])
    mode, covariance = best(seen)
    valley = LocalMode(straight, seen, mode, GaussianPrior.none(mode))
    for i in (0, 1):
        held, free = SHAPES[i].ravel(), SHAPES[1 - i].ravel()
        moved = mode[i] + math.sqrt(covariance[i, i])
        rest = free @ (seen.electrons.ravel() - moved * held) / (free @ free)
        want = np.zeros(2)
        want[i], want[1 - i] = moved, rest
        assert mode + valley.along(i) == pytest.approx(want, rel=1e-9)


def test_errors_of_dark_and_flat_spread_the_estimate_as_the_whole_covariance_of_the_pixels_says():
    """C AᵀW (noise + common errors) W A C with the dense matrix of all pixels, against
    the sums over frames.
    """
    x, floor, light = np.array([1.3, -0.4]), 0.21, 0.17
    images = 3.0 + straight(x, False)[0]
    seen = dataclasses.replace(data(images), common_floor=floor, common_light=light)
    valley = LocalMode(
        lambda x, j: (3.0 + straight(x, j)[0], SHAPES), seen, x, GaussianPrior.none(x)
    )
    n = images[0].size
    alike = np.kron(np.ones((3, 3)), np.eye(n))
    lit = np.maximum(images, 0).ravel()
    common = (
        floor * NOISE**2 * (alike - np.eye(3 * n))
        + light**2 * np.outer(lit, lit) * alike
    )
    gain = valley.covariance @ SHAPES.reshape(2, -1) / NOISE**2
    assert valley.calibration() == pytest.approx(gain @ common @ gain.T, rel=1e-6)


def test_a_prior_narrows_the_interval_as_information_adds():
    seen = data(straight(np.array([1.3, -0.4]), False)[0])
    flat, covariance = best(seen)
    wide = np.full(2, np.inf)
    prior = GaussianPrior(np.array([0.0, -0.35]), np.array([np.inf, 0.03]), -wide, wide)
    information = np.linalg.inv(covariance) + np.diag([0, 0.03**-2])
    mode = np.linalg.solve(
        information, np.linalg.inv(covariance) @ flat + np.array([0, -0.35 / 0.03**2])
    )
    found, _ = profile(LocalMode(straight, seen, mode, prior), 1)
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

    mode, asked = np.array([back(amplitude[0]), amplitude[1]]), []

    def counted(x, jacobian):
        asked.append(jacobian)
        return bent(x, jacobian)

    found, better = profile(LocalMode(counted, seen, mode, GaussianPrior.none(mode)), 0)
    reach = REACH * np.sqrt(covariance[0, 0])
    ends = back(amplitude[0] - reach), back(amplitude[0] + reach)
    assert better is None
    assert found.low == pytest.approx(
        ends[0], abs=0.06 * (ends[1] - ends[0])
    )  # a step stops within 0.08 of the root
    assert found.high == pytest.approx(ends[1], abs=0.06 * (ends[1] - ends[0]))
    rise = np.interp(mode[0], found.value, found.rise)
    assert rise < 0.3
    assert asked.count(False) <= 12  # two on the way out, and five an end


def test_slopes_met_along_one_way_count_by_how_far_a_place_lies_that_way_in_sigmas():
    """Slopes that change with a projection by the curvature, of two parameters that go
    almost together: what was met
    at one place gives those of any other, without a further derivative, and at right
    angles to it those of the mode."""
    shapes = np.stack([SHAPES[0], SHAPES[0] + 0.11 * SHAPES[1]])
    curvature = shapes.reshape(2, -1) @ shapes.reshape(2, -1).T / NOISE**2
    place = np.array([0.9, -0.4])
    toward = (
        curvature @ place / (place @ curvature @ place)
    )  # of what lies along the place, 1 at the place itself
    bow, asked = 1.7 * np.random.default_rng(5).standard_normal(SHAPES[0].shape), []

    def bowed(x, jacobian):
        asked.append(jacobian)
        share = toward @ x
        image = np.tensordot(x, shapes, 1) + bow * share**2 / 2
        return image, shapes + np.multiply.outer(
            toward, bow * share
        ) if jacobian else None

    mode = np.zeros(2)
    exact = dataclasses.replace(
        data(np.zeros(SHAPES[0].shape)), electrons=np.zeros(SHAPES[0].shape)
    )
    valley = LocalMode(bowed, exact, mode, GaussianPrior.none(mode))
    valley.slopes_at(place)
    assert asked.count(True) == 2  # of the mode, and of the place
    across = np.array(
        [-curvature[1] @ place, curvature[0] @ place]
    )  # at right angles in sigmas
    assert across @ curvature @ place == pytest.approx(
        0, abs=1e-6 * abs(across @ curvature @ across)
    )
    across *= 3 / np.sqrt(across @ curvature @ across)
    for x in (1.4 * place, 0.6 * place + across, across, 1.1 * place - 2 * across):
        got, share = valley.slopes_at(x), toward @ x
        want = (shapes + np.multiply.outer(toward, bow * share)).reshape(
            2, -1
        ).T / NOISE
        assert np.abs(got[:-2] - want).max() < 1e-6 * np.abs(want).max()
    assert asked.count(True) == 2


def test_draws_of_a_bent_valley_have_the_data_s_spread():
    seen = data(bent(np.array([-1.1, 0.8]), False)[0])
    amplitude, covariance = best(seen)
    mode = np.array([-2 + 2 * np.sqrt(1 + amplitude[0]), amplitude[1]])
    some = draw_posterior(
        [LocalMode(bent, seen, mode, GaussianPrior.none(mode))], 400, seed=3
    )
    f = some[:, 0] + 0.25 * some[:, 0] ** 2
    assert f.mean() == pytest.approx(
        amplitude[0], abs=4 * np.sqrt(covariance[0, 0] / 400)
    )
    assert f.std() == pytest.approx(
        np.sqrt(covariance[0, 0]), rel=0.15
    )  # 400 draws: 3.5 % is one sigma


def test_two_lenses_alike_are_drawn_alike():
    seen = data(double(np.array([1.4, -0.6]), False)[0])
    amplitude, _ = best(seen)
    modes = [np.array([sign * np.sqrt(amplitude[0]), amplitude[1]]) for sign in (1, -1)]
    valleys = [
        LocalMode(double, seen, mode, GaussianPrior.none(mode)) for mode in modes
    ]
    assert mode_probabilities(valleys) == pytest.approx([0.5, 0.5], abs=1e-6)
    some = draw_posterior(valleys, 200, seed=4)
    assert 70 < (some[:, 0] > 0).sum() < 130  # binomial: 7 is one sigma


def test_a_profile_that_falls_below_its_mode_says_where():
    seen = data(bent(np.array([-1.1, 0.8]), False)[0])
    amplitude, _ = best(seen)
    wrong = np.array([-2 + 2 * np.sqrt(1 + amplitude[0]) + 0.35, amplitude[1]])
    valley = LocalMode(bent, seen, wrong, GaussianPrior.none(wrong))
    place, misfit = valley.descend(wrong)
    assert misfit < valley.least - 5
    assert place[0] + 0.25 * place[0] ** 2 == pytest.approx(amplitude[0], abs=0.02)


def test_the_density_of_a_parabola_is_the_normal_one_and_of_a_bent_profile_two_halves():
    at, z = np.linspace(2.0, 6.0, 41), np.array([-2.5, -1.0, 0.0, 1.0, 2.5])
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
    turn, shapes = (
        0.45,
        np.linalg.qr(np.random.default_rng(3).standard_normal((3 * 11 * 13, 3)))[0].T,
    )
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
    found, better = profile(LocalMode(turned, exact, mode, GaussianPrior.none(mode)), 0)
    reach = REACH * NOISE / 0.35
    assert turn * reach > math.radians(90)
    assert better is None
    assert (found.low, found.high) == pytest.approx(
        (mode[0] - reach, mode[0] + reach), abs=0.05 * reach
    )  # 0.08 of 1.96
