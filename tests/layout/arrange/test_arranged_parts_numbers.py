"""What is placed: boxes of lattices, figures and files, database units and layers, by
hand.
"""

from pathlib import Path

import numpy as np
import pytest

from layout.arrange import parts
from layout.files import CellContent, MaskContent, Placed, Sums
from layout.mask import Figure, Lattice, MaskPlan, PillarClass
from layout.process.process import Process
from metalens.ground.errors import MaskFileError

SMALL = np.array([[-20, -30], [25, -30], [25, 30], [-20, 30]])
LARGE = np.array(
    [[-41, -30], [25, -30], [25, 37], [-41, 37]]
)  # 41 is the farthest coordinate of all classes


def box(left, bottom, right, top):
    return np.array([[left, bottom], [right, bottom], [right, top], [left, top]])


def placed(child, *places, turn=0):
    """(child number, x, y) of each."""
    number, x, y = np.array(places, np.int32).reshape(-1, 3).T
    return Placed(child, number, x, y, np.full(len(x), turn, np.uint8))


def plan(lattice, *figures):
    classes = (
        PillarClass("THIN", 50.0, 50, (1, 0), SMALL),
        PillarClass("WIDE", 70.0, 70, (1, 0), LARGE),
    )
    return MaskPlan(
        "TOP",
        classes,
        (lattice,),
        figures,
        doses={(1, 0): 1.2},
        layer_names={(1, 0): "pillar"},
    )


def lattice(block, **more):
    rows, columns = block.shape
    return Lattice(
        "LENS", rows, columns, 400, -1000, 3000, lambda a, b: block[a:b], block, **more
    )


def made(planned, cells=(), **more):
    content = MaskContent("GDSII", 1.0, {c.name: c for c in cells})
    return parts.of_plan("P", planned, content, Process(), corrected=True, **more)


def test_a_small_lattice_has_a_box_for_each_pillar_around_the_farthest_reach_of_any_class():
    block = np.array([[0, 1, 2], [0, 0, 1]], np.uint8)
    boxes = parts.of_plan(
        "P",
        plan(lattice(block, row_pitch=300)),
        MaskContent("G", 1.0, {}),
        Process(),
        corrected=True,
    )
    want = {(-600, 3000), (-200, 3000), (-200, 2700)}
    assert {(b[0] + 41, b[1] + 41) for b in boxes.boxes[parts.PILLARS].tolist()} == want
    assert {(b[2] - 41, b[3] - 41) for b in boxes.boxes[parts.PILLARS].tolist()} == want
    assert boxes.extent.tolist() == [-641, 2659, -159, 3041]
    assert boxes.corrected


def test_a_large_lattice_has_sixty_four_squares_each_way_about_the_pillars_that_they_hold():
    """130 rows are 44 strips of 3, 65 columns are 33 of 2: each box ends at its
    outermost pillars.
    """
    block = np.zeros((130, 65), np.uint8)
    block[4, 7], block[5, 6] = 1, 2  # rows 3 to 5, columns 6 and 7
    block[129, 64] = 1  # alone in the last square
    got = made(plan(lattice(block))).boxes[parts.PILLARS]
    corner = [
        -1000 + 6 * 400 - 41,
        3000 - 5 * 400 - 41,
        -1000 + 7 * 400 + 41,
        3000 - 4 * 400 + 41,
    ]
    last = [
        -1000 + 64 * 400 - 41,
        3000 - 129 * 400 - 41,
        -1000 + 64 * 400 + 41,
        3000 - 129 * 400 + 41,
    ]
    assert got.tolist() == [corner, last]
    full = made(plan(lattice(np.ones((130, 65), np.uint8)))).boxes[parts.PILLARS]
    assert len(full) == 44 * 33
    assert made(plan(lattice(block))).boxes[parts.APERTURE].shape == (0, 4)
    single = made(plan(lattice(np.ones((64, 3), np.uint8)))).boxes[parts.PILLARS]
    assert len(single) == 64 * 3


def test_figures_are_of_the_exposure_of_their_layer_and_outlines_only_of_the_extent():
    figures = [
        Figure("MARKS", {(3, 0): (box(50, 60, 90, 70),), (2, 5): (box(7, 8, 9, 19),)}),
        Figure("OUTLINE", {(10, 0): (box(-9000, -8000, 7000, 6000),)}),
        Figure("FIELDS", {(2, 0): (box(0, 0, 5, 6500),)}),
    ]
    got = made(plan(lattice(np.array([[2]], np.uint8)), *figures))
    assert got.boxes[parts.PILLARS].tolist() == [
        [-1041, 2959, -959, 3041],
        [50, 60, 90, 70],
    ]
    assert got.boxes[parts.APERTURE].tolist() == [[7, 8, 9, 19]]
    assert got.extent.tolist() == [-9000, -8000, 7000, 6500]


def test_cells_are_named_after_the_part_and_sums_become_sites():
    block = np.array([[2, 1, 2]], np.uint8)
    one = lattice(block)
    sums = Sums(*(np.array([v]) for v in (2, 5, 7, 0, 11)))
    cells = [
        CellContent("WIDE", {(1, 0): [LARGE]}),
        CellContent("LENS", placed=placed(("WIDE",)), sums=sums),
        CellContent("TOP", placed=placed(("LENS", "WIDE"), (0, 3, -4), (1, 5, 6))),
    ]
    got = made(plan(one), cells, lattices={"LENS": one})
    assert list(got.cells) == ["P_WIDE", "P_LENS", "P"]
    assert [cell.name for cell in got.cells.values()] == ["P_WIDE", "P_LENS", "P"]
    assert got.cells["P"].placed.children == ("P_LENS", "P_WIDE")
    assert got.cells["P"].placed.x.tolist() == [3, 5]
    assert got.cells["P_LENS"].sums is None
    assert got.cells["P_LENS"].placed.children == ()
    assert set(got.sites) == {"P_LENS"}
    assert (got.sites["P_LENS"].lattice, got.sites["P_LENS"].children) == (
        one,
        ("", "P_WIDE"),
    )
    assert (got.name, got.top, got.doses, got.layer_names) == (
        "P",
        "P",
        {(1, 0): 1.2},
        {(1, 0): "pillar"},
    )


def file(unit_nm=1.0):
    """TOP places PAD and, through MID, DOT; LOOSE stands beside it."""
    cells = [
        CellContent("DOT", {(1, 4): [box(-3, -5, 7, 11)], (3, 2): [box(0, 0, 2, 2)]}),
        CellContent(
            "PAD",
            {(2, 0): [box(0, 0, 60, 40)], (10, 0): [box(-700, -500, 900, 600)]},
            texts=3,
        ),
        CellContent("MID", placed=placed(("DOT",), (0, 30, -20), (0, 1030, -20))),
        CellContent(
            "TOP",
            {(42, 7): [box(1, 2, 4, 8)]},
            placed=placed(("MID", "PAD"), (0, 500, 7), (1, -11, 13)),
            texts=2,
        ),
        CellContent("LOOSE", {(6, 0): [box(0, 0, 4000, 4000)]}, texts=5),
    ]
    return MaskContent(
        "GDSII", unit_nm, {c.name: c for c in cells}, {(1, 4): "dots", (6, 0): "loose"}
    )


def of_file(content, folder=Path("nowhere"), **more):
    asked = {"cell": "TOP", "relative_dose": 1.7, "keep_top": False} | more
    return parts.of_file("F", folder / "f.gds", content, Process(), **asked)


def test_a_cell_of_a_file_comes_with_what_it_places_alone():
    got = of_file(file())
    assert set(got.cells) == {"TOP", "MID", "PAD", "DOT"}
    assert (got.name, got.top, got.texts, got.corrected) == ("F", "TOP", 5, False)
    assert got.doses == dict.fromkeys(
        [(1, 4), (2, 0), (3, 2), (42, 7)], 1.7
    )  # no dose of the outline
    assert got.layer_names == {(1, 4): "dots"}
    assert sorted(got.boxes[parts.PILLARS].tolist()) == [
        [527, -18, 537, -2],
        [530, -13, 532, -11],
        [1527, -18, 1537, -2],
        [1530, -13, 1532, -11],
    ]
    assert got.boxes[parts.APERTURE].tolist() == [[-11, 13, 49, 53]]
    assert set(got.boxes) == {
        parts.PILLARS,
        parts.APERTURE,
    }  # layer 42 is of no exposure of ours
    assert got.extent.tolist() == [
        -711,
        -487,
        1537,
        613,
    ]  # but all of it counts for the extent
    whole = of_file(file(), keep_top=True)
    assert set(whole.cells) == set(file().cells)
    assert (whole.texts, whole.doses[6, 0], whole.layer_names) == (
        10,
        1.7,
        {(1, 4): "dots", (6, 0): "loose"},
    )
    assert whole.extent.tolist() == got.extent.tolist()
    dots = of_file(file(), cell="DOT")
    assert (set(dots.cells), dots.extent.tolist(), dots.texts) == (
        {"DOT"},
        [-3, -5, 7, 11],
        0,
    )
    empty = MaskContent("GDSII", 1.0, {"E": CellContent("E")})
    assert of_file(empty, cell="").extent.tolist() == [0, 0, 0, 0]


def test_doses_beside_a_file_go_before_the_one_of_the_arrangement(tmp_path):
    (tmp_path / "doses.csv").write_text(
        "layer,datatype,relative_dose\n1,4,1.35\n10,0,1.2\n"
    )
    assert of_file(file(), tmp_path).doses == {
        (1, 4): 1.35,
        (2, 0): 1.7,
        (3, 2): 1.7,
        (42, 7): 1.7,
    }


def test_a_file_of_several_tops_or_without_the_cell_is_refused():
    with pytest.raises(MaskFileError, match=r"2 top cells \(TOP, LOOSE\)"):
        of_file(file(), cell="")
    with pytest.raises(
        MaskFileError, match="no cell 'NONE'; the file holds DOT, PAD, MID, TOP, LOOSE"
    ):
        of_file(file(), cell="NONE")


def test_units_are_brought_to_nanometres_of_shapes_circles_and_places():
    cells = {
        "C": CellContent(
            "C", {(1, 0): [box(4, -6, 8, 10)]}, {(2, 0): [(6, -8, 14), (2, 4, 6)]}
        ),
        "T": CellContent("T", placed=placed(("C",), (0, 10, -12), (0, 14, 16), turn=5)),
    }
    got = parts.scaled(MaskContent("OASIS", 2.5, cells), 1.0, "FILE")
    assert (got.unit_nm, got.kind) == (1.0, "OASIS")
    assert got.cells["C"].polygons[1, 0][0].tolist() == box(10, -15, 20, 25).tolist()
    assert got.cells["C"].circles == {(2, 0): [(15, -20, 35), (5, 10, 15)]}
    assert (got.cells["T"].placed.x.tolist(), got.cells["T"].placed.y.tolist()) == (
        [25, 35],
        [-30, 40],
    )
    assert got.cells["T"].placed.turn.tolist() == [5, 5]
    assert parts.scaled(MaskContent("OASIS", 2.5, cells), 0.5, "F").cells[
        "T"
    ].placed.x.tolist() == [50, 70]
    same = MaskContent("OASIS", 1.0 + 5e-10, cells)
    assert parts.scaled(same, 1.0, "FILE") is same
    other = MaskContent(
        "OASIS", 1.0 + 2e-9, cells
    )  # 14 units of it are whole to 3e-8 nm
    assert parts.scaled(other, 1.0, "FILE").unit_nm == 1.0


@pytest.mark.parametrize(("x", "fits"), [(2**31 - 1, True), (2**31, False)])
def test_coordinates_beyond_32_bits_of_the_new_unit_are_refused(x, fits):
    cells = {
        "C": CellContent(
            "C", {(1, 0): [np.array([[0, 0], [2 * x, 0], [0, 8]], np.int64)]}
        )
    }
    if fits:
        assert (
            parts.scaled(MaskContent("G", 0.5, cells), 1.0, "F")
            .cells["C"]
            .polygons[1, 0][0]
            .max()
            == x
        )
    else:
        with pytest.raises(MaskFileError, match="within 32 bits"):
            parts.scaled(MaskContent("G", 0.5, cells), 1.0, "F")


@pytest.mark.parametrize(("off", "fits"), [(0.9e-6, True), (1.1e-6, False)])
def test_coordinates_are_whole_to_a_millionth_of_a_nanometre(off, fits):
    """1000 units of 5 nm and a little."""
    content = MaskContent(
        "G", 5.0 + off / 1000, {"C": CellContent("C", {(1, 0): [box(0, 0, 1000, 10)]})}
    )
    if fits:
        assert (
            parts.scaled(content, 1.0, "F").cells["C"].polygons[1, 0][0].max() == 5000
        )
    else:
        with pytest.raises(MaskFileError, match="no whole multiples"):
            parts.scaled(content, 1.0, "F")


def test_layers_that_become_one_are_put_together():
    cell = CellContent(
        "C",
        {(1, 0): [SMALL], (1, 3): [LARGE], (4, 0): [SMALL]},
        {(1, 3): [(1, 2, 3)], (1, 0): [(4, 5, 6)]},
    )
    got = parts.relayered(cell, {(1, 3): (1, 0), (4, 0): (5, 1)})
    assert {layer: len(shapes) for layer, shapes in got.polygons.items()} == {
        (1, 0): 2,
        (5, 1): 1,
    }
    assert got.circles == {(1, 0): [(1, 2, 3), (4, 5, 6)]}
    left, arrays = parts.compact(
        CellContent("A", placed=placed(("C",), *((0, 30 * k, 5) for k in range(6))))
    )
    assert [(one.columns, one.rows, one.across) for one in arrays] == [(6, 1, (30, 0))]
    assert len(left.placed.child) == 0
