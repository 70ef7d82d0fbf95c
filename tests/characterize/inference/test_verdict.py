"""Checks of a finished fit at limits that noise sets: how often chance alone passes
them is known.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from characterize.captures import Gain
from characterize.inference import verdict
from characterize.inference.missing import Unstated
from characterize.model import PARAMETERS, PLACE

RNG = np.random.default_rng(2)
NOTHING = Unstated.none(3)


def rows_of(names):
    return [PARAMETERS[PLACE[name]] for name in names]


def solution(chi2, pixels=800):
    shown = np.zeros((1, 40, 40))
    shown.flat[:pixels] = 0.7
    return SimpleNamespace(chi2_per_dof=chi2, residual_sigma=shown)


def test_chance_of_chi_square_is_root_two_over_the_pixels_that_count():
    assert verdict.chance_of(solution(1.0)) == pytest.approx(math.sqrt(2 / 800))
    means = (RNG.standard_normal((3000, 800)) ** 2).mean(1)
    assert means.std() == pytest.approx(
        verdict.chance_of(solution(1.0)), rel=0.06
    )  # 3000 draws: 1.3 %


def test_a_fit_is_explained_within_four_sigma_of_pixels_and_gain_together():
    """800 pixels: 0.05; a gain known to 4 %: 0.04; four times both in squares is 0.256,
    above the 15 % of many.
    """
    gain = Gain(2.5, 0.1, 3.0)
    limit = 1 + 4 * math.hypot(math.sqrt(2 / 800), 0.04)
    assert verdict.explained(solution(limit - 1e-3), gain)
    assert not verdict.explained(solution(limit + 1e-3), gain)
    sure = Gain(2.5, 0.0, 3.0)
    assert verdict.explained(solution(1.149, 1600), sure)
    assert not verdict.explained(solution(1.151, 1600), sure)
    assert not verdict.explained(solution(1.501, 20), sure)


def test_more_than_noise_begins_at_three_sigma_and_ends_where_it_is_another_lens():
    assert [verdict.left_over(solution(c)) for c in (1.149, 1.151, 30.9, 31.1)] == [
        False,
        True,
        True,
        False,
    ]


def words(residual, what):
    return any(what in line for line in verdict.structure(residual))


def test_noise_is_not_taken_for_structure():
    assert not any(
        verdict.structure(RNG.standard_normal((5, 20, 24))) for _ in range(200)
    )


def test_errors_of_dark_and_flat_go_together_from_frame_to_frame_and_are_expected():
    """Eleven frames of 24 x 24: 0.16 + 0.09 of each product is common, 19 sigma if it
    were not known to be.
    """
    dark, flat = np.full((2, 11, 24, 24), [[[[0.4]]], [[[0.3]]]])
    told = {"known": 0, "not": 0, "more": 0}
    for _ in range(60):
        own, common = (
            RNG.standard_normal((11, 24, 24)),
            RNG.standard_normal((3, 24, 24)),
        )
        residual = math.sqrt(1 - 0.4**2) * own + 0.4 * common[0] + 0.3 * common[1]
        told["known"] += bool(verdict.structure(residual, np.stack([dark, flat])))
        told["not"] += bool(verdict.structure(residual))
        more = verdict.structure(residual + 0.45 * common[2], np.stack([dark, flat]))
        told["more"] += any("frame to frame" in line for line in more)
    assert told == {"known": 0, "not": 60, "more": 60}


@pytest.mark.parametrize("axis", [1, 2])
@pytest.mark.parametrize("alike", [9, 2])
def test_neighbours_that_go_together_by_more_than_four_sigma_and_a_half_are_told(
    axis, alike
):
    """Signs along the axis of which ``alike`` pairs more are alike than unlike; along
    the other axis they alternate.

    20 places in 19 pairs times 24 lines: alike * 24 / sqrt(19 * 24), 10.1 and 2.2
    sigma.
    """
    turns = np.arange(19) < (19 - alike) // 2 + (19 - alike) % 2
    line = np.cumprod([1.0, *np.where(turns, -1.0, 1.0)])
    residual = line[:, None] * np.where(np.arange(24) % 2, -1.0, 1.0)
    residual = residual[None] if axis == 1 else residual.T[None]
    assert words(residual, "from pixel to pixel") is (alike == 9)


def test_statistics_of_structure_are_in_sigma_of_noise():
    """The three of them on noise have mean 0 and standard deviation 1, so that 4.5 is a
    chance of 7e-6.
    """
    many = RNG.standard_normal((2000, 9, 11))
    sides = verdict._together(many[:, :, 1:], many[:, :, :-1])
    assert sides.std() == pytest.approx(1.0, abs=0.06)  # 2000 draws: 0.016
    masked = many * (RNG.uniform(size=many.shape) > 0.4)
    assert verdict._together(masked[:, 1:], masked[:, :-1]).std() == pytest.approx(
        1.0, abs=0.06
    )


def test_frames_that_share_what_is_missed_are_told():
    """Two frames of 99 pixels with correlation c: c sqrt(99) sigma."""
    base = RNG.choice([-1.0, 1.0], (1, 9, 11))
    for unlike, told in (
        (26, True),
        (28, False),
    ):  # (99 - 2 u) / sqrt(99) = 4.72 and 4.32
        turned = base.copy()
        turned.flat[:unlike] *= -1
        assert words(np.concatenate([base, turned]), "from frame to frame") is told


def test_a_frame_of_another_exposure_is_told():
    """Mean residual times the root of the pixels: 5 sigma are the limit, and the frame
    is named.
    """
    noise = np.tile(np.array([[1.0, -1.0], [-1.0, 1.0]]), (3, 5, 6))
    for level, told in ((0.47, True), (0.45, False)):  # of 120 pixels: 5.15 and 4.93
        shifted = noise.copy()
        shifted[1] += level
        assert words(shifted, "frame 1 is brighter or darker") is told


def test_bounds_that_a_parameter_ran_into_are_named():
    names = ("bias_nm", "pinhole_um", "crosstalk_px", "height_nm")
    prior = SimpleNamespace(
        low=np.array([-5.0, 0.0, 0.02, -9.0]), high=np.array([5.0, 20.0, 3.0, 9.0])
    )
    found = SimpleNamespace(
        value=np.array([-5.0, 0.0, 3.0, 8.9]), beyond=np.array([-2.1, -7.0, 2.1, 9.0])
    )
    assert verdict.at_bounds(names, found, prior) == [
        ("bias_nm", -5.0),
        ("crosstalk_px", 3.0),
    ]
    assert "bias_nm ran to its bound -5" in verdict.held_back(names, found, prior)[0]
    weak = SimpleNamespace(value=found.value, beyond=np.array([-1.9, -7.0, 1.9, 9.0]))
    assert not verdict.held_back(names, weak, prior)


def test_what_is_known_is_an_interval_within_the_usual_uncertainty():
    """3.92 sigma make an interval of 95 %; told above 0.7 of the prior is prior
    knowledge.
    """
    names = ("bias_nm", "height_nm", "background_e")
    scales = [PARAMETERS[PLACE[name]].scale for name in names]
    low = np.array([50.0, -1.9 * scales[1], 0.0])
    high = np.array([50.0 + 3.9 * scales[0], 2.1 * scales[1], 1.0])
    words = verdict.process_verdict(
        rows_of(names), low, high, np.array([0.2, 0.69, 0.9]), NOTHING
    )
    assert f"known to bias_nm +- {3.9 * scales[0] / 3.92:.2g}" in words
    assert f"loosely: height_nm {low[1]:.3g} to {high[1]:.3g}" in words
    assert "prior" not in words
    words = verdict.process_verdict(
        rows_of(names), low, high, np.array([0.2, 0.71, 0]), NOTHING
    )
    assert "from prior knowledge only: height_nm" in words


def test_what_others_may_have_moved_is_known_within_the_model_alone():
    """Two causes of 1.5 and 0.4 standard errors: the first takes its parameter out of
    what is known, by its name.
    """
    names = ("bias_nm", "height_nm", "coma_x_rad")
    sigma = np.array([0.8, 1.0, 0.01])
    low, high = -1.96 * sigma, 1.96 * sigma
    by_cause = np.array([[1.2, 0.0, 0.0], [0.0, 0.4, 0.0], [0.0, 0.0, 0.003]])
    moved = np.diag(by_cause.sum(0) ** 2)
    unstated = Unstated(
        ("a plate of glass", "an oblique saddle", "uneven light"),
        by_cause,
        moved,
        np.zeros((3, 3)),
    )
    words = verdict.process_verdict(
        rows_of(names), low, high, np.full(3, 0.1), unstated
    )
    assert words.startswith(
        "the process is known to height_nm +- 1.1, coma_x_rad +- 0.01;"
    )
    assert "within the model only, that is without plate of glass" in words
    assert "bias_nm +- 0.8 (else +- 1.4)" in words
