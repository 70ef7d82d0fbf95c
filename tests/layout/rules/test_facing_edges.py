"""Edges that face each other, and the counting loops of the check, against figures
whose distances are known.
"""

import math

import numpy as np
import pytest

from layout.rules import edges, loops
from layout.rules.edges import SPACE, WIDTH


def contour(*points):
    p = np.array(points)
    return np.hstack([p, np.roll(p, -1, axis=0)])


def found(shapes, feature, gap):
    """Sorted (kind, distance) of the pairs of some contours."""
    lines = np.concatenate([contour(*s) for s in shapes])
    owner = np.concatenate([np.full(len(s), n) for n, s in enumerate(shapes)])
    rows = edges.facing(lines, owner, feature, gap)
    return (
        sorted((int(kind), round(away, 9)) for _, _, kind, away in rows.tolist()),
        rows,
        lines,
    )


BAR = [(0, 0), (400, 0), (400, 37), (0, 37)]


def test_a_bar_is_as_wide_as_its_sides_are_apart():
    assert found([BAR], 37.0, 90.0)[0] == []
    pairs, rows, lines = found([BAR], 37.5, 90.0)
    assert pairs == [(WIDTH, 37.0)]
    assert {int(rows[0, 0]), int(rows[0, 1])} == {0, 2}  # lower and upper side
    assert lines[int(rows[0, 0])].tolist() in ([0, 0, 400, 0], [400, 37, 0, 37])


@pytest.mark.parametrize(("p", "q", "r"), [(3, 4, 5), (12, 5, 13), (-8, 15, 17)])
def test_a_turned_bar_and_its_turned_neighbour(p, q, r):
    turn = np.array([[p, q], [-q, p]])
    bar = np.array(BAR) @ turn
    beside = (np.array(BAR) + np.array([90, 37 + 11])) @ turn
    pairs = found([bar.tolist(), beside.tolist()], 37 * r - 0.5, 11 * r + 0.5)[0]
    assert pairs == [(SPACE, pytest.approx(11 * r))]
    pairs = found([bar.tolist(), beside.tolist()], 37 * r + 0.5, 11 * r - 0.5)[0]
    assert pairs == [(WIDTH, pytest.approx(37 * r))] * 2


def test_a_notch_of_one_shape_is_a_space_and_its_arms_are_widths():
    u = [(0, 0), (90, 0), (90, 70), (61, 70), (61, 30), (23, 30), (23, 70), (0, 70)]
    assert found([u], 23.5, 38.5)[0] == [(WIDTH, 23.0), (SPACE, 38.0)]
    assert found([u], 31.0, 10.0)[0] == [(WIDTH, 23.0), (WIDTH, 29.0), (WIDTH, 30.0)]


def test_two_shapes_have_no_width_between_them():
    other = [(x, y + 37 + 20) for x, y in BAR]
    assert found([BAR, other], 36.0, 20.5)[0] == [(SPACE, 20.0)]
    assert (
        found([BAR, other], 90.0, 1.0)[0] == [(WIDTH, 37.0)] * 2
    )  # 57 and 94 are through the space


def test_a_diagonal_gap_is_measured_between_the_parts_that_face():
    low = [(0, 0), (100, 0), (100, 50), (0, 50)]
    high = [
        (128, 71),
        (300, 71),
        (300, 160),
        (128, 160),
    ]  # 28 to the right and 21 up: 35
    assert (SPACE, 35.0) in found([low, high], 1.0, 35.5)[0]
    assert found([low, high], 1.0, 35.0)[0] == []


def test_more_pairs_than_fit_at_first_are_all_found():
    bars = [
        [(0, 50 * n), (900, 50 * n), (900, 50 * n + 37), (0, 50 * n + 37)]
        for n in range(4200)
    ]
    pairs = found(bars, 37.5, 13.5)[0]
    assert pairs.count((WIDTH, 37.0)) == 4200
    assert pairs.count((SPACE, 13.0)) == 4199


def test_pairs_of_kinds_are_counted_once_each():
    block = np.array([[1, 2, 0], [3, 1, 2], [2, 0, 1]], np.uint8)
    kind = np.array([0, 1, 2, 1])
    offsets = np.array([[1, 0], [0, 1], [-1, 1], [1, 2]])
    table = np.zeros((4, 3, 3), np.int64)
    loops.pair_histogram(block, 1, kind, offsets, table)
    drawn = kind[block]
    wanted = np.zeros_like(table)
    for m, (right, up) in enumerate(offsets.tolist()):
        for row in range(1, 3):
            for column in range(3):
                if row >= up and 0 <= column + right < 3:
                    wanted[m, drawn[row, column], drawn[row - up, column + right]] += 1
    assert (table == wanted).all()
    assert table[0].sum() == 4  # two rows of two neighbours
    bad = np.zeros((4, 3, 3), bool)
    bad[2, 1, 2] = True
    out = np.full((5, 3), -1)
    count = loops.find_pairs(block, 1, kind, offsets, bad, out, 0)
    # up and to the left of a kind 1 stands a kind 2: (row, column) of the lower one
    want = [
        [r, c, 2]
        for r in (1, 2)
        for c in (1, 2)
        if drawn[r, c] == 1 and drawn[r - 1, c - 1] == 2
    ]
    assert out[:count].tolist() == want


def test_pillars_and_their_area_are_counted_by_tiles():
    block = np.array([[1, 0, 2], [2, 2, 1]], np.uint8)
    counts, cover = np.zeros(3, np.int64), np.zeros((3, 2))
    loops.count_and_cover(block, 3, np.array([0.0, 7.0, 11.0]), (4, 2), counts, cover)
    assert counts.tolist() == [1, 2, 3]
    assert cover.tolist() == [[7.0, 11.0], [22.0, 7.0], [0.0, 0.0]]
    assert math.isclose(cover.sum(), 2 * 7 + 3 * 11)


def test_edges_that_stand_behind_others_do_not_face():
    """A step of the outline beside a hole: 60 up and 80 across through the solid
    between them, which is no space.
    """
    slab = [(0, 0), (400, 0), (400, 200), (180, 200), (180, 500), (0, 500)]
    hole = [
        (100, 40),
        (100, 140),
        (260, 140),
        (260, 40),
    ]  # clockwise; its right edge ends 80 and 60 from the step
    lines = np.concatenate([contour(*slab), contour(*hole)])
    rows = edges.facing(lines, np.zeros(len(lines), int), 1.0, 99.9)
    assert rows.size == 0
    open_slab = [
        (0, 0),
        (400, 0),
        (400, 200),
        (180, 200),
        (180, 140),
        (260, 140),
        (260, 40),
        (100, 40),
        (100, 500),
        (0, 500),
    ]
    opened = edges.facing(contour(*open_slab), np.zeros(10, int), 1.0, 80.5)
    assert [round(away, 9) for away in opened[:, 3].tolist()] == [
        80.0
    ]  # the same step, now beside an open space


def test_what_is_hidden_at_one_end_is_measured_where_it_is_seen():
    """Two long sides 50 apart, a post of 30 between their left ends, which are nearest:
    what is seen counts.
    """
    low, high = (
        [(0, 0), (900, 0), (900, 90), (0, 90)],
        [(0, 140), (900, 149), (900, 250), (0, 250)],
    )
    post = [(-20, 100), (60, 100), (60, 130), (-20, 130)]
    pairs = found([low, high, post], 1.0, 60.0)[0]
    spaces = [away for _, away in pairs]
    assert min(spaces) == 10.0  # post to either side
    beside_post = [away for away in spaces if away > 11]
    assert beside_post[0] == pytest.approx(
        50 + 9 * 60 / 900, abs=0.1
    )  # where the post ends, not 50


def test_shapes_of_known_width_have_no_width_here():
    lines = contour(*BAR)
    assert len(edges.facing(lines, np.full(4, edges.KNOWN), 37.5, 1.0)) == 0
