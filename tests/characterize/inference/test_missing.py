"""Causes that are not fitted: chance is chance, what is there is found, and what cannot
be told apart is said.
"""

import dataclasses
import math
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage, stats

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.bench import bench
from characterize.captures import to_electrons
from characterize.inference import causes, estimate, missing
from characterize.inference.estimate import FitOptions
from characterize.inference.missing import (
    CHANCE,
    FitAtMode,
    ScoreTest,
    ScoreTests,
    run_score_tests,
    score_test_text,
    undetectable_effects,
)
from characterize.inference.prepare import data_of
from characterize.inference.search import SearchTask, refine_fit
from characterize.model import PLACE, ForwardModel, FrameSetting, parameter_vector
from metalens.core.errors import FitError
from metalens.fabrication import WavefrontError, maps
from metalens.lens import DiameterMap

rng = np.random.default_rng(20)
SLOPES = rng.normal(size=(4, 900)) * np.array([[3.1], [0.7], [11.0], [2.3]])
CHANGES = rng.normal(size=(3, 900)) + 0.4 * SLOPES[:3]
PRIOR = np.diag([0.0, 0.3**-2.0, 0.0, 2.1**-2.0])
ALONE = np.zeros((2, 9, 10, 10))


def fit_of(rest, shared=ALONE):
    """The residuals at the mode of a linear problem: data less what the least squares
    take, priors included.
    """
    known = SLOPES @ SLOPES.T + PRIOR
    mode = np.linalg.solve(known, SLOPES @ rest)
    return FitAtMode(
        ("one", "two", "three", "four"),
        SLOPES,
        known,
        rest - SLOPES.T @ mode,
        shared,
        PRIOR @ mode,
    )


def test_where_nothing_is_missing_the_score_is_chi_square():
    """Mean and variance of chi-square of 3: 3 and 6, to 0.055 and 0.3 from 2000 draws.
    Truths follow the prior.
    """
    found = []
    for _ in range(2000):
        truth = rng.normal(size=4) * [0.0, 0.3, 0.0, 2.1]
        found.append(
            fit_of(rng.normal(size=900) + SLOPES.T @ truth).lean("any", CHANGES).chi2
        )
    assert np.mean(found) == pytest.approx(3, abs=0.22)
    assert np.var(found) == pytest.approx(6, abs=1.3)


def test_errors_that_are_one_in_all_frames_are_not_taken_for_a_cause():
    """Nine frames, each with the dark's error as 0.4 of its unit noise and the flat's
    as 0.3 beyond it.

    A cause that looks the same in all frames would scatter with variance 1 + 8 * 0.16 +
    9 * 0.09 = 3.09, not 1.
    """
    dark, flat = np.full((2, 9, 10, 10), [[[[0.4]]], [[[0.3]]]])
    alike = np.tile(rng.normal(size=100), 9)[None]
    found, plain = [], []
    for _ in range(1500):
        own, common = rng.normal(size=(9, 100)), rng.normal(size=(2, 100))
        noise = (
            math.sqrt(1 - 0.4**2) * own + 0.4 * common[0] + 0.3 * common[1]
        ).ravel()
        found.append(fit_of(noise, np.stack([dark, flat])).lean("any", alike).chi2)
        plain.append(fit_of(noise).lean("any", alike).chi2)
    assert np.mean(found) == pytest.approx(1, abs=0.16)  # 1500 draws: 0.037
    assert np.mean(plain) == pytest.approx(3.09, abs=0.5)


def test_what_the_fit_makes_up_for_is_not_seen_but_said():
    fit = fit_of(rng.normal(size=900))
    change = 2.3 * SLOPES[0] - 0.41 * SLOPES[2]
    assert fit.lean("hidden", change[None]).degrees == 0
    told = fit.taken(change, 7.0, "{:.3g} um")
    assert told.startswith("7 um would be taken for")
    assert "one +2.3 " in told
    assert "three -0.41 " in told
    assert undetectable_effects([ScoreTest("hidden", 0.0, 0, 1.0, told)]) == [
        f"hidden is not fitted: {told}"
    ]
    own = CHANGES[0] - CHANGES[0] @ np.linalg.pinv(SLOPES) @ SLOPES
    loud = (
        8.0 * own / np.linalg.norm(own)
    )  # 8 sigma are left of it: only half as much would not be seen
    assert fit.taken(change + loud, 7.0, "{:.3g} um").startswith(
        "3.5 um would be taken for"
    )
    assert fit.taken(1e-5 * change, 7.0, "{:.3g} um") == ""  # nothing moves


def errors_of(causes, shared, common, draws=3000):
    """Errors of the fit (draws, 4) over many truths, noises and causes of unit size,
    and what is reckoned with.
    """
    errors, reckoned = [], []
    solve = np.linalg.inv(SLOPES @ SLOPES.T + PRIOR)
    for _ in range(draws):
        truth = np.where(
            np.diag(PRIOR) > 0, rng.normal(size=4) * [1.0, 0.3, 1.0, 2.1], 0.0
        )
        rest = (
            common(rng.normal(size=900))
            + SLOPES.T @ truth
            + rng.normal(size=len(causes)) @ causes
        )
        errors.append(solve @ (SLOPES @ rest) - truth)
        looked = ScoreTests(
            [], fit_of(rest, shared), {"first": causes[:1], "others": causes[1:]}
        )
        reckoned.append(looked.reckoned().sigma)
    return np.array(errors), np.sqrt(np.diag(solve)), np.array(reckoned)


def test_intervals_hold_with_causes_of_plausible_size():
    """Causes of unit size, of which the frames see one well, one a little and one not
    at all.

    The second moment of the error about the fit is that of the parabola and what is
    reckoned with, on average; 3000
    draws give it to 4 %. Within the parabola alone it is far too small.
    """
    own = CHANGES - CHANGES @ np.linalg.pinv(SLOPES) @ SLOPES
    own /= np.linalg.norm(own, axis=1)[:, None]
    size = np.sqrt(np.diag(SLOPES @ SLOPES.T))
    causes = np.stack(
        [
            SLOPES[0] * 2 / size[0],
            SLOPES[1] * 3 / size[1] + 5 * own[0],
            SLOPES[2] / size[2] + own[1],
        ]
    )
    errors, sigma, reckoned = errors_of(causes, ALONE, lambda noise: noise)
    want = (errors**2).mean(0)
    assert want == pytest.approx(sigma**2 + (reckoned**2).mean(0), rel=0.12)
    assert (want[:3] > 1.5 * sigma[:3] ** 2).all()


def test_what_is_reckoned_with_knows_that_errors_of_dark_are_one_in_all_frames():
    """The dark's error is as large as the noise of each of nine frames: a cause alike
    in all is seen worse.
    """
    dark = np.zeros((2, 9, 10, 10))
    dark[0] = 0.7
    alike = np.tile(rng.normal(size=100), 9)
    left = alike - alike @ np.linalg.pinv(SLOPES) @ SLOPES
    cause = (SLOPES[0] / np.linalg.norm(SLOPES[0]) + 2 * left / np.linalg.norm(left))[
        None
    ]

    def common(noise):
        return (
            math.sqrt(1 - 0.49) * noise.reshape(9, 100) + 0.7 * rng.normal(size=100)
        ).ravel()

    errors, sigma, reckoned = errors_of(cause, dark, common)
    assert (errors[:, 0] ** 2).mean() == pytest.approx(
        sigma[0] ** 2 + (reckoned[:, 0] ** 2).mean(), rel=0.12
    )


def test_each_cause_has_its_share():
    fit = fit_of(rng.normal(size=900))
    cause = 2.3 * SLOPES[0] - 0.41 * SLOPES[2]
    looked = ScoreTests([], fit, {"hidden": cause[None], "twice": 2 * cause[None]})
    found = looked.reckoned()
    assert found.causes == ("hidden", "twice")
    assert found.by_cause[0, [0, 2]] == pytest.approx(
        [2.3, 0.41], rel=1e-2
    )  # the prior of a third of 3e-4
    assert found.sigma[0] == pytest.approx(
        2.3 * math.sqrt(5), rel=1e-2
    )  # nothing of either is seen: they are apart
    loud = cause + 40 * SLOPES[1] * rng.normal(size=900)
    for roughly, more in (
        (frozenset(), False),
        (frozenset({"loud"}), True),
    ):  # no frame bounds what is known roughly
        shift = ScoreTests([], fit, {"loud": loud[None]}, roughly).reckoned().sigma[0]
        assert (
            shift == pytest.approx(abs(float(fit.moved_by(loud[None])[0, 0])), rel=1e-9)
        ) == more
    assert ScoreTests([], fit, {}).reckoned().sigma.tolist() == [0, 0, 0, 0]


def lean_of(light, seed):
    """The causes seen in noisy frames of a hidden lens, fitted from its true
    parameters.
    """
    shots = b.capture(light, seed=seed)
    seen = data_of(to_electrons(shots), (slice(None), slice(None)))
    setting = FrameSetting(
        np.array(b.DEPTHS), np.zeros((5, 2)), np.ones(5), 1.5, 16, 16
    )
    model = ForwardModel(b.lens(), setting, b.RESPONSE)
    start = parameter_vector(b.VALUES)
    bare = model.images(
        parameter_vector(b.VALUES | {"background_e": 0.0, "background_x_e": 0.0})
    )[0]
    start[PLACE["log_gain"]] = np.log((light.max() - 20.0) / bare.max())
    task = SearchTask(model, seen, start, {}, None)
    place = [PLACE[name] for name in task.names]
    return run_score_tests(task, refine_fit(task, start[place])).leans


def shifted(light):
    ghost = np.zeros_like(light)
    ghost[:, 5:, :-4] = light[:, :-5, 4:] - light.min()
    return ghost


FAULTS = {
    "a ghost": lambda light: light + 0.05 * shifted(light),
    "vibration or blur in single": lambda light: np.stack(
        [ndimage.gaussian_filter(frame, 0.7 * (i % 2)) for i, frame in enumerate(light)]
    ),
    "vibration or blur along one": lambda light: ndimage.gaussian_filter(
        light, (0, 0.2, 0.6), mode="nearest"
    ),
    "a lamp": lambda light: (
        light * (1 + 0.06 * np.array([0, 1, -1, 1, -1]))[:, None, None]
    ),
}


def test_write_fields_moved_alike_are_a_lean_and_single_ones_are_not():
    """All 16 fields moved by 1 um along x: phase k x (1/r + 1/s), nearly a lean, and
    nothing odd along y.
    """
    lens = b.lens()
    fields = causes.write_fields(lens)
    t = np.linspace(-1, 1, 33)
    u, v = (part[np.hypot(*np.meshgrid(t, t)) <= 0.97] for part in np.meshgrid(t, t))
    every = np.concatenate(
        [causes.smooth_phase_changes(u, v, 27), maps(WavefrontError, u, v)]
    )
    found = fields[:16].sum(0) @ every
    r = 20.0 * np.hypot(u, v)
    want = (
        2
        * np.pi
        / 0.85
        * 20.0
        * u
        * (1 / np.hypot(r, lens.sensor_distance_um) + 1 / np.hypot(r, 600.0))
    )
    assert (
        np.abs(found - want).max() < 0.02 * np.abs(want).max()
    )  # sine for tangent at the rim, 1.6 % of third order
    single = fields @ every
    assert (np.abs(single).max(1) < 2 * np.abs(want).max()).all()


@pytest.mark.parametrize("cause", FAULTS)
def test_faults_of_a_bench_are_named(cause):
    """Each is far above the noise of 6000 e, and no parameter does the same."""
    found = lean_of(FAULTS[cause](b.electrons()), 4)
    told = [one.cause for one in found if one.chance < CHANCE] or found[:2]
    assert any(str(one).startswith(cause) for one in told[:2]), told
    assert score_test_text(found)


def test_a_patch_without_pillars_is_named_with_its_place():
    """4.8 by 3.2 um of 40 about x 6, y -9: 1.2 % of the light of a spot, 70 of 6000 e;
    places are 4 um apart.
    """
    d = b.lens().diameters
    gone = (abs(d.y_um + 9.0) < 1.6)[:, None] & (abs(d.x_um - 6.0) < 2.4)
    holed = dataclasses.replace(
        b.lens(), diameters=DiameterMap(np.where(gone, 0, d.diameter_um), d.pitch_um)
    )
    light = bench.bench_irradiance(holed, b.truth(), b.RESPONSE)
    first = lean_of(
        light * (6000.0 / light.max()) + bench.background_plane(b.truth()), 6
    )[0]
    assert first.chance < CHANCE
    x, y = map(
        float, re.search(r"patch .* about x (\S+), y (\S+) um", first.cause).groups()
    )
    assert math.hypot(x - 6.0, y + 9.0) < 4.0


def test_patches_are_seldom_found_in_noise(monkeypatch):
    """The best of 81 places: a chance of 1e-4 takes a chi-square of 22 where one place
    has 15.
    """
    monkeypatch.setattr(missing, "_PATCHY", -100.0)
    (one,) = (
        one for one in lean_of(b.electrons(), 5) if one.cause.startswith("a patch")
    )
    assert one.chance == pytest.approx(min(1.0, 81 * stats.chi2.sf(one.chi2, 1) / 2))
    assert one.chance > 1e-2


@pytest.mark.parametrize("turn_deg", [0.0, 30.0, 45.0, 110.0])
def test_blur_along_one_direction_changes_light_by_its_second_derivatives(turn_deg):
    """A Gaussian of 3 pixels whose variance is s² more along a direction and s² less
    across it, to first order in s²;
    central differences of such a Gaussian err by (3 to 5) / (6 x 9), along each axis.
    """
    y, x = np.mgrid[:31, :35] - np.array([14.6, 17.3])[:, None, None]
    s2, turn = 0.3, np.radians(turn_deg)
    a, o = s2 * np.cos(2 * turn), s2 * np.sin(2 * turn)

    def spot(sign):
        inverse = np.linalg.inv([[9 + sign * a, sign * o], [sign * o, 9 - sign * a]])
        q = inverse[0, 0] * x**2 + 2 * inverse[0, 1] * x * y + inverse[1, 1] * y**2
        return np.exp(-q / 2) * np.sqrt(np.linalg.det(inverse))

    want = (spot(1) - spot(-1)) / 2
    along, diagonal = causes._along_one(spot(0)[None])[:, 0]
    assert (
        np.abs(a / 2 * along + o / 2 * diagonal - want).max() < 0.1 * np.abs(want).max()
    )


def test_a_refusal_names_what_the_residuals_lean_to():
    leans = [
        ScoreTest("a ghost", 90.0, 1, 1e-9),
        ScoreTest("a lamp", 40.0, 4, 1e-6),
        ScoreTest("a drift", 2.0, 1, 0.2),
    ]
    with pytest.raises(
        FitError,
        match=r"refused: a bad fit; residuals lean towards a ghost.*; a lamp.* explain",
    ):
        estimate._refuse(["a bad fit"], FitOptions(), leans)
    with pytest.raises(FitError, match=r"refused: a bad fit$"):
        estimate._refuse(["a bad fit"], FitOptions(), leans[2:])
    estimate._refuse([], FitOptions(), leans)
    estimate._refuse(["a bad fit"], FitOptions(insist=True), leans)


def test_a_clean_bench_is_called_clean_and_glass_is_declared():
    found = lean_of(b.electrons(), 5)
    assert not score_test_text(found)
    wall = next(one for one in found if one.cause.startswith("a side wall"))
    assert wall.chi2 < 16
    glass = next(one for one in undetectable_effects(found) if "plate of glass" in one)
    assert "distance_um" in glass or "stage_zero_um" in glass
