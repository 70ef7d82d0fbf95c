"""``metalens info`` of a mask: its layers and shapes as another reader counts them."""

import json

import pytest

from layout.gdsii import write as gdsii_write
from layout.oasis import write as oasis_write
from metalens.cli import BAD_INPUT, SUCCESS, main

klayout = pytest.importorskip("klayout.db")


def counted(path):
    """{"LAYER/DATATYPE": shapes below the top cells} by KLayout."""
    layout = klayout.Layout()
    layout.read(str(path))
    found = {}
    for index in layout.layer_indexes():
        about = layout.get_info(index)
        number = sum(1 for top in layout.top_cells() for _ in _each(top.begin_shapes_rec(index)))
        if number:
            found[f"{about.layer}/{about.datatype}"] = number
    return found, [top.name for top in layout.top_cells()]


def _each(walk):
    while not walk.at_end():
        yield walk
        walk.next()


@pytest.mark.parametrize(("ending", "kind"), [("oas", "OASIS mask"), ("gds", "GDSII mask")])
def test_shapes_of_every_layer_are_those_that_klayout_counts(make_plan, tmp_path, capsys, ending, kind):
    path = tmp_path / f"m.{ending}"
    (oasis_write.write if ending == "oas" else gdsii_write.write)(make_plan(seed=7), path)
    assert main(["info", str(path), "--json"]) == SUCCESS
    told = json.loads(capsys.readouterr().out)
    shapes, tops = counted(path)
    assert {number: entry["shapes"] for number, entry in told["layers"].items()} == shapes
    assert (told["kind"], told["tops"], told["shapes"]) == (kind, tops, sum(shapes.values()))
    assert main(["info", str(path)]) == SUCCESS
    assert f"{sum(shapes.values()):,} shapes" in capsys.readouterr().out


def test_a_mask_cut_short_is_refused_by_name(make_plan, tmp_path, capsys):
    path = tmp_path / "m.gds"
    gdsii_write.write(make_plan(seed=7), path)
    path.write_bytes(path.read_bytes()[:-40])
    assert main(["info", str(path)]) == BAD_INPUT
    assert str(path) in capsys.readouterr().err
    assert main(["info", str(tmp_path / "none.oas")]) == BAD_INPUT
    assert "none.oas: no such file" in capsys.readouterr().err
