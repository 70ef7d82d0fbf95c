"""Corners of turned and grown sections with straight edges, by hand."""

import cmath
import math

import numpy as np
import pytest

from metalens.cell.shapes.straight import (
    Cross,
    Polygon,
    Rectangle,
    RegularPolygon,
    Square,
)


def corners(shape, size_um, grow_um):
    """Of the one loop, as complex numbers in its own order, begun at the first by angle
    from -x on.
    """
    (loop,) = shape.outline(size_um, grow_um=grow_um).parts
    found = [complex(*point) for point in loop.corners_um]
    first = min(range(len(found)), key=lambda k: round(cmath.phase(found[k]), 6))
    return np.array(found[first:] + found[:first])


def turned(points, angle_rad):
    made = [complex(*point) * cmath.exp(1j * angle_rad) for point in points]
    first = min(range(len(made)), key=lambda k: round(cmath.phase(made[k]), 6))
    return np.array(made[first:] + made[:first])


@pytest.mark.parametrize("grow_um", [0.0, 0.05, -0.03])
@pytest.mark.parametrize("angle_rad", [0.0, 0.3, -1.9])
def test_squares_rectangles_and_crosses_turn_from_x_to_y_and_grow_by_half_at_every_edge(
    grow_um, angle_rad
):
    half = 0.2 + grow_um / 2
    box = [(-half, -half), (half, -half), (half, half), (-half, half)]
    assert corners(Square(angle_rad), 0.4, grow_um) == pytest.approx(
        turned(box, angle_rad)
    )
    deep = 0.12 + grow_um / 2
    box = [(-half, -deep), (half, -deep), (half, deep), (-half, deep)]
    assert corners(Rectangle(0.6, angle_rad), 0.4, grow_um) == pytest.approx(
        turned(box, angle_rad)
    )
    a, b = half, 0.05 + grow_um / 2
    bars = [
        (b, -a),
        (b, -b),
        (a, -b),
        (a, b),
        (b, b),
        (b, a),
        (-b, a),
        (-b, b),
        (-a, b),
        (-a, -b),
        (-b, -b),
        (-b, -a),
    ]
    assert corners(Cross(0.25, angle_rad), 0.4, grow_um) == pytest.approx(
        turned(bars, angle_rad)
    )


@pytest.mark.parametrize("sides", [3, 5, 8])
def test_regular_polygons_begin_at_x_and_grow_by_half_at_every_edge(sides):
    """Their edges lie R cos(π / n) from the middle: further out by half of what they
    grow.
    """
    reach = 0.2 + 0.03 / 2 / math.cos(math.pi / sides)
    points = [
        (reach * math.cos(k), reach * math.sin(k))
        for k in 2 * np.pi * np.arange(sides) / sides
    ]
    assert corners(RegularPolygon(sides, 0.4), 0.4, 0.03) == pytest.approx(
        turned(points, 0.4)
    )


def test_own_polygons_are_scaled_turned_and_moved_out():
    """A right triangle of 3, 4, 5: its edges move out by d, its corner of 90 degrees by
    (-d, -d), the others by d over
    the tangent of half their angle along its sides."""
    shape, d = Polygon(((0.0, 0.0), (4.0, 0.0), (0.0, 3.0)), angle_rad=0.7), 0.02
    right = d / math.tan(math.atan2(3, 4) / 2)
    upper = d / math.tan(math.atan2(4, 3) / 2)
    want = [(-d, -d), (2 + right, -d), (-d, 1.5 + upper)]
    assert corners(shape, 0.5, 2 * d) == pytest.approx(turned(want, 0.7))
    assert corners(Polygon(shape.corners[::-1], 0.7), 0.5, 2 * d)[:1] == pytest.approx(
        turned(want, 0.7)[:1]
    )
