"""Parts put together: database units, doses that are alike to a millionth, free numbers
and names, dies on a wafer.
"""

import numpy as np
import pytest

from layout.arrange import At, joined, parts
from layout.files import CellContent, Copies, Placed, Sites, Turn
from layout.mask import Lattice
from metalens.ground.errors import ProcessError

TRIANGLE = np.array([[0, 0], [50, 0], [0, 30]])


def part(cells, top, doses, names=None, sites=None):
    return parts.Part(
        "P", top, cells, doses, names or {}, {}, np.zeros(4), sites=sites or {}
    )


def shape(name, *layers):
    return CellContent(name, {layer: [TRIANGLE] for layer in layers})


def alone(name, doses, names=None):
    return part({name: shape(name, *doses)}, name, doses, names)


def test_places_and_steps_are_whole_nanometres_and_turns_less_than_one():
    at = At(
        x_um=-2.0316,
        y_um=7.5004,
        turn_deg=-90.0,
        mirrored=True,
        columns=3,
        rows=5,
        step_um=(1.25, 4.0006),
    )
    (one,) = joined.Placing(alone("A", {}), (at,)).copies("TOP_OF_A")
    assert one == Copies(
        "TOP_OF_A", -2032, 7500, Turn(270.0, True), 3, 5, (1250, 0), (0, 4001)
    )
    (one,) = joined.Placing(alone("A", {}), (At(turn_deg=750.0),)).copies("B")
    assert one == Copies("B", 0, 0, Turn(30.0), 1, 1, (0, 0), (0, 0))


def test_doses_that_are_written_alike_share_a_number_and_no_others():
    """Six decimals are written: 4e-7 apart is one dose, 6e-7 is two."""
    made = joined.Layers(frozenset())
    assert made.take(alone("A", {(7, 3): 1.25})) == {(7, 3): (7, 3)}
    assert made.take(alone("B", {(7, 3): 1.25 + 4e-7})) == {(7, 3): (7, 3)}
    made = joined.Layers(frozenset(), {(7, 3): 1.25, (5, 0): 1.31})
    assert made.take(alone("C", {(7, 3): 1.25 + 6e-7})) == {(7, 3): (7, 0)}
    assert made.take(alone("D", {(7, 9): 1.25 - 4e-7})) == {
        (7, 9): (7, 9)
    }  # free: stays
    assert made.take(alone("E", {(7, 0): 1.31, (7, 3): 1.25 - 1e-6})) == {
        (7, 0): (7, 1),
        (7, 3): (7, 2),
    }


def test_a_number_that_is_taken_goes_to_one_of_its_dose_on_its_layer_or_to_the_first_free_one():
    made = joined.Layers(frozenset({(7, 1)}), {(5, 4): 1.31, (7, 0): 1.1, (7, 6): 1.31})
    assert made.take(alone("A", {(7, 0): 1.31})) == {
        (7, 0): (7, 6)
    }  # not 5/4, of another layer
    assert made.take(alone("B", {(7, 1): 1.9})) == {(7, 1): (7, 2)}  # 1 is kept
    assert made.take(alone("C", {(7, 1): 1.1})) == {(7, 1): (7, 0)}
    assert made.take(alone("D", {(7, 0): 1.9 + 6e-7})) == {(7, 0): (7, 3)}
    assert made.doses == {
        (5, 4): 1.31,
        (7, 0): 1.1,
        (7, 6): 1.31,
        (7, 2): 1.9,
        (7, 3): 1.9 + 6e-7,
    }
    last = joined.Layers(frozenset((7, n) for n in range(32767)))
    assert last.take(alone("E", {(7, 0): 1.5})) == {(7, 0): (7, 32767)}
    with pytest.raises(ProcessError, match="layer 7: all datatypes hold doses"):
        last.take(alone("F", {(7, 0): 1.6}))


def test_names_of_layers_go_with_their_numbers_and_the_first_stays():
    made = joined.Layers(frozenset())
    made.take(alone("A", {(7, 3): 1.25}, {(7, 3): "pads", (9, 0): "outline"}))
    made.take(alone("B", {(7, 3): 1.4}, {(7, 3): "posts", (9, 0): "edge"}))
    assert made.names == {(7, 3): "pads", (9, 0): "outline", (7, 0): "posts"}


def test_cells_are_numbered_from_two_until_they_are_free():
    one = part(
        {"X": shape("X", (7, 0)), "X_2": shape("X_2", (7, 0))}, "X", {(7, 0): 1.1}
    )
    three = [
        joined.Placing(alone("X", {(7, 0): 1.1}), (At(),)),
        joined.Placing(one, (At(),)),
    ]
    made = joined.die(
        "TOP",
        [*three, joined.Placing(alone("X", {(7, 0): 1.1}), (At(x_um=3.0),))],
        kept=frozenset(),
    )
    assert set(made.cells) == {"X", "X_2", "X_2_2", "X_3", "TOP"}
    assert [copy.child for copy in made.copies["TOP"]] == ["X", "X_2", "X_3"]
    assert {name: cell.name for name, cell in made.cells.items()} == {
        name: name for name in made.cells
    }
    assert made.unit_nm == 1.0
    with pytest.raises(
        ProcessError, match="a part holds a cell 'X', the name of the arrangement"
    ):
        joined.die("X", three, kept=frozenset())


def grid(child, turn):
    """Five columns of three rows, 70 and 90 apart."""
    x, y = (
        v.ravel().astype(np.int32)
        for v in np.meshgrid(np.arange(5) * 70 - 11, np.arange(3) * 90 + 13)
    )
    return Placed((child,), np.zeros(15, np.int32), x, y, np.full(15, turn, np.uint8))


def test_arrays_and_sites_of_a_part_follow_the_new_names_of_its_cells():
    lattice = Lattice.of("OWN", np.ones((2, 3), np.uint8), pitch=400, x0=5, y0=7)
    cells = {
        "X": shape("X", (7, 0)),
        "Y": CellContent("Y", placed=grid("X", 6)),
        "S": CellContent("S"),
    }
    one = part(cells, "Y", {(7, 0): 1.1}, sites={"S": Sites(lattice, ("X", ""))})
    first = joined.Placing(
        part({k: shape(k, (7, 0)) for k in "XYS"}, "X", {(7, 0): 1.3}), ()
    )
    made = joined.die(
        "TOP", [first, joined.Placing(one, (At(x_um=1.5),))], kept=frozenset()
    )
    assert made.copies["Y_2"] == (
        Copies("X_2", -11, 13, Turn(180.0, True), 5, 3, (70, 0), (0, 90)),
    )
    assert len(made.cells["Y_2"].placed.child) == 0
    assert set(made.cells["X_2"].polygons) == {(7, 1)}
    assert {name: sites.children for name, sites in made.sites.items()} == {
        "S_2": ("X_2", "")
    }
    assert [copy.child for copy in made.copies["TOP"]] == ["Y_2"]


def test_a_wafer_holds_its_steps_and_its_marks_in_a_number_of_their_own():
    die = joined.die(
        "DIE",
        [joined.Placing(alone("MARK", {(3, 0): 1.2}, {(3, 0): "m"}), (At(),))],
        kept=frozenset(),
    )
    steps = (Copies("DIE", -9, 4, columns=3, rows=2, across=(700, 0), up=(0, 900)),)
    bare = joined.wafer("W", die, steps, None)
    assert (bare.name, bare.copies["W"], set(bare.cells)) == (
        "W",
        steps,
        {"MARK", "DIE", "W"},
    )
    assert bare.cells["W"].name == "W"
    marks = joined.Placing(
        alone("MARK", {(3, 0): 1.0}, {(3, 0): "wafer"}), (At(x_um=4.0), At(y_um=-6.0))
    )
    made = joined.wafer("W", die, steps, marks)
    assert made.copies["W"] == (
        *steps,
        Copies("MARK_2", 4000, 0),
        Copies("MARK_2", 0, -6000),
    )
    assert made.doses == {(3, 0): 1.2, (3, 1): 1.0}
    assert made.layer_names == {(3, 0): "m", (3, 1): "wafer"}
    assert (die.doses, set(die.cells)) == (
        {(3, 0): 1.2},
        {"MARK", "DIE"},
    )  # the die stays as it was
    assert joined.MARGIN_UM == 10.0  # that the command keeps free around the marks
    with pytest.raises(ProcessError, match="a part holds a cell 'MARK'"):
        joined.wafer("MARK", die, steps, None)
