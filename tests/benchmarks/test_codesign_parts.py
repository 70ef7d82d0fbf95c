"""Parts of the axial error of errors that are made up of known ones."""

import numpy as np
import pytest

from benchmarks import codesign_parts

PAIRS = 20_000
PERSON, NOISE, FRAME, WINDOW, TOGETHER = 0.23, 0.17, 0.11, 0.41, 0.29  # mm


def test_parts_of_errors_are_those_that_they_were_made_of() -> None:
    draw = np.random.default_rng(5)
    person = np.repeat(draw.normal(0, PERSON, PAIRS), 2)
    common = draw.normal(0, TOGETHER, 2 * PAIRS)
    rest = person + draw.normal(0, FRAME, 2 * PAIRS) - 0.7 * common
    axial = np.stack([rest + draw.normal(0, NOISE, 2 * PAIRS) for _ in range(2)])
    windows = common[:, None] + draw.normal(0, WINDOW, (2 * PAIRS, 49))
    found = codesign_parts.of_errors(axial, windows)
    variance = PERSON**2 + FRAME**2 + NOISE**2 + 0.49 * TOGETHER**2
    mean_variance = TOGETHER**2 + WINDOW**2 / 49
    share = (0.7 * TOGETHER**2) ** 2 / (variance * mean_variance)
    # Errors of a standard deviation from n normal numbers are 1 / sqrt(2 n) of it: four
    # of them, 0.02 for pairs. The
    # person's comes from a covariance of pairs: variance / sqrt(pairs) of PERSON^2,
    # four of them 0.09 / 2 of PERSON.
    assert found["rms_mm"] == pytest.approx(variance**0.5, rel=0.02)
    assert found["mean_abs_mm"] == pytest.approx(
        (2 * variance / np.pi) ** 0.5, rel=0.02
    )
    assert found["noise_mm"] == pytest.approx(NOISE, rel=0.02)
    assert found["person_mm"] == pytest.approx(PERSON, rel=0.05)
    assert found["window_mm"] == pytest.approx(
        (TOGETHER**2 + WINDOW**2) ** 0.5, rel=0.02
    )
    assert found["together_mm"] == pytest.approx(mean_variance**0.5, rel=0.02)
    assert found["together_share"] == pytest.approx(
        share, abs=0.02
    )  # 4 (1 - r^2) r 2 / sqrt(n) below 0.016


def test_what_is_told_up_to_its_squares_leaves_the_rest_alone() -> None:
    draw = np.random.default_rng(7)
    told = draw.normal(size=(1600, 5)) * [1.0, 3.0, 0.2, 1.0, 7.0] + 4.0
    unknown = 0.3 * draw.normal(size=1600)
    truth = (
        1.0
        + told @ [0.4, -0.2, 1.0, 0.0, 0.1]
        + 0.1 * told[:, 0] * told[:, 1]
        + unknown
    )
    # 5 + 15 numbers from 1400 frames add 20 / 1400 of the variance, the ridge 1e-3 of
    # what is explained, of rms 2.1:
    # 2e-3 mm; four statistical errors of the standard deviation of 1600 numbers are 7
    # %.
    assert codesign_parts.rms(codesign_parts.left_open(told, truth)) == pytest.approx(
        0.3, rel=0.08
    )


def test_no_pair_is_read_by_its_own_truth() -> None:
    draw = np.random.default_rng(9)
    person = np.repeat(
        draw.normal(size=(60, 30)), 2, 0
    )  # both frames of a person are told the same
    truth = np.repeat(draw.normal(size=60), 2)  # and nothing that has to do with it
    assert codesign_parts.rms(
        codesign_parts.left_open(person, truth)
    ) >= codesign_parts.rms(truth)
