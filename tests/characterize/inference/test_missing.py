"""Causes that are not fitted: chance is chance, what is there is found, and what cannot be told apart is said."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

import characterize
from characterize.inference.estimate import Options
from characterize.inference.missing import CHANCE, Fitted, Lean, untold, words

rng = np.random.default_rng(20)
SLOPES = rng.normal(size=(4, 900)) * np.array([[3.1], [0.7], [11.0], [2.3]])
CHANGES = rng.normal(size=(3, 900)) + 0.4 * SLOPES[:3]
PRIOR = np.diag([0.0, 0.3**-2.0, 0.0, 2.1**-2.0])


def fit_of(rest):
    """The residuals at the mode of a linear problem: data less what the least squares take, priors included."""
    known = SLOPES @ SLOPES.T + PRIOR
    return Fitted(
        ("one", "two", "three", "four"), SLOPES, known, rest - SLOPES.T @ np.linalg.solve(known, SLOPES @ rest)
    )


def test_where_nothing_is_missing_the_score_is_chi_square():
    """Mean and variance of chi-square of 3: 3 and 6, to 0.055 and 0.3 from 2000 draws. Truths follow the prior."""
    found = []
    for _ in range(2000):
        truth = rng.normal(size=4) * [0.0, 0.3, 0.0, 2.1]
        found.append(fit_of(rng.normal(size=900) + SLOPES.T @ truth).lean("any", CHANGES).chi2)
    assert np.mean(found) == pytest.approx(3, abs=0.22)
    assert np.var(found) == pytest.approx(6, abs=1.3)


def test_what_is_there_is_found_whatever_the_fit_takes_of_it():
    """Its own part that the slopes cannot make up: 0.3 sigma a pixel of 900 pixels, so 81 for each of three."""
    own = CHANGES - CHANGES @ np.linalg.pinv(SLOPES) @ SLOPES
    seen = fit_of(rng.normal(size=900) + 0.3 * CHANGES[1] + 5 * SLOPES[2]).lean("second", CHANGES[1:2])
    want = 0.09 * float(own[1] @ own[1])
    assert seen.chi2 == pytest.approx(want, abs=5 * 2 * np.sqrt(want))  # variance of chi² is 4 times its offset
    assert seen.degrees == 1
    assert seen.chance < CHANCE
    assert words([seen, Lean("other", 30.0, 1, 0.1)])[0].startswith("residuals lean towards second")
    assert not words([Lean("other", 3.0, 1, 0.1)])


def test_what_the_fit_makes_up_for_is_not_seen_but_said():
    fit = fit_of(rng.normal(size=900))
    change = 2.3 * SLOPES[0] - 0.41 * SLOPES[2]
    assert fit.lean("hidden", change[None]).degrees == 0
    told = fit.taken(change, "7 um")
    assert told.startswith("7 um would be taken for")
    assert "one +2.3 " in told
    assert "three -0.41 " in told
    assert untold([Lean("hidden", 0.0, 0, 1.0, told)]) == [f"hidden is not fitted: {told}"]
    assert fit.taken(change + 1.0, "7 um") == ""  # 30 sigma are left: it would be seen
    assert fit.taken(1e-4 * change, "7 um") == ""  # nothing moves


def test_a_ghost_in_the_frames_is_spoken_of():
    light = b.electrons()
    ghost = np.zeros_like(light)
    ghost[:, 5:, :-4] = light[:, :-5, 4:] - light.min()
    shots = b.capture(light + 0.05 * ghost, seed=4)
    found = characterize.fit(shots, b.lens(), Options(scan_um=60.0, insist=True), response=b.RESPONSE)
    assert "lean towards a ghost" in " ".join(found.cautions)
