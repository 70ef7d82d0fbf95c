"""``metalens check`` says what it looked at, and agrees with KLayout's projections."""

import gzip

import numpy as np
import pytest

from layout.drc.library import check_library
from layout.formats.reading import read_mask
from layout.process.process import DesignRules
from tests.command_line import call, printed

db = pytest.importorskip("klayout.db")

MOST = 110  # nm; least widths and spaces are sought below it


def polygon(points):
    return db.Polygon([db.Point(*map(int, np.rint(p))) for p in points])


def write(path, layers, *, build=None):
    """A top cell T with polygons: {(layer, datatype): [points]}."""
    made = db.Layout()
    top = made.create_cell("T")
    for layer, shapes in layers.items():
        for points in shapes:
            top.shapes(made.layer(*layer)).insert(polygon(points))
    if build is not None:
        build(made, top)
    made.write(str(path))


def run(capsys, *arguments):
    """Exit code and values of the command."""
    code = call("check", *map(str, arguments), "--json")
    return code, printed(capsys)


def box(x, y, width=300, height=200):
    return [(x, y), (x + width, y), (x + width, y + height), (x, y + height)]


CLOSE = [box(0, 0), box(310, 0)]  # 10 nm apart


@pytest.mark.parametrize("layer", [(10, 0), (7, 3), (255, 9)])
@pytest.mark.parametrize("suffix", ["gds", "oas"])
def test_every_layer_of_a_foreign_file_is_checked(tmp_path, capsys, layer, suffix):
    write(tmp_path / f"m.{suffix}", {layer: CLOSE, (1, 0): [box(0, 4000)]})
    code, values = run(capsys, tmp_path / f"m.{suffix}")
    assert (code, values["ok"]) == (1, False)
    assert values["violations"]["space"] == 1
    name = f"{layer[0]}/{layer[1]}"
    assert values["layers"] == {
        "1/0": {"checked": True, "shapes": 1},
        name: {"checked": True, "shapes": 2},
    }
    (worst,) = values["worst"]
    assert worst == {
        "rule": "space",
        "layer": layer[0],
        "cell": "T",
        "count": 1,
        "worst": 10.0,
        "limit": 70.0,
    }


def test_layers_not_chosen_are_listed_and_nothing_checked_is_no_pass(tmp_path, capsys):
    path = tmp_path / "m.gds"
    write(path, {(10, 0): CLOSE, (10, 4): [box(0, 900)], (2, 0): [box(0, 0)]})
    code, values = run(capsys, path, "--layers", "2")
    assert (code, values["ok"], values["shapes"]) == (0, True, 1)
    assert values["layers"]["10/0"] == {"checked": False, "shapes": 2}
    code, values = run(capsys, path, "--layers", "10/4", "2")
    assert (code, values["layers"]["10/0"]["checked"]) == (0, False)
    code, values = run(capsys, path, "--layers", "11")
    assert (code, values["ok"]) == (1, False)
    assert values["failures"] == [
        "nothing is drawn on layer 11",
        "no shape was checked",
    ]
    assert call(f"check {path} --layers 2") == 0
    assert "layer 10/0: 2 shapes, NOT CHECKED" in capsys.readouterr().out
    assert call(f"check {path} --layers two") == 2
    assert "need LAYER or LAYER/DATATYPE" in capsys.readouterr().err


def test_a_file_without_shapes_does_not_pass(tmp_path, capsys):
    write(tmp_path / "m.oas", {})
    code, values = run(capsys, tmp_path / "m.oas")
    assert (code, values["ok"], values["shapes"]) == (1, False, 0)
    write(tmp_path / "t.gds", {}, build=lambda made, top: top.shapes(
        made.layer(1, 0)).insert(db.Text("label", db.Trans(3, 4))))  # fmt: skip
    code, values = run(capsys, tmp_path / "t.gds")
    assert (code, values["skipped"]) == (1, {"text": 1})


def test_one_top_cell_of_several_is_chosen(tmp_path, capsys):
    def build(made, top):
        other = made.create_cell("OTHER")
        inner = made.create_cell("INNER")
        inner.shapes(made.layer(1, 0)).insert(db.Box(0, 0, 400, 100))
        for x in (0, 405):
            other.insert(db.CellInstArray(inner.cell_index(), db.Trans(x, 0)))

    path = tmp_path / "m.gds"
    write(path, {(1, 0): [box(0, 0)]}, build=build)
    code, values = run(capsys, path)
    assert (code, sorted(values["tops"]), values["shapes"]) == (1, ["OTHER", "T"], 3)
    code, values = run(capsys, path, "--top", "T")
    assert (code, values["tops"], values["shapes"]) == (0, ["T"], 1)
    code, values = run(capsys, path, "--top", "OTHER")
    assert (code, values["violations"]["space"], values["shapes"]) == (1, 1, 2)
    code, values = run(capsys, path, "--top", "INNER")
    assert (code, values["shapes"]) == (0, 1)
    assert call(f"check {path} --top NONE") == 2
    assert "no cell 'NONE' in the mask; top cells: " in capsys.readouterr().err
    assert call(f"info {path} --top INNER --json") == 0
    info = printed(capsys)
    assert (info["tops"], info["layers"]["1/0"]["shapes"]) == (["INNER"], 1)


def test_the_context_cell_of_klayout_is_no_drawing(tmp_path, capsys):
    """KLayout writes its library cells below ``$$$CONTEXT_INFO$$$``: shapes that it does
    not count itself.
    """

    def build(made, top):
        part = made.create_cell("PART")
        part.shapes(made.layer(1, 0)).insert(db.Box(0, 0, 200, 40))
        context = made.create_cell("$$$CONTEXT_INFO$$$")
        for cell in (part, top):
            context.insert(db.CellInstArray(cell.cell_index(), db.Trans(7, 7)))
        top.insert(db.CellInstArray(part.cell_index(), db.Trans(0, 3000)))

    write(tmp_path / "m.gds", {(1, 0): [box(0, 0)]}, build=build)
    code, values = run(capsys, tmp_path / "m.gds")
    assert (code, values["tops"], values["shapes"]) == (1, ["T"], 2)
    assert values["violations"]["width"] == 1


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("m.dxf", b"  0\r\nSECTION\r\n  2\r\nHEADER\r\n", "a DXF drawing"),
        ("m.dxf", b"AutoCAD Binary DXF\r\n\x1a\0", "a DXF drawing"),
        ("m.cif", b"DS 1 1 1;\n9 top;\nL L1;\n", "a CIF file"),
        ("m.cif", b"(made by hand);\nDS 1;\n", "a CIF file"),
        ("m.gds.gz", gzip.compress(b"\0\6\0\2\2X" * 40, mtime=0), "a compressed file"),
    ],
)
@pytest.mark.parametrize("command", ["check", "info"])
def test_files_of_other_formats_are_named(tmp_path, capsys, name, data, words, command):
    (tmp_path / name).write_bytes(data)
    assert call(command, f"{tmp_path}/{name}") == 2
    said = capsys.readouterr().err
    assert words in said
    assert "GDSII or OASIS" in said


def disc(radius, corners=64, turn=0.0):
    angle = 2 * np.pi * np.arange(corners) / corners + turn
    return radius * np.column_stack([np.cos(angle), np.sin(angle)])


@pytest.mark.parametrize("suffix", ["gds", "oas"])
def test_a_disc_placed_at_any_angle_is_as_wide_as_itself(tmp_path, capsys, suffix):
    """Rounding rotated corners to the grid dents the disc; its chords are no widths."""

    def build(made, top):
        cell = made.create_cell("DISC")
        cell.shapes(made.layer(1, 0)).insert(polygon(disc(49.5)))
        for n in range(40):
            turn = db.ICplxTrans(1.0, 45.0 if n == 0 else 9.7 * n, n % 2, 400 * n, 0)
            top.insert(db.CellInstArray(cell.cell_index(), turn))

    write(tmp_path / f"m.{suffix}", {}, build=build)
    process = tmp_path / "p.toml"
    process.write_text("[rules]\nminimum_feature_nm = 95\n")
    code, values = run(capsys, tmp_path / f"m.{suffix}", "--process", process)
    assert (code, values["shapes"], values["violations"]["width"]) == (0, 40, 0)
    assert values["minimum_width_nm"] == pytest.approx(99, abs=2**0.5)


def rectangle(rng):
    return np.array(box(0, 0, rng.uniform(60, 300), rng.uniform(100, 600)))


def angle(rng):
    w, h = rng.integers(200, 900, 2).tolist()
    a, b = int(rng.integers(40, w - 30)), int(rng.integers(40, h - 30))
    return np.array([(0, 0), (w, 0), (w, b), (a, b), (a, h), (0, h)])


def round_shape(rng):
    return disc(rng.uniform(30, 150), 64, rng.uniform(0, 1))


def arc(rng):
    along = disc(1.0, 64)[: int(rng.integers(17, 50))]
    radius, width = rng.uniform(200, 400), rng.uniform(40, 150)
    return np.vstack([along * (radius + width / 2), along[::-1] * (radius - width / 2)])


def touches(pair):
    ends = [{(e.p1.x, e.p1.y), (e.p2.x, e.p2.y)} for e in (pair.first, pair.second)]
    return bool(ends[0] & ends[1])


def klayout_least(region, check):
    """Largest whole limit up to MOST without a pair of edges, corners left out."""

    def is_kept(limit):
        found = getattr(region, check)(
            limit, False, db.Metrics.Projection, None, None, None
        )
        return all(touches(pair) for pair in found.each())

    low, high = 0, MOST + 1
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if is_kept(middle) else (low, middle)
    return low


KINDS = {
    "upright": ((rectangle, angle), False, 0),
    "any angle": ((rectangle, angle), True, 2),
    "round": ((round_shape, arc), True, 2),
}


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("kind", KINDS)
def test_least_width_and_space_are_those_of_klayout_in_projection(tmp_path, kind, seed):
    """Overlapping and touching shapes in a hierarchy of two levels, quarter turns.

    Tolerance: exact for upright shapes; 2 nm otherwise, for the rounding of corners
    where shapes are merged and the whole limits of KLayout.
    """
    makers, is_turned, tolerance = KINDS[kind]
    rng = np.random.default_rng(seed)
    made = db.Layout()
    top = made.create_cell("T")
    sub = made.create_cell("SUB")
    layer = made.layer(3, 1)
    for n in range(int(rng.integers(2, 10))):
        points = makers[n % 2](rng)
        a = rng.uniform(0, 7) if is_turned else rng.integers(4) * np.pi / 2
        c, s = np.cos(a), np.sin(a)
        points = points @ [[c, s], [-s, c]] + rng.integers(-1500, 1500, 2)
        (sub if n == 1 else top).shapes(layer).insert(polygon(points))
    steps = db.Vector(int(rng.integers(700, 1300)), 40), db.Vector(-30, 1100)
    at = db.Trans(seed % 8, 50, -70)
    top.insert(db.CellInstArray(sub.cell_index(), at, *steps, 2, 3))
    path = tmp_path / f"m.{('gds', 'oas')[seed % 2]}"
    made.write(str(path))
    rules = DesignRules(minimum_gap_nm=MOST, minimum_feature_nm=MOST)
    report = check_library(read_mask(path), rules)
    region = db.Region(top.begin_shapes_rec(layer)).merged()
    holes = [hole for p in region.each() for hole in range(p.holes())]
    if is_turned and holes:
        pytest.skip("a triangular hole is a notch here, corners alone for KLayout")
    least = {
        "minimum_width_nm": klayout_least(region, "width_check"),
        "minimum_space_nm": min(
            klayout_least(region, "space_check"), klayout_least(region, "notch_check")
        ),
    }
    for name, theirs in least.items():
        own = min(np.floor(getattr(report, name) + 1e-9), MOST)
        assert abs(own - theirs) <= tolerance


@pytest.mark.parametrize("seed", range(6))
def test_a_hierarchy_is_checked_as_its_flattened_drawing(tmp_path, seed):
    """Three levels with arrays, mirrors and quarter turns, dies near each other."""
    rng = np.random.default_rng(seed)
    made = db.Layout()
    layer = made.layer(4, 0)
    leaf, block, top = (made.create_cell(name) for name in ("LEAF", "BLOCK", "TOP"))
    for _ in range(3):
        points = angle(rng) + rng.integers(-600, 600, 2)
        leaf.shapes(layer).insert(polygon(points))
    for cell, parent, pitch, turns in ((leaf, block, 2600, 8), (block, top, 9000, 4)):
        for n in range(2):
            at = db.Trans(int(rng.integers(turns)), n * 4 * pitch, 30 * n)
            steps = db.Vector(pitch, 0), db.Vector(7, pitch - 240 * seed)
            parent.insert(db.CellInstArray(cell.cell_index(), at, *steps, 3, 2))
    block.shapes(layer).insert(db.Box(-900, -900, -860, 3000))
    path = tmp_path / "m.oas"
    made.write(str(path))
    rules = DesignRules(minimum_gap_nm=90, minimum_feature_nm=95)
    report = check_library(read_mask(path), rules)
    made.flatten(top.cell_index(), -1, True)
    made.write(str(tmp_path / "flat.oas"))
    flat = check_library(read_mask(tmp_path / "flat.oas"), rules)
    assert report.counts == flat.counts
    assert report.sizes == flat.sizes
    assert report.shapes == flat.shapes
    assert report.counts["width"] > 5


def test_a_wafer_of_isolated_dies_is_counted_by_products(tmp_path, capsys):
    """2 nm too narrow once in a die of 10^6 shapes placed 2 500 times."""
    made = db.Layout()
    layer = made.layer(1, 0)
    pillar, die, top = (made.create_cell(name) for name in ("P", "DIE", "WAFER"))
    pillar.shapes(layer).insert(polygon(disc(80)))
    steps = db.Vector(300, 0), db.Vector(0, 300)
    die.insert(
        db.CellInstArray(pillar.cell_index(), db.Trans(0, 0), *steps, 1000, 1000)
    )
    die.shapes(layer).insert(db.Box(0, -1000, 900, -922))
    steps = db.Vector(400_000, 0), db.Vector(0, 400_000)
    top.insert(db.CellInstArray(die.cell_index(), db.Trans(0, 0), *steps, 50, 50))
    made.write(str(tmp_path / "wafer.oas"))
    code, values = run(capsys, tmp_path / "wafer.oas")
    assert (code, values["shapes"]) == (1, 2500 * (1000 * 1000 + 1))
    assert values["violations"]["width"] == 2500
    assert values["worst"][0]["cell"] == "DIE"
