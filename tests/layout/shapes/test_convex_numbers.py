"""Distances and widths of convex polygons from right triangles of whole sides."""

import numpy as np
import pytest

from layout.shapes import convex

TRIANGLE = np.array([[0, 0], [30, 0], [0, 40]])  # 24 high over its longest side
SLANTED = np.array([[0, 0], [40, 30], [31, 42], [-9, 12]])  # sides of 50 and 15
BOX = np.array([[-7, -3], [13, -3], [13, 9], [-7, 9]])


def test_the_reach_is_that_of_the_farthest_corner():
    assert convex.farthest_vertex(np.array([[3, -4], [0, 1], [-12, 5]])) == 13.0
    assert convex.farthest_vertex(np.array([[3, -4], [-8, 15], [-12, 5]])) == 17.0


def test_the_hull_leaves_out_what_lies_within():
    points = np.array([[0, 0], [9, 2], [50, -10], [20, 10], [60, 40], [5, 30]])
    got = convex.convex_hull(points).tolist()
    start = got.index([0, 0])
    assert got[start:] + got[:start] == [[0, 0], [50, -10], [60, 40], [5, 30]]


@pytest.mark.parametrize(
    ("shape", "want"),
    [(TRIANGLE, 24.0), (SLANTED, 15.0), (BOX, 12.0), (BOX[:, ::-1], 12.0)],
)
def test_the_width_is_the_least_of_all_directions(shape, want):
    assert convex.least_width(shape) == pytest.approx(want, rel=1e-15)
    assert convex.least_width(shape + np.array([1000, -300])) == pytest.approx(
        want, rel=1e-15
    )
    assert convex.least_width(shape[::-1]) == pytest.approx(want, rel=1e-15)


@pytest.mark.parametrize(
    ("first", "second", "dx", "dy", "want"),
    [
        (BOX, BOX, 20 + 3, 12 + 4, 5.0),  # corner to corner
        (BOX, BOX, -20 - 8, -12 - 15, 17.0),
        (BOX, BOX, 20 + 6, 5, 6.0),  # edge to edge
        (BOX, BOX, 4, -12 - 7, 7.0),
        (BOX, BOX, 20, 12, 0.0),  # they touch at a corner
        (BOX, BOX, 20, 3, 0.0),
        (BOX, BOX, 19, 3, -1.0),
        (BOX, BOX, 5, 2, -1.0),
        (TRIANGLE, BOX, 30 + 7, 40 + 3, 24.0),  # 0.8 * 30 + 0.6 * 40 - 24
        (TRIANGLE, BOX, 15 + 7 - 4, 20 + 3 - 3, -1.0),
        (TRIANGLE, BOX, 15 + 7, 20 + 3, 0.0),  # its corner on the middle of the slant
        (SLANTED, TRIANGLE, 40 + 9, 30 + 12 - 24, 9.0),
    ],
)
def test_the_gap_is_the_least_distance_of_any_two_points(first, second, dx, dy, want):
    assert convex.convex_gap(first, second, dx, dy) == pytest.approx(want, rel=1e-15)
    assert convex.convex_gap(second, first, -dx, -dy) == pytest.approx(want, rel=1e-15)


def test_boxes_of_a_unit_lie_a_unit_apart():
    unit = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    assert convex.convex_gap(unit, unit, 2, 0) == 1.0
    assert convex.convex_gap(unit, unit, 0, -1) == 0.0


def test_gaps_agree_with_points_along_both_outlines():
    """500 places on each side of each: never nearer than the gap, and within their step
    of it.
    """
    rng = np.random.default_rng(12)

    def places(shape):
        t = np.linspace(0, 1, 500)[:, None, None]
        return (shape * (1 - t) + np.roll(shape, -1, axis=0) * t).reshape(-1, 2)

    for _ in range(4):
        move = rng.integers(45, 90, 2) * rng.choice([-1, 1], 2)
        got = convex.convex_gap(SLANTED, TRIANGLE, *move.tolist())
        one, two = places(SLANTED), places(TRIANGLE + move)
        least = min(np.hypot(*(two - p).T).min() for p in one[::7])
        assert got <= least + 1e-9 <= got + 0.8  # a seventh of a side of 50 is 0.7
