"""Areas, moments and places along edges of polygons with holes, from rectangles and
right triangles.
"""

import numpy as np
import pytest

from layout.shapes import moments

OUTER = np.array(
    [[-4.0, 3.0], [26.0, 3.0], [26.0, 14.0], [9.0, 14.0], [9.0, 21.0], [-4.0, 21.0]]
)  # an L
HOLE = np.array([[1.0, 5.0], [1.0, 11.0], [7.0, 11.0], [7.0, 5.0]])  # clockwise


def boxed(left, bottom, right, top):
    """Area, integrals of x and of y, and of x^2 + y^2 over a rectangle."""
    wide, high = right - left, top - bottom
    x, y = (left + right) / 2, (bottom + top) / 2
    area = wide * high
    return np.array(
        [area, area * x, area * y, area * (x * x + wide**2 / 12 + y * y + high**2 / 12)]
    )


def told(contours):
    area, first, second = moments.polygon_moments(contours)
    return np.array([area, *first, second])


def test_moments_are_those_of_the_rectangles_of_a_shape():
    whole = boxed(-4, 3, 26, 14) + boxed(-4, 14, 9, 21)
    assert told([OUTER]) == pytest.approx(whole, rel=1e-14)
    assert told([OUTER, HOLE]) == pytest.approx(whole - boxed(1, 5, 7, 11), rel=1e-14)
    assert told([HOLE]) == pytest.approx(-boxed(1, 5, 7, 11), rel=1e-14)


def test_a_right_triangle_has_a_third_and_a_sixth():
    """(0, 0), (a, 0), (0, b): ab/2, a²b/6, ab²/6, ab (a² + b²) / 12."""
    a, b = 7.0, 11.0
    want = [a * b / 2, a * a * b / 6, a * b * b / 6, a * b * (a * a + b * b) / 12]
    assert told([np.array([[0, 0], [a, 0], [0, b]])]) == pytest.approx(
        np.array(want), rel=1e-14
    )


def test_the_perimeter_is_that_of_all_contours():
    assert moments.total_perimeter([OUTER]) == pytest.approx(2 * (30 + 18), rel=1e-15)
    assert moments.total_perimeter(
        [OUTER, HOLE, np.array([[0, 0], [3, 0], [0, 4]])]
    ) == pytest.approx(96 + 24 + 12, rel=1e-15)


def test_places_lie_half_a_step_from_the_start_and_a_step_from_each_other():
    """A rectangle of 30 x 10, then a triangle of 12 + 16 + 20 around a hole: 16 places
    8 apart, the first at 4.
    """
    box = np.array([[2, 1], [32, 1], [32, 11], [2, 11]])
    hole = np.array([[5, 3], [5, 15], [21, 3]])
    want = [
        (6, 1),
        (14, 1),
        (22, 1),
        (30, 1),
        (32, 7),
        (28, 11),
        (20, 11),
        (12, 11),
        (4, 11),
        (2, 5),
    ]
    want += [(5, 7), (5, 15), (11.4, 10.2), (17.8, 5.4), (17, 3), (9, 3)]
    got = moments.points_along_edges([box, hole], 16)
    order = {tuple(np.round(p, 9)) for p in got.tolist()}
    assert order == {(float(x), float(y)) for x, y in want}
    assert got[0] == pytest.approx([6, 1], rel=1e-14)
    assert got[4] == pytest.approx([32, 7], rel=1e-14)
    assert moments.points_along_edges([box], 1).tolist() == [[32.0, 11.0]]
