"""Pillar polygons: area of the circle, centroid at the site, symmetry of the square, on
the grid.
"""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from layout.shapes import polygon


def images(points):
    """The eight mirror images of a set of points, each sorted."""
    for p in (points, points * (-1, 1)):
        for _ in range(4):
            p = np.column_stack([-p[:, 1], p[:, 0]])
            yield sorted(map(tuple, p.tolist()))


@given(
    diameter=st.floats(8, 400),
    vertices=st.sampled_from([8, 12, 16, 20, 24, 32, 48, 64]),
)
def test_polygons_are_symmetric_convex_and_on_the_grid(diameter, vertices):
    made = polygon.pillar_polygon(diameter, vertices=vertices)
    assert made.dtype == np.int64
    assert len(made) <= vertices
    assert all(image == sorted(map(tuple, made.tolist())) for image in images(made))
    before, after = (np.roll(made, n, axis=0) - made for n in (1, -1))
    turn = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    assert (turn < 0).all()  # strictly convex, counter-clockwise, no double vertex


@pytest.mark.parametrize("diameter", [80, 81, 99, 100, 151, 200, 255, 320])
def test_area_of_32_vertices_is_the_circle_within_a_thousandth(diameter):
    made = polygon.pillar_polygon(diameter)
    x, y = made.T.astype(float)
    cross = x * np.roll(y, -1) - np.roll(x, -1) * y
    assert abs(cross.sum() / 2 / (math.pi * diameter**2 / 4) - 1) < 1e-3
    centroid = (
        ((x + np.roll(x, -1)) * cross).sum(),
        ((y + np.roll(y, -1)) * cross).sum(),
    )
    assert centroid == (0.0, 0.0)  # odd diameters too: no half grid step


def test_edge_error_of_an_equal_area_polygon_follows_the_closed_form():
    # n = 16: vertices stand out by R (sqrt(pi / (n/2 sin(2 pi/n))) - 1); grid rounding
    # adds 0.7 steps at most
    diameter, n = 300, 16
    ideal = (
        diameter / 2 * (math.sqrt(math.pi / (n / 2 * math.sin(2 * math.pi / n))) - 1)
    )
    made = polygon.pillar_polygon(diameter, vertices=n)
    edge = np.roll(made, -1, axis=0) - made
    feet = (made[:, 0] * edge[:, 1] - made[:, 1] * edge[:, 0]) / np.hypot(*edge.T)
    error = max(np.hypot(*made.T).max() - diameter / 2, diameter / 2 - feet.min())
    assert ideal - 0.8 < error < 2 * ideal + 0.8


def test_octagons_have_edges_along_axes_and_diagonals_only():
    edges = np.diff(polygon.pillar_polygon(201, vertices=8), axis=0)
    assert all(dx == 0 or dy == 0 or abs(dx) == abs(dy) for dx, dy in edges.tolist())


@pytest.mark.parametrize("vertices", [8, 12, 32, 64])
def test_widths_and_areas_never_fall_as_the_diameter_rises(vertices):
    """Grid steps: 100, 105, 110, 120 nm on a grid of 5 nm are 20, 21, 22, 24."""
    made = [polygon.pillar_polygon(float(d), vertices=vertices) for d in range(4, 160)]
    for axis in (0, 1):
        widths = [int(np.ptp(p[:, axis])) for p in made]
        assert all(a <= b for a, b in itertools.pairwise(widths))
        off = [abs(w - d) for d, w in enumerate(widths, 4)]
        if vertices > 8:
            assert max(off) <= 1  # the nearest even number of steps
    areas = []
    for p in made:
        x, y = p.T
        after = np.roll(p, -1, axis=0).T
        areas.append(int((x * after[1] - after[0] * y).sum()) / 2)
    assert all(a < b for a, b in itertools.pairwise(areas[1:]))
