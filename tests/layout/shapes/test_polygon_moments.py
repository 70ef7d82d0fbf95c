"""Moments of a rectangle with a hole, by hand, and places that share its edges evenly."""

import numpy as np
import pytest

from layout.shapes.moments import points_along_edges, polygon_moments, total_perimeter

OUTER = np.array([[1.0, 2.0], [6.0, 2.0], [6.0, 5.0], [1.0, 5.0]])
HOLE = np.array([[2.0, 3.0], [2.0, 4.5], [4.0, 4.5], [4.0, 3.0]])  # clockwise


def test_moments_are_those_of_the_rectangle_less_those_of_the_hole():
    area, first, second = polygon_moments([OUTER, HOLE])
    assert area == pytest.approx(15 - 3)
    assert first == pytest.approx([15 * 3.5 - 3 * 3, 15 * 3.5 - 3 * 3.75])
    third = [
        (6**3 - 1) / 3 * 3 + (5**3 - 2**3) / 3 * 5,
        (4**3 - 2**3) / 3 * 1.5 + (4.5**3 - 3**3) / 3 * 2,
    ]
    assert second == pytest.approx(third[0] - third[1])
    assert polygon_moments([HOLE])[0] == pytest.approx(-3)


def test_places_divide_the_edges_evenly():
    assert total_perimeter([OUTER, HOLE]) == pytest.approx(16 + 7)
    places = points_along_edges([OUTER, HOLE], 46)  # a step of 0.5 along 23
    assert places[[0, 9, 10, 31, 32, 45]] == pytest.approx(
        np.array([[1.25, 2], [5.75, 2], [6, 2.25], [1, 2.25], [2, 3.25], [2.25, 3]])
    )
