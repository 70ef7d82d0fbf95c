"""``metalens layout`` from lens file to mask: what it writes, what it refuses, and how
it ends.
"""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

import layout
from layout.commands import make
from layout.drc.klayout import write_lyp, write_lyrdb
from layout.drc.lattice import check_plan
from layout.formats import dxf
from layout.process.process import DesignRules
from layout.shapes import polygon
from metalens import cli, lens
from metalens.cell.record import Cell
from metalens.core.errors import ProcessError
from metalens.lens.record import DiameterMap, Lens
from metalens.library.proxy import Proxy
from metalens.optics import Layers, Stop
from tests.referees.mask_places import places

FORMATS = (".oas", ".gds", ".stl")


@pytest.fixture(scope="module")
def lens_file(tmp_path_factory):
    """A small round lens of random diameters."""
    proxy = Proxy(
        np.array([[3.0, 3.0]]),
        np.array([[0.95]]),
        (0.08, 0.32),
        (0.85, 0.85),
        0.01,
        0.01,
    )
    axis = np.arange(60) - 29.5
    d = np.random.default_rng(0).uniform(0.1, 0.3, (60, 60))
    d[axis**2 + axis[:, None] ** 2 > 900] = 0
    path = tmp_path_factory.mktemp("lens") / "lens.h5"
    lens.save(
        path,
        Lens(
            DiameterMap(d, 0.4),
            Cell(0.4),
            proxy,
            0.85,
            500.0,
            float("inf"),
            "hyperbolic",
        ),
    )
    return path


def run(*words):
    return cli.main(["layout", *map(str, words)])


@pytest.mark.parametrize("words", [("--oasis", "--gds"), ("--stl",)])
def test_a_lens_whose_diameters_stay_in_its_file_gives_the_same_mask(
    lens_file, tmp_path, monkeypatch, words
):
    more = ["--window.size-um", "8"] if "--stl" in words else []
    for name in ("whole", "rows"):
        if name == "rows":  # as of a lens of several millimetres
            monkeypatch.setattr("metalens.lens.record.MOST_HELD_BYTES", 0)
        out = str(tmp_path / name)
        assert cli.main(["layout", str(lens_file), "-o", out, *words, *more]) == 0
    written = [p for p in (tmp_path / "whole").iterdir() if p.suffix in FORMATS]
    assert len(written) >= len(words)
    for path in written:
        assert path.read_bytes() == (tmp_path / "rows" / path.name).read_bytes()


def test_a_lens_becomes_a_mask_with_report(lens_file, tmp_path, capsys):
    target = tmp_path / "mask"
    assert (
        run(
            lens_file,
            "-o",
            target,
            "--dxf",
            "--oasis",
            "--gds",
            "--stl",
            "--window.size-um",
            6,
        )
        == 0
    )
    assert "reads back as planned" in capsys.readouterr().out
    names = {path.name for path in target.iterdir()}
    assert {
        "mask.oas",
        "mask.gds",
        "mask.dxf",
        "mask.lyp",
        "mask.lyrdb",
        "report.html",
        "pillars.stl",
    } <= names
    assert {"die.png", "process.toml", "layout.json"} <= names
    values = json.loads((target / "layout.json").read_text())
    assert values["ok"]
    planned = np.count_nonzero(lens.load(lens_file).diameters.diameter_um)
    for content in (
        layout.read_oasis(target / "mask.oas"),
        layout.read_gdsii(target / "mask.gds"),
    ):
        assert sum(len(x) for x, _ in places(content, "LENS").values()) == planned
    page = (target / "report.html").read_text()
    assert "violations" in page
    assert f"as {planned:,} pillars ({values['pillars']:,} on the die" in page
    assert values["pillars"] > planned
    assert "http://" not in page.replace("http://www.w3.org", "")


def test_a_study_of_a_lens_behind_a_stop_is_refused_before_its_mask_is_made(
    lens_file, tmp_path, monkeypatch, capsys
):
    behind = replace(lens.load(lens_file), layers=Layers(stop=Stop(9.0, 4.0)))
    lens.save(tmp_path / "behind.h5", behind)
    monkeypatch.setattr(make.build, "draw_mask", None)
    assert run(tmp_path / "behind.h5", "-o", tmp_path / "mask", "--study") == 2
    assert "study the same lens designed without layers.stop" in capsys.readouterr().err
    assert not (tmp_path / "mask").exists()


def test_a_corrected_mask_is_certified_and_hands_on_its_lens(
    lens_file, tmp_path, capsys
):
    process = tmp_path / "process.toml"
    process.write_text("[exposure]\nalpha_um = 0.012\nbeta_um = 40.0\neta = 0.7\n")
    target = tmp_path / "mask"
    assert run(lens_file, "--process", process, "-o", target, "--oasis", "--json") == 0
    values = json.loads(capsys.readouterr().out)
    assert values["failures"] == []
    assert values["exposure"]["mask.oas"]["edges"] > 100
    made, designed = (
        lens.load(path).diameters.diameter_um
        for path in (target / "made.h5", lens_file)
    )
    # half a step of 2 nm, and 1 nm of the exposure
    assert np.abs(made - designed).max() < 2.1e-3
    assert (target / "fields.csv").read_text().startswith("sequence,")
    assert "The mask passes its own checks." in (target / "job.txt").read_text()


@pytest.fixture(scope="module")
def made(lens_file, tmp_path_factory):
    """The mask as the command writes it where nothing is asked for."""
    target = tmp_path_factory.mktemp("made") / "mask"
    assert run(lens_file, "-o", target, "--quiet") == 0
    return target


def test_same_input_gives_the_same_masks(lens_file, made, tmp_path):
    assert run(lens_file, "-o", tmp_path / "again", "--quiet") == 0
    for name in (
        "mask.oas",
        "mask.gds",
        "mask.lyp",
        "mask.lyrdb",
        "process.toml",
        "die.png",
    ):
        assert (tmp_path / "again" / name).read_bytes() == (made / name).read_bytes()


def test_a_broken_rule_ends_with_one_and_is_marked(lens_file, tmp_path, capsys):
    process = tmp_path / "process.toml"
    process.write_text("[rules]\nminimum_gap_nm = 130\n[exposure]\ncorrect = false\n")
    target = tmp_path / "mask"
    assert run(lens_file, "--process", process, "-o", target, "--oasis", "--json") == 1
    values = json.loads(capsys.readouterr().out)
    assert not values["ok"]
    assert values["violations"]["space"] > 0
    assert values["failures"] == [
        f"design rules violated: {values['violations']['space']:,} space"
    ]
    rdb = pytest.importorskip("klayout.rdb")
    database = rdb.ReportDatabase()
    database.load(str(target / "mask.lyrdb"))
    shown = sum(1 for _ in database.each_item())
    assert shown == min(values["violations"]["space"], 500)
    assert {c.name() for c in database.each_category() if c.num_items()} == {"space"}


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("[rules]\ngrid_mn = 1\n", "grid_nm"),
        ("[rules]\ngrid_nm = 5\ndiameter_step_nm = 2\n", "coarser"),
        ("[die]\nmargin_um = 20\n", "margin_um"),
        ("[die]\nlabel = 'ÄÖ'\n", "font"),
    ],
)
def test_bad_processes_end_with_two_and_write_nothing(
    lens_file, tmp_path, capsys, text, match
):
    process = tmp_path / "process.toml"
    process.write_text(text)
    assert run(lens_file, "--process", process, "-o", tmp_path / "mask") == 2
    assert match in capsys.readouterr().err
    assert not (tmp_path / "mask").exists()


def test_bad_targets_and_lenses_end_with_two(lens_file, tmp_path, capsys):
    assert run(tmp_path / "none.h5", "-o", tmp_path / "mask") == 2
    assert run(lens_file, "-o", tmp_path / "no" / "mask") == 2
    (tmp_path / "file").write_text("x")
    assert run(lens_file, "-o", tmp_path / "file", "--force") == 2
    assert run(lens_file, "-o", tmp_path / "mask", "--name", "A B") == 2
    capsys.readouterr()
    assert not (tmp_path / "mask").exists()


def test_an_existing_mask_stays_without_force_and_stale_files_go_with_it(
    lens_file, made, tmp_path, capsys
):
    target = shutil.copytree(made, tmp_path / "mask")
    before = (target / "mask.oas").read_bytes()
    assert run(lens_file, "-o", target, "--quiet") == 2
    assert (target / "mask.oas").read_bytes() == before
    assert (
        run(lens_file, "-o", target, "--quiet", "--force", "--oasis", "--name", "B")
        == 0
    )
    assert not (target / "mask.gds").exists()
    assert (target / "mask.oas").read_bytes() != before
    capsys.readouterr()


def test_dxf_of_a_window_reads_in_klayout(plan, tmp_path):
    db = pytest.importorskip("klayout.db")
    window = dxf.DxfWindow(-2.0, 1.0, 4.0)
    count = layout.write_dxf(plan, tmp_path / "m.dxf", window=window)
    inside = [
        k
        for (row, column), k in np.ndenumerate(plan.lattices[0].whole())
        if k and -4000 <= -6000 + 400 * column < 0 and -1000 < 4400 - 400 * row <= 3000
    ]
    assert count == len(inside) > 0
    read = db.Layout()
    options = db.LoadLayoutOptions()
    options.dxf_dbu = 0.001
    options.dxf_polyline_mode = 3  # closed polylines are polygons
    pytest.importorskip("ezdxf")
    read.read(str(tmp_path / "m.dxf"), options)
    layer = next(i for i in read.layer_indexes() if read.get_info(i).name == "PILLAR")
    region = db.Region(read.top_cell().begin_shapes_rec(layer))
    assert region.count() == count
    area = sum(polygon.twice_area(plan.classes[k - 1].outline) for k in inside) / 2
    assert region.area() == area


def test_a_dxf_says_its_unit_and_layers_and_is_written_the_same_twice(plan, tmp_path):
    ezdxf = pytest.importorskip("ezdxf")
    window, path = dxf.DxfWindow(-2.0, 1.0, 4.0), tmp_path / "m.dxf"
    layout.write_dxf(plan, path, window=window)
    drawing = ezdxf.readfile(path)
    assert drawing.units == 13  # micrometres, in the table of $INSUNITS
    assert {"PILLAR": "1/0", "MARKS": "3/0"}.items() <= {
        e.dxf.name: e.description for e in drawing.layers
    }.items()
    layout.write_dxf(plan, tmp_path / "again.dxf", window=window)
    assert path.read_bytes() == (tmp_path / "again.dxf").read_bytes()


def test_dxf_beyond_its_limit_is_refused(plan, tmp_path, monkeypatch):
    monkeypatch.setattr(dxf, "MOST_PILLARS", 3)
    with pytest.raises(ProcessError, match="take at most 3"):
        layout.write_dxf(plan, tmp_path / "m.dxf", window=dxf.DxfWindow(0, 0, 50))
    assert not list(tmp_path.iterdir())


def test_layer_properties_name_every_layer(plan, tmp_path):
    write_lyp(plan, tmp_path / "m.lyp")
    text = (tmp_path / "m.lyp").read_text()
    for source, name in (("1/0@1", "pillar"), ("3/0@1", "marks")):
        assert f"<source>{source}</source>" in text
        assert f"<name>{name}</name>" in text


def test_markers_stand_where_the_violations_are(make_plan, tmp_path):
    rdb = pytest.importorskip("klayout.rdb")
    plan = make_plan(np.array([[7, 7]], np.uint8))
    found = check_plan(plan, DesignRules(minimum_gap_nm=300, minimum_feature_nm=1))
    write_lyrdb(found, plan.name, tmp_path / "m.lyrdb")
    database = rdb.ReportDatabase()
    database.load(str(tmp_path / "m.lyrdb"))
    (item,) = database.each_item()
    box = next(v.box() for v in item.each_value() if v.is_box())
    violation = found.violations[0]
    assert [
        round(1000 * v) for v in (box.left, box.bottom, box.right, box.top)
    ] == list(violation.box)
