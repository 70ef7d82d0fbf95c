"""Cells put together: arrays found again hold every copy once, and both formats hold
them, read by KLayout too.
"""

import numpy as np
import pytest

from layout.formats import gdsii_read, gdsii_write, oasis_read, oasis_write
from layout.formats.library import (
    QUARTERS,
    CellPlacements,
    CellReference,
    MaskCell,
    MaskLibrary,
    Orientation,
)
from metalens.core.errors import ProcessError

WRITERS = {
    ".gds": (gdsii_write.write_gdsii, gdsii_read.read_gdsii),
    ".oas": (oasis_write.write_oasis, oasis_read.read_oasis),
}
BAR = np.array([[0, 0], [10, 0], [10, 23], [0, 23]])
ELL = np.array([[0, 0], [90, 0], [90, 40], [31, 40], [31, 70], [0, 70]])


def listed(references):
    """Every copy as (child, turn, x, y)."""
    return [
        (one.child, one.turn, x, y)
        for one in references
        for x, y in (
            zip(one.x.tolist(), one.y.tolist(), strict=True)
            if isinstance(one, CellPlacements)
            else (
                (
                    one.x + i * one.across[0] + j * one.up[0],
                    one.y + i * one.across[1] + j * one.up[1],
                )
                for i in range(one.columns)
                for j in range(one.rows)
            )
        )
    ]


def placements(child, turn, x, y):
    return CellPlacements(child, turn, *(np.array(v, np.int32) for v in (x, y)))


def sort_key(row):
    child, turn, x, y = row
    return child, turn.angle_deg, turn.mirrored, turn.scale, x, y


@pytest.mark.parametrize("suffix", WRITERS)
@pytest.mark.parametrize(("child", "turn"), [("A", 1), ("A", 0), ("B", 2)])
def test_placements_of_one_cell_in_one_turn_are_written_whatever_their_number(
    suffix, child, turn, tmp_path
):
    """Three of one kind alone: as the first cell unturned, by its second turn, or of a
    later cell.
    """
    write, read = WRITERS[suffix]
    placed = (placements(child, QUARTERS[turn], [5, -7, 130], [11, 4, -60]),)
    cells = {name: MaskCell(name, {(1, 0): [BAR]}) for name in "AB"}
    write(
        MaskLibrary("TOP", cells | {"TOP": MaskCell("TOP", references=placed)}),
        tmp_path / f"a{suffix}",
    )
    found = read(tmp_path / f"a{suffix}").cells["TOP"].references
    assert sorted(listed(found), key=sort_key) == sorted(listed(placed), key=sort_key)


@pytest.mark.parametrize("suffix", WRITERS)
def test_hundreds_of_turns_come_back_each_with_its_own_placement(suffix, tmp_path):
    """Beyond the eight quarter turns 300 angles, more than a byte numbers."""
    write, read = WRITERS[suffix]
    turns = (*QUARTERS, *(Orientation(0.5 + n / 4) for n in range(300)))
    placed = tuple(
        placements("A", turn, [7 * n], [7 * (307 - n)]) for n, turn in enumerate(turns)
    )
    top = MaskCell("TOP", references=placed)
    cells = {"A": MaskCell("A", {(1, 0): [BAR]}), "TOP": top}
    write(MaskLibrary("TOP", cells), tmp_path / f"a{suffix}")
    found = read(tmp_path / f"a{suffix}").cells["TOP"].references
    for got, want in zip(
        sorted(listed(found), key=sort_key),
        sorted(listed(placed), key=sort_key),
        strict=True,
    ):
        assert got[2:] == want[2:]
        assert got[1].mirrored == want[1].mirrored
        assert got[1].angle_deg == pytest.approx(want[1].angle_deg, abs=1e-9)


def assembly():
    loose = (
        placements("A", QUARTERS[0], [5], [-6]),
        placements("B", QUARTERS[7], [-700], [41]),
        placements("A", Orientation(211.25), [5], [900]),
        placements("B", QUARTERS[3], [2**30, 77], [-(2**30), 8]),
        placements("B", Orientation(33.5, True, 1.5), [12], [13]),
    )
    cells = {
        "A": MaskCell("A", {(1, 0): [BAR], (1, 7): [ELL - 3]}),
        "B": MaskCell("B", {(2, 3): [ELL]}),
    }
    copies = (
        CellReference("A", 5, -6, QUARTERS[5], 3, 4, (0, 1000), (-700, 30)),
        CellReference("B", 60_000, -8, Orientation(17.0), 1, 9, (0, 0), (0, -4100)),
        CellReference("B", -60_000, 1),
    )
    cells["TOP"] = MaskCell("TOP", references=(*loose, *copies))
    return MaskLibrary("TOP", cells, layer_names={(1, 0): "pillar"})


@pytest.mark.parametrize("end", [".gds", ".oas"])
def test_every_copy_comes_back(tmp_path, end):
    made, (write, read) = assembly(), WRITERS[end]
    write(made, tmp_path / f"m{end}")
    content = read(tmp_path / f"m{end}")
    assert content.tops == ["TOP"]
    planned = listed(made.cells["TOP"].references)
    there = listed(content.cells["TOP"].references)
    assert sorted(there, key=sort_key) == sorted(planned, key=sort_key)
    for name in ("A", "B"):
        for layer, shapes in made.cells[name].polygons.items():
            assert [p.tolist() for p in content.cells[name].polygons[layer]] == [
                p.tolist() for p in shapes
            ]
    if end == ".oas":
        assert content.layer_names == {(1, 0): "pillar"}


@pytest.mark.parametrize("end", [".gds", ".oas"])
def test_an_independent_reader_finds_every_shape(tmp_path, end):
    db = pytest.importorskip("klayout.db")
    made, (write, _) = assembly(), WRITERS[end]
    write(made, tmp_path / f"m{end}")
    there = db.Layout()
    there.read(str(tmp_path / f"m{end}"))
    top = there.top_cell()
    planned = listed(made.cells["TOP"].references)
    for layer, child, shape in (((1, 0), "A", BAR), ((2, 3), "B", ELL)):
        found = db.Region(top.begin_shapes_rec(there.layer(*layer)))
        found.merged_semantics = False
        wanted = db.Region()
        polygon = db.Polygon([db.Point(*map(int, p)) for p in shape])
        for name, turn, x, y in planned:
            if name == child:
                wanted.insert(
                    polygon.transformed(
                        db.ICplxTrans(turn.scale, turn.angle_deg, turn.mirrored, x, y)
                    )
                )
        wanted.merged_semantics = False
        assert (
            found.count()
            == wanted.count()
            == sum(name == child for name, *_ in planned)
        )
        assert sorted(str(p) for p in found.each()) == sorted(
            str(p) for p in wanted.each()
        )


def test_files_do_not_grow_with_copies(tmp_path):
    dot = MaskCell("A", {(1, 0): [BAR]})
    for end, (write, _) in WRITERS.items():
        sizes = []
        for side in (3, 300):
            many = CellReference(
                "A", 7, -3, QUARTERS[2], side, side + 1, (100, 0), (0, 130)
            )
            write(
                MaskLibrary(
                    "TOP", {"A": dot, "TOP": MaskCell("TOP", references=(many,))}
                ),
                tmp_path / f"{side}{end}",
            )
            sizes.append((tmp_path / f"{side}{end}").stat().st_size)
        assert sizes[1] - sizes[0] <= 4  # a few digits of two numbers


def test_what_gdsii_cannot_hold_is_refused_by_name(tmp_path):
    dot = MaskCell("A", {(1, 0): [BAR]})
    row = CellReference("A", 0, 0, columns=32768, across=(30, 0))
    long = MaskLibrary("TOP", {"A": dot, "TOP": MaskCell("TOP", references=(row,))})
    with pytest.raises(ProcessError, match="32768 x 1 copies of A: GDSII holds 32767"):
        gdsii_write.write_gdsii(long, tmp_path / "m.gds")
    oasis_write.write_oasis(long, tmp_path / "m.oas")
    (read,) = oasis_read.read_oasis(tmp_path / "m.oas").cells["TOP"].references
    assert read.count == 32768
