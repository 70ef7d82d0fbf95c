"""Unions and differences keep what has three corners, and drop what has fewer."""

import numpy as np

from layout.shapes import polygon, region

TRIANGLE = np.array([[10, -20], [70, -10], [30, 50]])


def test_a_triangle_cut_off_a_square_is_left():
    square = np.array([[0, 0], [40, 0], [40, 40], [0, 40]])
    taken = np.array([[0, 0], [40, 0], [40, 30], [10, 40], [0, 40]])  # all but a corner
    (found,) = region.subtract_contours([square], [taken])
    assert len(found) == 3
    assert abs(polygon.twice_area(found)) == 30 * 10


def test_a_slanted_hole_is_cut_from_corner_to_corner_and_nothing_moves():
    """The middle of the hole lies off whole units on its edges: no corner is made, and
    twice the area is kept.
    """
    square = np.array([[-200, -200], [201, -200], [201, 200], [-200, 200]])
    hole = np.array([[-70, -31], [77, -62], [90, 10], [13, 101], [-3, 40]])
    left = region.subtract_contours([square], [hole])
    pieces = region.without_holes(left)
    assert len(pieces) == 2
    corners = {tuple(p) for p in np.concatenate([square, hole]).tolist()}
    assert {tuple(p) for piece in pieces for p in piece.tolist()} == corners
    # no way there and back
    assert all(len(np.unique(piece, axis=0)) == len(piece) for piece in pieces)
    assert sum(map(polygon.twice_area, pieces)) == 2 * 401 * 400 - polygon.twice_area(
        hole
    )
    (whole,) = [c for c in region.union_contours(pieces) if polygon.twice_area(c) > 0]
    assert len(whole) == 4
