"""Dies on a wafer at the very edge of what fits: right triangles of 3, 4 and 5, and
arrays by hand.
"""

import math

import numpy as np
import pytest

from layout.arrange import wafer
from layout.arrange.record import Mark, Wafer
from layout.files import Copies
from metalens.ground.errors import ProcessError

# um: beyond the edge by this, a box is off; the code forgives 1e-6 um of rounding
STEP = 0.01


def usable(made, *boxes):
    return wafer._usable(made, np.array(boxes, float)).tolist()


def test_the_farthest_corner_of_a_box_may_lie_on_the_rim_less_the_exclusion():
    """Corners at (30, 40) mm are 50 mm out: the radius of 53 mm less 3 mm."""
    made = Wafer((9000.0, 7000.0), diameter_mm=106.0, edge_exclusion_mm=3.0)
    inside = (30000, 40000), (-30000, 40000), (30000, -40000), (-30000, -40000)
    boxes = [sorted_box(x, y, 1000, -2000) for x, y in inside]
    assert usable(made, *boxes) == [True] * 4
    assert (
        usable(
            made,
            *(
                sorted_box(x + math.copysign(STEP, x), y, 1000, -2000)
                for x, y in inside
            ),
        )
        == [False] * 4
    )
    assert (
        usable(
            made,
            *(
                sorted_box(x, y + math.copysign(STEP, y), 1000, -2000)
                for x, y in inside
            ),
        )
        == [False] * 4
    )
    assert usable(
        Wafer((9000.0, 7000.0), diameter_mm=100.0, edge_exclusion_mm=0.0), boxes[0]
    ) == [True]


def sorted_box(x, y, u, v):
    """left, bottom, right, top of two corners."""
    return min(x, u), min(y, v), max(x, u), max(y, v)


def test_a_flat_cuts_at_its_chord_below_alone():
    """A flat of 28 mm lies 48 mm below the middle of 100 mm; 2.5 mm are excluded."""
    made = Wafer(
        (9000.0, 7000.0), diameter_mm=100.0, edge_exclusion_mm=2.5, flat_mm=28.0
    )
    assert wafer.chord_um(made) == pytest.approx(48_000, rel=1e-15)
    assert wafer.chord_um(Wafer((9000.0, 7000.0), diameter_mm=76.0)) == 38_000
    rows = (
        (-5000, -45_500, 9000, -30_000),
        (-5000, -45_500 - STEP, 9000, -30_000),
        (-5000, 30_000, 9000, 40_000),
    )
    assert usable(made, *rows) == [True, False, True]


def test_a_notch_is_kept_away_from_by_its_tip():
    """1.6 mm deep in 100 mm: the tip is 48.4 mm below the middle; 1.5 mm aside and 2 mm
    above it is 2.5 mm away.
    """
    made = Wafer(
        (9000.0, 7000.0), diameter_mm=100.0, edge_exclusion_mm=2.5, notch_mm=1.6
    )
    right, left = (1500, -46_400, 5000, -40_000), (-5000, -46_400, -1500, -40_000)
    assert usable(made, right, left) == [True, True]
    assert usable(
        made, (1500 - STEP, *right[1:]), (1500, -46_400 - STEP, *right[2:])
    ) == [False, False]
    above = (-900, -45_900, 1300, -40_000), (-900, -45_900 - STEP, 1300, -40_000)
    assert usable(made, *above) == [True, False]
    plain = Wafer((9000.0, 7000.0), diameter_mm=100.0, edge_exclusion_mm=2.5)
    assert usable(plain, above[1]) == [True]


def places(made, box, **more):
    found = wafer.dies(made, box, **more)
    assert found.place_um == pytest.approx(
        found.index * np.array(made.pitch_um) + made.offset_um
    )
    return {tuple(pair) for pair in found.index.tolist()}


BOX = (-700.0, -300.0, 800.0, 400.0)


def fitting(made, box, reach=60):
    """Dies whose four corners lie within the usable circle, one by one."""
    radius = made.diameter_mm * 500 - made.edge_exclusion_mm * 1000
    (px, py), (ox, oy) = made.pitch_um, made.offset_um
    return {
        (i, j)
        for i in range(-reach, reach + 1)
        for j in range(-reach, reach + 1)
        if all(
            math.hypot(i * px + ox + x, j * py + oy + y) <= radius
            for x in box[::2]
            for y in box[1::2]
        )
    }


@pytest.mark.parametrize("offset", [(0.0, 0.0), (310.0, -170.0), (-1690.0, 890.0)])
def test_all_dies_of_the_raster_that_fit_are_found(offset):
    made = Wafer(
        (1700.0, 900.0), diameter_mm=22.0, edge_exclusion_mm=0.7, offset_um=offset
    )
    assert places(made, BOX) == fitting(made, BOX)
    tall, box = (
        Wafer(
            (900.0, 1700.0), diameter_mm=22.0, edge_exclusion_mm=0.7, offset_um=offset
        ),
        (-300, -700, 400, 800),
    )
    assert places(tall, box) == fitting(tall, box)


@pytest.mark.parametrize("steps", [(9, 0), (-9, 4), (2, -23)])
def test_an_offset_of_whole_steps_moves_no_die(steps):
    """It renames the columns and rows: the raster is the same."""
    about = {"diameter_mm": 22.0, "edge_exclusion_mm": 0.7}
    here = Wafer((1700.0, 900.0), offset_um=(310.0, -170.0), **about)
    moved = Wafer(
        (1700.0, 900.0),
        offset_um=(310.0 + 1700 * steps[0], -170.0 + 900 * steps[1]),
        **about,
    )
    assert {(i - steps[0], j - steps[1]) for i, j in places(here, BOX)} == places(
        moved, BOX
    )


def test_dies_keep_away_from_marks_by_what_is_asked():
    """Marks of 400 um; the die at (1, -2) reaches from x = 1310 to 2810 and from y =
    -1970 to -1270.
    """
    about = {
        "diameter_mm": 22.0,
        "edge_exclusion_mm": 0.7,
        "offset_um": (310.0, 130.0),
        "mark_width_um": 7.0,
    }
    whole = places(Wafer((1700.0, 900.0), **about), BOX)

    def gone(x, y, around):
        made = Wafer((1700.0, 900.0), marks=(Mark(x / 1000, y / 1000),), **about)
        return whole - places(made, BOX, around_marks_um=around)

    assert gone(2010 + 800 + 100, -1500, 60) == {
        (1, -2),
        (2, -2),
    }  # both are 0.1 mm from its middle
    assert gone(2910, -1670 + 400 + 100, 0) == {(1, -2), (2, -2), (1, -1), (2, -1)}
    assert gone(2010, -1270 + 100, 0) == {(1, -2), (1, -1)}
    narrow = {"mark_um": 150.0} | about
    made = Wafer((1700.0, 900.0), marks=(Mark(2.91, -1.5),), **narrow)
    assert whole - places(made, BOX, around_marks_um=24.9) == set()
    assert whole - places(made, BOX, around_marks_um=25.0) == {
        (1, -2),
        (2, -2),
    }  # they touch


@pytest.mark.parametrize(("sx", "sy"), [(1, 1), (-1, 1), (1, -1), (-1, -1)])
def test_marks_may_reach_to_the_edge_and_no_farther(sx, sy):
    made = Wafer(
        (9000.0, 7000.0), diameter_mm=106.0, marks=(Mark(sx * 29.8, sy * 39.8),)
    )
    wafer.refuse_marks_off(made)
    for dx, dy in ((0.001, 0), (0, 0.001)):
        off = Wafer(
            (9000.0, 7000.0),
            diameter_mm=106.0,
            marks=(Mark(0, 0), Mark(sx * (29.8 + dx), sy * (39.8 + dy))),
        )
        with pytest.raises(ProcessError, match="is off the usable wafer"):
            wafer.refuse_marks_off(off)


def dies_at(*index):
    index = np.array(index)
    return wafer.Dies(index, index * [70.5, 40.25] + [3.0, -7.0])


def test_equal_rows_above_each_other_are_one_array_and_a_break_begins_another():
    found = dies_at(
        (2, 1),
        (0, 0),
        (1, 0),
        (2, 0),
        (1, -1),
        (0, 1),
        (1, 1),
        (0, 2),
        (1, 2),
        (3, 2),
        (4, 2),
    )
    assert wafer.stepped("D", found, units_per_um=1000.0) == (
        Copies(
            "D", 73_500, -47_250, columns=1, rows=1, across=(70_500, 0), up=(0, 40_250)
        ),
        Copies("D", 3000, -7000, columns=3, rows=2, across=(70_500, 0), up=(0, 40_250)),
        Copies(
            "D", 3000, 73_500, columns=2, rows=1, across=(70_500, 0), up=(0, 40_250)
        ),
        Copies(
            "D", 214_500, 73_500, columns=2, rows=1, across=(70_500, 0), up=(0, 40_250)
        ),
    )


def test_a_row_a_column_and_a_gap_between_rows():
    row = wafer.stepped("D", dies_at((-3, 5), (-2, 5), (-1, 5)), units_per_um=4.0)
    assert row == (
        Copies("D", -834, 777, columns=3, rows=1, across=(282, 0), up=(0, 0)),
    )
    column = wafer.stepped("D", dies_at((4, -2), (4, -1), (4, 1)), units_per_um=4.0)
    assert column == (
        Copies("D", 1140, -350, columns=1, rows=2, across=(0, 0), up=(0, 161)),
        Copies("D", 1140, 133, columns=1, rows=1, across=(0, 0), up=(0, 161)),
    )
