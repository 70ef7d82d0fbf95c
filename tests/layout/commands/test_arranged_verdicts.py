"""What an arrangement says of doses, of rules that nobody checked, and of shapes that
draw nothing; its doses beside a plain sum of Gaussians over KLayout's shapes.
"""

import csv
import json
import math

import numpy as np
import pytest

from layout.formats import gdsii_write
from layout.formats.library import MaskCell, MaskLibrary
from metalens import lens
from metalens.cell.record import Cell
from metalens.lens.record import DiameterMap, Lens
from tests.command_line import call
from tests.proxies import proxy_of

PROXY = proxy_of([3.0, 3.0], [0.95], (0.08, 0.32), 0.85, 0.01)
ALPHA_UM, BETA_UM, ETA, TOLERANCE = 0.013, 7.3, 0.62, 0.02
PEC = f"""
[exposure]
alpha_um = {ALPHA_UM}
beta_um = {BETA_UM}
eta = {ETA}
tolerance = {TOLERANCE}
maximum_classes = 64
[die]
margin_um = 330
verniers = false
"""
PLAIN = "[exposure]\ncorrect = false\n[die]\nmargin_um = 330\nverniers = false\n"


def square(x, y, side):
    return np.array([[x, y], [x + side, y], [x + side, y + side], [x, y + side]])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A dense lens and a sparse one of thin pillars; pads of another tool, sound or
    with shapes that have no area.
    """
    target = tmp_path_factory.mktemp("verdicts")
    rng = np.random.default_rng(3)
    maps = {
        "dense": rng.choice([0.2, 0.24, 0.3], (41, 39)),
        "sparse": rng.choice([0.0, 0.0, 0.11, 0.13], (21, 24)),
    }
    for name, diameters in maps.items():
        made = Lens(
            DiameterMap(diameters, 0.42),
            Cell(0.42),
            PROXY,
            0.85,
            500.0,
            math.inf,
            "hyperbolic",
        )
        lens.save(target / f"{name}.h5", made)
    pads = MaskCell("PADS", {(1, 0): [square(0, 0, 5000), square(9000, 0, 4000)]})
    flat = np.array([[0, 0], [700, 0], [1400, 0]])
    there_and_back = np.array([[0, 0], [700, 0], [700, 300], [700, 0]])
    thin = MaskCell(
        "THIN",
        {(1, 0): [square(0, 0, 5000)], (20, 3): [flat], (21, 0): [there_and_back]},
    )
    for cell in (pads, thin):
        file = target / f"{cell.name.lower()}.gds"
        gdsii_write.write_gdsii(MaskLibrary(cell.name, {cell.name: cell}), file)
    (target / "pec.toml").write_text(PEC)
    (target / "plain.toml").write_text(PLAIN)
    return target


def run(folder, text, target, process):
    path = folder / "arrangement.toml"
    path.write_text(text)
    words = f"--process {folder}/{process} -o {target} --force --gds"
    return call(f"layout {path} {words}")


CELL = """
[[cell]]
file = "{file}"
name = "PADS"
checked = {checked}
[[cell.at]]
x_um = 31.5
y_um = -12.0
"""


def texts(target, printed):
    return (
        printed,
        (target / "report.html").read_text(),
        (target / "job.txt").read_text(),
    )


def test_shapes_of_a_file_without_corrected_doses_fail_and_are_said(
    folder, tmp_path, capsys
):
    target = tmp_path / "m"
    text = CELL.format(file="pads.gds", checked="true")
    assert run(folder, text, target, "pec.toml") == 1
    for said in texts(target, capsys.readouterr().out):
        assert (
            "PADS: 2 shapes on 1/0 of pads.gds get the relative dose 1 without" in said
        )
        assert "proximity correction" in said
        assert "passes its own checks" not in said
    # one dose is what was asked for
    assert run(folder, text, target, "plain.toml") == 0
    table = folder / "doses.csv"
    table.write_text("layer,datatype,relative_dose\n1,0,0.87\n")
    try:
        assert run(folder, text, target, "pec.toml") == 0
    finally:
        table.unlink()
    rows = list(csv.DictReader((target / "doses.csv").open()))
    assert [float(row["relative_dose"]) for row in rows] == [0.87]


def test_a_part_that_was_not_checked_never_reads_as_sound(folder, tmp_path, capsys):
    target = tmp_path / "m"
    assert (
        run(folder, CELL.format(file="pads.gds", checked="false"), target, "plain.toml")
        == 0
    )
    for said in texts(target, capsys.readouterr().out):
        assert "NOT CHECKED: the design rules of PADS (checked = false)" in said
        assert "passes its own checks" not in said
        assert "very part is within" not in said
    values = json.loads((target / "layout.json").read_text())
    assert values["unchecked"] == ["PADS"]


def test_shapes_without_area_are_left_out_and_said(folder, tmp_path, capsys):
    db = pytest.importorskip("klayout.db")
    target = tmp_path / "m"
    assert (
        run(folder, CELL.format(file="thin.gds", checked="true"), target, "plain.toml")
        == 0
    )
    for said in texts(target, capsys.readouterr().out):
        assert "2 shapes without area of thin.gds are left out" in said
    there = db.Layout()
    there.read(str(target / "mask.gds"))
    drawn = {
        (info.layer, info.datatype): db.Region(
            there.top_cell().begin_shapes_rec(there.layer(info))
        ).area()
        for info in there.layer_infos()
    }
    assert drawn == {(1, 0): 25_000_000}


DIE = """
name = "DUO"
[die]
size_um = [1300, 800]
[[lens]]
file = "dense.h5"
name = "A"
[[lens.at]]
x_um = -40
y_um = 21
[[lens]]
file = "sparse.h5"
name = "B"
[[lens.at]]
x_um = 45
turn_deg = 90
"""


def plain_exposure(points, boxes, squares):
    """Double-Gaussian exposure at points (n, 2) um by boxes (m, 4) and small shapes
    (k, 4) of x, y, area, dose; boxes come with their dose as a fifth number.
    """
    from scipy.special import erf

    total = np.zeros(len(points))
    for range_um, weight in ((ALPHA_UM, 1 / (1 + ETA)), (BETA_UM, ETA / (1 + ETA))):
        for left, bottom, right, top, dose in boxes:
            x = erf((right - points[:, 0]) / range_um) - erf(
                (left - points[:, 0]) / range_um
            )
            y = erf((top - points[:, 1]) / range_um) - erf(
                (bottom - points[:, 1]) / range_um
            )
            total += weight * dose * x * y / 4
        if range_um > 1:
            x, y, area, dose = squares.T
            for n, (px, py) in enumerate(points):
                r2 = (x - px) ** 2 + (y - py) ** 2
                flux = dose * area * np.exp(-r2 / range_um**2)
                total[n] += weight * flux.sum() / (np.pi * range_um**2)
    return total


def test_one_series_of_doses_serves_all_parts_and_gives_dose_to_size(
    folder, tmp_path, capsys
):
    """Every dose of the job is on one geometric series; edges of pillars of both
    lenses, of the dose test and of the witness cells are at dose to size by a plain sum.

    Budget of a pillar's edge: the tolerance, and 0.2 % of the Gaussian core at its rim
    by the closed form of the disc.
    """
    db = pytest.importorskip("klayout.db")
    from scipy.special import i0e

    target = tmp_path / "m"
    assert run(folder, DIE, target, "pec.toml") == 0
    capsys.readouterr()
    rows = list(csv.DictReader((target / "doses.csv").open()))
    doses = {
        (int(row["layer"]), int(row["datatype"])): float(row["relative_dose"])
        for row in rows
    }
    found = sorted({round(v, 6) for (layer, _), v in doses.items() if layer != 2})
    steps = np.diff(np.log(found))
    whole = np.log(np.array(found) / found[0]) / steps.min()
    assert abs(whole - np.rint(whole)).max() < 0.02  # six digits of a dose
    assert steps.min() > TOLERANCE  # twice 3/4 of the tolerance, at most
    assert len(found) <= 64
    there = db.Layout()
    there.read(str(target / "mask.gds"))
    boxes, pillars = [], []
    for info in there.layer_infos():
        layer = info.layer, info.datatype
        if layer not in doses or info.layer == 2:
            continue
        drawn = db.Region(there.top_cell().begin_shapes_rec(there.layer(info)))
        for shape in drawn.each():
            box = shape.bbox()
            if info.layer in (1, 5, 6):
                middle = box.center()
                pillars.append(
                    (
                        middle.x / 1e3,
                        middle.y / 1e3,
                        shape.area() / 1e6,
                        doses[layer],
                        info.layer,
                    )
                )
            else:
                boxes.append(
                    (
                        box.left / 1e3,
                        box.bottom / 1e3,
                        box.right / 1e3,
                        box.top / 1e3,
                        doses[layer],
                    )
                )
    pillars = np.array(pillars)
    rng = np.random.default_rng(11)
    lens_a = np.flatnonzero((pillars[:, 4] == 1) & (pillars[:, 0] < 0))
    lens_b = np.flatnonzero((pillars[:, 4] == 1) & (pillars[:, 0] > 0))
    witness = np.flatnonzero(pillars[:, 4] == 6)
    some = np.concatenate(
        [rng.choice(g, 20, replace=False) for g in (lens_a, lens_b, witness)]
    )
    around = plain_exposure(pillars[some, :2], np.array(boxes), pillars[:, :4])
    _, _, area, dose = pillars[some, :4].T
    radius = np.sqrt(area / np.pi)
    itself = dose * area / (np.pi * BETA_UM**2) * ETA / (1 + ETA)
    core = dose / (1 + ETA) * (1 - i0e(2 * (radius / ALPHA_UM) ** 2)) / 2
    own_wide = dose * ETA / (1 + ETA) * (1 - i0e(2 * (radius / BETA_UM) ** 2)) / 2
    edge = around - itself + core + own_wide
    assert abs(edge / 0.5 - 1).max() < TOLERANCE + 0.002


def test_an_arrangement_has_layers_write_fields_charge_and_time(
    folder, tmp_path, capsys
):
    """Area by KLayout's merged regions, base dose 300 uC/cm2, all doses 1; a field of a
    lens that is turned by a quarter has its sides exchanged.
    """
    db = pytest.importorskip("klayout.db")
    target = tmp_path / "m"
    assert run(folder, DIE, target, "plain.toml") == 0
    printed = capsys.readouterr().out
    assert "The mask passes its own checks." in printed
    there = db.Layout()
    there.read(str(target / "mask.gds"))
    names = (target / "mask.lyp").read_text()
    charge = {"pillars": 0.0, "aperture": 0.0}
    for info in there.layer_infos():
        assert f"<source>{info.layer}/{info.datatype}@1</source>" in names
        if info.layer not in (7, 10):
            region = db.Region(there.top_cell().begin_shapes_rec(there.layer(info)))
            step = "aperture" if info.layer == 2 else "pillars"
            charge[step] += region.area() * 1e-14 * 300.0  # nm^2 in cm^2
    values = json.loads((target / "layout.json").read_text())
    assert values["charge_uC"] == pytest.approx(charge, rel=1e-6)
    sheet = (target / "job.txt").read_text()
    for step, value in charge.items():
        assert (
            f"Step {step}: charge {value:.4g} uC ({value / 3.6:.3g} h at 1 nA" in sheet
        )
    rows = list(csv.DictReader((target / "fields.csv").open()))
    assert sum(int(row["pillars"]) for row in rows if row["part"] == "A") == 41 * 39
    (a,) = [row for row in rows if row["part"] == "A"]
    (b,) = [row for row in rows if row["part"] == "B"]
    assert (float(a["x_um"]), float(a["y_um"])) == (-40.0, 21.0)
    assert (float(b["x_um"]), float(b["y_um"])) == (45.0, 0.0)
    assert float(a["width_um"]) < float(a["height_um"])  # 39 columns, 41 rows
    assert float(b["width_um"]) < float(b["height_um"])  # 24 columns, turned
