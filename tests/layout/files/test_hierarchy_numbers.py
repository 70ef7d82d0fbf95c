"""How often cells are drawn, by products: five in three in two, and one beside."""

import numpy as np
import pytest

from layout.files import QUARTERS, CellContent, MaskContent, Placed, hierarchy
from metalens.ground.errors import MaskFileError

BAR = np.array([[0, 0], [30, 0], [30, 4], [0, 4]])


def placed(children, *child):
    number = np.array(child, np.int32)
    zeros = np.zeros(len(number), np.int32)
    return Placed(children, number, zeros, zeros, zeros.astype(np.uint8), QUARTERS)


def mask():
    """A 2 x 3 + 1 times, B twice; LOOSE is a top cell of its own and places A four
    times; HOLLOW holds nothing.
    """
    cells = {
        "A": CellContent("A", {(1, 0): [BAR] * 5}, {(2, 0): [(0, 0, 9)] * 2}),
        "HOLLOW": CellContent("HOLLOW"),
        "B": CellContent(
            "B", {(1, 0): [BAR]}, placed=placed(("A", "HOLLOW"), 0, 0, 0, 1)
        ),
        "TOP": CellContent("TOP", placed=placed(("B", "A"), 0, 1, 0)),
        "LOOSE": CellContent("LOOSE", {(3, 0): [BAR]}, placed=placed(("A",), *[0] * 4)),
    }
    return MaskContent("GDSII", 1.0, cells)


def test_cells_are_drawn_as_often_as_those_above_times_their_copies():
    assert hierarchy.drawn(mask()) == {
        "A": 11,
        "HOLLOW": 2,
        "B": 2,
        "TOP": 1,
        "LOOSE": 1,
    }
    order = hierarchy.ordered(mask())
    assert all(
        order.index(a) < order.index(b)
        for a, b in (("TOP", "B"), ("B", "A"), ("LOOSE", "A"), ("B", "HOLLOW"))
    )


def test_shapes_are_those_of_each_cell_as_often_as_it_is_drawn():
    assert hierarchy.shapes(mask()) == {(1, 0): 57, (2, 0): 22, (3, 0): 1}


def test_what_is_drawn_is_held_to_the_limit_hollow_cells_counted_too():
    """57 + 22 + 1, and 2 of the hollow cell."""
    hierarchy.refuse_beyond(mask(), 82)
    with pytest.raises(
        MaskFileError,
        match="draws 82 shapes when its arrays are taken apart, at most 81",
    ):
        hierarchy.refuse_beyond(mask(), 81)


def test_circles_of_cells_are_refused_with_their_way():
    cells = {
        "A": CellContent("A", placed=placed(("B",), 0)),
        "B": CellContent("B", placed=placed(("A",), 0)),
    }
    with pytest.raises(MaskFileError, match=r"places itself through [AB] > [AB]"):
        hierarchy.ordered(MaskContent("G", 1.0, cells))
    with pytest.raises(
        MaskFileError, match="'B' is placed, but the file does not hold it"
    ):
        hierarchy.drawn(MaskContent("G", 1.0, {"A": cells["A"]}))
