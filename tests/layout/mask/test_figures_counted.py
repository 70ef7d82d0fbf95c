"""Figures of a mask by counting: sites inside each rectangle of the write fields,
quarters of a wafer's cross.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from layout.mask import marks, with_fields


def test_a_rectangle_of_the_write_fields_holds_the_sites_of_its_field():
    """Rows are counted from below, the lattice's first row is its top one; sites lie
    half a step inside the borders.
    """
    lattice = SimpleNamespace(
        x0=-3900, y0=2700, rows=9, columns=14, pitch=300, down=420
    )
    plan = SimpleNamespace(lattices=(lattice,), grid=10, figures=(), layer_names={})
    plan.replace = lambda **new: SimpleNamespace(**vars(plan) | new)
    split = SimpleNamespace(
        rows=np.array([-2, 3, 8, 13]), columns=np.array([-1, 4, 9, 14])
    )
    made = with_fields(
        plan, split, SimpleNamespace(layers=SimpleNamespace(fields=(7, 0)))
    )
    boxes = made.figures[-1].polygons[(7, 0)]
    x = lattice.x0 + 300 * np.arange(14)
    y = lattice.y0 - 420 * np.arange(9)[::-1]  # from below
    rows, columns = [(0, 3), (3, 8), (8, 9)], [(0, 4), (4, 9), (9, 14)]
    wanted = [(r, c) for c in columns for r in rows]
    assert len(boxes) == len(wanted)
    for box, (row, column) in zip(boxes, wanted, strict=True):
        (left, bottom), (right, top) = box.min(0), box.max(0)
        assert np.flatnonzero((y > bottom) & (y < top)).tolist() == list(range(*row))
        assert np.flatnonzero((x > left) & (x < right)).tolist() == list(range(*column))
        assert (
            min(
                np.abs(y[:, None] - [bottom, top]).min(),
                np.abs(x[:, None] - [left, right]).min(),
            )
            >= 145
        )
    assert made.layer_names == {(7, 0): "fields"}


def test_a_wafer_cross_is_the_same_after_a_quarter_turn_and_leaves_its_middle_free():
    unit = marks.DatabaseUnits(
        SimpleNamespace(unit_nm=1.0, grid=5, lattices=[SimpleNamespace(constant=400)])
    )
    *bars, fine = marks.wafer_cross(unit, 400.0, 21.0)
    assert len(bars) == 4
    spans = sorted((*bar.min(0).tolist(), *bar.max(0).tolist()) for bar in bars)
    turns = [bar @ [[0, 1], [-1, 0]] for bar in bars]
    turned = sorted((*bar.min(0).tolist(), *bar.max(0).tolist()) for bar in turns)
    assert len(set(spans)) == 4
    assert spans == turned
    assert max(abs(np.array(spans)).ravel()) == 200_000
    free = min(np.abs(bar).max(1).min() for bar in bars)
    assert np.abs(fine).max() == pytest.approx(free / 2, abs=5)
