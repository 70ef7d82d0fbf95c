"""Causes that are not fitted: chance is chance, what is there is found, and what cannot be told apart is said."""

import math
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.captures import clean
from characterize.inference.missing import CHANCE, Fitted, Lean, leans, untold, words
from characterize.inference.prepare import data_of
from characterize.inference.search import Task, refine
from characterize.model import PLACE, ForwardModel, Setting, vector

rng = np.random.default_rng(20)
SLOPES = rng.normal(size=(4, 900)) * np.array([[3.1], [0.7], [11.0], [2.3]])
CHANGES = rng.normal(size=(3, 900)) + 0.4 * SLOPES[:3]
PRIOR = np.diag([0.0, 0.3**-2.0, 0.0, 2.1**-2.0])
ALONE = np.zeros((2, 9, 10, 10))


def fit_of(rest, shared=ALONE):
    """The residuals at the mode of a linear problem: data less what the least squares take, priors included."""
    known = SLOPES @ SLOPES.T + PRIOR
    left = rest - SLOPES.T @ np.linalg.solve(known, SLOPES @ rest)
    return Fitted(("one", "two", "three", "four"), SLOPES, known, left, shared)


def test_where_nothing_is_missing_the_score_is_chi_square():
    """Mean and variance of chi-square of 3: 3 and 6, to 0.055 and 0.3 from 2000 draws. Truths follow the prior."""
    found = []
    for _ in range(2000):
        truth = rng.normal(size=4) * [0.0, 0.3, 0.0, 2.1]
        found.append(fit_of(rng.normal(size=900) + SLOPES.T @ truth).lean("any", CHANGES).chi2)
    assert np.mean(found) == pytest.approx(3, abs=0.22)
    assert np.var(found) == pytest.approx(6, abs=1.3)


def test_errors_that_are_one_in_all_frames_are_not_taken_for_a_cause():
    """Nine frames, each with the dark's error as 0.4 of its unit noise and the flat's as 0.3 beyond it.

    A cause that looks the same in all frames would scatter with variance 1 + 8 * 0.16 + 9 * 0.09 = 3.09, not 1.
    """
    dark, flat = np.full((2, 9, 10, 10), [[[[0.4]]], [[[0.3]]]])
    alike = np.tile(rng.normal(size=100), 9)[None]
    found, plain = [], []
    for _ in range(1500):
        own, common = rng.normal(size=(9, 100)), rng.normal(size=(2, 100))
        noise = (math.sqrt(1 - 0.4**2) * own + 0.4 * common[0] + 0.3 * common[1]).ravel()
        found.append(fit_of(noise, np.stack([dark, flat])).lean("any", alike).chi2)
        plain.append(fit_of(noise).lean("any", alike).chi2)
    assert np.mean(found) == pytest.approx(1, abs=0.16)  # 1500 draws: 0.037
    assert np.mean(plain) == pytest.approx(3.09, abs=0.5)


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
    told = fit.taken(change, 7.0, "{:.3g} um")
    assert told.startswith("7 um would be taken for")
    assert "one +2.3 " in told
    assert "three -0.41 " in told
    assert untold([Lean("hidden", 0.0, 0, 1.0, told)]) == [f"hidden is not fitted: {told}"]
    own = CHANGES[0] - CHANGES[0] @ np.linalg.pinv(SLOPES) @ SLOPES
    loud = 8.0 * own / np.linalg.norm(own)  # 8 sigma are left of it: only half as much would not be seen
    assert fit.taken(change + loud, 7.0, "{:.3g} um").startswith("3.5 um would be taken for")
    assert fit.taken(1e-5 * change, 7.0, "{:.3g} um") == ""  # nothing moves


def lean_of(light, seed):
    """The causes seen in noisy frames of a hidden lens, fitted from its true parameters."""
    shots = b.capture(light, seed=seed)
    seen = data_of(clean(shots), (slice(None), slice(None)))
    setting = Setting(np.array(b.DEPTHS), np.zeros((5, 2)), np.ones(5), 1.5, 16, 16)
    model = ForwardModel(b.lens(), setting, b.RESPONSE)
    start = vector(b.VALUES)
    bare = model.images(vector(b.VALUES | {"background_e": 0.0, "background_x_e": 0.0}))[0]
    start[PLACE["log_gain"]] = np.log((light.max() - 20.0) / bare.max())
    task = Task(model, seen, start, {}, None)
    place = [PLACE[name] for name in task.names]
    return leans(task, refine(task, start[place]))


def shifted(light):
    ghost = np.zeros_like(light)
    ghost[:, 5:, :-4] = light[:, :-5, 4:] - light.min()
    return ghost


FAULTS = {
    "a ghost": lambda light: light + 0.05 * shifted(light),
    "vibration": lambda light: np.stack(
        [ndimage.gaussian_filter(frame, 0.7 * (i % 2)) for i, frame in enumerate(light)]
    ),
    "a lamp": lambda light: light * (1 + 0.06 * np.array([0, 1, -1, 1, -1]))[:, None, None],
}


@pytest.mark.parametrize("cause", FAULTS)
def test_faults_of_a_bench_are_named(cause):
    """Each is far above the noise of 6000 e, and no parameter does the same."""
    found = lean_of(FAULTS[cause](b.electrons()), 4)
    told = [one.cause for one in found if one.chance < CHANCE] or found[:2]
    assert any(str(one).startswith(cause) for one in told[:2]), told
    assert words(found)


def test_a_clean_bench_is_called_clean_and_glass_is_declared():
    found = lean_of(b.electrons(), 5)
    assert not words(found)
    wall = next(one for one in found if one.cause.startswith("a side wall"))
    assert wall.chi2 < 16
    glass = next(one for one in untold(found) if "plate of glass" in one)
    assert "distance_um" in glass or "stage_zero_um" in glass
