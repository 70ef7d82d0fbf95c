"""A mask held against its plan, both by hand: each kind of difference is told with its
number and its place.
"""

import dataclasses

import numpy as np
import pytest

from layout.files import CellContent, Digest, MaskContent, Placed, Turn, verify
from layout.files.content import QUARTERS
from layout.mask import Figure, Lattice, MaskPlan, PillarClass

SQUARE = np.array([[-60, -60], [61, -60], [61, 60], [-60, 60]])
BIG = np.array([[-80, -80], [80, -80], [80, 80], [-80, 80]])
BAR = np.array([[0, 0], [900, 0], [900, 50], [0, 50]])
SITES = np.array([[1, 0, 2, 2], [0, 1, 1, 0], [2, 2, 0, 1]], np.uint8)


def plan(sites=SITES):
    """Three rows of four, 410 and 300 apart, the first at (-7, 1009); the third class
    does not occur.
    """
    classes = [
        PillarClass(n, float(d), d, (1, 0), o)
        for n, d, o in (("A", 121, SQUARE), ("B", 160, BIG), ("C", 9, BAR))
    ]
    rows, columns = sites.shape
    lattice = Lattice(
        "LENS",
        rows,
        columns,
        410,
        -7,
        1009,
        lambda a, b: sites[a:b],
        sites,
        row_pitch=300,
    )
    figures = (Figure("MARKS", {(3, 0): (BAR, BAR + 700)}),)
    return MaskPlan("TOP", tuple(classes), (lattice,), figures, unit_nm=2.0)


def placed(children, *rows, turns=QUARTERS):
    """(child, x, y, turn) of each."""
    child, x, y, turn = np.array(rows, np.int32).reshape(-1, 4).T
    return Placed(children, child, x, y, turn.astype(np.uint8), turns)


PILLARS = [
    (1 - k % 2, -7 + 410 * c, 1009 - 300 * r, 0)
    for r, row in enumerate(SITES)
    for c, k in enumerate(row)
    if k
]


def mask(pillars=PILLARS, turns=QUARTERS, **other):
    """As the plan is written: A as a circle, B from another corner on and the other way
    round.
    """
    cells = {
        "A": CellContent("A", circles={(1, 0): [(0, 0, 60)]}),
        "B": CellContent("B", {(1, 0): [np.roll(BIG, 1, axis=0)[::-1]]}),
        "MARKS": CellContent(
            "MARKS", {(3, 0): [(BAR + 700)[::-1], np.roll(BAR, 2, axis=0)]}
        ),
        "LENS": CellContent("LENS", placed=placed(("A", "B"), *pillars, turns=turns)),
        "TOP": CellContent(
            "TOP", placed=placed(("MARKS", "LENS"), (0, 0, 0, 0), (1, 0, 0, 0))
        ),
    }
    return MaskContent(
        "OASIS",
        2.0,
        {name: cell for name, cell in (cells | other).items() if cell is not None},
    )


def told(content):
    found = verify.compare(plan(), content)
    assert found.ok == (not found.differences)
    return found.pillars, list(found.differences)


def test_a_mask_as_planned_differs_in_nothing():
    assert told(mask()) == (8, [])
    assert told(mask(PILLARS[::-1])) == (8, [])


def test_the_unit_agrees_to_a_part_in_a_million_millions():
    assert told(dataclasses.replace(mask(), unit_nm=2.0 * (1 + 0.9e-12)))[1] == []
    (text,) = told(dataclasses.replace(mask(), unit_nm=2.0 * (1 - 1.1e-12)))[1]
    assert text.startswith("database unit 1.99999")


def test_cells_too_many_and_cells_too_few():
    assert told(mask(MORE=CellContent("MORE")))[1] == [
        "top cells ['TOP', 'MORE'], planned 'TOP' alone"
    ]
    count, texts = told(mask(A=None, MARKS=None))
    assert (count, texts[-1]) == (0, "2 cells are missing: A, MARKS")


@pytest.mark.parametrize(
    "cell",
    [
        CellContent("A", circles={(1, 0): [(0, 0, 61)]}),
        CellContent("A", circles={(1, 0): [(0, 1, 60)]}),
        CellContent("A", circles={(1, 0): [(0, 0, 60)] * 2}),
        CellContent("A", {(1, 0): [SQUARE]}, {(1, 0): [(0, 0, 60)]}),
        CellContent("A", {(1, 0): [SQUARE + np.array([0, 1])]}),
        CellContent("A", {(1, 0): [SQUARE] * 2}),
        CellContent("A", {(1, 1): [SQUARE]}),
        CellContent("A", {(1, 0): [SQUARE], (1, 1): [SQUARE]}),
        CellContent("A", {(1, 0): [SQUARE[[0, 2, 1, 3]]]}),
    ],
)
def test_a_class_of_another_shape_is_told(cell):
    assert told(mask(A=cell))[1] == ["class A: the shape differs"]
    assert told(mask(A=CellContent("A", {(1, 0): [SQUARE]})))[1] == []


def test_figures_and_what_the_top_cell_places():
    other = CellContent("MARKS", {(3, 0): [BAR + 700, BAR + 1]})
    assert told(mask(MARKS=other))[1] == [
        "figure MARKS: polygons on layer (3, 0) differ"
    ]
    text = "cell TOP does not place each figure and lattice once at (0, 0)"
    for rows in (
        [(0, 0, 0, 0), (1, 0, 0, 0), (0, 0, 0, 0)],
        [(0, 0, 0, 0), (1, 1, 0, 0)],
        [(0, 0, -1, 0), (1, 0, 0, 0)],
        [(0, 0, 0, 0), (1, 0, 0, 2)],
    ):
        top = CellContent("TOP", placed=placed(("MARKS", "LENS"), *rows))
        assert told(mask(TOP=top))[1] == [text]


@pytest.mark.parametrize(
    "shapes", [{"polygons": {(3, 1): [BAR]}}, {"circles": {(3, 1): [(0, 0, 7)]}}]
)
def test_shapes_where_the_plan_has_none_are_told(shapes):
    """On a layer of their own in a figure or a class, in the cell of a lattice, in the
    top cell.
    """
    kept = mask().cells
    kinds = {"polygons": {}, "circles": {}}
    added = {
        n: {k: getattr(kept[n], k) | shapes.get(k, {}) for k in kinds}
        for n in ("MARKS", "A", "LENS", "TOP")
    }
    cells = {
        name: dataclasses.replace(kept[name], **both) for name, both in added.items()
    }
    words = {
        "MARKS": "figure MARKS: polygons on layer (3, 1) differ",
        "A": "class A: the shape differs",
        "LENS": "cell LENS holds shapes of its own, which the plan lacks",
        "TOP": "cell TOP holds shapes of its own, which the plan lacks",
    }
    for name, cell in cells.items():
        assert told(mask(**{name: cell}))[1] == [words[name]]
    assert told(
        mask(MARKS=dataclasses.replace(kept["MARKS"], circles={(3, 0): [(0, 0, 7)]}))
    )[1] == ["figure MARKS: polygons on layer (3, 0) differ"]
    assert (
        told(mask(TOP=dataclasses.replace(kept["TOP"], polygons={(3, 0): []})))[1] == []
    )


@pytest.mark.parametrize("chunk", [1 << 20, 3])
@pytest.mark.parametrize(
    "row",
    [
        (0, -6, 1009, 0),
        (0, -7, 1008, 0),
        (0, -417, 1009, 0),
        (0, 1633, 1009, 0),
        (1, -7, 1309, 0),
        (1, 403, 109, 0),
    ],
)
def test_pillars_off_the_lattice_are_told_by_the_place_of_the_first(
    monkeypatch, chunk, row
):
    """By a unit along x or y, and by a step beyond each of the four sides."""
    monkeypatch.setattr(verify, "_CHUNK", chunk)
    pillars = list(PILLARS)
    pillars[4] = row
    count, texts = told(mask(pillars))
    assert texts == [
        f"LENS: 1 pillars off the lattice, the first at ({row[1]}, {row[2]})"
    ]
    assert count == 0
    pillars[5] = (1, 20_000, -7, 0)
    assert told(mask(pillars))[1] == [
        f"LENS: 2 pillars off the lattice, the first at ({row[1]}, {row[2]})"
    ]


def test_a_pillar_at_an_odd_angle_is_off_and_one_turned_by_a_quarter_is_not():
    turns = (*QUARTERS, Turn(30.0))
    assert told(mask([*PILLARS[:7], (*PILLARS[7][:3], 7)], turns))[1] == []
    (text,) = told(mask([*PILLARS[:7], (*PILLARS[7][:3], 8)], turns))[1]
    assert "1 pillars off the lattice, the first at (1223, 409)" in text


def test_sites_of_another_class_are_told_by_row_and_column_and_pillars_are_counted():
    swapped = list(PILLARS)
    swapped[4], swapped[3] = (1, *PILLARS[4][1:]), (1, *PILLARS[3][1:])
    assert told(mask(swapped)) == (
        8,
        ["LENS: 2 sites differ, the first at row 1, column 1"],
    )
    assert told(mask(PILLARS[:7])) == (
        7,
        ["LENS: 1 sites differ, the first at row 2, column 3"],
    )
    assert told(mask([*PILLARS, PILLARS[2]])) == (9, ["LENS: 9 pillars, planned 8"])
    strange = mask(
        [*PILLARS[:7], (2, *PILLARS[7][1:])], X=CellContent("X", {(1, 0): [BAR]})
    )
    cell = strange.cells["LENS"]
    strange.cells["LENS"] = dataclasses.replace(
        cell, placed=dataclasses.replace(cell.placed, children=("A", "B", "X"))
    )
    assert told(strange)[1] == ["LENS: 1 sites differ, the first at row 2, column 3"]


def test_rows_are_counted_on_beyond_the_first_thousand():
    tall = np.ones((1100, 1), np.uint8)
    rows = [(0, -7, 1009 - 300 * r, 0) for r in range(1100) if r != 1031]
    got = verify.compare(plan(tall), mask(rows))
    assert got.differences == ("LENS: 1 sites differ, the first at row 1031, column 0",)
    assert verify.compare(plan(tall), mask([*rows, (0, -7, 1009 - 300 * 1031, 0)])).ok


def summed(*pillars, children=("A", "B")):
    """Of a reader that kept the sums of these pillars alone."""
    child, x, y, turn = np.array(pillars).T
    digest = Digest()
    digest.take(child, x, y, turn)
    sums = digest.of(np.arange(len(children)))
    return CellContent(
        "LENS",
        placed=dataclasses.replace(placed(children), children=children),
        sums=sums,
    )


@pytest.mark.parametrize("chunk", [1 << 20, 4])
def test_sums_of_each_class_are_held_against_the_plan(monkeypatch, chunk):
    monkeypatch.setattr(verify, "_CHUNK", chunk)
    assert told(mask(LENS=summed(*PILLARS))) == (8, [])
    assert told(mask(LENS=summed(*PILLARS[1:]))) == (
        7,
        ["LENS: class A: one pillar is missing, at (-7, 1009)"],
    )
    more = summed(*PILLARS, (1, 5, -9, 0))
    assert told(mask(LENS=more)) == (
        9,
        ["LENS: class B: one pillar too many, at (5, -9)"],
    )
    two = summed(*PILLARS, (0, 5, -9, 0), (0, 6, -9, 0))
    assert told(mask(LENS=two))[1] == ["LENS: class A: 6 pillars, planned 4"]
    moved = [(c, -7 if x == 403 else x, y, t) for c, x, y, t in PILLARS]
    texts = told(mask(LENS=summed(*moved)))[1]
    assert texts == [
        f"LENS: class {n}: 4 pillars, not all at their places" for n in "AB"
    ]
    turned = summed(*PILLARS[:6], *((*p[:3], 3) for p in PILLARS[6:]))
    assert told(mask(LENS=turned))[1] == [
        f"LENS: class {n}: 1 pillars are turned" for n in "AB"
    ]
    strange = mask(
        LENS=summed(*PILLARS, (2, 0, 0, 0), children=("A", "B", "X")),
        X=CellContent("X"),
    )
    assert told(strange) == (9, ["LENS places X, which are no classes of the plan"])


def test_the_places_of_a_lattice_are_those_of_its_sites():
    """Classes that do not occur are no children."""
    got = verify._places(plan(), plan().lattices[0])
    assert got.children == ("A", "B")
    rows = zip(*(v.tolist() for v in (got.child, got.x, got.y, got.turn)), strict=True)
    assert set(rows) == set(PILLARS)
    gap = np.where(SITES == 2, 3, 0).astype(np.uint8)
    assert verify._places(plan(gap), plan(gap).lattices[0]).children == ("C",)


def test_pieces_of_which_only_sums_were_kept_must_be_pieces_of_the_plan():
    row = dataclasses.replace(summed(*PILLARS), name="ROW")
    nested = mask(
        ROW=row, LENS=CellContent("LENS", placed=placed(("ROW",), (0, 0, 0, 0)))
    )
    assert told(nested) == (0, ["LENS places ROW, which are no pieces of the plan"])


def test_classes_beyond_a_byte_are_told_apart():
    """300 classes: number 256 more or less is another one."""
    classes = tuple(
        PillarClass(f"C{k:03}", 121.0, 121, (1, 0), SQUARE) for k in range(300)
    )
    sites = np.array([[299, 43]], np.uint16)
    many = MaskPlan(
        "TOP", classes, (Lattice.of("LENS", sites, pitch=410, x0=0, y0=0),), unit_nm=2.0
    )
    cells = {f"C{k:03}": CellContent(f"C{k:03}", {(1, 0): [SQUARE]}) for k in (298, 42)}
    cells["TOP"] = CellContent("TOP", placed=placed(("LENS",), (0, 0, 0, 0)))
    swapped = ("LENS: 2 sites differ, the first at row 0, column 0",)
    for order, want in ((("C298", "C042"), ()), (("C042", "C298"), swapped)):
        cells["LENS"] = CellContent(
            "LENS", placed=placed(order, (0, 0, 0, 0), (1, 410, 0, 0))
        )
        assert (
            verify.compare(many, MaskContent("GDSII", 2.0, cells)).differences == want
        )
