"""Files beside a mask for KLayout: layers in order with their numbers, a marker for
each violation, read as XML.
"""

from xml.etree import ElementTree

import numpy as np

from layout.mask import Figure, Lattice, MaskPlan, PillarClass
from layout.process.process import Rules
from layout.rules import markers
from layout.rules.report import DrcReport, Violation

SQUARE = np.array([[-60, -60], [60, -60], [60, 60], [-60, 60]])
NAMES = {(2, 0): "aperture", (10, 0): "outline", (7, 0): "fields", (1, 1): "pillar 2"}


def plan(count=8):
    lattice = Lattice.of("LENS", np.ones((2, 3), np.uint8), pitch=400, x0=0, y0=0)
    classes = (
        PillarClass("A", 120.0, 120, (1, 1), SQUARE),
        PillarClass("B", 120.0, 120, (1, 0), SQUARE),
    )
    shapes = {
        layer: (SQUARE,)
        for layer in (
            (10, 0),
            (2, 0),
            (7, 0),
            (1, 1),
            *((20 + k, k) for k in range(count)),
        )
    }
    return MaskPlan(
        "TOP",
        classes,
        (lattice,),
        (Figure("MORE", shapes),),
        unit_nm=2.5,
        layer_names=NAMES,
    )


def test_every_layer_has_its_source_its_name_and_a_colour_of_its_own(tmp_path):
    markers.write_lyp(plan(), tmp_path / "m.lyp")
    rows = [
        {e.tag: e.text for e in p}
        for p in ElementTree.parse(tmp_path / "m.lyp").getroot()
    ]
    sources = [
        *((1, 0), (1, 1), (2, 0), (7, 0), (10, 0)),
        *((20 + k, k) for k in range(8)),
    ]
    assert [row["source"] for row in rows] == [f"{a}/{b}@1" for a, b in sources]
    assert [row["name"] for row in rows][:7] == [
        *(
            "layer_1_0",
            "pillar 2",
            "aperture",
            "fields",
            "outline",
            "layer_20_0",
            "layer_21_1",
        )
    ]
    assert [row["dither-pattern"] for row in rows] == [
        "I9",
        "I9",
        "I1",
        "I1",
        "I1",
        *["I9"] * 8,
    ]
    colours = [row["fill-color"] for row in rows]
    assert colours == [row["frame-color"] for row in rows]
    assert len(set(colours[:8])) == 8
    assert colours[8:] == colours[:5]  # and begin again


def test_every_listed_violation_is_a_box_in_its_category(tmp_path):
    report = DrcReport.empty(plan(), Rules(minimum_gap_nm=77.5))
    report.add(
        "gap",
        1234,
        Violation("gap", (-41_000, 7300, -40_200, 9900), 57.31, 77.5, "A and B"),
    )
    report.add(
        "density", 1, Violation("density", (0, -4, 800, 1200), 0.8125, 0.75, "window")
    )
    markers.write_lyrdb(plan(), report, tmp_path / "m.lyrdb")
    root = ElementTree.parse(tmp_path / "m.lyrdb").getroot()
    told = {
        c.findtext("name"): c.findtext("description") for c in root.find("categories")
    }
    assert told["gap"] == "1,234 violations, limit 77.5"
    assert told["density"] == "1 violations, limit 0.75"
    assert told["feature"].startswith("0 violations")
    items = root.find("items").findall("item")
    assert [
        (i.findtext("category"), i.findtext("cell"), i.findtext("multiplicity"))
        for i in items
    ] == [
        ("'gap'", "TOP", "1"),
        ("'density'", "TOP", "1"),
    ]
    assert [[v.text for v in i.find("values")] for i in items] == [
        ["box: (-102.5,18.25;-100.5,24.75)", "text: 'A and B: 57.31, need 77.5'"],
        ["box: (0,-0.01;2,3)", "text: 'window: 0.8125, need 0.75'"],
    ]
    assert root.findtext("top-cell") == root.findtext("cells/cell/name") == "TOP"
