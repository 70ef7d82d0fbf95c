"""Unions and differences keep what has three corners, and drop what has fewer."""

import numpy as np

from layout.shapes import polygon, region

TRIANGLE = np.array([[10, -20], [70, -10], [30, 50]])


def test_a_triangle_stays():
    (found,) = region.union([TRIANGLE])
    assert len(found) == 3
    assert abs(polygon.twice_area(found)) == 60 * 70 - 20 * 10  # of the sides (60, 10) and (20, 70)


def test_a_triangle_cut_off_a_square_is_left():
    square = np.array([[0, 0], [40, 0], [40, 40], [0, 40]])
    taken = np.array([[0, 0], [40, 0], [40, 30], [10, 40], [0, 40]])  # all but a corner
    (found,) = region.difference([square], [taken])
    assert len(found) == 3
    assert abs(polygon.twice_area(found)) == 30 * 10
