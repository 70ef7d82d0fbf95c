"""``metalens info`` of a mask: its layers and shapes as another reader counts them."""

import numpy as np
import pytest

from layout.formats import gdsii_write, oasis_write
from layout.formats.library import QUARTERS, CellReference, MaskCell, MaskLibrary
from metalens.cli import BAD_INPUT, SUCCESS
from tests.command_line import call, printed

klayout = pytest.importorskip("klayout.db")


def counted(path):
    """{"LAYER/DATATYPE": shapes below the top cells} by KLayout."""
    layout = klayout.Layout()
    layout.read(str(path))
    found = {}
    for index in layout.layer_indexes():
        about = layout.get_info(index)
        number = sum(
            1 for top in layout.top_cells() for _ in _each(top.begin_shapes_rec(index))
        )
        if number:
            found[f"{about.layer}/{about.datatype}"] = number
    return found, [top.name for top in layout.top_cells()]


def _each(walk):
    while not walk.at_end():
        yield walk
        walk.next()


@pytest.mark.parametrize(
    ("ending", "kind"), [("oas", "OASIS mask"), ("gds", "GDSII mask")]
)
def test_shapes_of_every_layer_are_those_that_klayout_counts(
    make_plan, tmp_path, capsys, ending, kind
):
    path = tmp_path / f"m.{ending}"
    (oasis_write.write_oasis if ending == "oas" else gdsii_write.write_gdsii)(
        make_plan(seed=7), path
    )
    assert call(f"info {path} --json") == SUCCESS
    told = printed(capsys)
    shapes, tops = counted(path)
    assert {
        number: entry["shapes"] for number, entry in told["layers"].items()
    } == shapes
    assert (told["kind"], told["tops"], told["shapes"]) == (
        kind,
        tops,
        sum(shapes.values()),
    )
    assert call(f"info {path}") == SUCCESS
    assert f"{sum(shapes.values()):,} shapes" in capsys.readouterr().out


def test_a_mask_cut_short_is_refused_by_name(make_plan, tmp_path, capsys):
    path = tmp_path / "m.gds"
    gdsii_write.write_gdsii(make_plan(seed=7), path)
    path.write_bytes(path.read_bytes()[:-40])
    assert call(f"info {path}") == BAD_INPUT
    assert str(path) in capsys.readouterr().err
    assert call(f"info {tmp_path}/none.oas") == BAD_INPUT
    assert "none.oas: no such file" in capsys.readouterr().err


@pytest.mark.parametrize("ending", ["oas", "gds"])
def test_a_wafer_of_any_size_is_told_by_products(tmp_path, capsys, ending):
    """Arrays of arrays of arrays: the numbers are products, far beyond what could be
    taken apart.
    """
    box = np.array([[0, 0], [130, 0], [130, 70]])
    dot, bar = (
        MaskCell(name, {(7, n): [box] * (n + 1)})
        for n, name in enumerate(("DOT", "BAR"))
    )
    steps = {"across": (300, 0), "up": (0, 310)}
    copies = {
        "LENS": (
            CellReference("DOT", 0, 0, columns=600, rows=700, **steps),
            CellReference("BAR", 5, 9, QUARTERS[3]),
        ),
        "DIE": (
            CellReference("LENS", 0, 0, QUARTERS[6], columns=40, rows=50, **steps),
            CellReference("BAR", 0, 0, rows=3, up=(0, 9)),
        ),
        "WAFER": (
            CellReference("DIE", -7, 0, columns=210, rows=330, **steps),
            CellReference("LENS", 0, 0),
        ),
    }
    cells = {"DOT": dot, "BAR": bar}
    cells |= {name: MaskCell(name, references=r) for name, r in copies.items()}
    write = oasis_write.write_oasis if ending == "oas" else gdsii_write.write_gdsii
    write(MaskLibrary("WAFER", cells), tmp_path / f"w.{ending}")
    assert call(f"info {tmp_path}/w.{ending} --json") == SUCCESS
    told = printed(capsys)
    lenses = 210 * 330 * 40 * 50 + 1
    found = {number: entry["shapes"] for number, entry in told["layers"].items()}
    assert found == {"7/0": lenses * 600 * 700, "7/1": 2 * (lenses + 210 * 330 * 3)}
    assert told["tops"] == ["WAFER"]


def test_cells_that_draw_nothing_and_two_tops_are_counted(tmp_path, capsys):
    """A cell of each top, one that holds only another, and one that is empty; no layer
    but those that are drawn.
    """
    box = np.array([[0, 0], [130, 0], [130, 70]])
    cells = [MaskCell("A", {(7, 0): [box]}), MaskCell("EMPTY")]
    copies = {
        "ONE": (
            CellReference("A", 0, 0),
            CellReference("EMPTY", 0, 0, rows=9, up=(0, 5)),
        ),
        "TWO": (CellReference("A", 3, 4),) * 3,
    }
    cells += [MaskCell(name, references=r) for name, r in copies.items()]
    gdsii_write.write_gdsii(
        MaskLibrary("L", {cell.name: cell for cell in cells}), tmp_path / "w.gds"
    )
    assert call(f"info {tmp_path}/w.gds --json") == SUCCESS
    told = printed(capsys)
    assert told["layers"] == {"7/0": {"name": "", "shapes": 4}}
    assert sorted(told["tops"]) == ["ONE", "TWO"]
