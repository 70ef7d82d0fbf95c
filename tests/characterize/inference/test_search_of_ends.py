"""Ends over several valleys: who is asked from where, what is kept, and what lies
beyond; single ends stand in.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from characterize.inference import ends
from characterize.inference.ends import ConfidenceLimit, LimitSearch

REACH = 1.959964
SIGMA = np.array([0.7, 2.1])
MODE = SimpleNamespace(value=np.array([1.0, -3.0]), chi2_per_dof=1.44)
GOAL = 1.2 * REACH


def valley(mode=(1.0, -3.0), above=0.0, sigma=SIGMA):
    return SimpleNamespace(
        mode=np.array(mode), sigma=np.array(sigma), above=above, met=()
    )


class Told:
    """In place of :func:`ends.end`: ends by parameter and side, what was met on the
    way; keeps what it was asked.
    """

    def __init__(self, by):
        self.by, self.asked = by, []

    def __call__(self, valley, i, sign, goal, *, begin, most, beyond, promised, turns):
        self.asked.append((valley.mode.tolist(), i, sign, goal, begin, most, beyond))
        valley.met += ((i, sign),)
        return self.by[i, sign]


def four(**more):
    """Ends of two parameters: -0.5 to 2.9 and -8 to 3; on the way to the first a place
    of 3.08 of the second.
    """
    found = {
        (0, -1): ConfidenceLimit(
            -0.5, [(-0.2, 1.0)], [(np.array([-0.4, 3.08]), 2.0)], steps=3
        ),
        (0, 1): ConfidenceLimit(
            2.9, [(2.0, 2.0)], [(np.array([2.5, -4.0]), 1.0)], steps=3
        ),
        (1, -1): ConfidenceLimit(-8.0, [(-7.0, 2.5)], [], steps=3),
        (1, 1): ConfidenceLimit(3.0, [(2.0, 3.0)], [], steps=3),
    }
    return found | more


WANTED = [(0, -1, None), (0, 1, None), (1, -1, None), (1, 1, None)]


def test_ends_are_asked_from_each_mode_at_the_level_of_the_misfit(monkeypatch):
    """1.96 times the root of 1.44; steps of twice that; the second mode, 2 above,
    begins only where it may reach on.
    """
    told = Told(four())
    monkeypatch.setattr(ends, "find_limit", told)
    second = valley((4.0, -3.5), above=2.0)
    hopeless, little = (
        valley((7.0, 9.0), above=GOAL**2 + 0.1),
        valley((1.0, -3.0), above=GOAL**2 - 0.5),
    )
    search = LimitSearch(None, MODE, None, [valley(), second, hopeless, little])
    assert [k for k, *_ in search._begins(1, 1)] == [-1, -2, -4]
    assert search.ends(WANTED) == []
    for _, i, _, goal, _, most, _ in told.asked:
        assert (goal, most) == pytest.approx((GOAL, 2 * GOAL * SIGMA[i]))
    left = math.sqrt(GOAL**2 - 2.0)
    reach = {
        (mode[0], i, sign): sign * mode[i] + 1.18 * room * SIGMA[i]
        for mode, room in (((1.0, -3.0), GOAL), ((4.0, -3.5), left))
        for i in (0, 1)
        for sign in (-1, 1)
    }
    for i, sign in ((0, -1), (0, 1), (1, -1), (1, 1)):
        mine = [(one[0][0], one[6]) for one in told.asked if one[1:3] == (i, sign)]
        order = sorted((1.0, 4.0), key=lambda at: -reach[at, i, sign])
        end = sign * search._found[i, sign].place
        want = [(order[0], -math.inf)] + [(order[1], end)] * int(
            reach[order[1], i, sign] > end + 0.1 * SIGMA[i]
        )
        assert mine == want
    few = LimitSearch(
        None, SimpleNamespace(value=MODE.value, chi2_per_dof=0.5), None, [valley()]
    )
    assert few._level == pytest.approx(
        REACH**2
    )  # less misfit than noise narrows nothing


def test_slopes_met_by_one_end_are_known_to_those_asked_later_and_once(monkeypatch):
    monkeypatch.setattr(ends, "find_limit", Told(four()))
    one = valley()
    one.met = ("before",)
    search = LimitSearch(None, MODE, None, [one])
    search.ends(WANTED[:2])
    assert search._valleys[-1].met == ("before", (0, -1), (0, 1))
    search.ends(WANTED[2:])
    assert search._valleys[-1].met == ("before", (0, -1), (0, 1), (1, -1), (1, 1))


def test_a_place_beyond_an_end_is_asked_once_and_the_farther_end_stays(monkeypatch):
    """3.08 lies 0.08 beyond 3 of an interval of 11, a fiftieth of which is 0.22: too
    near; 3.3 is asked. So is -0.56
    too near to -0.5 of an interval of 3.4."""
    told = Told(four())
    monkeypatch.setattr(ends, "find_limit", told)
    search = LimitSearch(None, MODE, None, [valley()])
    search.ends(WANTED[2:])
    assert search.beyond() == []  # nothing met yet
    search.ends(WANTED[:2])
    assert search.beyond() == []
    told.by[0, 1].met.append((np.array([-0.56, -4.0]), 2.5))
    search.ends(WANTED[:2])
    assert search.beyond() == []
    far = np.array([0.2, 3.3])
    told.by[1, 1] = ConfidenceLimit(
        2.7, [], [(far, 3.0), (np.array([-0.66, 1.0]), 3.0)], steps=2
    )
    assert search.ends([(1, 1, (-1, None, 9.0))]) == []
    assert search._found[1, 1].place == 3.0  # what was found before lies farther
    (low, high) = sorted(search.beyond())
    assert low[:2] == (
        0,
        -1,
    )  # -0.66 lies 0.16 beyond -0.5: more than a fiftieth of 3.4
    assert low[2][1].tolist() == [-0.66, 1.0]
    assert low[2][2] == pytest.approx(0.66)
    assert high[:2] == (1, 1)
    assert (high[2][0], high[2][1].tolist(), high[2][2]) == (-1, far.tolist(), 3.3)
    assert search.beyond() == []
    told.by[1, 1], told.by[0, -1] = (
        ConfidenceLimit(3.6, [], [], steps=2),
        ConfidenceLimit(-0.7, [], [], steps=2),
    )
    search.ends([low, high])
    assert told.asked[-2][4].tolist() == [-0.66, 1.0]
    assert told.asked[-1][4].tolist() == far.tolist()
    assert (search._found[1, 1].place, search._found[0, -1].place) == (3.6, -0.7)


def test_an_end_that_was_not_found_is_asked_again_from_a_place_as_far_and_told(
    monkeypatch,
):
    """2.8 falls 0.2 short of 3, of an interval of 11 no more than a fiftieth: from
    there once, and from no place that
    is not a fiftieth farther again."""
    told = Told(
        four()
        | {
            (1, 1): ConfidenceLimit(
                3.0, [], [(np.array([0.0, 2.8]), 3.0)], steps=3, done=False
            )
        }
    )
    told.by[0, -1].met.clear()
    monkeypatch.setattr(ends, "find_limit", told)
    search = LimitSearch(None, MODE, None, [valley()])
    search.ends(WANTED)
    (again,) = search.beyond()
    assert again[:2] == (1, 1)
    assert again[2][1].tolist() == [0.0, 2.8]
    assert search.beyond() == []
    told.by[1, 1] = ConfidenceLimit(2.9, [], [(np.array([0.0, 2.95]), 3.0)], steps=3)
    search.ends([again])
    assert search.beyond() == []
    assert search.profile(1).found == (
        True,
        False,
    )  # what is known reaches to 3, and was not the end
    told.by[1, 1] = ConfidenceLimit(3.1, [], [], steps=3)
    search.ends([again])
    assert search.profile(1).found == (True, True)


def test_places_below_the_mode_are_told(monkeypatch):
    lower = np.array([0.1, -2.0])
    monkeypatch.setattr(
        ends,
        "find_limit",
        Told(four() | {(1, 1): ConfidenceLimit(3.0, [], [], lower, 2)}),
    )
    found = LimitSearch(None, MODE, None, [valley()]).ends(WANTED)
    assert len(found) == 1
    assert found[0] is lower


def test_a_profile_is_what_was_seen_on_the_way_to_both_ends(monkeypatch):
    """Of the second: -8 to 3 about -3 where the parabola has 1.96 · 1.2 · 2.1 = 4.9 to
    either side: 6 is too far.
    """
    monkeypatch.setattr(ends, "find_limit", Told(four()))
    search = LimitSearch(
        None, MODE, None, [valley(), valley((9.0, 9.0), sigma=(99.0, 99.0))]
    )
    search.ends(WANTED)
    made = search.profile(1)
    assert (made.low, made.high, made.parabolic) == (-8.0, 3.0, False)
    assert list(zip(made.value, made.rise, strict=True)) == [
        (-7.0, 2.5),
        (-3.0, 0.0),
        (2.0, 3.0),
    ]
    assert search.profile(0).parabolic  # -1.5 and 1.9 for 1.65: 0.91 and 1.15


def walk(places, rise):
    own = np.array([[-0.7, 4.0], [1.0, 0.0], [3.1, 5.0]])
    curve = np.array(
        [
            [-9.0, 20.0],
            [-6.9, 9.0],
            [-4.0, 1.0],
            [-3.0, 0.0],
            [1.0, 2.0],
            [1.8, 2.8],
            [2.4, 4.0],
            [9.0, 30.0],
        ]
    )

    def profile_of(i, share):
        assert share.tolist() == np.linspace(-1, 1, 61).tolist()
        return (curve if i else own).T

    stops = [SimpleNamespace(value=np.array(x)) for x in places]
    return SimpleNamespace(value=np.array(places), rise=np.array(rise), stops=stops, profile_of=profile_of,
                           outermost=lambda i, sign, level: [(2, np.array([0.0, sign * 20.0]))])  # fmt: skip


def test_a_profile_along_a_walk_is_the_walk_between_what_was_seen_and_its_own_stops(
    monkeypatch,
):
    """Stops below the level from -5 to 1.8 of the second; ends have seen -7 and 2: the
    curve between -5 and 1.8.
    """
    asked = []
    monkeypatch.setattr(ends, "find_limit", Told(four()))
    monkeypatch.setattr(
        ends,
        "valley_of",
        lambda task, at, rise: asked.append((at, rise)) or valley(at.value),
    )
    by = walk([[1.0, -3.0], [0.0, -5.0], [2.0, 1.8], [3.0, 8.0]], [0.0, 3.0, 5.0, 5.6])
    search = LimitSearch(None, MODE, by, [valley()])
    assert [(k, begin, x.tolist()) for k, begin, x in search._met] == [
        (0, None, [1.0, -3.0]), (1, None, [0.0, -5.0]), (2, None, [2.0, 1.8])
    ]  # fmt: skip
    search.ends(WANTED)
    assert asked == [(by.stops[2], 5.0)]
    assert search.beyond() == []
    assert [k for k, *_ in search._begins(1, 1)] == [
        2
    ]  # a stop as long as the walk asks for it, and no mode
    assert search.profile(0).parabolic
    made = search.profile(1)
    assert (made.low, made.high, made.parabolic) == (-8.0, 3.0, False)
    assert list(zip(made.value, made.rise, strict=True)) == [
        (-7.0, 2.5), (-4.0, 1.0), (-3.0, 0.0), (1.0, 2.0), (1.8, 2.8), (2.0, 3.0)
    ]  # fmt: skip


def test_a_walk_beyond_both_ends_gives_way_to_what_was_seen_there(monkeypatch):
    """Stops from -9.5 to 9: the curve between -6.8, the nearest that the lower end has
    seen, and 2.
    """
    low = ConfidenceLimit(-8.0, [(-7.0, 2.5), (-6.8, 2.4)], [], steps=3)
    high = ConfidenceLimit(3.0, [(1.9, 2.9), (2.0, 3.0)], [], steps=3)
    monkeypatch.setattr(ends, "find_limit", Told(four() | {(1, -1): low, (1, 1): high}))
    monkeypatch.setattr(ends, "valley_of", lambda task, at, rise: valley(at.value))
    search = LimitSearch(
        None,
        MODE,
        walk([[1.0, -9.5], [0.0, 9.0], [2.0, 1.7]], [2.0, 3.0, 5.0]),
        [valley()],
    )
    search.ends(WANTED)
    made = search.profile(1)
    assert made.value.tolist() == [-7.0, -6.8, -4.0, -3.0, 1.0, 1.8, 1.9, 2.0]


def test_a_begin_must_reach_beyond_the_farthest_end_so_far(monkeypatch):
    """Ends at 3 and 5; what reaches 4.5 is not asked, nor what reaches 5.06, by less
    than 0.07.
    """
    places = iter([3.0, 5.0, 9.0])
    monkeypatch.setattr(
        ends, "find_limit", lambda *_, **__: ConfidenceLimit(next(places), [], [])
    )
    search = LimitSearch(None, MODE, None, [valley()])
    begins = [(-1, None, reach) for reach in (6.0, 5.5, 4.5, 5.06)]
    found = search._farthest(((0, 1, begins), search._valleys))
    assert [one.place for _, one in found] == [3.0, 5.0]
