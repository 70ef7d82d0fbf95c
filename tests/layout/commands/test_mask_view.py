"""A mask to be looked at: every shape of the file is in the page, where the file has
it.
"""

import base64
import json
import re
import zlib

import numpy as np
import pytest

from layout.commands import view
from layout.drc import DrcReport, Violation, write_lyrdb
from layout.formats import gdsii_write, oasis_write
from layout.process.process import DesignRules
from metalens import cli
from metalens.core.errors import MaskFileError
from metalens.view.page import page_html

KINDS = {"Float32Array": "<f4", "Int32Array": "<i4", "Uint8Array": "u1"}


def unpacked(entry):
    return np.frombuffer(
        zlib.decompress(base64.b64decode(entry["data"])), KINDS[entry["type"]]
    ).reshape(entry["shape"])


def content(text):
    return json.loads(
        re.search(
            r'<script type="application/json" id="data">(.*?)</script>', text, re.S
        ).group(1)
    )


@pytest.mark.parametrize("ending", ["oas", "gds"])
def test_every_shape_is_in_the_page_where_the_file_has_it(make_plan, tmp_path, ending):
    plan = make_plan(seed=5)
    write = oasis_write.write if ending == "oas" else gdsii_write.write
    write(plan, tmp_path / f"m.{ending}")
    panel = content(page_html("mask", view.mask_panels(tmp_path / f"m.{ending}")))[
        "panels"
    ][0]
    assert panel["unit"] == pytest.approx(1e-3, rel=1e-12)
    found = set()
    for outline in panel["outlines"]:
        x, y = np.cumsum(unpacked(outline["dx"])), np.cumsum(unpacked(outline["dy"]))
        width = float(np.ptp(unpacked(outline["corners"])[:, 0]))
        found |= {
            (outline["layer"].split()[0], width, int(a), int(b))
            for a, b in zip(x, y, strict=True)
        }
    lattice, sizes = (
        plan.lattices[0],
        [float(np.ptp(made.outline[:, 0])) for made in plan.classes],
    )
    rows, columns = np.nonzero(lattice.array)
    want = {
        ("1", sizes[lattice.array[i, k] - 1], -6000 + 400 * int(k), 4400 - 400 * int(i))
        for i, k in zip(rows, columns, strict=True)
    }
    assert want <= found
    assert {width for layer, width, _, _ in found if layer == "3"} == {9000.0}
    assert len(found) == len(want) + 1


def test_doses_and_broken_rules_beside_the_mask_are_shown(plan, tmp_path):
    oasis_write.write(plan, tmp_path / "mask.oas")
    (tmp_path / "doses.csv").write_text("layer,datatype,relative_dose\n1,0,1.37\n")
    broken = Violation("space", (-5000, 4300, -4700, 4500), 55.0, 70.0, "two pillars")
    report = DrcReport.empty(1.0, DesignRules())
    report.add("space", 1, layer=1, cell="TOP", worst=55.0, examples=[broken])
    write_lyrdb(report, "TOP", tmp_path / "mask.lyrdb")
    drawn, layers = view.mask_panels(tmp_path)
    ((x, y, rule),) = drawn.marks
    assert (x, y, rule) == (pytest.approx(-4.85), pytest.approx(4.4), "space")
    assert {
        o.notes["relative dose"] for o in drawn.outlines if o.layer == "1 pillar"
    } == {1.37}
    rows = {row[0]: row for row in layers.rows}
    assert rows["1/0"][2] == int((plan.lattices[0].array > 0).sum())
    assert rows["3/0"][3] == pytest.approx(9 * 0.5 + 8.5 * 0.5)  # an L of two bars, um²
    assert rows["3/0"][4] == "none stated"


def test_what_holds_no_mask_is_refused(tmp_path, capsys):
    with pytest.raises(MaskFileError, match="no mask file"):
        view.mask_panels(tmp_path)
    (tmp_path / "notes.txt").write_text("x")
    assert cli.main(["view", str(tmp_path), "-o", str(tmp_path / "page.html")]) == 2
    assert (
        "is no folder of a mask, of captures or of a run; give a file"
        in capsys.readouterr().err
    )
    assert not (tmp_path / "page.html").exists()
