"""The bars of a result, put together by hand: intervals, the gain's share, causes that
nobody stated, draws, words.
"""

import math
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.bench import bench
from characterize.bench.bench import Camera, Truth
from characterize.captures import Gain
from characterize.inference import estimate, verdict
from characterize.inference.asbuilt import WithinModel
from characterize.inference.ends import Profile
from characterize.inference.leastsquares import Prior
from characterize.inference.missing import Unstated
from characterize.inference.search import with_values
from characterize.model import NAMES, PLACE, vector
from characterize.model.parameters import Known

RNG = np.random.default_rng(57)
Z = 1.959963984540054  # of 95 %
FITTED = ("bias_nm", "log_gain", "height_nm", "background_e")
VALUE = np.array([2.3, 9.1, -4.7, 23.0])
OWN = np.array(
    [
        [0.49, 0.001, -0.3, 0.05],
        [0.001, 4e-4, 0.002, -0.01],
        [-0.3, 0.002, 2.6, 0.2],
        [0.05, -0.01, 0.2, 0.7],
    ]
)
LOW, HIGH = (
    VALUE - np.array([1.1, 0.9, 3.7, 1.2]),
    VALUE + np.array([1.9, 0.02, 2.6, 9.0]),
)
GAIN = Gain(3.1, 0.4, 2.0)
SHARE = 0.4 / 3.1
WITH_GAIN = OWN + np.outer([0, SHARE, 0, 23 * SHARE], [0, SHARE, 0, 23 * SHARE])
SHIFTS = np.array(
    [[0.8, 0.003, -1.3, 0.4], [0.1, -0.02, 2.1, 0.9]]
)  # of two causes, one sigma each
UNSTATED = Unstated(
    ("glass", "wall"), np.abs(SHIFTS), SHIFTS.T @ SHIFTS, np.outer(SHIFTS[0], SHIFTS[0])
)
WIDE = np.full(4, 99.0)
CAMERA = Camera(pixel_um=1.5, pixels=16)


def posterior(**more):
    best = SimpleNamespace(
        value=VALUE,
        information=np.diag([3.0, 5.0, 7.0, 11.0]),
        image=np.full((2, 3, 4), 31.0),
        residual_sigma=np.full((2, 3, 4), 0.3),
        chi2_per_dof=1.07,
        converged=True,
        reason="made",
    )
    about = dict(
        best=best,
        low=LOW,
        high=HIGH,
        covariance=OWN,
        draws=np.empty((0, 4)),
        profiles={},
    )
    return SimpleNamespace(**(about | more))


def test_within_the_model_the_gain_widens_what_is_counted_in_electrons_and_nothing_else():
    """Gain and background to 1.96 sigma with the gain's error where that lies farther
    out than the profile's end; of
    bias and height the profile's ends, though their 1.96 sigma lie farther out on one
    side."""
    found = posterior(draws=RNG.normal(size=(7, 4)))
    within = estimate._within(found, WITH_GAIN, FITTED)
    light, dark = Z * math.sqrt(4e-4 + SHARE**2), Z * math.sqrt(0.7 + (23 * SHARE) ** 2)
    assert Z * 0.7 > 1.1  # of the bias: beyond its profile's lower end
    assert within.low == pytest.approx([LOW[0], 9.1 - 0.9, LOW[2], 23 - dark], rel=1e-6)
    assert within.high == pytest.approx(
        [HIGH[0], 9.1 + light, HIGH[2], 23 + 9.0], rel=1e-6
    )
    assert within.covariance is WITH_GAIN
    assert within.draws is found.draws


def test_a_parameter_is_told_by_the_width_of_its_interval_over_that_of_the_prior():
    """Of 1.96 sigma to both sides: a posterior of 0.31, 0.9 and 1.02 of the prior's
    sigma.
    """
    share, sigma = np.array([0.31, 0.9, 1.02]), np.array([3.0, 0.02, 7.0])
    found = SimpleNamespace(
        low=VALUE[:3] - 0.4 * share * sigma,
        high=VALUE[:3] + (2 * Z - 0.4) * share * sigma,
    )
    task = SimpleNamespace(prior=SimpleNamespace(sigma=sigma))
    assert estimate._told(task, found) == pytest.approx(
        share, rel=1e-3
    )  # 1.96 for 1.95996


def test_draws_scatter_by_what_nobody_stated_and_stay_inside_the_bounds():
    """Each about its own place, with the second moment of the shifts; cut at the bounds
    of the prior.
    """
    places = np.tile([[1.0, -2.0, 0.5, 3.0], [-6.0, 4.0, 2.0, -1.0]], (30_000, 1))
    task = SimpleNamespace(prior=Prior(np.zeros(4), WIDE, -WIDE, WIDE))
    moved = estimate._drawn(task, places, UNSTATED) - places
    size = np.sqrt(np.diag(UNSTATED.covariance))
    assert np.abs(moved.mean(0) / size).max() < 0.025  # 60 000 draws: 0.004
    assert (
        np.abs(
            (moved.T @ moved / len(moved) - UNSTATED.covariance) / np.outer(size, size)
        ).max()
        < 0.035
    )  # 0.006
    low, high = np.array([-6.3, -2.0, -99.0, -1.1]), np.array([99.0, 4.2, 0.9, 3.0])
    cut = SimpleNamespace(prior=Prior(np.zeros(4), WIDE, low, high))
    assert estimate._drawn(cut, places, UNSTATED) == pytest.approx(
        np.clip(moved + places, low, high), abs=1e-12
    )
    nothing = np.empty((0, 4))
    assert estimate._drawn(task, nothing, UNSTATED) is nothing


@pytest.fixture(scope="module")
def seen():
    """Frames of a lens and bench of the fitted values, at two depths; a task of these
    parameters, and its start.
    """
    data, model = b.near_focus((480.0, 800.0), bias_nm=2.3, height_nm=-4.7)
    start = vector({"stage_scale": 0.002, "crosstalk_px": 0.2})
    prior = Prior(np.zeros(4), np.array([3.0, 5.0, 8.0, 9.0]), -WIDE, WIDE)
    return b.Given(model, data, start, {}, None, names=FITTED, prior=prior)


def result(task, gain, **more):
    """A posterior of that task, put together: residuals of the same sign everywhere,
    and background at its bound.
    """
    image = task.model.images(
        with_values(task.start, dict(zip(FITTED, VALUE.tolist(), strict=True)))
    )[0]
    best = SimpleNamespace(
        value=VALUE,
        covariance=OWN,
        information=np.diag([3.0, 5.0, 7.0, 11.0]),
        image=image,
        residual_sigma=np.full(image.shape, 0.9),
        chi2_per_dof=1.07,
        converged=True,
        reason="made",
        beyond=np.array([0.0, 0.0, 0.0, 7.0]),
    )
    about = dict(
        best=best,
        parabolic=np.array([False, True, True, True]),
        modes=(best,),
        share=np.ones(1),
    )
    found = posterior(**about | more)
    high = np.where(np.arange(4) == 3, VALUE, WIDE)
    task = replace(task, prior=replace(task.prior, high=high))
    looked = SimpleNamespace(reckoned=lambda: UNSTATED, leans=[])
    return (
        task,
        found,
        estimate._result(
            SimpleNamespace(pixel_um=1.5), task, found, ["before"], gain, looked
        ),
    )


def test_a_result_adds_variances_and_holds_intervals_in_quadrature(seen):
    """Own, the gain's and what nobody stated: three variances of one sum; each end by
    itself.
    """
    curve = Profile(
        1.0, 2.0, np.array([1.0, 2.0, 4.0]), np.array([3.0, 0.0, 5.0]), parabolic=False
    )
    draws = np.tile(VALUE, (5, 1)) + RNG.normal(size=(5, 4)) * np.sqrt(np.diag(OWN))
    task, found, built = result(seen, GAIN, draws=draws, profiles={"bias_nm": curve})
    within = estimate._within(found, WITH_GAIN, FITTED)
    more = Z * np.hypot(*SHIFTS)
    assert built.covariance == pytest.approx(WITH_GAIN + SHIFTS.T @ SHIFTS, rel=1e-12)
    assert built.within.covariance == pytest.approx(WITH_GAIN, rel=1e-12)
    assert built.low == pytest.approx(
        VALUE - np.sqrt((VALUE - within.low) ** 2 + more**2), rel=1e-6
    )
    assert built.high == pytest.approx(
        VALUE + np.sqrt((within.high - VALUE) ** 2 + more**2), rel=1e-6
    )
    assert built.draws == pytest.approx(estimate._drawn(task, draws, UNSTATED))
    assert isinstance(built.within, WithinModel)
    assert built.held == {
        name: task.start[PLACE[name]] for name in NAMES if name not in FITTED
    }
    assert built.curves["bias_nm"].tolist() == [[1.0, 2.0, 4.0], [3.0, 0.0, 5.0]]
    assert (built.causes, built.by_cause, built.bench) == (
        UNSTATED.causes,
        UNSTATED.by_cause,
        UNSTATED.bench,
    )
    assert built.measured is task.data.electrons
    assert (built.chi2_per_dof, built.converged, built.reason) == (1.07, True, "made")


def test_the_words_of_a_result_are_those_of_its_own_numbers(seen):
    """Information of 3, 5, 7 and 11 alone: 0.58 of bias and 0.30 of background, both
    far below half of their priors,
    height's in steps of 5 nm. The gain's error is in both that it counts; bias is bent;
    background is held; neighbours
    err alike. Of bias what nobody stated is more than its own width, of height (told to
    5 nm) it is not."""
    _, _, built = result(seen, GAIN)
    unit = {"bias_nm": 1.0, "height_nm": 5.0}
    for name, information in (("bias_nm", 3.0), ("height_nm", 7.0)):
        told = f"+1.00 {name}/{unit[name]:g} to {1 / math.sqrt(information) / unit[name]:.2g}"
        assert any(
            line.replace("-1.00", "+1.00") == told for line in built.identifiable
        )
    bent, pair = built.degeneracies
    both = (-0.01 + 23 * SHARE**2) / math.sqrt(
        (4e-4 + SHARE**2) * (0.7 + (23 * SHARE) ** 2)
    )
    assert pair.startswith(
        f"log_gain and background_e go together (correlation {both:+.3f})"
    )
    assert bent.startswith(
        f"bias_nm is bent: 95 % within {LOW[0]:.3g} to {HIGH[0]:.3g} about 2.3"
    )
    (held,) = built.problems
    assert held.startswith(
        "background_e ran to its bound 23: the true value lies outside"
    )
    before, *structure = built.cautions
    assert before == "before"
    assert "go together from pixel to pixel" in structure[0]
    psf, process = built.verdicts
    assert psf.endswith("at one angle")  # two frames: too few to leave any out
    own = (HIGH - LOW) / 3.92
    bias, height = (math.hypot(own[i], *SHIFTS[:, i]) for i in (0, 2))
    assert process.startswith(
        f"the process is known to height_nm +- {height:.2g}; within the model only, that is "
    )
    assert process.endswith(
        f"without glass, wall: bias_nm +- {own[0]:.2g} (else +- {bias:.2g})"
    )


def test_the_lens_as_designed_is_that_of_the_virtual_bench(seen):
    """Of gain and background as found: light of the bench without any cause, which sums
    over every pillar.
    """
    _, _, built = result(seen, GAIN)
    hidden = Truth(
        (480.0, 800.0),
        parameter=(Known("stage_scale", 0.002), Known("crosstalk_px", 0.2)),
        camera=CAMERA,
    )
    light = bench.irradiance(b.lens(), hidden, b.RESPONSE)
    missed = []
    for image in (built.nominal - 23.0, built.predicted - 23.0):
        missed.append(
            np.abs(image / image.sum() - light / light.sum()).max()
            / light.max()
            * light.sum()
        )
    assert missed[0] < 2e-4  # the quick model's
    assert missed[1] > 3 * missed[0]  # bias and height show


def test_without_a_known_gain_nothing_is_said_of_the_residuals_and_electrons_are_of_any_size(
    seen,
):
    """Chi-square has no scale then; gain and background are known to themselves."""
    _, _, built = result(seen, Gain(1.0, np.inf, 2.0, known=False))
    by = np.array([0, 1.0, 0, 23.0])
    assert built.covariance == pytest.approx(
        OWN + np.outer(by, by) + SHIFTS.T @ SHIFTS, rel=1e-12
    )
    assert built.cautions == ("before",)
    assert len(built.draws) == 0


def test_the_psf_s_verdict_has_both_errors_and_frames_left_out_where_there_are_enough():
    short = "the PSF is known to 1.2% at the captured depths and 4.6% between them, at one angle"
    assert estimate._psf_verdict((0.0123, 0.0456), None, math.nan, 1) == short
    several = "the PSF is known to 1.2% at the captured depths and 4.6% between them, at the 3 captured angles"
    several += " (2.3% between these, 6.8% half a step beyond)"
    assert (
        estimate._psf_verdict((0.0123, 0.0456), (0.0234, 0.0678), math.nan, 3)
        == several
    )
    longer = short + "; frames left out agree within 1.31 times their noise"
    assert estimate._psf_verdict((0.0123, 0.0456), None, 1.31, 1) == longer


def test_the_lens_as_designed_is_seen_through_the_bench_that_was_fitted():
    """Gain, background, place and blur as found; the pillars, the stage and a phase
    that is left as at the start.
    """
    asked = []
    plain = SimpleNamespace(images=lambda x: asked.append(x) or ("images", None))
    model = SimpleNamespace(
        with_residual=lambda modes, basis: plain if not len(modes) else None
    )
    start = vector(
        {"height_nm": 4.0, "distance_um": 7.0, "log_gain": 3.0, "decentre_x_um": 0.2}
    )
    found = {
        "log_gain": 9.1,
        "background_x_e": 2.0,
        "decentre_x_um": 1.7,
        "crosstalk_px": 0.6,
    }
    lens = {"bias_nm": 5.0, "distance_um": -31.0, "stage_zero_um": 8.0}
    assert (
        estimate._nominal(SimpleNamespace(model=model, start=start), found | lens)
        == "images"
    )
    want = start.copy()
    for name, value in found.items():
        want[PLACE[name]] = value
    assert asked[0] == pytest.approx(want)


@dataclass(frozen=True)
class Freed:
    """A task by what it frees."""

    free: tuple[str, ...]

    @property
    def names(self):
        return *FITTED, *self.free

    def all_of(self, value):
        return f"all of {value}"


@pytest.mark.parametrize(("ratio", "taken"), [(0.96, True), (0.98, False)])
def test_more_is_fitted_where_it_explains_the_frames_better_by_three_hundredths(
    monkeypatch, ratio, taken
):
    """Of chi-square a pixel: 3 % are beyond chance (2 % of 5000 pixels)."""
    usual, wide = (
        SimpleNamespace(chi2_per_dof=2.9, value="usual"),
        SimpleNamespace(chi2_per_dof=2.9 * ratio),
    )
    monkeypatch.setattr(estimate.search, "search", lambda task: (task, [usual]))
    monkeypatch.setattr(
        estimate.search,
        "wider",
        lambda task, at: (task, [wide]) if at == "all of usual" else None,
    )
    monkeypatch.setattr(verdict, "explained", lambda end, gain: False)

    cautions = []
    found, ends = estimate._ends(Freed(("index",)), GAIN, cautions)
    assert ends == ([wide] if taken else [usual])
    assert found.free == (("index", *estimate.MORE) if taken else ("index",))
    assert len(cautions) == taken
    every = Freed(("index", *estimate.MORE))
    assert estimate._ends(every, GAIN, cautions) == (every, [usual])
