"""What the check says of each violation, by hand: rectangles on unlike pitches, in
units of half a nanometre.
"""

import dataclasses

import numpy as np
import pytest

from layout.drc.lattice import check_plan
from layout.drc.report import RuleViolation
from layout.mask.plan import MaskPlan, PillarArray, PillarClass
from layout.process.process import DesignRules

UNIT_NM = 0.5
LOOSE = DesignRules(minimum_feature_nm=1, minimum_gap_nm=1, maximum_density=1)


def rectangle(name, wide, high, **about):
    """A class of (2 wide, 2 high) database units."""
    corners = np.array([[-wide, -high], [wide, -high], [wide, high], [-wide, high]])
    return PillarClass(
        name, 2 * wide * UNIT_NM, 2 * wide, (1, 0), corners, drawn=(corners,), **about
    )


def plan_of(
    *made, classes=((1, 2), (0, 0)), pitch=300, down=500, x0=-700, y0=900, grid=1
):
    """Rows lie ``down`` apart, from y0 downwards."""
    lattice = PillarArray.of(
        "L", np.array(classes, np.uint8), pitch=pitch, x0=x0, y0=y0
    )
    return MaskPlan(
        "TOP",
        made,
        (dataclasses.replace(lattice, row_pitch=down),),
        unit_nm=UNIT_NM,
        grid=grid,
    )


A, B = rectangle("A", 90, 60), rectangle("B", 100, 40)


def test_a_gap_is_told_in_nanometres_with_the_box_of_both():
    """300 - 90 - 100 units of half a nm between them; a pillar is as wide as its lesser
    side.
    """
    rules = dataclasses.replace(LOOSE, minimum_gap_nm=70, minimum_feature_nm=50)
    found = check_plan(plan_of(A, B), rules)
    assert [v for v in found.violations if v.rule == "space"] == [
        RuleViolation("space", (-790, 840, -300, 960), 55.0, 70, "A to B in L")
    ]
    assert [v for v in found.violations if v.rule == "width"] == [
        RuleViolation("width", (-500, 860, -300, 940), 40.0, 50, "B")
    ]
    assert (found.counts["space"], found.counts["width"], found.shapes) == (1, 1, 2)
    assert (found.minimum_space_nm, found.minimum_width_nm) == (55.0, 40.0)


def test_a_gap_from_row_to_row_and_an_overlap():
    """500 - 60 - 40 units downwards; 300 - 90 - 260 across."""
    rules = dataclasses.replace(LOOSE, minimum_gap_nm=201)
    found = check_plan(plan_of(A, B, classes=((1, 0), (2, 0))), rules)
    assert found.violations == [
        RuleViolation("space", (-800, 360, -600, 960), 200.0, 201, "B to A in L")
    ]
    rules = dataclasses.replace(LOOSE, minimum_gap_nm=8)
    found = check_plan(plan_of(A, rectangle("C", 260, 30)), rules)
    assert found.violations == [
        RuleViolation("overlap", (-790, 840, -140, 960), 0.0, 8, "A to C in L")
    ]


def test_no_gap_is_told_where_it_is_the_rule():
    rules = dataclasses.replace(LOOSE, minimum_gap_nm=55, minimum_feature_nm=40)
    assert check_plan(plan_of(A, B), rules).ok


@pytest.mark.parametrize(
    "off", [{"pitch": 301}, {"down": 505}, {"x0": -701}, {"y0": 901}]
)
def test_lattices_off_the_grid_are_told_at_their_first_pillar(off):
    place = {"pitch": 300, "down": 500, "x0": -700, "y0": 900} | off
    found = check_plan(plan_of(A, B, grid=10, **place), LOOSE)
    x, y = place["x0"], place["y0"]
    assert found.violations == [RuleViolation("off-grid", (x, y, x, y), 0.0, 10.0, "L")]


def test_shapes_off_the_grid_are_told_about_their_middle():
    found = check_plan(plan_of(A, rectangle("B", 100, 45), grid=10), LOOSE)
    assert found.violations == [
        RuleViolation("off-grid", (-100, -45, 100, 45), 0.0, 10.0, "B")
    ]


def test_dense_windows_step_by_half_their_size_both_ways():
    """8 um are 16 000 units: 2 x 20 columns of 400 and 2 x 27 rows of 300. One tile of
    20 x 27 pillars is full.
    """
    classes = np.zeros((4 * 27, 4 * 20), np.uint8)
    classes[27:54, 40:60] = 1
    plan = plan_of(rectangle("C", 160, 100), classes=classes, pitch=400, down=300)
    share = 20 * 27 * 320 * 200 / (16_000 * 16_200)
    rules = dataclasses.replace(LOOSE, maximum_density=0.9 * share, density_window_um=8)
    found = check_plan(plan, rules)
    boxes = {
        (
            -700 + 8000 * j,
            900 - 8100 * i - 16_200,
            -700 + 8000 * j + 16_000,
            900 - 8100 * i,
        )
        for i in (0, 1)
        for j in (1, 2)
    }
    assert {v.box for v in found.violations} == boxes
    assert {(v.rule, v.value, v.limit, v.text) for v in found.violations} == {
        ("density", share, 0.9 * share, "L")
    }
    assert (found.maximum_density, found.counts["density"]) == (share, 4)
    assert check_plan(plan, dataclasses.replace(rules, maximum_density=share)).ok


def test_windows_reach_over_the_last_rows_and_columns():
    """30 rows of 300 and 25 columns of 400 units, in tiles of 27 and 20: windows begin
    at rows 0 and 27 (of 3 left) and
    columns 0 and 20 (of 5 left)."""
    plan = plan_of(
        rectangle("C", 160, 100),
        classes=np.ones((30, 25), np.uint8),
        pitch=400,
        down=300,
    )
    found = check_plan(
        plan, dataclasses.replace(LOOSE, maximum_density=1e-6, density_window_um=8)
    )
    one = 320 * 200 / (16_000 * 16_200)
    assert {(v.box[0], v.box[3]): v.value for v in found.violations} == pytest.approx(
        {
            (-700, 900): 750 * one,
            (7300, 900): 150 * one,
            (-700, -7200): 75 * one,
            (7300, -7200): 15 * one,
        }
    )
    small = check_plan(
        plan, dataclasses.replace(LOOSE, maximum_density=0.1, density_window_um=0.1)
    )
    # a window is two pillars wide at least
    assert small.maximum_density == pytest.approx(320 * 200 / (400 * 300))


def test_feet_are_told_once_a_lattice():
    """Round: 150 nm from axis to axis, less half of 61 and 95 nm; else 55 nm drawn,
    less what both walls lean out, 4 and 7 nm in diameter.
    """
    rules = dataclasses.replace(LOOSE, minimum_foot_gap_nm=75)
    feet = np.array([61.0, 95.0])
    found = check_plan(plan_of(A, B), rules, foot_nm=feet)
    box = (-700, -100, -100, 900)
    assert found.violations == [
        RuleViolation("foot", box, 72.0, 75, "feet of etched pillars in L")
    ]
    assert found.counts["foot"] == 1
    assert check_plan(
        plan_of(A, B), dataclasses.replace(rules, minimum_foot_gap_nm=72), foot_nm=feet
    ).ok
    bars = (rectangle("A", 90, 60, round=False), rectangle("B", 100, 40, round=False))
    found = check_plan(plan_of(*bars), rules, foot_nm=np.array([94.0, 107.0]))
    assert found.violations == [
        RuleViolation(
            "foot", box, 55.0 - (4 + 7) / 2, 75, "feet of etched pillars in L"
        )
    ]
    assert check_plan(
        plan_of(*bars),
        dataclasses.replace(rules, minimum_foot_gap_nm=49),
        foot_nm=np.array([94, 107]),
    ).ok
