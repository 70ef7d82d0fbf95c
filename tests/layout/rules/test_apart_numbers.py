"""Distances of any two polygons beside exact fractions, and where corners miss an edge
by less than a thousandth.
"""

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from layout.rules.apart import apart

WEDGE = [(0, 0), (1000, 7), (600, 900)]
LOW = [
    (0, 0),
    (-30, -400),
    (40, -500),
]  # its first corner is the nearest one to what lies above
EIGHT = [
    (0, 0),
    (40, 0),
    (40, 50),
    (-70, -30),
    (-70, 0),
]  # crosses itself at (0, 0): right lobe left around, ...
STAR = [
    (0, 100),
    (-59, -81),
    (95, 31),
    (-95, 31),
    (59, -81),
]  # goes around its middle twice
SPECK = [(0, 0), (2, 0), (0, 1)]


def distance(one, two, dx=0, dy=0, most=math.inf):
    shapes = [np.array(one), np.array(two)]
    return apart(
        shapes,
        (np.array([0]), np.array([1])),
        (np.array([dx]), np.array([dy])),
        most=most,
    )[0]


@pytest.mark.parametrize(
    ("x", "y", "wanted"),
    [
        (857, 6, 0.0),  # 1000 · 6 - 7 · 857 = +1: within, by 1 / 1000.02
        (143, 1, 1 / math.hypot(1000, 7)),  # 1000 - 1001 = -1: as far without
        (286, 2, 2 / math.hypot(1000, 7)),  # 2000 - 2002 = -2
        (1000, 7, 0.0),  # its own corner
        (0, 0, 0.0),
        (0, -1, 1.0),  # its foot would lie 7/1000 before the start
        (
            1000,
            6,
            1000 / math.hypot(1000, 7),
        ),  # 6000 - 7000, its foot 7/1000 before the end ...
        (1004, 4, 5.0),  # ... and here beyond it: 4 and 3 from the corner
        (-4, -3, 5.0),
    ],
)
def test_a_corner_at_a_slanted_edge_is_as_far_as_its_cross_product_says(x, y, wanted):
    """An edge from (0, 0) to (1000, 7) has a point (u, v) at (1000 v - 7 u) / 1000.02
    above it.
    """
    assert distance(WEDGE, LOW, x, y) == pytest.approx(wanted, rel=1e-9, abs=1e-13)
    assert distance(LOW, WEDGE, -x, -y) == pytest.approx(wanted, rel=1e-9, abs=1e-13)


def to_edge(end, p, q):
    """Squared distance of a point from an edge, exact."""
    (ex, ey), (px, py), (qx, qy) = end, p, q
    long = (qx - px) ** 2 + (qy - py) ** 2
    t = (
        Fraction((ex - px) * (qx - px) + (ey - py) * (qy - py), long)
        if long
        else Fraction(0)
    )
    t = min(max(t, Fraction(0)), Fraction(1))
    return (px + t * (qx - px) - ex) ** 2 + (py + t * (qy - py) - ey) ** 2


def cross_within(p, q, r, s):
    """Whether two edges that are not parallel have a point in common: p + t (q - p) = r
    + u (s - r).
    """
    across = (q[0] - p[0]) * (s[1] - r[1]) - (q[1] - p[1]) * (s[0] - r[0])
    if across == 0:
        return False
    t = Fraction((r[0] - p[0]) * (s[1] - r[1]) - (r[1] - p[1]) * (s[0] - r[0]), across)
    u = Fraction((r[0] - p[0]) * (q[1] - p[1]) - (r[1] - p[1]) * (q[0] - p[0]), across)
    return 0 <= t <= 1 and 0 <= u <= 1


def winds(polygon, at):
    """Turns around a point on no edge, as the sum of the angles under which edges are
    seen.
    """
    total = 0.0
    for p, q in zip(polygon, polygon[1:] + polygon[:1], strict=True):
        a, b = (p[0] - at[0], p[1] - at[1]), (q[0] - at[0], q[1] - at[1])
        total += math.atan2(a[0] * b[1] - a[1] * b[0], a[0] * b[0] + a[1] * b[1])
    return round(total / (2 * math.pi))


def exactly(one, two):
    """Squared distance of two polygons as a fraction."""
    least = None
    for p, q in zip(one, one[1:] + one[:1], strict=True):
        for r, s in zip(two, two[1:] + two[:1], strict=True):
            if cross_within(p, q, r, s):
                return Fraction(0)
            ends = min(
                to_edge(p, r, s), to_edge(q, r, s), to_edge(r, p, q), to_edge(s, p, q)
            )
            least = ends if least is None else min(least, ends)
    return (
        Fraction(0) if least and (winds(one, two[0]) or winds(two, one[0])) else least
    )


corner = st.tuples(st.integers(-9, 9), st.integers(-6, 7))
polygon = st.lists(corner, min_size=3, max_size=6)


@settings(max_examples=120)
@given(
    shapes=st.lists(polygon, min_size=2, max_size=3),
    moves=st.lists(
        st.tuples(st.integers(-21, 21), st.integers(-17, 17)), min_size=1, max_size=4
    ),
    most=st.one_of(st.just(math.inf), st.integers(1, 15)),
)
def test_any_polygons_are_as_far_apart_as_exact_fractions_say(shapes, moves, most):
    """Corners may repeat and edges cross; rounding: some ten operations of numbers
    below 60, and a square root.
    """
    count = len(moves)
    one, two = np.arange(count) % len(shapes), (np.arange(count) + 1) % len(shapes)
    dx, dy = np.array(moves).T
    found = apart(
        [np.array(shape) for shape in shapes], (one, two), (dx, dy), most=most
    )
    for n, (x, y) in enumerate(moves):
        moved = [(u + x, v + y) for u, v in shapes[two[n]]]
        wanted = exactly(shapes[one[n]], moved)
        assert found[n] == pytest.approx(
            min(math.sqrt(wanted), most), rel=1e-9, abs=1e-9
        )
        assert (found[n] == 0) == (wanted == 0)


@pytest.mark.parametrize(
    ("around", "x", "y", "within"),
    [
        (EIGHT, 30, 5, True),  # the right lobe, once to the left
        (EIGHT, -60, -10, True),  # the left lobe, once to the right
        (EIGHT, -20, -30, False),  # beside it, below the slanted edge
        (EIGHT, 20, 40, False),
        (STAR, -1, 0, True),  # the middle, around which it goes twice
        (STAR, -1, 80, True),
        (STAR, 50, 60, False),  # between two rays
        (STAR, -60, -20, False),
        (EIGHT[::-1], 30, 5, True),
        (STAR[::-1], -1, 0, True),
    ],
)
def test_what_is_enclosed_goes_by_turns_of_either_sense(around, x, y, within):
    assert (distance(around, SPECK, x, y) == 0) == within
    assert (distance(SPECK, around, -x, -y) == 0) == within


def test_heights_of_corners_are_told_from_heights_between_them():
    """A point at the height of a corner that only touches its line, and at that of two
    corners on either side.
    """
    kite = [(0, 0), (60, -40), (130, 0), (60, 35)]
    assert distance(kite, SPECK, 50, 0) == 0
    assert distance(kite, SPECK, -12, 0) == pytest.approx(
        10
    )  # left of all, at the height of (0, 0) and (130, 0)
    assert distance(kite, SPECK, 141, 0) == pytest.approx(11)
    teeth = [(0, 0), (100, 0), (100, 90), (70, 20), (50, 90), (30, 20), (0, 90)]
    assert distance(teeth, SPECK, 20, 20) == 0  # left of the two dents, at their depth
    assert distance(teeth, SPECK, 85, 20) == 0
    assert distance(teeth, SPECK, -9, 90) == pytest.approx(7)


def test_far_coordinates_keep_their_units():
    """Squares whose corners lie near 2^29, 3 and 4 apart; products go to 2^61."""
    far = 1 << 29
    one = [(-far, -far), (far - 5, -far), (far - 5, far - 7), (-far, far - 7)]
    two = [(0, 0), (900, 0), (900, 700), (0, 700)]
    assert distance(one, two, far - 5 + 3, far - 7 + 4) == 5
    assert distance(one, two, far - 5, far - 7) == 0
    assert distance(one, two, far - 5 + 3, 11) == 3
    assert distance(one, two, far - 905, 0) == 0  # its right side along the other's
    assert distance(one, two, far - 906, 0) == 0


def test_no_pairs_and_no_outlines_have_no_distances():
    nothing = np.empty(0, np.int64)
    assert apart([], (nothing, nothing), (nothing, nothing)).shape == (0,)
