"""How far a parameter is walked, and what is read off a walk: Gaussians whose walk is a
straight line.
"""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from characterize.inference import walk
from characterize.inference.leastsquares import FitSolution, GaussianPrior
from characterize.inference.walk import ProfileScan


def prior(mean=3.0, sigma=4.0, low=-5.0, high=99.0):
    free = np.full(2, np.inf)
    return GaussianPrior(
        np.array([0.0, mean, 0.0]),
        np.array([np.inf, sigma, np.inf]),
        np.r_[-free[0], low, -9.0],
        np.r_[free[0], high, 9],
    )


def mode(value=1.0, sigma=0.7, merit=20.0, **more):
    covariance = np.array([[0.5, 0.2, 0.0], [0.2, sigma**2, -0.3], [0.0, -0.3, 0.9]])
    known = {
        "value": np.array([2.0, value, 0.4]),
        "covariance": covariance,
        "merit": merit,
        "information": np.eye(3),
    }
    nothing = dict.fromkeys(("image", "residual_sigma", "slopes"), np.zeros(0)) | {
        "beyond": np.zeros(3)
    }
    ended = {"chi2_per_dof": 1.0, "converged": True, "reason": "made", "iterations": 1}
    return FitSolution(**nothing | ended | known | more)


def test_a_walk_goes_two_and_a_half_prior_sigma_to_either_side_within_the_bounds():
    about = SimpleNamespace(prior=prior())
    assert walk._ends(about, mode(), 1) == (-5.0, 13.0)  # 3 - 10 lies beyond the bound
    assert walk._ends(SimpleNamespace(prior=prior(low=-99.0, high=8.0)), mode(), 1) == (
        -7.0,
        8.0,
    )
    assert walk._ends(about, mode(value=14.5), 1) == (
        -5.0,
        14.5,
    )  # the mode belongs to it
    assert walk._wide(about, mode(), 1) == 4.0
    free = SimpleNamespace(prior=prior(sigma=np.inf, low=-99.0))
    assert walk._wide(free, mode(), 1) == pytest.approx(3.2 * 0.7)
    assert walk._ends(free, mode(), 1) == pytest.approx(
        (1 - 8 * 0.7, 1 + 8 * 0.7)
    )  # eight of its own sigma


def test_valleys_are_walked_in_steps_of_their_sigma_up_to_fourteen_variances_above_the_best(
    monkeypatch,
):
    """A third of the prior's 4 at most; the second valley lies beside the first walk,
    and goes as far.
    """
    sides = []

    def side(task, part, one, i, end, *, step, settings, most):
        sides.append((one.value[1], end, step, most))
        return [mode(value=end, merit=60.0)]

    monkeypatch.setattr(walk, "_side", side)
    monkeypatch.setattr(
        walk, "_measured", lambda task, data, x, image: 30.0 + abs(x[1] - 1)
    )
    about = SimpleNamespace(
        prior=prior(low=-99.0),
        names=("a", "bias_nm", "c"),
        problem=lambda: None,
        data=None,
    )
    for passes in (False, True):
        monkeypatch.setattr(
            ProfileScan, "passes", lambda self, value, passes=passes: passes
        )
        for sigma, step in ((0.7, 0.7), (2.0, 1.4)):
            sides.clear()
            modes = [mode(1.0, 0.3), mode(6.0, sigma)]
            made = walk.scan_profile(about, modes, "bias_nm", widened=1.5)
            assert [s[0] for s in sides] == [1.0, 1.0, 6.0, 6.0]
            assert [s[1] for s in sides[:2]] == [-7.0, 13.0]
            beside = (
                [6 - 2 * step, 6 + 2 * step] if passes else [-7.0, 13.0]
            )  # two steps where the walk came by
            assert [s[1] for s in sides[2:]] == pytest.approx(beside)
            assert [s[2] for s in sides] == pytest.approx([step] * 4)
            assert [s[3] for s in sides] == [30 + 1.5 * 14] * 4
            assert made.rise.min() == 0
            assert (made.index, made.shown) == (1, 21.0)


SLOPE = np.array([0.4, 1.0, -1.5])  # of all parameters along the walk of the second
OTHERS = np.array([[0.09, 0.0, 0.05], [0.0, 0.0, 0.0], [0.05, 0.0, 0.25]])
SIGMA, MIDDLE = 1.7, 5.0


@pytest.fixture(scope="module")
def straight():
    """A Gaussian: the rise (x - 5)² / 1.7², the others along a line with one
    covariance; stops a tenth of it apart.
    """
    at = MIDDLE + SIGMA * np.linspace(-6, 6, 121)
    value = np.array([2.0, 0.0, 7.0]) + (at - MIDDLE)[:, None] * SLOPE
    value[:, 1] = at
    return ProfileScan(
        1,
        value,
        ((at - MIDDLE) / SIGMA) ** 2,
        np.broadcast_to(OTHERS, (121, 3, 3)).copy(),
    )


def covariance():
    return OTHERS + SIGMA**2 * np.outer(SLOPE, SLOPE)


def test_intervals_of_a_gaussian_are_those_of_its_covariance(straight):
    low, high = straight.interval(3.8415)
    near = 12 / 1200 * SIGMA  # a place of 1201 over twelve sigma
    middle, half = np.array([2.0, 5.0, 7.0]), 1.96 * np.sqrt(np.diag(covariance()))
    assert low == pytest.approx(middle - half, abs=near)
    assert high == pytest.approx(middle + half, abs=near)
    for above in (9.0, 30.0):  # of another lens; the second is no profile at all
        nowhere = ProfileScan(1, straight.value, straight.rise + above, straight.spread)
        assert nowhere.interval(3.8)[0] == pytest.approx(middle, abs=1e-6)


def test_the_mass_of_a_gaussian_is_its_integral_and_the_others_volume(straight):
    volume = math.sqrt(0.09 * 0.25 - 0.05**2)
    # cut where the rise is 14: erf(sqrt(7)) of it, 0.99982
    assert straight.log_mass() == pytest.approx(
        math.log(SIGMA * math.sqrt(2 * math.pi) * volume), abs=1e-3
    )
    half = walk._half_volume(np.stack([OTHERS, 4 * OTHERS]), 1)
    assert half == pytest.approx([math.log(volume), math.log(4 * volume)])


def test_a_profile_ends_at_a_rise_of_fourteen(straight):
    at, rise = straight.profile()
    assert rise == pytest.approx(((at - MIDDLE) / SIGMA) ** 2, abs=1e-3)
    assert (at[0], at[-1]) == pytest.approx(
        (MIDDLE - SIGMA * math.sqrt(14), MIDDLE + SIGMA * math.sqrt(14)), abs=0.02
    )


@pytest.mark.parametrize("widened", [1.0, 2.3])
def test_draws_have_the_covariance_of_the_walk(straight, widened):
    """40000 draws: means to sigma / 200, covariances to 0.7 % of the product of both
    sigma, four of each.
    """
    walked = ProfileScan(
        1, straight.value, straight.rise, straight.spread, 14 * widened
    )
    drawn = walked.draws(40_000, widened=widened, rng=np.random.default_rng(3))
    want = widened * covariance()
    sigma = np.sqrt(np.diag(want))
    assert np.abs((drawn.mean(0) - [2.0, 5.0, 7.0]) / sigma).max() < 0.02
    # cut at 3.74 sigma: 0.3 % of the variance
    assert np.abs((np.cov(drawn.T) - want) / np.outer(sigma, sigma)).max() < 0.03


def test_lowest_places_come_first():
    rise = np.array([3.0, 1.0, 4.0, 0.0, 0.0, 6.0, 2.0])
    made = ProfileScan(0, np.arange(7.0)[:, None], rise, np.zeros((7, 1, 1)))
    assert made.minima() == [3, 4, 1, 6]


def test_what_lies_within_three_sigma_of_a_walk_is_passed(straight):
    """(2, 5, 7) and its place at 6: beside it by u in the others, u C⁻¹ u below 9."""
    inverse = np.linalg.inv(OTHERS[np.ix_([0, 2], [0, 2])])
    step = np.array([0.2, -0.3])
    length = math.sqrt(step @ inverse @ step)
    here = np.array([2.4, 6.0, 5.5])
    for times, near in ((2.99, True), (3.01, False)):
        off = np.array([step[0], 0.0, step[1]]) * times / length
        assert straight.passes(here + off) == near
    for end in (-1, 1):  # stops are a tenth apart, and the last is at six
        assert straight.passes(np.array([2.0, 5.0, 7.0]) + end * 5.97 * SIGMA * SLOPE)
        assert not straight.passes(
            np.array([2.0, 5.0, 7.0]) + end * 6.01 * SIGMA * SLOPE
        )


def test_what_is_held_has_no_spread_and_the_others_that_of_image_and_prior():
    information = np.array([[9.0, 2.0, 1.0], [2.0, 7.0, -1.0], [1.0, -1.0, 4.0]])
    about = SimpleNamespace(prior=SimpleNamespace(sigma=np.array([0.5, 2.0, np.inf])))
    got = walk._held(
        about, SimpleNamespace(value=np.zeros(3), information=information), 1
    )
    want = np.linalg.inv(np.array([[9.0 + 4.0, 1.0], [1.0, 4.0]]))
    assert got[np.ix_([0, 2], [0, 2])] == pytest.approx(want)
    assert not got[1].any()
    assert not got[:, 1].any()


def test_outliers_count_linearly_saturated_pixels_where_they_are_too_dark_and_the_prior_by_its_sigma():
    """Noise of 1 e without light: (d - t)² up to 4 of Huber's sigma, then twice that a
    sigma.
    """
    huber = walk.SolverSettings().huber
    seen = np.array([[[0.5, huber + 2.0, 9.0, 50.0, 50.0]]])
    image = np.array([[[0.0, 0.0, 0.0, 49.0, 51.0]]])
    floor = np.full(seen.shape, 1.0)
    usable, saturated = np.ones(seen.shape, bool), np.zeros(seen.shape, bool)
    usable[..., 2] = False
    saturated[..., 3:] = True
    data = walk.FitImages(seen, usable, saturated, floor, np.full(seen.shape, 1e15))
    about = SimpleNamespace(prior=prior())
    got = walk._measured(about, data, np.array([7.0, 9.0, 7.0]), image)
    bent = huber * (2 * (huber + 2) - huber)
    assert got == pytest.approx(
        0.25 + bent + 1.0 + (6 / 4) ** 2, rel=1e-6
    )  # the pixel that is too bright: not counted


def lopsided(left=1.7, right=2.9, cut=6.0):
    """Half a Gaussian of either width about 5, the others along a line with one
    covariance; 201 stops.
    """
    x = np.concatenate(
        [
            left * np.linspace(-6, 0, 100, endpoint=False),
            right * np.linspace(0, cut, 101),
        ]
    )
    value = np.array([2.0, 0.0, 7.0]) + x[:, None] * SLOPE
    value[:, 1] = MIDDLE + x
    rise = np.where(x < 0, x / left, x / right) ** 2
    return ProfileScan(1, value, rise, np.broadcast_to(OTHERS, (201, 3, 3)).copy())


@pytest.mark.parametrize("i", [0, 2])
def test_a_profile_of_another_parameter_rises_by_the_square_of_its_share(i):
    """Least over x of (x / s)² + ((y - a x) / h)²: y² / (h² + a² s²), with the width s
    of the side that y calls for.
    """
    share = np.array([-1.0, -0.6, -0.1, 0.0, 0.3, 0.8])
    at, rise = lopsided().profile_of(i, share)
    wide = np.where((share < 0) == (SLOPE[i] > 0), 1.7, 2.9)
    want = np.array([2.0, 0.0, 7.0])[i] + share * np.sqrt(
        14 * (OTHERS[i, i] + SLOPE[i] ** 2 * wide**2)
    )
    assert at == pytest.approx(want, abs=0.01)  # places of 1201
    assert rise == pytest.approx(14 * share**2, abs=0.06)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("i", [0, 2])
def test_another_parameter_is_farthest_where_its_own_covariance_sends_all(
    straight, i, sign
):
    """(2, 5, 7) + sign sqrt(level / C_ii) C_i, to half a step of the places tried,
    0.07; the stop nearest to it, and
    the rise of the walk there to what a cubic between stops is off."""
    level, total = 5.1, covariance()
    want = np.array([2.0, 5.0, 7.0]) + sign * np.sqrt(level / total[i, i]) * total[i]
    (k, place), *_ = straight.outermost(i, sign, level)
    assert place[1] == pytest.approx(want[1], abs=0.07)
    assert np.abs(straight.value[:, 1] - place[1]).argmin() == k
    assert place[i] == pytest.approx(want[i], abs=0.005)  # flat at its greatest
    held = np.sqrt(level - ((place[1] - MIDDLE) / SIGMA) ** 2)
    middle = np.array([2.0, MIDDLE, 7.0]) + (place[1] - MIDDLE) * SLOPE
    assert place == pytest.approx(
        middle + sign * held * OTHERS[i] / np.sqrt(OTHERS[i, i]), rel=1e-3
    )


def test_a_walk_that_ends_inside_is_farthest_at_its_end():
    made = lopsided(cut=1.5)
    ((k, place),) = made.outermost(0, 1, 6.0)
    assert k == 200
    assert place[0] == pytest.approx(made.value[-1, 0] + np.sqrt(6.0 - 1.5**2) * 0.3)


def test_two_valleys_go_farthest_each_by_itself_and_a_stop_that_nothing_holds_as_far_as_twice_a_usual_one():
    """Stops of two parameters, the second at 0, 3 and 5 in the lows; 0.5 held, but for
    one of 90.
    """
    at = np.arange(11.0)
    value = np.column_stack(
        [at, np.array([0.0, 0.4, 3.0, 0.8, 0.5, 0.2, 0.1, 5.0, 2.0, 9.0, 0.0])]
    )
    rise = np.array([9.0, 6.0, 0.0, 5.0, 4.0, 8.5, 2.0, 3.0, 8.5, 8.1, 9.0])
    spread = np.zeros((11, 2, 2))
    spread[:, 1, 1] = 0.25
    made = ProfileScan(0, value, rise, spread)
    want = [5 + math.sqrt(5) * 0.5, 3 + math.sqrt(8) * 0.5]  # 9 lies above the level
    assert [k for k, _ in made.outermost(1, 1, 8.0)] == [7, 2]
    assert [place[1] for _, place in made.outermost(1, 1, 8.0)] == pytest.approx(want)
    spread[4, 1, 1] = 90.0**2
    free = ProfileScan(0, value, rise, spread).outermost(1, -1, 8.0)
    assert [k for k, _ in free] == [4, 6]
    assert [place[1] for _, place in free] == pytest.approx(
        [0.5 - math.sqrt(4) * 2 * 0.5, 0.1 - math.sqrt(6) * 0.5]
    )


@pytest.mark.parametrize("widened", [1.0, 1.9])
def test_a_walk_into_more_room_is_drawn_where_the_room_is(widened):
    """Volume of two others ~ exp(2 c x): a Gaussian of variance w s² about 5 + 2 c w
    s²; its mass, by the square.
    """
    growth, x = 0.12, SIGMA * np.linspace(-6, 6, 241)
    value = np.column_stack([2 + 0 * x, MIDDLE + x, 7 + 0 * x])
    spread = OTHERS * np.exp(2 * growth * x)[:, None, None]
    made = ProfileScan(1, value, (x / SIGMA) ** 2, spread, 22.0 * widened)
    drawn = made.draws(20_000, widened=widened, rng=np.random.default_rng(5))
    variance = widened * SIGMA**2
    assert drawn[:, 1].mean() == pytest.approx(
        MIDDLE + 2 * growth * variance, abs=0.05
    )  # four of 2.3 / sqrt(20000)
    assert drawn[:, 1].var() == pytest.approx(variance, rel=0.04)
    if widened == 1.0:
        volume = math.sqrt(0.09 * 0.25 - 0.05**2)
        want = (
            math.log(SIGMA * math.sqrt(2 * math.pi) * volume)
            + (2 * growth * SIGMA) ** 2 / 2
        )
        assert made.log_mass() == pytest.approx(want, abs=2e-3)


def test_every_share_of_the_mass_has_one_draw_evenly_between_its_places(monkeypatch):
    """Three stops and nothing in between: of 1.5 / 2 · 4 and 0.625 / 2 · 6 of mass, in
    1000 equal parts.
    """
    monkeypatch.setattr(walk, "_FINE", 2)
    value = np.array([[0.0, 3.0], [4.0, -1.0], [10.0, 2.0]])
    spread = np.zeros((3, 2, 2))
    spread[:, 1, 1] = 1e-18
    made = ProfileScan(0, value, -2 * np.log([1.0, 0.5, 0.125]), spread)
    drawn = made.draws(1000, widened=1.0, rng=np.random.default_rng(7))
    drawn = drawn[np.argsort(drawn[:, 0])]
    mass = (
        np.where(
            drawn[:, 0] < 4, drawn[:, 0] / 4 * 3.0, 3 + (drawn[:, 0] - 4) / 6 * 1.875
        )
        / 4.875
        * 1000
    )
    part = mass - np.arange(1000)
    assert part.min() > -1e-9
    assert part.max() < 1 + 1e-9
    assert part.std() == pytest.approx(12**-0.5, rel=0.1)  # anywhere in its share
    assert drawn[:, 1] == pytest.approx(
        np.interp(drawn[:, 0], value[:, 0], value[:, 1]), abs=1e-7
    )


@pytest.mark.parametrize(
    ("end", "most", "count", "kept"),
    [
        (5.7, math.inf, 5, 5),
        (-3.0, math.inf, 4, 4),
        (-3.0, 109.0, 4, 2),
        (-3.0, 110.0, 4, 4),
        (1.0, math.inf, 0, 0),
    ],
)
def test_a_side_goes_two_steps_at_a_time_and_then_to_the_place_left_out(
    monkeypatch, end, most, count, kept
):
    """From 1 in equal steps of 1 or less, the last one single where they are odd, until
    a stop is higher than asked.
    """
    seen = []

    def stop(task, part, here, i, goal, settings):
        seen.append((here.value[i], goal))
        return mode(goal, merit=100 + 5 * abs(goal - 1))

    def amid(task, part, ends, i, goal, settings):
        seen.append((*(one.value[i] for one in ends), goal))
        return mode(goal, merit=0.0)

    monkeypatch.setattr(walk, "_stop", stop)
    monkeypatch.setattr(walk, "_amid", amid)
    out = walk._side(None, None, mode(1.0), 1, end, step=1.0, settings=None, most=most)
    at = [1 + (end - 1) * k / max(count, 1) for k in range(count + 1)]
    assert [one.value[1] for one in out] == pytest.approx(at[1 : kept + 1])
    want = []
    for k in range(0, kept, 2):
        want.append((at[k], at[min(k + 2, count)]))
        want += [(at[k], at[k + 2], at[k + 1])] if k + 1 < count else []
    assert [len(one) for one in seen] == [len(one) for one in want]
    assert np.concatenate([*seen, ()]) == pytest.approx(np.concatenate([*want, ()]))


def _begun(monkeypatch):
    """What a fit of the others is given."""
    told = []
    monkeypatch.setattr(walk, "_fitted", lambda task, part, begin, known, settings, slopes=None: told.append(
        (begin, known, slopes)
    ))  # fmt: skip
    return told


@pytest.mark.parametrize(
    ("best", "thought"),
    [("parabola", 7.2), ("parabola", -0.1), ("here", 0.1), ("lost", 7.2)],
)
def test_a_stop_begins_where_the_parabola_or_the_place_itself_misses_less(
    monkeypatch, best, thought
):
    """From (2, 1, 0.4) to 1.8 of the second: by C_i / C_ii, (0.2, 0.49, -0.3) / 0.49
    times 0.8; within the bounds.

    The place itself is thought to have the straight image 5.3 + 0.8 times 1.7, and
    asked only where that is better.
    """
    told, about, part = (
        _begun(monkeypatch),
        SimpleNamespace(prior=prior(high=8.0)),
        (None, None),
    )
    along, alone = (
        np.array([2 + 0.8 * 0.2 / 0.49, 1.8, 0.4 - 0.8 * 0.3 / 0.49]),
        np.array([2.0, 1.8, 0.4]),
    )
    want, lower = (
        (alone if best == "here" else along),
        (along if best == "parabola" else alone),
    )
    asked = []
    monkeypatch.setattr(
        walk,
        "_misfit",
        lambda task, part, x: asked.append(x) or float(np.abs(x - lower).sum()),
    )
    monkeypatch.setattr(
        walk,
        "_measured",
        lambda task, data, x, image: (
            thought if image == [5.3 + 0.8 * 1.7] else math.nan
        ),
    )
    here = mode(1.0, slopes=np.array([[9.0], [1.7], [9.0]]), image=np.array([5.3]))
    walk._stop(about, part, here, 1, 1.8, None)
    assert len(asked) == (1 if thought == 7.2 else 2)
    ((begin, known, slopes),) = told
    assert begin == pytest.approx(want, rel=1e-12)
    assert slopes is None
    assert (known.low.tolist(), known.high.tolist()) == (
        [-np.inf, 1.8, -9.0],
        [np.inf, 1.8, 9.0],
    )
    assert (about.prior.low[1], about.prior.high[1]) == (
        -5.0,
        8.0,
    )  # what was given stays


def test_between_two_stops_all_goes_straight(monkeypatch):
    """At 2.2 from 1 to 4: two fifths of the way; the third parameter is held at its
    bound of 9.
    """
    told, about = _begun(monkeypatch), SimpleNamespace(prior=prior())
    slopes = np.random.default_rng(2).normal(size=(2, 3, 1, 4, 5))
    ends = (
        mode(1.0, slopes=slopes[0]),
        replace(mode(4.0, slopes=slopes[1]), value=np.array([-3.0, 4.0, 99.0])),
    )
    walk._amid(about, None, ends, 1, 2.2, None)
    ((begin, known, mixed),) = told
    assert begin == pytest.approx([2 - 0.4 * 5, 2.2, 9.0], rel=1e-12, abs=1e-12)
    assert (known.low[1], known.high[1]) == (2.2, 2.2)
    assert mixed == pytest.approx(0.6 * slopes[0] + 0.4 * slopes[1], rel=1e-12)


def test_valleys_are_sought_on_few_frames_from_the_lowest_places_and_again_from_a_new_best(
    monkeypatch,
):
    """The three lowest places of the walk but the best's own; a fit that is lower by
    more than 1 begins it anew.
    """
    asked, followed = [], []
    heights = {
        -6.0: 6.0,
        -5.0: 30.0,
        -3.0: 4.0,
        -2.0: 50.0,
        3.0: 12.0,
        4.0: 7.0,
        5.0: 15.0,
        6.0: 5.0,
    }
    free = {"slopes": np.arange(15.0).reshape(3, 5), "image": np.arange(5.0)}

    def side(task, part, here, i, end, *, step, settings):
        asked.append((part, here.value[i], here.merit, here.slopes.tolist(), end, step))
        return [
            mode(at, merit=rise, **free)
            for at, rise in heights.items()
            if (at < here.value[i]) == (end < 0)
        ]

    news = iter([mode(-3.0, merit=10.0, **free), mode(2.0, merit=9.5, **free)])

    def follow(task, best, begins):
        followed.append((float(best.value[1]), [float(b[1]) for b in begins]))
        return [next(news)]

    monkeypatch.setattr(walk, "few_frames", lambda setting: np.array([1, 3]))
    monkeypatch.setattr(walk, "_side", side)
    monkeypatch.setattr(walk, "_misfit", lambda task, part, x: 2.0)
    monkeypatch.setattr(walk, "follow_starts", follow)
    monkeypatch.setattr(
        walk, "distinct_modes", lambda ends: sorted(ends, key=lambda e: e.merit)
    )
    about = SimpleNamespace(
        prior=prior(low=-99.0), names=("a", "bias_nm", "c"), model=SimpleNamespace(setting=None),
        problem=lambda few: few.tolist(), data=SimpleNamespace(planes=lambda few: few.tolist()),
    )  # fmt: skip
    kept = walk.find_modes(about, [mode(1.0, merit=20.0, **free)], "bias_nm")
    assert [one.merit for one in kept] == [
        9.5,
        10.0,
        20.0,
    ]  # 9.5 is not lower than 10 by more than 1
    assert followed == [(1.0, [-3.0, 6.0, -6.0]), (-3.0, [6.0, -6.0, 4.0])]
    assert [one[:3] for one in asked] == [
        (([1, 3], [1, 3]), at, 2.0) for at in (1.0, 1.0, -3.0, -3.0)
    ]
    assert asked[0][3] == free["slopes"][:, [1, 3]].tolist()
    assert [one[4:] for one in asked[:2]] == [
        (-7.0, pytest.approx(0.35 * 4)),
        (13.0, pytest.approx(0.35 * 4)),
    ]
