"""The exact sum that a fast one is judged by, and how Gaussians are sorted by reach:
pillar by pillar in loops.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import brentq

from layout.dose import bodies, sampled
from layout.dose.assign import Ladder
from layout.dose.bodies import NONE, Body
from layout.dose.drawn import Discs
from layout.dose.exposure import CLEARS, PointExposure, disc, rim_of_own_disc
from metalens.ground.errors import ProcessError

PITCH = 0.43
DIAMETER = np.array([0.0, 0.21, 0.33, 0.17])
GOAL = np.array([1.0, 0.9, 1.15, 1.0])
DOSES = np.array([0.8, 1.1, 1.5])
POINT = PointExposure(np.array([0.04, 0.5, 3.1]), np.array([0.6, 0.15, 0.25]))
RNG = np.random.default_rng(6)
SITES = RNG.integers(0, 4, (19, 23)).astype(
    np.uint8
)  # not square; a quarter of the sites is empty
CHOSEN = np.where(SITES > 0, RNG.integers(0, 3, SITES.shape), NONE).astype(np.uint8)
GIVEN = np.append(DOSES, np.zeros(NONE + 1 - 3))


def lens():
    return Body(19, 23, PITCH, 4.0, 7.7, lambda first, end: SITES[first:end])


def table():
    own = np.array([0.0, 0.31, 0.36, 0.28])
    return SimpleNamespace(
        drawn=Discs(DIAMETER), area_um2=math.pi / 4 * DIAMETER**2, goal=GOAL, own=own
    )


def rim(row, column, rows, columns, far):
    """Mean over the rim of what the discs of a block of sites give, itself included."""
    turn = 2 * np.pi * (np.arange(24) + 0.5) / 24
    own, total = DIAMETER[SITES[row, column]], 0.0
    for i in rows:
        for j in columns:
            if SITES[i, j] and (i, j) != (row, column):
                y, x = (i - row) * PITCH, (j - column) * PITCH
                away = np.hypot(x - own / 2 * np.cos(turn), y - own / 2 * np.sin(turn))
                for width, weight in zip(far.widths_um, far.weights, strict=True):
                    total += (
                        weight
                        * GIVEN[CHOSEN[i, j]]
                        * disc(away, DIAMETER[SITES[i, j]], width).mean()
                    )
    for width, weight in zip(far.widths_um, far.weights, strict=True):
        total += weight * GIVEN[CHOSEN[row, column]] * rim_of_own_disc(own, width)
    return total


@pytest.mark.parametrize("site", [(9, 11), (2, 21), (17, 1)])
def test_the_rim_sees_the_discs_of_a_block(site):
    row, column = site
    rows = range(max(row - 5, 0), min(row + 6, 19))
    columns = range(max(column - 5, 0), min(column + 6, 23))
    block = SITES[rows.start : rows.stop, columns.start : columns.stop]
    given = GIVEN[CHOSEN[rows.start : rows.stop, columns.start : columns.stop]]
    assert SITES[site]
    fields = SimpleNamespace(bodies=[lens()], table=table())
    got = sampled._close(
        fields, (block, given), (row - rows.start, column - columns.start), POINT
    )
    own = sampled._own(
        lens(), (np.array([row]), np.array([column])), table().drawn, POINT
    )
    got += given[row - rows.start, column - columns.start] * own[SITES[site]]
    assert got == pytest.approx(rim(row, column, rows, columns, POINT), rel=1e-12)


def around(monkeypatch):
    """Fields with two bodies and pieces of a mark; classes as drawn above, the second
    body all of entry 2, class 1.
    """
    second = Body(
        2, 3, 0.9, 15.0, 2.0, lambda first, end: np.full((end - first, 3), 2, np.uint8)
    )

    def classes(fields, number, first, block, steps):
        return (
            CHOSEN[first : first + len(block)]
            if number == 0
            else np.full(block.shape, 1, np.uint8)
        )

    monkeypatch.setattr(sampled, "classes", classes)
    far = PointExposure(np.array([3.1]), np.array([0.25]))
    middle = PointExposure(np.array([0.5]), np.array([0.15]))
    background = RNG.uniform(0.1, 0.2, SITES.shape)
    return SimpleNamespace(
        bodies=[lens(), second],
        table=table(),
        ranges=SimpleNamespace(far=far, middle=middle),
        spots=(
            np.array([[3.0, 9.0], [2.5, 9.5], [14.0, 1.0]]),
            np.array([0.4, 0.7, 1.3]),
            np.array([0, 0, 1]),
        ),
        rects=SimpleNamespace(goal=np.array([1.0, 1.2])),
        own=np.array([0.4, 0.35]),
        far=None,
        of_rects=lambda _: np.array([0.06, 0.2]),
        at=lambda field, number, first, count, near: background[first : first + count],
        background=background,
    )


def test_what_is_far_is_summed_over_all_but_the_sites_within_five(monkeypatch):
    monkeypatch.setattr(bodies, "_BLOCK_SITES", 7 * 23)  # seven rows at a time
    fields, steps = around(monkeypatch), Ladder(DOSES)
    rows, columns = np.array([2, 9, 16]), np.array([20, 11, 1])
    got = sampled._distant(fields, steps, GIVEN, (rows, columns))
    area, second = table().area_um2, fields.bodies[1]
    # classes of the pieces: (0.5 - 0.06) / 0.4 = 1.1 and (0.6 - 0.2) / 0.35 = 1.143,
    # both nearest to 1.1
    pieces = list(
        zip(fields.spots[0].tolist(), (fields.spots[1] * 1.1).tolist(), strict=True)
    )
    for n, (row, column) in enumerate(zip(rows, columns, strict=True)):
        x, y, want = 4.0 + PITCH * column, 7.7 - PITCH * row, 0.0
        for k, width, weight in ((0, 3.1, 0.25), (1, 0.5, 0.15)):
            masses = []
            for i in range(19):
                for j in range(23):
                    if SITES[i, j] and not (abs(i - row) <= 5 and abs(j - column) <= 5):
                        mass = area[SITES[i, j]] * GIVEN[CHOSEN[i, j]]
                        masses.append((4.0 + PITCH * j, 7.7 - PITCH * i, mass))
            masses += [
                (a, b, area[2] * 1.1)
                for a in second.columns_um
                for b in second.rows_um(0, 2)
            ]
            masses += [(*at, mass) for at, mass in pieces] if k == 0 else []
            bells = [
                m * math.exp(-((a - x) ** 2 + (b - y) ** 2) / width**2)
                for a, b, m in masses
            ]
            want += weight / (math.pi * width**2) * sum(bells)
        assert got[n] == pytest.approx(want, rel=2e-5)  # float32 sums of some 400 terms


def test_the_error_is_relative_to_what_the_edge_should_get(monkeypatch):
    """Over all sampled pillars the largest of |dose own + background - distant - close|
    / (goal / 2).
    """
    fields = around(monkeypatch)
    picked = np.array([0, 4, 9, 18]), np.array([0, 22, 11, 3])
    picked = tuple(v[SITES[picked] > 0] for v in picked)
    assert len(picked[0]) > 2
    distant = np.array([0.03, 0.45, 0.02, 0.04])[
        : len(picked[0])
    ]  # the exact sum is the larger in the second
    monkeypatch.setattr(sampled, "_some", lambda body, samples: picked)
    monkeypatch.setattr(sampled, "_distant", lambda *_: distant)
    found = SimpleNamespace(far=None, near=None)
    got = sampled.sampled_error(fields, Ladder(DOSES), found, point=POINT, samples=4)
    off = []
    for n, (row, column) in enumerate(zip(*picked, strict=True)):
        entry, dose = SITES[row, column], GIVEN[CHOSEN[row, column]]
        rows = range(max(row - 5, 0), min(row + 6, 19))
        columns = range(max(column - 5, 0), min(column + 6, 23))
        exact = distant[n] + rim(row, column, rows, columns, POINT)
        off.append(
            abs(dose * table().own[entry] + fields.background[row, column] - exact)
            / (CLEARS * GOAL[entry])
        )
    assert got == pytest.approx(max(off), rel=1e-12)
    assert got > 0.3


def test_sampled_pillars_spread_over_rows_and_columns(monkeypatch):
    """Of 4 n rows n pillars each, and of those n evenly; few pillars between the
    sampled rows are found too.
    """
    rows, columns = sampled._some(lens(), 3)
    every = []
    for row in np.unique(np.linspace(0, 18, 12).astype(int)):
        there = np.nonzero(SITES[row])[0]
        every += [
            (row, there[k])
            for k in np.unique(np.linspace(0, len(there) - 1, 3).astype(int))
        ]
    want = [every[k] for k in np.unique(np.linspace(0, len(every) - 1, 3).astype(int))]
    assert list(zip(rows, columns, strict=True)) == want
    few = np.zeros((40, 7), np.uint8)
    few[8, 2], few[8, 5] = 1, 2  # of rows 0, 5.6, …: 0, 5, 11 and so on for 2 samples
    monkeypatch.setattr(bodies, "_BLOCK_SITES", 35)  # five rows: the second block
    hidden = Body(40, 7, PITCH, 0.0, 0.0, lambda first, end: few[first:end])
    rows, columns = sampled._some(hidden, 2)
    assert list(zip(rows.tolist(), columns.tolist(), strict=True)) == [(8, 2), (8, 5)]


def test_gaussians_are_sorted_by_reach_and_widened_by_the_pillars():
    """Six pitches and more are far; what four neighbours see above 5e-4 or is wider
    than a pitch is middle.
    """
    number = np.array([0, 30, 5, 0])
    point = PointExposure(
        np.array([0.02, 0.11, 0.5, 2.5799, 2.5801]),
        np.array([0.4, 0.1, 1e-4, 0.2, 0.3]),
    )
    ranges = bodies.split(point, Discs(DIAMETER), number, lens())
    area = number * DIAMETER**2
    square = (area * DIAMETER**2).sum() / area.sum()
    more = (
        1.5 * square / 4
    )  # R² / 2 of the disc that gives and R² of the ring that sees
    assert ranges.far.widths_um == pytest.approx(
        [math.sqrt(2.5801**2 + more)], rel=1e-12
    )
    assert ranges.far.weights.tolist() == [0.3]
    # 0.33 wide at 0.43: 0.11 reaches the gap of 0.1; 0.5 is wider than a pitch, however
    # faint
    assert ranges.middle.widths_um == pytest.approx(
        np.sqrt(np.array([0.11, 0.5, 2.5799]) ** 2 + more), rel=1e-12
    )
    assert ranges.middle.weights.tolist() == [0.1, 1e-4, 0.2]
    assert ranges.near.widths_um.tolist() == [0.02]
    turn = 2 * np.pi * (np.arange(24) + 0.5) / 24
    seen = disc(
        np.hypot(PITCH - 0.165 * np.cos(turn), 0.165 * np.sin(turn)), 0.33, 0.11
    ).mean()
    for factor, middle in ((1.001, 1), (0.999, 0)):
        faint = PointExposure(np.array([0.11]), np.array([factor * 5e-4 / (4 * seen)]))
        assert (
            len(bodies.split(faint, Discs(DIAMETER), number, lens()).middle.widths_um)
            == middle
        )


def test_the_table_takes_from_each_pillar_what_the_far_field_counts_for_it():
    number = np.array([0, 30, 5, 0])
    ranges = bodies.split(POINT, Discs(DIAMETER), number, lens())
    made = bodies.table(
        Discs(DIAMETER), GOAL, number, point=POINT, ranges=ranges, body=lens()
    )
    assert ranges.far.weights.tolist() == [0.25]
    for k in (1, 2):
        area = math.pi / 4 * DIAMETER[k] ** 2
        whole = sum(
            w * rim_of_own_disc(DIAMETER[k], a)
            for a, w in zip(POINT.widths_um, POINT.weights, strict=True)
        )
        assert made.own[k] == pytest.approx(
            whole - area * 0.25 / (math.pi * ranges.far.widths_um[0] ** 2), rel=1e-12
        )
        h = 1e-6
        rise = sum(
            w
            * (
                disc(DIAMETER[k] / 2 - h, DIAMETER[k], a)
                - disc(DIAMETER[k] / 2 + h, DIAMETER[k], a)
            )
            / (2 * h)
            for a, w in zip(POINT.widths_um, POINT.weights, strict=True)
        )
        assert made.slope[k] == pytest.approx(rise, rel=1e-6)
        assert made.area_um2[k] == pytest.approx(area, rel=1e-12)
    assert (made.own[3], made.slope[3], made.area_um2[3]) == (0, 0, 0)  # does not occur
    assert bodies.count([lens(), lens()], 4).tolist() == [
        0,
        *(2 * np.bincount(SITES.ravel())[1:]).tolist(),
    ]


def test_neighbours_of_a_site_stand_on_every_side():
    straight, slant = (
        Body(3, 4, 0.43, 0.0, 0.0, lens().source, 0.37, centred)
        for centred in (False, True)
    )
    cross = {(0.43, 0), (-0.43, 0), (0, 0.37), (0, -0.37)}
    assert set(map(tuple, straight.steps_um.tolist())) == cross
    corners = {(x, y) for x in (0.43, -0.43) for y in (0.37, -0.37)}
    assert (
        set(map(tuple, slant.steps_um.tolist()))
        == {(2 * x, 2 * y) for x, y in cross} | corners
    )
    assert (straight.apart_um, slant.apart_um) == (
        0.37,
        pytest.approx(math.hypot(0.43, 0.37)),
    )


def test_boxes_and_areas_of_what_is_exposed():
    none = bodies.Rects.none()
    assert (none.box_um.shape, none.group.shape, none.goal.shape) == (
        (0, 4),
        (0,),
        (0,),
    )
    assert lens().box_um == pytest.approx(
        (4.0, 7.7 - 18 * PITCH, 4.0 + 22 * PITCH, 7.7)
    )
    assert lens().columns_um == pytest.approx(4.0 + PITCH * np.arange(23))
    assert lens().rows_um(3, 4) == pytest.approx(7.7 - PITCH * np.arange(3, 7))
    rects = bodies.Rects(
        np.array([[1.0, 2.0, 4.0, 2.5], [-1.0, 0.0, 1.0, 7.0]]),
        np.zeros(2, int),
        np.ones(2),
    )
    assert rects.area_um2 == pytest.approx([1.5, 14.0])


@pytest.mark.parametrize(("own", "refused"), [(0.021, False), (0.019, True)])
def test_pillars_that_their_own_dose_hardly_reaches_are_refused(own, refused):
    """At least 0.02 at the edge, where a half clears; the core is made as wide as that
    asks.
    """
    width = brentq(lambda a: float(rim_of_own_disc(0.21, a)) - own, 0.1, 5.0)
    point = PointExposure(np.array([width]), np.array([1.0]))
    near = bodies.Ranges(
        *(PointExposure(np.zeros(0), np.zeros(0)) for _ in range(2)), point
    )
    number = np.array([0, 5, 0, 0])
    if refused:
        with pytest.raises(
            ProcessError,
            match=r"a pillar of 210 nm gives its own edge an exposure of 0\.019 only",
        ):
            bodies.table(
                Discs(DIAMETER), GOAL, number, point=point, ranges=near, body=lens()
            )
    else:
        assert bodies.table(
            Discs(DIAMETER), GOAL, number, point=point, ranges=near, body=lens()
        ).own[1] == pytest.approx(own)


def others(width, pitch):
    """Sum over the other sites of exp(-r²/width²), by Poisson: (√π w/p Σ
    exp(-π²k²w²/p²))² less the site's own 1.
    """
    k = np.arange(-40, 41)
    return (
        math.sqrt(math.pi)
        * width
        / pitch
        * np.exp(-((math.pi * k * width / pitch) ** 2)).sum()
    ) ** 2 - 1


@pytest.mark.parametrize(
    ("widths", "by_sum"),
    [((0.75, 0.5), True), ((0.75, 0.9), True), ((1.1, 1.4), False)],
)
def test_what_neighbours_give_is_bounded_by_their_sum_or_by_what_a_site_would_give_itself(
    widths, by_sum
):
    """Widths in pitches: the sum of narrow ones is less than a site's own; of wide ones
    the own is the bound.
    """
    middle = PointExposure(np.array(widths) * PITCH, np.array([0.2, 0.07]))
    scale = middle.weights / (math.pi * middle.widths_um**2)
    total = sum(
        s * others(w, PITCH) for s, w in zip(scale, middle.widths_um, strict=True)
    )
    assert (total < scale.sum()) == by_sum
    # sites beyond five widths: exp(-25) each
    assert bodies._beside(middle, lens()) == pytest.approx(
        min(total, scale.sum()), rel=1e-9
    )


@pytest.mark.parametrize(("share", "refused"), [(0.88, False), (0.92, True)])
def test_pillars_to_whom_neighbours_give_nine_tenths_of_their_own_are_refused(
    share, refused
):
    """The smaller pillar of two: what neighbours give goes with the area, its own less
    so; the other is far below.
    """
    number, core = (
        np.array([0, 5, 30, 0]),
        PointExposure(np.array([0.4]), np.array([1.0])),
    )
    nothing = PointExposure(np.zeros(0), np.zeros(0))
    area, own = (
        math.pi / 4 * DIAMETER**2,
        np.array([float(rim_of_own_disc(d, 0.4)) for d in DIAMETER]),
    )
    worst = (area[1:3] / own[1:3]).max()
    one = area[1] / own[1], area[2] / own[2]
    assert max(one) > 1.05 * min(one)  # so that one of them alone is refused
    width = 2.0 * PITCH
    weight = (
        share / worst * math.pi * width**2
    )  # a wide one: bounded by what a site would give itself
    ranges = bodies.Ranges(
        nothing, PointExposure(np.array([width]), np.array([weight])), core
    )
    about = dict(point=core, ranges=ranges, body=lens())
    if refused:
        with pytest.raises(ProcessError, match="less than its neighbours do"):
            bodies.table(Discs(DIAMETER), GOAL, number, **about)
    else:
        assert bodies.table(Discs(DIAMETER), GOAL, number, **about).own[
            1:3
        ] == pytest.approx(own[1:3], rel=1e-9)
