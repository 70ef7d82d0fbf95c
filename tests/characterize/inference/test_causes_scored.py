"""Scores of causes that nobody fits, by hand: noise in common, what frames say of an
amount, words, and a ghost.
"""

import dataclasses
import itertools
import math
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from characterize.inference import causes, missing
from characterize.inference.causes import Change
from characterize.inference.missing import Fitted, Lean
from characterize.model import Setting, vector

RNG = np.random.default_rng(77)
SHAPE = (3, 4, 5)
PIXELS = math.prod(SHAPE)
NAMES = ("one", "two", "three", "four")
SLOPES = RNG.normal(size=(4, PIXELS)) * np.array([[3.1], [0.7], [11.0], [2.3]])
PRIOR = np.diag([0.0, 0.3**-2.0, 1.7**-2.0, 2.1**-2.0])
CHANGES = (
    0.8 * RNG.normal(size=(3, PIXELS)) + np.array([[0.1], [0.5], [-0.06]]) * SLOPES[:3]
)
ALONE = np.zeros((2, *SHAPE))


def fit_of(data, shared=ALONE):
    """The least squares of ``data`` by the slopes, priors about 0 included."""
    known = SLOPES @ SLOPES.T + PRIOR
    mode = np.linalg.solve(known, SLOPES @ data)
    return Fitted(NAMES, SLOPES, known, data - SLOPES.T @ mode, shared, PRIOR @ mode)


def test_scores_scatter_by_the_whole_covariance_of_the_pixels():
    """Unit noise a pixel of which the dark's part is one in all frames; the flat's
    error is beyond it and one too.
    """
    dark, flat = RNG.uniform(0.2, 0.9, SHAPE), RNG.uniform(0.1, 0.6, SHAPE)
    covariance = np.zeros((*SHAPE, *SHAPE))
    for i, j in itertools.product(range(SHAPE[1]), range(SHAPE[2])):
        for a, b in itertools.product(range(SHAPE[0]), repeat=2):
            own = 1 - dark[a, i, j] ** 2 if a == b else 0.0
            covariance[a, i, j, b, i, j] = (
                own + dark[a, i, j] * dark[b, i, j] + flat[a, i, j] * flat[b, i, j]
            )
    found = fit_of(np.zeros(PIXELS), np.stack([dark, flat])).in_common(CHANGES)
    whole = CHANGES @ covariance.reshape(PIXELS, PIXELS) @ CHANGES.T
    assert found == pytest.approx(whole - CHANGES @ CHANGES.T, rel=1e-9, abs=1e-9)


def test_amounts_of_causes_are_those_of_a_fit_with_them_all():
    """Parameters and causes together by least squares, causes known to 1 about 0:
    second moments about 0 (Bayes).
    """
    data = RNG.normal(size=PIXELS) + np.array([1.9, -0.6, 0.3]) @ CHANGES
    every = np.concatenate([SLOPES, CHANGES])
    known = every @ every.T
    known[:4, :4] += PRIOR
    known[4:, 4:] += np.eye(3)
    covariance, mean = np.linalg.inv(known), np.linalg.solve(known, every @ data)
    want = covariance[4:, 4:] + np.outer(mean[4:], mean[4:])
    assert fit_of(data).likely(CHANGES) == pytest.approx(
        want, rel=1e-6
    )  # 1e-9 of the trace keeps it solvable
    assert abs(want[0, 1]) > 0.1


def test_odds_for_a_cause_are_those_of_gaussian_data_with_and_without_it():
    """Data scatter by unit noise, what the priors leave open, and the cause: two
    densities of all pixels at once. The
    slope without a prior is known to 30 here."""
    data = RNG.normal(size=PIXELS) + np.array([0.9, -0.5]) @ CHANGES[:2]
    wide = np.diag([30.0**2, *(1 / np.diag(PRIOR)[1:])])
    known = SLOPES @ SLOPES.T + np.linalg.inv(wide)
    mode = np.linalg.solve(known, SLOPES @ data)
    fit = Fitted(
        NAMES, SLOPES, known, data - mode @ SLOPES, ALONE, np.linalg.inv(wide) @ mode
    )
    absent = np.eye(PIXELS) + SLOPES.T @ wide @ SLOPES
    for changes in (CHANGES[:2], CHANGES[2:], 0.3 * CHANGES):
        there = stats.multivariate_normal(cov=absent + changes.T @ changes).logpdf(data)
        want = there - stats.multivariate_normal(cov=absent).logpdf(data)
        assert math.log(fit.odds(changes)) == pytest.approx(want, abs=1e-4)
    assert fit.odds(np.zeros((1, PIXELS))) == 1.0


@pytest.mark.parametrize("size", [0.05, 1.0, 20.0])
def test_odds_of_ten_are_rare_where_there_is_nothing(size):
    """For r sigma of three directions ten is chi-square 2 (1 + 1/r²) (ln 10 + 3/2 ln(1
    + r²)), 11.7 at least: chance
    0.0085, which 2000 draws give to 0.002. Where the frames tell nothing the odds are
    1."""
    changes = size * CHANGES / np.linalg.norm(CHANGES, axis=1)[:, None]
    truths = RNG.normal(size=(2000, 4)) * [1.0, 0.3, 1.7, 2.1]
    odds = np.array(
        [fit_of(RNG.normal(size=PIXELS) + one @ SLOPES).odds(changes) for one in truths]
    )
    assert (odds > missing.ODDS).mean() < 0.0145
    assert size > 0.1 or np.abs(odds - 1).max() < 0.1


def test_scores_are_chi_square_and_no_less_where_priors_hold_what_the_frames_hardly_see():
    """Slopes as telling as the priors, truths that follow these; 2000 draws give the
    mean of 3 to 0.055. Without the
    pull of the priors it is below 2.5."""
    size = np.linalg.norm(SLOPES, axis=1)
    slopes, prior = (
        SLOPES / size[:, None],
        np.diag(np.array([1.0, 0.6, 2.3, 1.4]) ** -2.0),
    )
    change = slopes[:3] + 0.6 * CHANGES / np.linalg.norm(CHANGES, axis=1)[:, None]
    known, found, bare = slopes @ slopes.T + prior, [], []
    for _ in range(2000):
        data = (
            RNG.normal(size=PIXELS)
            + (RNG.normal(size=4) * [1.0, 0.6, 2.3, 1.4]) @ slopes
        )
        mode = np.linalg.solve(known, slopes @ data)
        for pull, kept in ((prior @ mode, found), (np.zeros(4), bare)):
            kept.append(
                Fitted(NAMES, slopes, known, data - mode @ slopes, ALONE, pull)
                .lean("any", change)
                .chi2
            )
    assert np.mean(found) == pytest.approx(3, abs=0.22)
    assert np.mean(bare) < 2.5


def test_changes_of_nothing_have_no_degrees():
    fit = fit_of(RNG.normal(size=PIXELS))
    two = fit.lean("two", CHANGES[:2])
    again = fit.lean("two", np.stack([CHANGES[0], np.zeros(PIXELS), CHANGES[1]]))
    assert (again.chi2, again.degrees) == (pytest.approx(two.chi2, rel=1e-9), 2)
    assert fit.lean("none", np.zeros((2, PIXELS))) == Lean("none", 0.0, 0, 1.0)
    assert fit_of(np.ones(PIXELS)).lean("fitted", 3.3 * SLOPES[:1]) == Lean(
        "fitted", 0.0, 0, 1.0
    )


def test_what_a_cause_would_be_taken_for_is_said_in_sigma_the_largest_first():
    """Of slopes without overlap a change c of slope j moves its parameter by c, and by
    c |slope j| in sigma.
    """
    size = np.array([4.0, 0.5, 20.0, 7.0, 3.0])
    slopes = size[:, None] * np.eye(5, PIXELS)
    fit = Fitted(
        (*NAMES, "five"),
        slopes,
        slopes @ slopes.T,
        np.zeros(PIXELS),
        ALONE,
        np.zeros(5),
    )
    moved = np.array([0.6, -7.0, 0.36, -0.2, 0.3])  # 2.4, 3.5, 7.2, 1.4 and 0.9 sigma
    told = fit.taken(moved @ slopes, 2.5, "{:.3g} um")
    want = "three +0.36 (7.2 sigma), two -7 (3.5 sigma), one +0.6 (2.4 sigma)"
    assert told == f"2.5 um would be taken for {want}; state it if there is any"
    told = fit.taken(
        np.array([0.0, 0.0, 0.07, -0.13, 0.3]) @ slopes, 2.5, "{:.3g} um"
    )  # 1.4, 0.91 and 0.9 sigma
    assert (
        told
        == "2.5 um would be taken for three +0.07 (1.4 sigma); state it if there is any"
    )


def test_three_more_causes_are_named_beside_the_likeliest():
    leans = [Lean(f"cause {k}", 40.0 - k, 2, 1e-7 * (k + 1)) for k in range(6)] + [
        Lean("chance", 3.0, 1, 0.1)
    ]
    (words,) = missing.words(leans)
    assert "towards cause 0, " in words
    assert (
        "(chi-square 40 with 2 of them); cause 1, cause 2, cause 3 would explain"
        in words
    )
    assert "cause 1, cause 2 would" in missing.words(leans[:3])[0]


def test_the_next_to_fit_is_what_shows_or_else_what_is_likeliest():
    """Nothing where a cause that no parameter describes shows most."""
    shift, light = (
        Lean("shifts", 90.0, 9, 1e-9),
        Lean("light", 14.0, 3, 3e-3, frees=("light_x",), odds=16.0),
    )
    glass = Lean("glass", 8.0, 1, 5e-3, frees=("glass_um",), odds=11.0)
    bare, plate = (
        Lean("gamma", 9.0, 1, 2e-3, odds=0.0),
        dataclasses.replace(glass, chance=1e-7),
    )
    assert missing.to_fit([bare, light, glass]) is light
    assert missing.to_fit([glass, dataclasses.replace(light, odds=9.9)]) is glass
    assert missing.to_fit([plate, light]) is plate
    assert missing.to_fit([shift, plate, light]) is None
    assert missing.to_fit([bare]) is None


@pytest.mark.parametrize(
    ("chi2", "chance", "refused"),
    [(53.0, 1e-9, True), (51.0, 1e-9, False), (53.0, 2e-4, False)],
)
def test_windows_off_are_a_problem_where_they_explain_half_of_what_is_left(
    chi2, chance, refused
):
    """Of chi-square 120 with 20 degrees: 100 beyond chance, of which two more degrees
    are to explain 50.
    """
    leans = [
        Lean("shifts from frame to frame", 120.0, 20, 1e-16),
        Lean(causes.WINDOWS, chi2, 2, chance),
    ]
    assert bool(missing.misplaced(leans)) == refused
    assert not missing.misplaced(leans[:1])
    assert not missing.misplaced([])


ALONG = 40 * RNG.normal(size=(2, *SHAPE))


def looked(monkeypatch, changes):
    image = RNG.uniform(20, 90, SHAPE)
    data = SimpleNamespace(
        usable=np.ones(SHAPE, bool), saturated=np.zeros(SHAPE, bool), variance=lambda light: 2.5 * light + 9.0,
        shared=lambda light: ALONE,
    )  # fmt: skip
    task = SimpleNamespace(
        model=SimpleNamespace(images=lambda x, names: (image, ALONG)), data=data, all_of=lambda value: value,
        prior=SimpleNamespace(sigma=np.array([0.3, 2.1]), mean=np.zeros(2)), names=("one", "two"),
    )  # fmt: skip
    mode = SimpleNamespace(
        value=np.zeros(2),
        residual_sigma=RNG.normal(size=SHAPE),
        chi2_per_dof=1.0,
        image=image,
        slopes=ALONG,
    )
    monkeypatch.setattr(missing.causes, "changes", lambda *_: changes)
    monkeypatch.setattr(missing, "_ghost", lambda *_: Lean("a ghost", 4.0, 1, 0.03))
    return missing.look(task, mode), 1 / np.sqrt(2.5 * image + 9.0)


def test_causes_are_reckoned_with_by_their_sigma_and_what_kind_they_are(monkeypatch):
    """One sigma for all changes of a cause or one each; none is not reckoned with; some
    are not looked for alone.
    """
    many = RNG.normal(size=(4, 2, *SHAPE))
    many[2] += 3 * ALONG
    changes = [
        Change("a plate", many[0], sigma=2.7, roughly=True),
        Change(
            "a wall",
            many[1],
            sigma=np.array([0.4, 3.3]),
            of_mask=True,
            sought=False,
            told="{:g} um",
        ),
        Change("a lamp", many[2], amount=1.6, told="{:.4f} V"),
        Change("a drift", many[3], sigma=np.array([0.0, 1.9]), frees=("light_x",)),
    ]
    found, root = looked(monkeypatch, changes)
    assert list(found.unstated) == ["a plate", "a wall", "a drift"]
    for name, k, sigma in (
        ("a plate", 0, [2.7, 2.7]),
        ("a wall", 1, [0.4, 3.3]),
        ("a drift", 3, [0.0, 1.9]),
    ):
        want = np.stack(
            [s * (one * root).ravel() for s, one in zip(sigma, many[k], strict=True)]
        )
        assert found.unstated[name] == pytest.approx(want, rel=1e-12)
    assert found.roughly == {"a plate"}
    assert found.of_mask == {"a wall"}
    assert {one.cause for one in found.leans} == {
        "a plate",
        "a lamp",
        "a drift",
        "a ghost",
    }
    lamp = {one.cause: one for one in found.leans}["a lamp"].taken
    assert lamp == found.fit.taken((many[2][0] * root).ravel(), 1.6, "{:.4f} V")
    assert " V would be taken for " in lamp
    assert [one.chance for one in found.leans] == sorted(
        one.chance for one in found.leans
    )
    assert {one.cause: one.frees for one in found.leans}["a drift"] == ("light_x",)


def by_hand(light, dy, dx):
    """Every pixel of the light put ``dy`` lower and ``dx`` to the right, where there is
    a place for it.
    """
    out = np.zeros_like(light)
    for i, j in np.ndindex(light.shape[1:]):
        if 0 <= i + dy < light.shape[1] and 0 <= j + dx < light.shape[2]:
            out[:, i + dy, j + dx] = light[:, i, j]
    return out


@pytest.mark.parametrize("shift", [(0, 0), (2, -1), (-1, 3), (3, 4), (-2, -2)])
def test_light_is_moved_by_whole_pixels(shift):
    light = RNG.uniform(1, 2, (2, 5, 7))
    assert np.array_equal(missing._moved(light, shift), by_hand(light, *shift))


def ghost(rows, columns, shift, amount=1.0, taken=False, dark=0.0):
    """(the lean, chi-square of the copy by itself) where the residuals are a copy of
    the light with that of 20.
    """
    x = vector({"background_e": 41.0, "background_x_e": 13.0, "background_y_e": -7.0})
    setting = Setting(np.ones(2), np.zeros((2, 2)), np.ones(2), 1.5, rows, columns)
    light, root = (
        RNG.uniform(size=(2, rows, columns)) ** 6 * 900,
        RNG.uniform(0.1, 0.3, (2, rows, columns)),
    )
    plane = 41 + 13 * (np.arange(columns) - columns // 2) / (columns / 2)
    plane = plane - 7 * (np.arange(rows) - rows // 2)[:, None] / (rows / 2)
    copy = (by_hand(light, *shift) * root).ravel()
    rest = amount * math.sqrt(20.0) * copy / np.linalg.norm(copy)
    slopes = copy[None] if taken else np.zeros((1, copy.size))
    fit = Fitted(
        ("one",),
        slopes,
        slopes @ slopes.T + 1e-9,
        rest,
        dark * np.ones((2, 2, rows, columns)),
        np.zeros(1),
    )
    task = SimpleNamespace(model=SimpleNamespace(setting=setting))
    return missing._ghost(task, x, light + plane, root, fit)


@pytest.mark.parametrize(
    ("rows", "columns", "shift", "places"),
    [
        (
            13,
            17,
            (3, 0),
            11**2 - 5**2,
        ),  # all but those within 2, up to half the frame less 1
        (13, 17, (-1, -3), 96),
        (18, 13, (-5, 5), 96),
        (17, 13, (5, -4), 96),
        (
            34,
            40,
            (-14, -14),
            (29**2 - 5**2) // 3,
        ),  # at most 400, the first of three; none beyond 14
    ],
)
def test_a_copy_of_the_light_is_found_where_it_is_and_counted_as_the_best_of_many(
    rows, columns, shift, places
):
    """By Schwarz no other place explains as much: chi-square 20; half the places'
    chances of a positive one.
    """
    found = ghost(rows, columns, shift)
    assert found.chi2 == pytest.approx(20.0, rel=1e-9)
    assert found.chance == pytest.approx(
        places * stats.norm.sf(math.sqrt(20.0)), rel=1e-9
    )
    assert found.degrees == 1


@pytest.mark.parametrize(("shift", "more"), [((2, -2), {}), ((6, 1), {}), ((3, 4), {"amount": -1}),
                                             ((4, -3), {"taken": True})])  # fmt: skip
def test_what_is_no_ghost_is_not_found(shift, more):
    """Nearer than 3 pixels it is blur; farther than it can be seen; a lack of light;
    what a parameter takes up.
    """
    assert ghost(13, 17, shift, **more).chi2 < 15


def test_a_ghost_is_judged_by_the_scatter_that_frames_have_in_common():
    """Both frames share 0.6 of the dark's and of the flat's error: less is beyond
    chance than of 20.
    """
    assert ghost(13, 17, (3, -4), dark=0.6).chi2 < 16


def test_a_frame_without_room_for_a_ghost_says_so():
    assert ghost(7, 6, (1, 0)).degrees == 0
    assert ghost(8, 9, (3, -1)).chi2 == pytest.approx(20.0, rel=1e-9)


def test_a_chance_is_never_above_one():
    assert ghost(13, 17, (3, 1), amount=1e-3).chance == 1.0
