"""Distances of any two polygons beside closed forms, and beside convex ones measured by
separating lines.
"""

import numpy as np

from layout.drc.geometry import contour_edges, measure_separation
from tests.referees.convex import convex_gap

ANGLE = np.array([(0, 0), (900, 0), (900, 100), (120, 100), (120, 700), (0, 700)])
# cut in along y = 500
HOLE = [(800, 500), (800, 200), (200, 200), (200, 800), (800, 800), (800, 500)]
RING = np.array(
    [(0, 0), (1000, 0), (1000, 500), *HOLE, (1000, 500), (1000, 1000), (0, 1000)]
)
TURNED = np.array([(-30, -40), (70, 0), (0, 60)])


def distance(first, second, dx, dy):
    edges = [contour_edges([first]), contour_edges([second])]
    zero = np.zeros(1, np.int64)
    return measure_separation(edges, zero, zero + 1, np.array([[dx, dy]]))[0][0]


def test_what_lies_in_a_hole_that_is_cut_in_is_apart_and_what_lies_on_the_ring_is_not():
    # its lowest corner at 310, the hole begins at 200
    assert distance(RING, TURNED, 500, 350) == 110
    assert distance(RING, TURNED, 100, 100) == 0
    assert distance(RING, TURNED, 740, 500) == 0  # across the cut
    big = np.array([(-5000, -4000), (5000, -4000), (5000, 6000), (-5000, 6000)])
    assert distance(big, RING, 3, -7) == 0


def test_convex_ones_are_as_far_apart_as_lines_between_them_say():
    rng = np.random.default_rng(8)
    shapes = []
    for corners in rng.integers(3, 9, 12).tolist():
        angle = np.sort(rng.uniform(0, 2 * np.pi, corners))
        shape = np.rint(
            rng.uniform(40, 90) * np.column_stack([np.cos(angle), np.sin(angle)])
        ).astype(np.int64)
        shapes.append(shape[(shape != np.roll(shape, 1, axis=0)).any(1)])
    one, two = rng.integers(0, 12, (2, 600))
    dx, dy = rng.integers(-210, 210, (2, 600))
    edges = [contour_edges([shape]) for shape in shapes]
    found, _ = measure_separation(edges, one, two, np.column_stack([dx, dy]))
    some = zip(one.tolist(), two.tolist(), dx.tolist(), dy.tolist(), strict=True)
    wanted = [max(convex_gap(shapes[a], shapes[b], x, y), 0.0) for a, b, x, y in some]
    np.testing.assert_allclose(found, wanted, rtol=1e-12)
    assert 30 < np.count_nonzero(found == 0) < 300
