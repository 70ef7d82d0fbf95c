"""Pieces of marks: they tile their boxes on the grid, and are short only where the
background changes.
"""

import numpy as np
import pytest
from scipy.special import erf

from layout.dose import pieces
from layout.dose.exposure import PointExposure
from layout.dose.rects import pairs_near
from metalens.ground.errors import ProcessError

STEP_UM = 1e-3
CROSS = np.array(
    [
        [0, 0, 10_003, 45_001],
        [-44_000, 45_001, 55_007, 55_011],
        [0, 55_011, 10_003, 100_009],
    ]
)
NOTHING = np.empty((0, 4))


def beam(beta_um, eta=0.7):
    return PointExposure(np.array([0.01, beta_um]), np.array([1.0, eta]) / (1 + eta))


@pytest.mark.parametrize("beta_um", [5.0, 31.0])
def test_pieces_tile_their_boxes(beta_um):
    made, of = pieces.cut(
        CROSS, NOTHING, step_um=STEP_UM, point=beam(beta_um), tolerance=0.01
    )
    for n, box in enumerate(CROSS):
        mine = made[of == n]
        assert (mine[:, :2] >= box[:2]).all()
        assert (mine[:, 2:] <= box[2:]).all()
        area = ((mine[:, 2] - mine[:, 0]) * (mine[:, 3] - mine[:, 1])).sum()
        assert area == (box[2] - box[0]) * (box[3] - box[1])


def test_the_number_of_pieces_goes_with_corners_and_not_with_area():
    count = [
        len(
            pieces.cut(CROSS, NOTHING, step_um=STEP_UM, point=beam(b), tolerance=0.01)[
                0
            ]
        )
        for b in (20.0, 10.0, 5.0)
    ]
    assert (
        count[2] < 3 * count[0]
    )  # squares of a 16th of the range would be sixteen times as many


def by_boxes(at_um, boxes_um, point):
    """(n,) exposure at points by boxes of dose 1: for each Gaussian the product of two
    differences of erf, halved.
    """
    total = np.zeros(len(at_um))
    for width, weight in zip(point.widths_um, point.weights, strict=True):
        sides = [
            erf((boxes_um[:, axis + 2] - at_um[:, None, axis]) / width)
            - erf((boxes_um[:, axis] - at_um[:, None, axis]) / width)
            for axis in (0, 1)
        ]
        total += weight * (sides[0] * sides[1] / 4).sum(-1)
    return total


def test_the_background_hardly_changes_along_the_outer_side_of_a_piece():
    point = beam(8.0)
    made, _ = pieces.cut(CROSS, NOTHING, step_um=STEP_UM, point=point, tolerance=0.01)
    box, far = made * STEP_UM, PointExposure(point.widths_um[1:], point.weights[1:])
    bottom = box[(made[:, 1] == 45_001) & (made[:, 0] < -500)]  # of the left arm
    ends = [by_boxes(bottom[:, [k, 1]], CROSS * STEP_UM, far) for k in (0, 2)]
    long = bottom[:, 2] - bottom[:, 0] > 2 * 8.0 / 64
    assert long.any()
    assert np.abs(ends[0] - ends[1])[long].max() <= 2 * 0.2 * 0.01 * 0.5 * (1 + 1e-9)


def test_next_to_a_lens_pieces_stay_short():
    lens = np.array([[60.0, -20.0, 90.0, 20.0]])
    near, _ = pieces.cut(CROSS, lens, step_um=STEP_UM, point=beam(12.0), tolerance=0.01)
    right = near[near[:, 2] > 50_000]
    assert ((right[:, 2:] - right[:, :2]).max() * STEP_UM) <= 12.0 / 8


def test_too_many_pieces_are_refused_by_name(monkeypatch):
    monkeypatch.setattr(pieces, "MOST_PIECES", 100)
    with pytest.raises(
        ProcessError, match=r"more than 100 pieces .* backscatter ranges 5 um"
    ):
        pieces.cut(CROSS, NOTHING, step_um=STEP_UM, point=beam(5.0), tolerance=0.01)


@pytest.mark.parametrize(
    ("dx", "dy"),
    [(-1, 0), (1, 0), (0, -1), (0, 1), (0.6, 0.8), (-0.8, 0.6), (0.6, -0.8)],
)
def test_pieces_are_an_eighth_of_the_range_within_three_ranges_of_a_lens(dx, dy):
    """To each side of a lens of 40 x 20 um and over its corners; of two ranges the
    shorter one where both reach.
    """
    lens, size, step_um = (30.0, 50.0, 70.0, 70.0), (4.0, 6.0), 0.001
    point = PointExposure(np.array([2.0, 5.0]), np.array([0.7, 0.3]))

    def longest(distance_um):
        """Of a box that many um from the lens, in this direction."""
        left = (
            lens[2] + dx * distance_um
            if dx > 0
            else lens[0] + dx * distance_um - size[0]
            if dx < 0
            else 45.0
        )
        bottom = (
            lens[3] + dy * distance_um
            if dy > 0
            else lens[1] + dy * distance_um - size[1]
            if dy < 0
            else 55.0
        )
        box = np.rint(
            np.array([[left, bottom, left + size[0], bottom + size[1]]]) / step_um
        ).astype(np.int64)
        part = pieces._Pieces(box, np.ones((1, 4), bool), np.zeros(1, int))
        caps = pieces._Caps(1.0, 8.0, [], 1.0)
        return float(
            pieces._longest(
                part, np.array([lens]), box * step_um, step_um, point, caps
            )[0]
        )

    assert longest(5.99) == 2.0 / 8
    assert longest(6.01) == longest(14.99) == 5.0 / 8
    assert longest(15.01) == 8.0


@pytest.mark.parametrize("mirror", [(1, 1), (-1, 1), (1, -1)])
def test_the_change_of_the_background_is_that_along_outer_sides_and_across_to_the_opposite_one(
    mirror,
):
    """Half of the range over ends and middle of a side that the shape has, and half of
    the difference between two
    opposite ones, of a box with other boxes on no side alike; by products of
    differences of erf."""
    every = np.array(
        [
            [0, 0, 3_000, 5_000],
            [3_400, -900, 6_000, 900],
            [-2_600, 3_800, -300, 4_700],
            [1_100, 5_100, 2_000, 7_000],
        ]
    )
    ends = every.reshape(-1, 2, 2) * np.array(mirror)
    every = np.hstack([ends.min(1), ends.max(1)])
    point = PointExposure(np.array([1.3, 2.9]), np.array([0.6, 0.4]))
    (left, bottom, right, top), boxes = every[0] * STEP_UM, every * STEP_UM
    xs, ys = (left, (left + right) / 2, right), (bottom, (bottom + top) / 2, top)
    field = by_boxes(np.array([[x, y] for y in ys for x in xs]), boxes, point).reshape(
        3, 3
    )
    below, above, at_left, at_right = (
        float(np.ptp(line)) / 2
        for line in (field[0], field[2], field[:, 0], field[:, 2])
    )
    over = float(np.abs(field[:, 2] - field[:, 0]).max()) / 2
    up = float(np.abs(field[2] - field[0]).max()) / 2
    assert len({round(v, 3) for v in (below, above, at_left, at_right)}) == 4
    for outer, x, y in (
        ((1, 0, 0, 0), 0, at_left),
        ((0, 1, 0, 0), below, 0),
        ((0, 0, 1, 0), 0, at_right),
        ((0, 0, 0, 1), above, 0),
        ((1, 0, 1, 0), over, max(at_left, at_right)),
        ((0, 1, 0, 1), max(below, above), up),
        ((1, 1, 1, 1), max(below, above, over), max(at_left, at_right, up)),
    ):
        part = pieces._Pieces(every[:1], np.array([outer], bool), np.zeros(1, int))
        pairs = pairs_near(boxes, np.zeros(len(boxes)), point)
        assert pieces._change(part, boxes, pairs, STEP_UM, point)[0] == pytest.approx(
            [x, y], abs=1e-12
        )


def test_the_longest_piece_is_that_of_the_range_of_half_the_scattered_energy():
    """Narrower Gaussians count at corners as soon as an eighth of their weights, from
    the narrowest on, is enough.
    """
    widths, weights = (
        np.array([9.0, 0.3, 40.0, 1.1, 2.4]),
        np.array([0.15, 0.006, 0.35, 0.004, 0.03]),
    )
    order = [
        1,
        3,
        4,
        0,
        2,
    ]  # by width; sums of weights 0.006, 0.010, 0.040, 0.190, 0.540
    assert np.cumsum(weights[order])[2] / 8 == pytest.approx(0.005)
    around = PointExposure(widths, weights)
    assert pieces._ranges(around, 0.0049) == (40.0, [9.0, 2.4])
    assert pieces._ranges(around, 0.0051) == (40.0, [9.0])
    assert pieces._ranges(around, 0.001) == (40.0, [9.0, 2.4, 1.1])


def test_near_a_corner_a_piece_is_as_short_as_the_range_that_changes_there():
    box = np.array([[0, 0, 40_000, 24_000]])
    caps = pieces._Caps(1.0, 20.0, [(27.0, 9.0), (3.0, 1.0)], 1.0)

    def longest(left, bottom, right, top):
        part = pieces._Pieces(
            np.array([[left, bottom, right, top]]),
            np.ones((1, 4), bool),
            np.zeros(1, int),
        )
        around = PointExposure(np.array([9.0]), np.array([1.0]))
        return float(
            pieces._longest(part, NOTHING, box * STEP_UM, STEP_UM, around, caps)[0]
        )

    assert (
        longest(2_900, 700, 5_000, 900) == 1.0
    )  # 2.98 um from the corner at left below
    assert longest(3_000, 700, 5_000, 900) == 9.0  # 3.08
    assert (
        longest(35_000, 20_000, 37_100, 23_200) == 9.0
    )  # 3.01 from that at right above
    assert longest(35_000, 20_000, 37_200, 23_200) == 1.0  # 2.91
    assert longest(0, 0, 40_000, 200) == 1.0
    wide = np.array([[0, 0, 90_000, 60_000]])
    box = wide
    assert longest(40_000, 0, 50_000, 900) == 20.0


def test_a_middle_range_of_little_weight_does_not_cut_whole_marks():
    """A measured point exposure has a ladder of ranges; pieces of the narrowest would
    be millions.
    """
    point = PointExposure(
        np.array([0.01, 0.1, 0.4, 1.6, 30.0]),
        np.array([0.6, 0.002, 0.002, 0.03, 0.366]),
    )
    made, _ = pieces.cut(CROSS, NOTHING, step_um=STEP_UM, point=point, tolerance=0.01)
    area_um2 = (
        (CROSS[:, 2] - CROSS[:, 0]) * (CROSS[:, 3] - CROSS[:, 1])
    ).sum() * STEP_UM**2
    assert len(made) < 3000
    assert len(made) < area_um2 / 0.4**2 / 4  # squares of a range


@pytest.mark.parametrize("widths", [[0.4], [0.4, 1.59], [1.5, 0.4]])
def test_ranges_within_four_of_the_core_cut_nothing(widths):
    """They belong to the edge: 1.59 is less than four times 0.4."""
    point = PointExposure(np.array(widths), np.full(len(widths), 1 / len(widths)))
    made, of = pieces.cut(CROSS, NOTHING, step_um=STEP_UM, point=point, tolerance=0.01)
    assert made.tolist() == CROSS.tolist()
    assert of.tolist() == [0, 1, 2]


@pytest.mark.parametrize(("core_um", "shortest"), [(0.01, 8 / 64), (0.3, 0.6)])
def test_the_shortest_pieces_are_a_64th_of_the_narrowest_range_or_two_of_the_core(
    core_um, shortest
):
    """At a tolerance that nothing keeps, near the corners: halved until another half
    would be shorter than that.
    """
    point = PointExposure(np.array([core_um, 8.0, 300.0]), np.array([0.6, 0.3, 0.1]))
    box = np.array([[0, 0, 1024, 999]])
    made, _ = pieces.cut(box, NOTHING, step_um=STEP_UM * 4, point=point, tolerance=1e-7)
    least = float((made[:, 2:] - made[:, :2]).min()) * STEP_UM * 4
    assert (
        shortest - STEP_UM * 4 < least < 2 * shortest
    )  # halves of an odd number of grid steps


def test_no_boxes_are_no_pieces():
    made, of = pieces.cut(
        np.empty((0, 4), int), NOTHING, step_um=STEP_UM, point=beam(8.0), tolerance=0.01
    )
    assert (made.shape, of.shape) == ((0, 4), (0,))


def asked_of(monkeypatch, boxes, point, tolerance=0.01):
    """Caps and limits that the cutting is tried with, one after the other, where none
    keeps its limit.
    """
    asked = []
    monkeypatch.setattr(
        pieces, "_halved", lambda *given, most: asked.append((given[4], most))
    )
    with pytest.raises(ProcessError):
        pieces.cut(boxes, NOTHING, step_um=STEP_UM, point=point, tolerance=tolerance)
    return asked


def test_pieces_grow_from_half_a_range_only_as_far_as_their_number_asks(monkeypatch):
    """Halves of a range have to be few, longer pieces no more than 500 000: squares of
    12 um of 3 by 7 mm are 146 000,
    of 9 by 21 mm too many. Within three ranges of a corner they go by the narrower
    range that counts there."""
    point = PointExposure(np.array([0.01, 12.0, 3.0]), np.array([0.5, 0.4, 0.1]))
    small = np.array([[0, 0, 3_000_000, 7_000_000]])
    tried = asked_of(monkeypatch, small // 3, point)
    assert [(caps.longest_um, most) for caps, most in tried] == [
        (6.0, 100_000), (12.0, 500_000), (24.0, 500_000), (48.0, 500_000)
    ]  # fmt: skip
    assert [caps.corners for caps, _ in tried] == [
        [(9.0, r * 3.0)] for r in (0.5, 1.0, 2.0, 4.0)
    ]
    assert {(caps.shortest, caps.change) for caps, _ in tried} == {
        (3.0 / 64 / STEP_UM, 0.2 * 0.01 * 0.5)
    }
    tried = asked_of(monkeypatch, small, point)  # 250 by 584 of 12 um, 125 by 292 of 24
    assert [(caps.longest_um, most) for caps, most in tried] == [
        (12.0, 500_000),
        (24.0, 500_000),
        (48.0, 500_000),
    ]
    tried = asked_of(monkeypatch, 3 * small, point)  # 375 by 875 of 24 um
    assert [(caps.longest_um, most) for caps, most in tried] == [
        (24.0, 500_000),
        (48.0, 500_000),
    ]


def test_the_usual_range_is_where_half_of_the_energy_is_reached():
    around = PointExposure(np.array([50.0, 2.0, 9.0]), np.array([0.2, 0.1, 0.3]))
    assert pieces._ranges(around, 1e-3) == (9.0, [2.0])


def test_halving_stops_at_what_is_asked_to_be_the_most():
    point = beam(8.0)
    around = PointExposure(point.widths_um[1:], point.weights[1:])
    caps = pieces._Caps(250.0, 8.0, [(24.0, 4.0)], 1e-3)
    made = pieces._halved(CROSS, NOTHING, STEP_UM, around, caps, most=10_000)
    count = len(made.of)
    assert (
        len(pieces._halved(CROSS, NOTHING, STEP_UM, around, caps, most=count).of)
        == count
    )
    assert pieces._halved(CROSS, NOTHING, STEP_UM, around, caps, most=count - 1) is None


def test_a_side_of_twice_the_shortest_is_halved_once_more():
    around = PointExposure(np.array([5.0]), np.array([1.0]))
    box = np.array([[0, 0, 64, 8]])
    made = pieces._halved(
        box, NOTHING, STEP_UM, around, pieces._Caps(4.0, 1e-3, [], 1.0), most=100
    )
    assert sorted(map(tuple, made.box.tolist())) == [
        (4 * i, 4 * j, 4 * i + 4, 4 * j + 4) for i in range(16) for j in (0, 1)
    ]


def test_sides_that_other_boxes_cover_from_end_to_end_are_no_edges():
    """A stem on a bar of unlike length, two boxes side by side below it: of each box
    (left, bottom, right, top).
    """
    boxes = np.array(
        [[0, 50, 100, 90], [-40, 20, 160, 50], [-40, 0, 30, 20], [30, -7, 160, 20]]
    )
    pairs = pairs_near(boxes * STEP_UM, np.zeros(len(boxes)), beam(8.0))
    outer, first = np.ones((4, 4), bool), np.searchsorted(pairs[0], np.arange(5))
    pieces._uncover(boxes, np.arange(4), boxes, first, pairs[1], outer)
    want = [
        [1, 0, 1, 1],
        [1, 0, 1, 1],
        [1, 1, 0, 0],
        [1, 1, 1, 0],
    ]  # the bar's top and the right box's left in part
    assert (outer == np.array(want, bool)).all()
    half = np.array(
        [[0, 20, 90, 50], [90, 20, 160, 50]]
    )  # of the bar: under the stem, and beyond it in part
    outer = np.ones((2, 4), bool)
    pieces._uncover(half, np.array([1, 1]), boxes, first, pairs[1], outer)
    assert outer[:, 3].tolist() == [False, True]


def test_pieces_of_many_shapes_are_no_longer_than_the_range(monkeypatch):
    """Longer ones reach as far into a shape: where they begin, the edges beside were 2
    % off.
    """
    monkeypatch.setattr(pieces, "_FEW_PIECES", 10)
    made, _ = pieces.cut(
        CROSS, NOTHING, step_um=STEP_UM, point=beam(5.0), tolerance=0.01
    )
    assert 2.5 < (made[:, 2:] - made[:, :2]).max() * STEP_UM <= 5.0


@pytest.mark.parametrize("turn", [[0, 1, 2, 3], [1, 0, 3, 2]])
def test_a_bar_drawn_as_two_is_not_cut_along_for_the_side_between_them(turn):
    """From its edge to its middle the background changes by more than a piece may have,
    but no edge is there.
    """
    bars, point = (
        np.array([[0, 0, 120_000, 6_000], [0, 6_000, 120_000, 13_000]]),
        beam(16.0),
    )
    far = PointExposure(point.widths_um[1:], point.weights[1:])
    ends = by_boxes(
        np.array([[60.0, 0.0], [60.0, 6.0], [60.0, 13.0]]), bars * STEP_UM, far
    )
    assert np.abs(np.diff(ends)).min() / 2 > 0.2 * 0.01 * 0.5
    made, of = pieces.cut(
        bars[:, turn], NOTHING, step_um=STEP_UM, point=point, tolerance=0.01
    )
    made = made[:, turn]
    middle = (made[:, 0] <= 60_000) & (made[:, 2] >= 60_000)
    for n, (_, bottom, _, top) in enumerate(bars):
        assert {
            tuple(piece) for piece in made[middle & (of == n)][:, [1, 3]].tolist()
        } == {(bottom, top)}
