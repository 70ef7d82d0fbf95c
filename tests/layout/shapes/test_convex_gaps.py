"""Gaps and widths of convex polygons by independent geometry: turned rectangles,
circles, triangles, in closed form.
"""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from layout.shapes import convex

# Pythagorean turns: corners stay whole numbers
TURNS = ((3, 4, 5), (5, 12, 13), (8, 15, 17), (20, 21, 29))


def rectangle(a, b, turn=None):
    """(4, 2) of sides 2 a and 2 b about (0, 0); turned corners are ``turn[2]`` times as
    far.
    """
    corners = np.array([[-a, -b], [a, -b], [a, b], [-a, b]])
    return (
        corners
        if turn is None
        else corners @ np.array([[turn[0], turn[1]], [-turn[1], turn[0]]])
    )


def between(first, second):
    """Distance of two polygons that do not meet, by all pairs of segments, sampled at
    their ends and feet.
    """

    def to(p, a, b):
        t = np.clip(np.dot(p - a, b - a) / np.dot(b - a, b - a), 0, 1)
        return math.dist(p, a + t * (b - a))

    sides = [
        list(zip(s.astype(float), np.roll(s, -1, axis=0).astype(float), strict=True))
        for s in (first, second)
    ]
    return min(
        min(to(p, *edge) for p in one.astype(float) for edge in edges)
        for one, edges in ((first, sides[1]), (second, sides[0]))
    )


@pytest.mark.parametrize("turn", TURNS)
def test_a_gap_along_the_common_direction_of_turned_rectangles(turn):
    p, q, r = turn
    one, two = rectangle(40, 23, turn), rectangle(31, 57, turn)
    # side by side along the turned x axis: centres 40 + 31 + 9 apart in units of r, 8
    # along the other
    dx, dy = 80 * p - 8 * q, 80 * q + 8 * p
    assert convex.convex_gap(one, two, dx, dy) == pytest.approx(9 * r, rel=1e-14)
    assert convex.convex_gap(two, one, -dx, -dy) == pytest.approx(9 * r, rel=1e-14)
    assert convex.convex_gap(one, two, dx - 9 * p, dy - 9 * q) == 0.0
    assert convex.convex_gap(one, two, dx - 10 * p, dy - 10 * q) == -1.0


@pytest.mark.parametrize("turn", TURNS)
def test_a_corner_that_points_at_a_side(turn):
    p, q, r = turn
    still, turned = rectangle(200, 90 * r), rectangle(30, 17, turn)
    reach = 30 * p + 17 * q  # of the corner along x
    assert convex.convex_gap(still, turned, 200 + reach + 13, 5) == pytest.approx(13)
    assert convex.convex_gap(turned, still, -200 - reach - 13, -5) == pytest.approx(13)


def test_a_corner_that_points_at_a_corner():
    one, two = rectangle(10, 20), rectangle(7, 5)
    assert convex.convex_gap(one, two, 10 + 7 + 60, 20 + 5 + 11) == pytest.approx(
        61
    )  # 11, 60, 61
    assert convex.convex_gap(one, two, -10 - 7 - 60, 20 + 5 + 11) == pytest.approx(61)
    assert convex.convex_gap(one, two, 17, 25) == 0.0  # corner on corner


@pytest.mark.parametrize(
    ("step", "count", "at"),
    [((20, 17), 17, 6), ((2, 11), 39, 5), ((1, 25), 56, 9), ((3, 7), 8, 3)],
)
def test_a_corner_on_a_slanted_side_touches_exactly(step, count, at):
    """A side of so many steps of whole numbers; the corner lies on one of them, where
    shares of the side round.
    """
    (p, q), corner = step, np.array([[0, 0], [40, -70], [90, -60]])
    side = np.array([[0, 0], [count * p, count * q], [0, count * q]])
    assert convex.convex_gap(side, corner, at * p, at * q) == 0.0
    assert convex.convex_gap(corner, side, -at * p, -at * q) == 0.0
    assert convex.convex_gap(side, corner, at * p - 1, at * q) == -1.0
    assert 0 < convex.convex_gap(side, corner, at * p + 1, at * q) < 1


@given(
    seed=st.integers(0, 10_000),
    sides=st.tuples(st.integers(3, 9), st.integers(3, 9)),
    away=st.tuples(st.integers(-5000, 5000), st.integers(-5000, 5000)),
)
def test_any_convex_polygons_are_as_far_as_their_nearest_points(seed, sides, away):
    from scipy.spatial import ConvexHull

    rng = np.random.default_rng(seed)
    shapes = []
    for count in sides:
        points = rng.integers(-900, 900, (count + 2, 2))
        shapes.append(points[ConvexHull(points).vertices])
    found = convex.convex_gap(*shapes, *away)
    moved = shapes[1] + np.array(away)
    if found > 0:
        assert found == pytest.approx(between(shapes[0], moved), rel=1e-12)
    else:  # no line along an edge has all of the one on one side and all of the other strictly beyond it
        for one, two in ((shapes[0], moved), (moved, shapes[0])):
            edge = np.roll(one, -1, axis=0) - one
            outside = edge[:, 1, None] * (two[:, 0] - one[:, :1]) - edge[:, 0, None] * (
                two[:, 1] - one[:, 1:]
            )
            assert (outside.min(1) <= 0).all()


def test_polygons_of_circles_are_as_far_as_circles_less_their_flats():
    count, radius = 64, 100_000
    angle = 2 * math.pi * (np.arange(count) + 0.5) / count
    circle = np.rint(radius * np.column_stack([np.cos(angle), np.sin(angle)])).astype(
        np.int64
    )
    for direction in (0.0, 0.7, 1.9, 4.4):
        dx, dy = (
            round(234_567 * math.cos(direction)),
            round(234_567 * math.sin(direction)),
        )
        found = convex.convex_gap(circle, circle, dx, dy)
        exact = math.hypot(dx, dy) - 2 * radius
        # corners lie on the circle to 0.71, flats radius (1 - cos(pi / 64)) = 120.5
        # within it
        assert (
            -1.5 <= found - exact <= 2 * radius * (1 - math.cos(math.pi / count)) + 1.5
        )


def test_width_is_the_least_height():
    assert convex.least_width(rectangle(40, 23)) == 46
    assert convex.least_width(rectangle(23, 40, (5, 12, 13))) == pytest.approx(46 * 13)
    assert convex.least_width(np.array([[0, 0], [60, 0], [0, 11]])) == pytest.approx(
        60 * 11 / 61
    )
    hexagon = np.array(
        [[200, 0], [100, 173], [-100, 173], [-200, 0], [-100, -173], [100, -173]]
    )
    assert convex.least_width(hexagon) == pytest.approx(2 * 173)
    assert convex.farthest_vertex(np.array([[3, -4], [1, 1], [-2, 0]])) == 5
