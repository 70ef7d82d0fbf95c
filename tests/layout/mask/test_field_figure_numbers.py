"""Rectangles of the write fields on the mask, by hand: clipped to the lens, rows from
below, on the grid.
"""

import itertools

import numpy as np

from layout.mask import FieldPlan, MaskPlan, PillarClass, PillarLattice, field_figure
from layout.process.process import LayerTable, Process

SQUARE = np.array([[-60, -60], [60, -60], [60, 60], [-60, 60]])


def corners(left, bottom, right, top):
    return [[left, bottom], [right, bottom], [right, top], [left, top]]


def test_each_field_is_a_box_from_midway_to_midway_on_the_grid():
    """Columns of 401 from -1000, rows of 300 up to 3000 (the lowest at 300), a grid of
    4: a border before column c at
    -1000 + 401 c - 200, one before row r from below at 300 + 300 r - 150, both down to
    the grid."""
    lattice = PillarLattice(
        "LENS",
        10,
        13,
        401,
        -1000,
        3000,
        lambda a, b: np.ones((b - a, 13), np.uint8),
        row_pitch=300,
    )
    classes = (PillarClass("A", 120.0, 120, (1, 0), SQUARE),)
    plan = MaskPlan("TOP", classes, (lattice,), grid=4, layer_names={(1, 0): "pillar"})
    split = FieldPlan(
        np.array([2, 5, 12]),
        np.array([-1, 4, 9, 15]),
        (10, 13),
        0.401,
        "shift",
        np.ones((2, 3), int),
        0,
        0.1,
        0.3,
    )
    made = field_figure.with_fields(
        plan, split, Process(layers=LayerTable(fields=(8, 3)))
    )
    (figure,) = made.figures
    assert (figure.name, list(figure.polygons)) == ("FIELDS", [(8, 3)])
    xs, ys = (-1200, 404, 2408, 4012), (748, 1648, 3148)
    want = [
        corners(a, c, b, d)
        for a, b in itertools.pairwise(xs)
        for c, d in itertools.pairwise(ys)
    ]
    assert [box.tolist() for box in figure.polygons[8, 3]] == want
    assert made.layer_names == {(1, 0): "pillar", (8, 3): "fields"}
    assert (made.name, made.lattices, plan.figures) == ("TOP", plan.lattices, ())
