"""An assembly held against a file by hand: what differs by a little is told, and what
only looks so is not.
"""

import dataclasses

import numpy as np
import pytest

from layout.arrange import readback
from layout.files import (
    QUARTERS,
    Assembly,
    CellContent,
    Copies,
    Digest,
    MaskContent,
    Placed,
    Sites,
    Turn,
    flat,
)
from layout.mask import Lattice

BAR = np.array([[0, 0], [90, 0], [90, 50], [0, 50]])
WEDGE = np.array([[700, 700], [790, 720], [710, 780]])
ODD = (*QUARTERS, Turn(30.0, True, 2.0))


def placed(children, *rows):
    """(child, x, y, turn) of each; turn 8 is a mirror, 30 degrees and doubled."""
    child, x, y, turn = np.array(rows, np.int32).reshape(-1, 4).T
    return Placed(children, child, x, y, turn.astype(np.uint8), ODD)


def made():
    """TOP places B once askew, an array of A, and LENS, whose sites are never all in
    memory.
    """
    cells = {
        "A": CellContent("A", {(1, 0): [BAR, WEDGE]}),
        "B": CellContent(
            "B", {(1, 0): [BAR]}, {(1, 0): [(7, -9, 400)], (3, 1): [(0, 0, 300)]}
        ),
        "LENS": CellContent("LENS"),
        "TOP": CellContent(
            "TOP",
            placed=placed(("B", "LENS"), (0, 5, 6, 8), (1, -7, 9, 0), (0, 50, 60, 1)),
        ),
    }
    copies = {
        "TOP": (
            Copies(
                "A",
                1000,
                -400,
                QUARTERS[5],
                columns=3,
                rows=2,
                across=(300, 0),
                up=(10, 700),
            ),
        )
    }
    lattice = Lattice.of(
        "OWN", np.array([[1, 2], [0, 1]], np.uint8), pitch=410, x0=-7, y0=9
    )
    return Assembly("LIB", cells, copies, sites={"LENS": Sites(lattice, ("A", "B"))})


ARRAY = [
    (1, 1000 + 300 * i + 10 * j, -400 + 700 * j, 5) for j in range(2) for i in range(3)
]
TOP = [(0, 5, 6, 8), (2, -7, 9, 0), (0, 50, 60, 1), *ARRAY]
SITES = [(0, -7, 9, 0), (1, 403, 9, 0), (0, 403, -401, 0)]


def content(top=TOP, sites=SITES, **other):
    """The same as a reader without circles gives it, shapes in another order and the
    other way round.
    """
    cells = {
        "A": CellContent(
            "A", {(1, 0): [np.roll(WEDGE, 1, axis=0)[::-1], np.roll(BAR, 2, axis=0)]}
        ),
        "B": CellContent(
            "B",
            {(3, 1): [flat.circle(0, 0, 300)], (1, 0): [flat.circle(7, -9, 400), BAR]},
        ),
        "LENS": CellContent("LENS", placed=placed(("A", "B"), *sites)),
        "TOP": CellContent("TOP", placed=placed(("B", "A", "LENS"), *top)),
    }
    return MaskContent("GDSII", 1.0, cells | other)


def told(read):
    return readback.differences(made(), read)


def test_a_file_as_planned_differs_in_nothing_in_whatever_order():
    assert told(content()) == []
    assert told(content(TOP[::-1], SITES[::-1])) == []
    assert told(content(EMPTY=CellContent("EMPTY"))) == [
        "0 cells are missing, 1 too many: EMPTY"
    ]
    short = content()
    del short.cells["A"], short.cells["B"]
    assert told(short) == ["2 cells are missing, 0 too many: A, B"]


def test_units_agree_to_a_part_in_a_million_millions():
    assert told(dataclasses.replace(content(), unit_nm=1 + 0.9e-12)) == []
    assert told(dataclasses.replace(content(), unit_nm=1 - 0.9e-12)) == []
    (text,) = told(dataclasses.replace(content(), unit_nm=1 + 1.1e-12))
    assert text.startswith("database unit 1.0000000000011 nm, planned 1.0")


@pytest.mark.parametrize(
    "polygons",
    [
        {(1, 0): [WEDGE, BAR + np.array([0, 1])]},
        {(1, 0): [WEDGE, BAR, BAR]},
        {(1, 0): [WEDGE], (1, 1): [BAR]},
        {(1, 0): [WEDGE, BAR[[0, 2, 1, 3]]]},
        {(1, 0): [WEDGE, BAR], (2, 0): [BAR]},
    ],
)
def test_shapes_that_differ_by_a_unit_a_layer_or_their_number_are_told(polygons):
    assert told(content(A=CellContent("A", polygons))) == ["cell A: shapes differ"]
    assert told(content(A=CellContent("A", {(1, 0): [WEDGE, BAR], (2, 0): []}))) == []


@pytest.mark.parametrize(
    ("number", "row", "who"),
    [
        (0, (0, 5, 7, 8), "B"),
        (0, (0, 5, 6, 0), "B"),
        (1, (2, -8, 9, 0), "LENS"),
        (2, (0, 50, 60, 2), "B"),
        (4, (1, 1301, -400, 5), "A"),
        (8, (1, 1610, 300, 4), "A"),
        (8, (0, 1610, 300, 5), "A"),
    ],
)
def test_a_copy_that_is_moved_turned_or_of_another_cell_is_told(number, row, who):
    top = [row if n == number else one for n, one in enumerate(TOP)]
    assert told(content(top)) == [
        f"cell TOP: copies of {who} are not all at their places"
    ]


def test_a_site_that_is_missing_twice_or_of_the_other_class_is_told():
    for sites in (
        SITES[:2],
        [*SITES, SITES[0]],
        [(1, *SITES[0][1:]), *SITES[1:]],
        [(*SITES[0][:3], 1), *SITES[1:]],
    ):
        assert told(content(sites=sites)) == [
            "cell LENS: copies of A are not all at their places"
        ]


def test_angles_agree_to_nine_decimals_and_scales_to_twelve_digits():
    """As a fraction of 56 bits to the base 16 holds them."""

    def turned(turn):
        read = content()
        turns = (*QUARTERS, turn)
        cell = read.cells["TOP"]
        read.cells["TOP"] = dataclasses.replace(
            cell, placed=dataclasses.replace(cell.placed, turns=turns)
        )
        return told(read)

    assert turned(Turn(30.0 + 4e-10, True, 2.0 * (1 + 4e-13))) == []
    assert turned(Turn(390.0, True, 2.0)) == []
    assert turned(Turn(30.0 + 6e-10, True, 2.0)) != []
    assert turned(Turn(30.0, True, 2.0 * (1 + 6e-12))) != []
    assert turned(Turn(30.0, False, 2.0)) != []
    assert readback._rounded(Turn(360.0 - 4e-10)) == QUARTERS[0]


def summed(name, children, *rows):
    """Of a reader that kept the sums of these alone."""
    child, x, y, turn = np.array(rows).T
    digest = Digest()
    digest.take(child, x, y, turn)
    sums = digest.of(np.arange(len(children)))
    return CellContent(
        name, placed=dataclasses.replace(placed(children), children=children), sums=sums
    )


def test_sums_of_a_cell_are_held_against_copies_and_sites_together():
    """Turns count in the sums: 8 and beyond alike."""
    names = ("B", "A", "LENS")
    assert (
        told(
            content(
                TOP=summed("TOP", names, *TOP), LENS=summed("LENS", ("A", "B"), *SITES)
            )
        )
        == []
    )
    moved = [(c, x + (n == 5), y, t) for n, (c, x, y, t) in enumerate(TOP)]
    assert told(content(TOP=summed("TOP", names, *moved))) == [
        "cell TOP: copies of A are not all at their places"
    ]
    turned = [(c, x, y, 4 if n == 5 else t) for n, (c, x, y, t) in enumerate(TOP)]
    assert told(content(TOP=summed("TOP", names, *turned))) == [
        "cell TOP: copies of A are not all at their places"
    ]
    lost = summed("LENS", ("A", "B"), *SITES[:2])
    assert told(content(LENS=lost)) == [
        "cell LENS: copies of A are not all at their places"
    ]
