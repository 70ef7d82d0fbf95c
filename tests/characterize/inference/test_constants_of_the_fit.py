"""What the constants of a fit promise: alarms per fit, shifts of an interval, images
that are asked for.
"""

import math
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.captures import likeness as likeness_of
from characterize.inference import causes, estimate, leastsquares, missing, verdict
from characterize.inference.arrange import Arrangement
from characterize.inference.leastsquares import Data, Prior
from characterize.inference.missing import Fitted, Lean
from characterize.inference.posterior import Valley
from characterize.inference.search import Task
from characterize.model import ForwardModel, Setting, vector
from metalens.ground.errors import FitRefused
from tests.referees.one_profile import profile

RNG = np.random.default_rng(71)
SIGMA = 0.37  # of the noise in a pixel
PICTURES = np.linalg.qr(RNG.standard_normal((2 * 9 * 11, 3)))[0].T.reshape(
    3, 2, 9, 11
)  # of unit length, at right angles


def sought():
    """How many causes are looked for beside a usual fit of a small lens, a ghost among
    them.
    """
    depths = np.array([480.0, 600.0, 800.0])
    model = ForwardModel(
        b.lens(), Setting(depths, np.zeros((3, 2)), np.ones(3), 1.5, 9, 9), b.RESPONSE
    )
    laid = Arrangement(0, 0, (0, 0), 1, np.arange(3), False, True, 0, False, ())
    start = vector(b.VALUES)
    data = Data(
        *(np.ones((3, 9, 9), kind) for kind in (float, bool, bool, float, float))
    )
    task = Task(model, data, start, {}, laid)
    slopes = model.images(start, task.names)[1]
    found = causes.changes(task, start, dict(zip(task.names, slopes, strict=True)))
    return 1 + sum(one.sought for one in found)


def test_a_sound_fit_names_a_cause_about_once_in_three_hundred_and_fifty():
    """The least of K chances, each even in 0 to 1 where nothing is there, is 1 - (1 -
    u)^(1 / K). 100 000 fits: 6 %.
    """
    count = sought()
    least = -np.expm1(np.log1p(-RNG.uniform(size=100_000)) / count)
    named = sum(
        bool(missing.words([Lean("any", 16.0, 1, float(one))])) for one in least
    )
    assert named / 100_000 == pytest.approx(1 / 350, rel=0.2), count


def test_what_is_said_to_go_unseen_is_what_would_not_be_named():
    """A change of which the fit takes up a part: nine tenths of what is said to hide
    are not named, a third more is.
    """
    slopes = PICTURES[:2].reshape(2, -1) * np.array([[40.0], [7.0]])
    change = 0.6 * slopes[0] + 33.0 * PICTURES[2].ravel()  # 33 sigma of it are left
    known = slopes @ slopes.T + np.diag([0.0, 2.0])
    said = Fitted(
        ("one", "two"),
        slopes,
        known,
        np.zeros(198),
        np.zeros((2, 2, 9, 11)),
        np.zeros(2),
    )
    amount = float(said.taken(change, 2.6, "{:.6f} um").split()[0])
    for times, named in ((0.9, False), (1.3, True)):
        score = times * amount / 2.6 * 33.0
        found = Fitted(
            said.names,
            slopes,
            known,
            score * PICTURES[2].ravel(),
            said.shared,
            said.pull,
        )
        assert bool(missing.words([found.lean("any", change[None])])) == named, score


def gaussian(width):
    y, x = np.mgrid[-30:31, -30:31]
    return np.exp(-((x - 1.3) ** 2 + (y + 0.4) ** 2) / (2 * width**2))


@pytest.mark.parametrize(
    ("wider", "refused"), [(2.0, False), (0.4, False), (7.0, True), (0.15, True)]
)
def test_spots_of_twice_the_width_are_the_lens_and_of_seven_times_another(
    wider, refused
):
    """Spots of widths 1 and q correlate by 2q / (1 + q²): blur of a bench doubles a
    spot (0.8); a spot seven times as
    wide (0.28) is one of another lens, or far from the depths."""
    told = 1.1 if wider > 1 else 8.0
    seen, told = gaussian(told * wider), gaussian(told)
    likeness, _ = likeness_of(3.7 * seen, told, 0.0)
    assert likeness == pytest.approx(
        2 * wider / (1 + wider**2), abs=0.02
    )  # of pixels, and the rim of the picture
    found = SimpleNamespace(likeness=likeness)
    lens = b.row()
    if refused:
        with pytest.raises(FitRefused, match="no image of this lens"):
            estimate._check_likeness(found, lens)
    else:
        estimate._check_likeness(found, lens)


@pytest.mark.parametrize(("missed", "said"), [(0.0, False), (1.0, True)])
def test_frames_left_out_are_doubted_where_the_model_errs_by_their_noise(
    monkeypatch, missed, said
):
    """Chi-square a pixel is 1 + (error / noise)²: 2 for errors as large as the noise.
    Of 16 x 16 pixels it scatters by
    9 %: one set of frames in a hundred is at 1.21, and sound."""
    monkeypatch.setattr(verdict, "structure", lambda *_: [])
    chance = float(stats.chi2.ppf(0.99, 256)) / 256
    unseen = chance if missed == 0 else 1 + missed**2
    data = SimpleNamespace(
        variance=np.ones_like, shared=lambda image: np.zeros((2, *image.shape))
    )
    solution = SimpleNamespace(
        image=np.ones((2, 3, 4)), residual_sigma=np.zeros((2, 3, 4))
    )
    words = estimate._seen(
        SimpleNamespace(data=data), solution, SimpleNamespace(leans=[]), unseen
    )
    assert [one.startswith("frames left out are predicted") for one in words] == [
        True
    ] * said


def frames(image):
    everywhere = np.ones(image.shape, bool)
    return Data(
        image,
        everywhere,
        ~everywhere,
        np.full(image.shape, SIGMA**2),
        np.full(image.shape, 1e15),
    )


def curved(by):
    """The first parameter x, in sigma, acts as x + by x² on one picture: at -+2 it
    misses the parabola by 4 by.
    """
    asked = []

    def model(x, jacobian):
        asked.append(jacobian)
        image = SIGMA * ((x[0] + by * x[0] ** 2) * PICTURES[0] + x[1] * PICTURES[1])
        slopes = SIGMA * np.stack([(1 + 2 * by * x[0]) * PICTURES[0], PICTURES[1]])
        return 50.0 + image, slopes if jacobian else None

    mode = np.array([0.0, 1.7])
    return Valley(model, frames(model(mode, False)[0]), mode, Prior.none(mode)), asked


def ends(by, reach):
    """Where x + by x² is -+ reach."""
    return np.array(
        [(math.sqrt(1 + 4 * by * r) - 1) / (2 * by) for r in (-reach, reach)]
    )


@pytest.mark.parametrize("by", [0.05, 0.085])
def test_an_end_is_found_by_one_image_where_the_next_step_is_a_quarter_of_a_sigma(by):
    """Ends of x + by x² = -+1.96 lie by 1.96² by lower each: 0.19 sigma at 0.05, which
    is gone after one image an end,
    and 0.33 at 0.085, which is tried. The secant over two sigma is off by 2 by at its
    far end: 0.1 of it."""
    valley, asked = curved(by)
    reach = float(stats.norm.ppf(0.975))
    found, _ = profile(valley, 0)
    if by < 0.06:
        assert asked[1:] == [
            True,
            False,
            False,
        ]  # no more than the two places that tell
    else:
        assert len(asked) > 4
    assert np.abs(np.array([found.low, found.high]) - ends(by, reach)).max() < 0.03


@pytest.mark.parametrize(("by", "computed"), [(0.3, False), (0.55, True)])
def test_slopes_are_taken_over_while_the_ends_of_intervals_are_right_to_a_fiftieth(
    by, computed
):
    """At one sigma x + by x² misses the trapezium rule with the mode's slopes by
    ``by``. An error e of the images moves
    the misfit by e² / 2, its root at 1.96 by e² / 8: 0.011 at 0.3, well within the 0.08
    to which an end is found, and
    0.04 at 0.55, half of it."""
    valley, asked = curved(by)
    asked.clear()
    slopes = valley.slopes_at(np.array([1.0, 1.7]))
    assert (by**2 / 2 / (2 * 1.96) < 0.08 / 4) != computed
    assert asked == [False, True][: 1 + computed]
    assert slopes[:-2, 0].reshape(2, 9, 11) == pytest.approx(
        (1 + 2 * by * computed) * PICTURES[0], abs=1e-9
    )


@pytest.mark.parametrize("off", [4.6, 9.5, 31.0])
def test_a_pixel_far_off_counts_in_the_valley_as_it_did_in_the_fit(off):
    """Both weigh it by 6 / off where that is below 1 (Huber 1964); covariances of the
    two are one.
    """
    slopes = np.zeros((1, 2, 3, 4))
    slopes[0, 1, 2] = [3.1, 0.4, -1.3, 2.2]
    slopes[0, 0, 0] = [0.7, -0.6, 0.2, 0.1]
    image = np.full((2, 3, 4), 50.0)
    seen = image.copy()
    seen[1, 2, 0] += off * SIGMA
    data, mode = frames(seen), np.zeros(1)
    valley = Valley(
        lambda x, jacobian: (image + x[0] * slopes[0], slopes),
        data,
        mode,
        Prior.none(mode),
    )
    weight = np.ones((2, 3, 4))
    weight[1, 2, 0] = min(1.0, 6 / off)
    want = SIGMA**2 / (weight * slopes[0] ** 2).sum()
    assert valley.covariance[0, 0] == pytest.approx(want, rel=1e-9)
    held = Prior(mode, np.array([np.inf]), mode, mode)
    fit = leastsquares.fit(
        lambda x, jacobian: (image + x[0] * slopes[0], slopes), data, mode, prior=held
    )
    assert fit.information[0, 0] == pytest.approx(1 / want, rel=1e-6)


def test_a_lamp_that_drifts_is_told_with_its_cure():
    """No parameter can be freed for it; its readings as exposures take it out."""
    for cause, cure in (
        (causes.LAMP, "as exposure_s of stage.csv"),
        ("any", "or mend the bench"),
    ):
        (said,) = missing.words([Lean(cause, 40.0, 5, 1e-9)])
        assert said.endswith(cure)
