"""Polygons with holes as plain ones: cuts, bridges and slivers by hand."""

import itertools

import numpy as np
import pytest
from manifold3d import CrossSection

from layout.shapes import region

OUTER = np.array([[0, 0], [100, 3], [40, 90]])
HOLE = np.array([[40, 30], [38, 42], [50, 44], [53, 31]])  # clockwise


def box(left, bottom, right, top):
    return np.array([[left, bottom], [right, bottom], [right, top], [left, top]])


def same(polygon):
    """Corners from the smallest on, as they run."""
    points = [tuple(p) for p in np.asarray(polygon).tolist()]
    first = points.index(min(points))
    return tuple(points[first:] + points[:first])


def twice_area(p):
    after = np.roll(p, -1, axis=0)
    return int((p[:, 0] * after[:, 1] - after[:, 0] * p[:, 1]).sum())


def test_what_rounds_to_a_line_or_a_point_is_left_out():
    """Triangles a third of a unit high, a third wide both ways, and one that keeps
    three corners.
    """
    line, point, whole = (
        [(0, 0), (5, 0.3), (0, 0.4)],
        [(9, 9), (9.3, 9), (9, 9.3)],
        [(20, 20), (23.2, 20), (20, 21.4)],
    )
    (kept,) = region._contours(
        CrossSection([np.array(p, float) for p in (line, point, whole)])
    )
    assert same(kept) == ((20, 20), (23, 20), (20, 21))


def test_unions_differences_and_overlaps_keep_holes():
    frame = [box(0, 0, 60, 40), box(11, 10, 24, 30)[::-1]]
    steps = [[0, 0], [20, 0], [20, 4], [31, 4], [31, 12], [15, 12], [15, 9], [0, 9]]
    assert {
        same(p) for p in region.union_contours([box(0, 0, 20, 9), box(15, 4, 31, 12)])
    } == {same(steps)}
    assert sorted(
        map(
            twice_area,
            region.subtract_contours([box(0, 0, 60, 40)], [box(11, 10, 24, 30)]),
        )
    ) == [-520, 4800]
    assert {
        same(p) for p in region.subtract_contours(frame, [box(-1, -1, 20, 41)])
    } == {
        same(
            [
                [20, 0],
                [60, 0],
                [60, 40],
                [20, 40],
                [20, 30],
                [24, 30],
                [24, 10],
                [20, 10],
            ]
        )
    }
    assert {same(p) for p in region.overlap_contours(frame, [box(5, 5, 20, 50)])} == {
        same(
            [[5, 5], [20, 5], [20, 10], [11, 10], [11, 30], [20, 30], [20, 40], [5, 40]]
        )
    }
    assert region.overlap_contours(frame, [box(12, 11, 23, 29)]) == []


@pytest.mark.parametrize(
    ("grid", "x", "levels"),
    [
        (1, 18, (0, 10, 30, 41)),
        (4, 16, (0, 12, 28, 44)),
        (10, 20, (0, 10, 30, 40)),
        (3, 18, (0, 9, 27, 42)),
    ],
)
def test_a_hole_is_cut_upright_through_its_middle_on_the_grid(grid, x, levels):
    """From 11 to 24: 17.5, to the nearest step (the even one of two)."""
    a, b, c, d = levels
    pieces = region.without_holes(
        [box(0, a, 60, d), box(11, b, 24, c)[::-1]], grid=grid
    )
    left = [[0, a], [x, a], [x, b], [11, b], [11, c], [x, c], [x, d], [0, d]]
    right = [[x, a], [60, a], [60, d], [x, d], [x, c], [24, c], [24, b], [x, b]]
    assert {same(p) for p in pieces} == {same(left), same(right)}


def test_levels_off_the_grid_are_bridged():
    """Of boxes too: a cut at 16 would end 10 high."""
    pieces = region.without_holes(
        [box(0, 0, 60, 40), box(11, 10, 24, 30)[::-1]], grid=4
    )
    assert sum(map(twice_area, pieces)) == 2 * (2400 - 260)
    assert {tuple(p) for piece in pieces for p in piece.tolist()} == {
        *((0, 0), (60, 0), (60, 40), (0, 40), (11, 10), (24, 10), (24, 30), (11, 30))
    }


def test_of_several_holes_each_is_cut_and_parts_without_are_left_alone():
    contours = [
        box(0, 0, 90, 40),
        box(11, 10, 25, 30)[::-1],
        box(50, 7, 70, 19)[::-1],
        box(200, 0, 210, 7),
    ]
    pieces = region.without_holes(contours)
    assert sum(map(twice_area, pieces)) == 2 * (3600 - 280 - 240 + 70)
    assert all(twice_area(p) > 0 for p in pieces)
    assert same(box(200, 0, 210, 7)) in {same(p) for p in pieces}
    edges = {int(v) for p in pieces for v in p[:, 0]}
    assert {18, 60} <= edges <= {0, 11, 18, 25, 50, 60, 70, 90, 200, 210}


def test_a_cut_ends_exactly_where_slanted_edges_meet_it_on_the_grid():
    wedge = np.array(
        [[0, 0], [6, 0], [6, 4]]
    )  # at x = 3 its slant is 2 high, at 4 it is 8/3
    assert region._ends_exactly(3, wedge, 1)
    assert region._ends_exactly(3, wedge, 2)
    assert not region._ends_exactly(3, wedge, 4)
    assert not region._ends_exactly(4, wedge, 1)
    assert region._ends_exactly(7, wedge, 4)  # it passes beside
    assert region._ends_exactly(-1, wedge, 4)
    corner = np.array([[0, 0], [6, 5], [2, 8]])
    assert region._ends_exactly(6, corner, 5)
    assert not region._ends_exactly(6, corner, 2)  # met at its corner, 5 high
    assert not region._ends_exactly(1, corner, 1)


@pytest.mark.parametrize(("i", "j"), itertools.product(range(3), range(4)))
def test_a_slanted_ring_is_bridged_at_its_nearest_corners_and_as_far_from_there_as_can_be(
    i, j
):
    """(40, 90) to (50, 44) is the shortest way; across the hole from there is (40, 30),
    nearest to (0, 0).
    """
    want = {
        same([[40, 90], [0, 0], [40, 30], [38, 42], [50, 44]]),
        same([[0, 0], [100, 3], [40, 90], [50, 44], [53, 31], [40, 30]]),
    }
    made = region._bridged(np.roll(OUTER, i, axis=0), np.roll(HOLE, j, axis=0))
    assert {same(p) for p in made} == want
    if (i, j) == (0, 0):
        assert {same(p) for p in region.without_holes([OUTER, HOLE])} == want


@pytest.mark.parametrize("j", range(3))
def test_of_ways_that_are_as_far_along_the_hole_the_shortest_is_taken(j):
    hole = np.roll(np.array([[40, 30], [45, 41], [52, 33]]), j, axis=0)
    want = {
        same([[40, 90], [0, 0], [40, 30], [45, 41]]),
        same([[0, 0], [100, 3], [40, 90], [45, 41], [52, 33], [40, 30]]),
    }
    assert {same(p) for p in region._bridged(OUTER, hole)} == want


def free(start, end, *contours):
    return region._free(
        np.array([start]), np.array([end]), contours or (HOLE + 1000,)
    ).tolist() == [True]


def test_a_way_is_free_that_touches_no_edge_but_at_its_own_ends():
    assert free((0, 0), (40, 30), OUTER, HOLE)
    assert not free((0, 0), (50, 44), OUTER, HOLE)  # through the hole
    assert not free((0, 0), (200, 200), box(50, 40, 60, 61))
    assert not free(
        (50, 45), (200, 45), box(50, 40, 60, 61)
    )  # from the middle of an edge
    assert not free(
        (0, 40), (50, 40), box(50, 20, 60, 40) + np.array([0, 10])
    )  # ends on an edge
    assert free((0, 40), (50, 40), box(50, 40, 60, 61))
    assert free(
        (0, 0), (49, 39), box(50, 40, 60, 61)
    )  # points at a corner, and ends before it
    assert free((0, 0), (10, 100), box(50, 40, 60, 61))
    assert not free((0, 40), (200, 40), box(50, 40, 60, 61))  # along an edge and beyond


def test_triangles_fill_outlines_but_for_their_holes():
    corners = np.concatenate([OUTER, HOLE, OUTER + 300])
    made = region.triangulate([OUTER, HOLE, OUTER + 300])
    areas = [twice_area(corners[t]) for t in made]
    assert min(areas) > 0
    assert sum(areas) == 2 * twice_area(OUTER) + twice_area(HOLE)
    assert len(made) == 7 + 1  # corners of a ring, and those of a triangle less two
