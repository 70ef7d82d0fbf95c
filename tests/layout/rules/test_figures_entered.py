"""Fixed figures of a die, and the frame of a negative tone, held to widths and spaces
that are drawn by hand.
"""

import math

import numpy as np

from layout.mask.plan import Figure, Lattice, MaskPlan, PillarClass
from layout.process.process import Rules
from layout.rules.edges import SPACE, WIDTH
from layout.rules.entered import entered
from layout.rules.figures import figures_kept, frame_kept
from layout.rules.report import DrcReport

SQUARE = np.array([[-60, -60], [60, -60], [60, 60], [-60, 60]])
LENS = Lattice.of(
    "LENS", np.ones((3, 4), np.uint8), pitch=200, x0=1000, y0=-500
)  # squares: 900, -1000 to 1700, -400


def box(left, bottom, right, top):
    return np.array([[left, bottom], [right, bottom], [right, top], [left, top]])


def plan(*figures):
    return MaskPlan(
        "TOP",
        (PillarClass("A", 240.0, 120, (1, 0), SQUARE),),
        (LENS,),
        figures,
        unit_nm=2.0,
    )


def told(check, *figures, feature=90.0, gap=60.0):
    rules = Rules(minimum_feature_nm=feature, minimum_gap_nm=gap)
    report = DrcReport.empty(plan(*figures), rules)
    check(plan(*figures), rules, report)
    rows = sorted((v.rule, v.box, v.value, v.limit, v.text) for v in report.violations)
    assert {rule: count for rule, count in report.counts.items() if count} == {
        rule: sum(row[0] == rule for row in rows) for rule in {row[0] for row in rows}
    }
    return rows, report


def test_a_thin_bar_and_a_narrow_space_of_one_layer_number():
    """Units of 2 nm. Pieces of two doses that abut are one figure; those of another
    layer are no neighbours.
    """
    marks = Figure(
        "MARKS",
        {
            (3, 0): (box(0, 0, 300, 20),),
            (3, 1): (box(0, 20, 300, 43), box(0, 72, 300, 400)),
        },
    )
    label = Figure("LABEL", {(5, 0): (box(302, 0, 390, 50),)})
    hidden = (
        Figure("OUTLINE", {(3, 0): (box(-900, 0, -500, 3),)}),
        Figure("FIELDS", {(3, 0): (box(-900, 9, 0, 11),)}),
    )
    rows, report = told(figures_kept, marks, label, *hidden)
    assert rows == [
        ("feature", (0, 0, 300, 43), 86.0, 90.0, "figures of layer 3"),
        ("gap", (0, 43, 300, 72), 58.0, 60.0, "figures of layer 3"),
    ]
    assert (report.minimum_feature_nm, report.minimum_gap_nm) == (86.0, 58.0)
    rows, report = told(figures_kept, marks, label, *hidden, feature=86.0, gap=58.0)
    assert rows == []
    assert math.isinf(report.minimum_feature_nm)  # what keeps the rules is not measured
    assert math.isinf(report.minimum_gap_nm)
    rows, report = told(figures_kept, marks, label, feature=103.0, gap=2.0)
    assert [(r[0], r[2], r[4]) for r in rows] == [
        ("feature", 86.0, "figures of layer 3"),
        ("feature", 100.0, "figures of layer 5"),
    ]
    assert report.minimum_feature_nm == 86.0


def test_walls_around_a_hole_are_widths_and_the_hole_is_a_space():
    """A ring in four pieces: walls of 30, 31, 32 and 33 units about a hole of 25 x 40.
    Each is one wall, though the
    pieces of two of them meet in the middle of an edge."""
    ring = (
        box(0, 0, 87, 31),
        box(0, 71, 87, 104),
        box(0, 31, 30, 71),
        box(55, 31, 87, 71),
    )
    rows, report = told(
        figures_kept, Figure("MARKS", {(3, 0): ring}), feature=65.0, gap=79.0
    )
    assert [(r[0], r[2]) for r in rows] == [
        ("feature", 60.0),
        ("feature", 62.0),
        ("feature", 64.0),
        ("gap", 50.0),
    ]
    assert rows[0][1] == (0, 0, 30, 104)  # all of the wall
    assert report.minimum_feature_nm == 60.0
    assert report.minimum_gap_nm == 50.0


def test_layers_without_polygons_hold_nothing():
    rows, report = told(figures_kept, Figure("MARKS", {(3, 0): ()}))
    assert rows == []
    assert math.isinf(report.minimum_feature_nm)


def test_what_a_negative_tone_draws_is_as_wide_as_a_gap_and_spares_what_is_as_wide_as_a_feature():
    """The lattice's squares count as drawn, and CLEAR lies in them; the second step's
    aperture does not.
    """
    frame = Figure(
        "FRAME",
        {(1, 0): (box(1700 + 40, -1000, 1900, -400), box(600, -1000, 629, -400))},
    )
    aside = (
        Figure("CLEAR", {(1, 0): (box(0, 0, 500, 4),)}),
        Figure("OUTLINE", {(1, 0): (box(0, 9, 500, 12),)}),
    )
    opening = (
        Figure("APERTURE", {(9, 0): (box(0, 40, 500, 43),)}),
        Figure("MORE", {(9, 0): (box(0, 60, 500, 63),)}),
    )
    rows, report = told(frame_kept, frame, *aside, *opening)
    assert rows == [
        (
            "feature",
            (1700, -1000, 1740, -400),
            80.0,
            90.0,
            "frame of the negative tone",
        ),
        ("gap", (600, -1000, 629, -400), 58.0, 60.0, "frame of the negative tone"),
    ]
    assert (report.minimum_feature_nm, report.minimum_gap_nm) == (80.0, 58.0)


def test_pairs_are_counted_all_and_listed_with_the_box_around_both():
    """Distances in units of 0.5 nm; the report keeps what was thinner before."""
    edges = np.array(
        [[0, 0, 40, 0], [7, 30, -5, 33], [90, 10, 90, 60], [60, 80, 61, -20.0]]
    )
    found = np.array(
        [
            [0, 1, WIDTH, 29.0],
            [2, 3, SPACE, 31.0],
            [1, 0, WIDTH, 28.0],
            [0, 2, SPACE, 33.0],
        ]
    )
    report = DrcReport(0.5, {}, 0.0, minimum_gap_nm=15.0, minimum_feature_nm=20.0)
    entered(report, edges, found, (("feature", 18.0), ("gap", 17.0)), "edges")
    assert [(v.rule, v.box, v.value, v.limit, v.text) for v in report.violations] == [
        ("feature", (-5, 0, 40, 33), 14.5, 18.0, "edges"),
        ("feature", (-5, 0, 40, 33), 14.0, 18.0, "edges"),
        ("gap", (60, -20, 90, 80), 15.5, 17.0, "edges"),
        ("gap", (0, 0, 90, 60), 16.5, 17.0, "edges"),
    ]
    assert (report.counts["feature"], report.counts["gap"]) == (2, 2)
    assert (report.minimum_feature_nm, report.minimum_gap_nm) == (14.0, 15.0)
    entered(report, edges, found[:0], (("feature", 18.0), ("gap", 17.0)), "edges")
    assert (report.minimum_feature_nm, report.minimum_gap_nm) == (14.0, 15.0)
    entered(
        report, edges, found[1:2], (("gap", 18.0), ("feature", 17.0)), "edges"
    )  # a negative tone
    assert (report.minimum_feature_nm, report.minimum_gap_nm) == (14.0, 15.0)
    assert report.violations[-1].rule == "feature"
