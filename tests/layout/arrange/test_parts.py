"""Parts put together: doses that share no datatype, names that differ, units, room
between parts.
"""

import math
from pathlib import Path

import numpy as np
import pytest

from layout.arrange import Placement, apart, joined, parts
from layout.formats import QUARTERS, CellContent, CellPlacements, MaskContent
from layout.process.process import DesignRules, ExposureSettings, Process
from metalens.core.errors import MaskFileError, ProcessError

PLAIN = Process(rules=DesignRules(minimum_gap_nm=70))
BEAM = Process(
    exposure=ExposureSettings(alpha_um=0.01, beta_um=30.0, eta=0.7, tolerance=0.01)
)


def part(name, doses, *, box=(-1000, -500, 2000, 900), corrected=False, cell="SHAPE"):
    """A part of one rectangle on the first of its layers."""
    left, bottom, right, top = box
    shape = np.array([[left, bottom], [right, bottom], [right, top], [left, top]])
    cells = {cell: CellContent(cell, {layer: [shape] for layer in doses})}
    boxes = {parts.PILLARS: np.array([box]), parts.APERTURE: np.empty((0, 4), np.int64)}
    return parts.DieComponent(
        name, cell, cells, doses, {}, boxes, np.array(box), corrected
    )


def test_two_doses_never_share_a_datatype_and_one_dose_has_one():
    first = part("A", {(1, 0): 1.27, (1, 1): 1.31})
    second = part("B", {(1, 0): 1.31, (1, 1): 1.4, (1, 2): 1.27}, cell="OTHER")
    made = joined.die_cell(
        "TOP",
        [joined.PartPlacement(p, (Placement(),)) for p in (first, second)],
        kept=frozenset({(1, 2), (10, 0)}),
    )
    assert made.doses == {
        (1, 0): 1.27,
        (1, 1): 1.31,
        (1, 3): 1.4,
    }  # 1/2 means something else
    assert set(made.cells["SHAPE"].polygons) == {(1, 0), (1, 1)}
    assert set(made.cells["OTHER"].polygons) == {(1, 1), (1, 3), (1, 0)}


def test_cells_of_one_name_are_told_apart_and_placed_where_they_were():
    inner = CellContent("X", {(2, 0): [np.array([[0, 0], [5, 0], [5, 7]])]})
    placed = CellPlacements(
        ("X",), *(np.array([v], np.int32) for v in (0, 11, -3)), np.array([5], np.uint8)
    )
    one = parts.DieComponent(
        "A",
        "Y",
        {"X": inner, "Y": CellContent("Y", placed=placed)},
        {(2, 0): 1.0},
        {},
        {},
        np.zeros(4),
    )
    two = part("B", {(1, 0): 1.0}, cell="X")
    at = Placement(x_um=2.5, y_um=-1.25, turn_deg=90.0, columns=3, step_um=(10.0, 20.0))
    made = joined.die_cell(
        "TOP",
        [joined.PartPlacement(two, (Placement(),)), joined.PartPlacement(one, (at,))],
        kept=frozenset(),
    )
    assert set(made.cells) == {"TOP", "X", "X_2", "Y"}
    assert made.cells["Y"].placed.children == ("X_2",)
    (_, copies) = made.copies["TOP"]
    assert (copies.child, copies.x, copies.y, copies.turn) == (
        "Y",
        2500,
        -1250,
        QUARTERS[1],
    )
    assert (copies.columns, copies.rows, copies.across) == (3, 1, (10_000, 0))


def content(unit_nm, shape, place=(0, 0)):
    top = CellPlacements(
        ("P",), *(np.array([v], np.int32) for v in (0, *place)), np.zeros(1, np.uint8)
    )
    cells = {
        "P": CellContent("P", {(9, 1): [np.array(shape)]}),
        "T": CellContent("T", placed=top),
    }
    return MaskContent("GDSII", unit_nm, cells)


def test_another_database_unit_is_brought_to_nanometres_or_refused():
    made = parts.scale_part(
        content(5.0, [[0, 0], [3, 0], [3, 7]], (-4, 9)), 1.0, "FILE"
    )
    assert made.cells["P"].polygons[9, 1][0].tolist() == [[0, 0], [15, 0], [15, 35]]
    assert (made.cells["T"].placed.x[0], made.cells["T"].placed.y[0]) == (-20, 45)
    half = parts.scale_part(content(0.5, [[0, 0], [30, 0], [30, 70]]), 1.0, "FILE")
    assert half.cells["P"].polygons[9, 1][0].tolist() == [[0, 0], [15, 0], [15, 35]]
    with pytest.raises(MaskFileError, match=r"FILE: its database unit is 0\.5 nm"):
        parts.scale_part(content(0.5, [[0, 0], [31, 0], [30, 70]]), 1.0, "FILE")


@pytest.mark.parametrize("away", [69, 70])
def test_the_gap_between_parts_is_that_of_the_rule(away):
    one, two = part("A", {(1, 0): 1.0}), part("B", {(1, 0): 1.0})
    # A from -1 to 2 um along x; B turned by a quarter: from -0.9 to 0.5 um about its
    # middle
    x = 2.0 + 0.9 + away / 1000
    placed = [
        joined.PartPlacement(one, (Placement(),)),
        joined.PartPlacement(two, (Placement(x_um=x, y_um=0.1, turn_deg=90.0),)),
    ]
    found = apart.check_separation(placed, PLAIN)
    assert len(found) == (away < 70)
    if found:
        assert found[0].value == pytest.approx(69.0)
        assert "A at (0, 0) um to B at (2.969, 0.1) um" in found[0].text


def test_copies_of_an_array_are_held_to_the_rule_too():
    def check(step):
        at = Placement(columns=4, rows=2, step_um=(step, 5.0))
        return apart.check_separation(
            [joined.PartPlacement(part("A", {(1, 0): 1.0}), (at,))], PLAIN
        )

    assert not check(3.07)
    assert len(check(3.05)) == 6  # three pairs in each of two rows


def test_backscatter_reaches_as_far_as_its_error_function_says():
    # eta / (1 + eta) / 2 erfc(d / beta) = 1 % of 1/2, alpha is far below
    reach = apart.reach_um(BEAM)
    assert 0.7 / 1.7 / 2 * math.erfc(reach / 30.0) == pytest.approx(0.005, rel=1e-3)
    assert apart.reach_um(PLAIN) == 0

    def check(away, corrected):
        one, two = (
            part("A", {(1, 0): 1.0}, corrected=corrected),
            part("B", {(1, 0): 1.0}),
        )
        return apart.check_separation(
            [
                joined.PartPlacement(one, (Placement(),)),
                joined.PartPlacement(two, (Placement(x_um=3 + away),)),
            ],
            BEAM,
        )

    assert not check(reach + 0.01, True)
    (found,) = check(reach - 0.01, True)
    assert "backscatter" in found.text
    assert found.limit == pytest.approx(1000 * reach)
    assert not check(reach - 0.01, False)


def test_impossible_places_are_refused():
    with pytest.raises(
        ProcessError, match="step_um is missing for 2 columns and 1 rows"
    ):
        Placement(columns=2)
    many = joined.PartPlacement(
        part("A", {(1, 0): 1.0}), (Placement(columns=4001, step_um=(9.0, 9.0)),)
    )
    with pytest.raises(ProcessError, match="4001 copies of A on a die"):
        apart.check_separation([many], PLAIN)


def test_a_disc_is_sliced_so_that_its_corners_stay_free():
    turn = np.linspace(0, 2 * np.pi, 401)[:-1]
    disc = np.rint(100_000 * np.column_stack([np.cos(turn), np.sin(turn)])).astype(
        np.int64
    )
    shapes = {"D": CellContent("D", {(2, 0): [disc]})}
    made = parts.of_file(
        "D",
        Path("d.gds"),
        MaskContent("GDSII", 1.0, shapes),
        PLAIN,
        cell="",
        relative_dose=1.0,
    ).boxes[parts.APERTURE]
    assert len(made) == 40  # slices of 5 um
    held = (made[:, 0] <= disc[:, None, 0]) & (disc[:, None, 0] <= made[:, 2])
    held &= (made[:, 1] <= disc[:, None, 1]) & (disc[:, None, 1] <= made[:, 3])
    assert held.any(1).all()  # nothing of it sticks out
    corner = np.hypot(np.abs(made[:, [0, 2]]).max(1), np.abs(made[:, [1, 3]]).min(1))
    assert (
        corner.max() <= 100_002
    )  # each slice is no wider than the disc at its edge nearer to the middle
