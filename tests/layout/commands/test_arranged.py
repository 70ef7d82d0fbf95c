"""``metalens layout ARRANGEMENT.toml``: every pillar of every die of the wafer at its
place, by another reader.
"""

from dataclasses import replace

import numpy as np
import pytest

import layout
from layout.commands import make
from layout.formats import gdsii_write, job_files
from layout.formats.library import QUARTERS, CellReference, MaskCell, MaskLibrary
from metalens import lens
from metalens.cell.record import Cell
from metalens.lens.record import DiameterMap, Lens
from tests.command_line import call, printed
from tests.proxies import proxy_of

SIDES = {"a": 15, "b": 10}


def lens_map(name):
    n = SIDES[name]
    d = np.random.default_rng(n).choice([0.0, 0.12, 0.16, 0.2], (n, n))
    d[0, 0] = d[-1, -1] = 0.12
    return DiameterMap(d, 0.4)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two small lenses, a file of pads made elsewhere (its unit 5 nm), and a process
    without correction.
    """
    target = tmp_path_factory.mktemp("arranged")
    proxy = proxy_of([3.0, 3.0], [0.95], (0.08, 0.32), 0.85, 0.01)
    for name in SIDES:
        made = Lens(
            lens_map(name), Cell(0.4), proxy, 0.85, 500.0, float("inf"), "hyperbolic"
        )
        lens.save(target / f"{name}.h5", made)
    pad = MaskCell(
        "PAD", {(1, 0): [np.array([[0, 0], [400, 0], [400, 200], [0, 200]])]}
    )
    chip = MaskCell("CHIP", {(20, 3): [np.array([[0, 0], [9, 0], [9, 11]])]})
    pads = CellReference(
        "PAD", -8000, 6000, columns=30, rows=2, across=(600, 0), up=(0, 900)
    )
    chip = replace(chip, references=(pads,))
    made = MaskLibrary("PADS", {"PAD": pad, "CHIP": chip}, unit_nm=5.0)
    gdsii_write.write_gdsii(made, target / "pads.gds")
    (target / "process.toml").write_text(
        "[exposure]\ncorrect = false\n[die]\nmargin_um = 330\nverniers = false\n"
    )
    return target


def run(folder, text, target, *words):
    (folder / "arrangement.toml").write_text(text)
    options = [
        "--process",
        str(folder / "process.toml"),
        "-o",
        str(target),
        "--force",
        *words,
    ]
    return call(f"layout {folder}/arrangement.toml", *options)


WAFER = """
name = "WAFER"
[[lens]]
file = "a.h5"
name = "A"
furnished = false
[[lens.at]]
x_um = -37.2
y_um = 11.3
turn_deg = 270
[[lens.at]]
x_um = 30
mirrored = true
columns = 2
rows = 3
step_um = [25, 21.5]
[[lens]]
file = "b.h5"
name = "B"
furnished = false
[[lens.at]]
x_um = -90
[[cell]]
file = "pads.gds"
name = "PADS"
relative_dose = 1.5
checked = false
[wafer]
diameter_mm = 3.2
edge_exclusion_mm = 0.1
pitch_um = [340, 290]
flat_mm = 1.5
mark_um = 120
mark_width_um = 8
[[wafer.marks]]
x_mm = 1.1
y_mm = 0.3
"""


def planned(name):
    """{(x, y) nm: drawn diameter} of a lens's pillars: the first row of the map is the
    lowest of the mask.
    """
    d = lens_map(name).diameter_um
    n = len(d)
    at = (np.arange(n) - (n - 1) / 2) * 400
    return {(at[j], at[i]): d[i, j] for i in range(n) for j in range(n) if d[i, j]}


@pytest.mark.parametrize(
    "kept", [1 << 16, 40]
)  # placements of a cell in memory: all, or rows of lattices as they go
def test_every_pillar_of_every_die_is_where_the_arrangement_puts_it(
    folder, tmp_path, capsys, monkeypatch, kept
):
    db = pytest.importorskip("klayout.db")
    monkeypatch.setattr(make, "KEPT", kept)
    assert run(folder, WAFER, tmp_path / "m", "--json") == 0
    values = printed(capsys)
    table = np.loadtxt(tmp_path / "m" / "dies.csv", delimiter=",", skiprows=1)
    dies = [(round(1000 * x), round(1000 * y)) for x, y in table[:, 3:]]
    assert len(dies) == values["dies"] > 40  # more than one of the readers keeps
    wanted = set()
    for name, x, y, turn in (
        ("a", -37200, 11300, 3),
        *(("a", 30000 + 25000 * i, 21500 * j, 4) for i in range(2) for j in range(3)),
        ("b", -90000, 0, 0),
    ):
        for u, v in planned(name):
            p, q = QUARTERS[turn].apply(np.array(u), np.array(v))
            wanted |= {
                (round(x + float(p) + a), round(y + float(q) + b)) for a, b in dies
            }
    for file in ("mask.gds", "mask.oas"):
        there = db.Layout()
        there.read(str(tmp_path / "m" / file))
        pillars = db.Region(there.top_cell().begin_shapes_rec(there.layer(1, 0)))
        pillars.merged_semantics = False
        found = [p.bbox().center() for p in pillars.each() if p.bbox().width() < 500]
        assert len(found) == len(wanted)
        # pillars are symmetric: the middle of their box is their place, but for one
        # step of the grid
        assert {(p.x, p.y) for p in found} == wanted
        pads = db.Region(there.top_cell().begin_shapes_rec(there.layer(1, 1)))
        # 1.5 of the dose: a datatype of their own
        assert pads.count() == 60 * len(dies)
        assert pads.area() == 60 * len(dies) * 2000 * 1000
    sizes = [
        (tmp_path / "m" / file).stat().st_size for file in ("mask.gds", "mask.oas")
    ]
    lone = [
        (tmp_path / "m" / "A" / file).stat().st_size
        for file in ("mask.gds", "mask.oas")
    ]
    # dies stand in arrays, and the witness pillars of the wafer's mark stand once
    assert sizes[0] < len(dies) * lone[0] / 4
    assert sizes[1] < len(dies) * lone[1] / 4
    page = (tmp_path / "m" / "report.html").read_text()
    assert (
        "NOT CHECKED: the design rules of PADS (checked = false). 2 lenses on a die"
        in page
    )
    sheet = (tmp_path / "m" / "job.txt").read_text()
    assert "mirrored" in sheet
    assert "pads.gds" in sheet
    assert f"{len(dies)} whole dies" in page
    assert (tmp_path / "m" / "wafer.png").is_file()
    held = job_files.read_dose_table(tmp_path / "m" / "doses.csv")
    assert held[1, 0] == 1.0
    assert held[1, 1] == held[20, 3] == 1.5


def test_parts_that_meet_and_rules_that_break_end_with_one_and_are_named(
    folder, tmp_path, capsys
):
    two = '[[lens]]\nfile = "a.h5"\nname = "A"\nfurnished = false\nat = [{x_um = 0}, {x_um = 5.5}]\n'
    assert run(folder, two, tmp_path / "m", "--oasis") == 1
    assert (
        "A at (0, 0) um to A at (5.5, 0) um, pillars: 0.000 um apart"
        in capsys.readouterr().out
    )
    corner = 'name = "B"\nfurnished = false\nat = [{x_um = 4.58, y_um = 4.58}, {x_um = 4.6, y_um = -4.9}]\n'
    beside = two.replace("at = [{x_um = 0}, {x_um = 5.5}]", "at = [{x_um = 0}]")
    assert (
        run(
            folder,
            f'{beside}[[lens]]\nfile = "b.h5"\n{corner}',
            tmp_path / "m",
            "--oasis",
        )
        == 1
    )
    told = capsys.readouterr().out
    # corner to corner of two squares of pillars: only the one of the upper right is
    # nearer than 70 nm
    assert "A at (0, 0) um to B at (4.58, 4.58) um, pillars: 0.000 um apart" in told
    assert "B at (4.6, -4.9) um, pillars" not in told
    pads = '[[cell]]\nfile = "pads.gds"\nname = "PADS"\nchecked = true\n'
    assert run(folder, pads, tmp_path / "m", "--gds") == 1  # 45 by 55 nm on 20/3
    told = capsys.readouterr().out
    assert (
        "  FAILED: PADS: design rules violated: 1 width, 2 corner" in told.splitlines()
    )
    assert "passes its own checks" not in told
    page = (tmp_path / "m" / "report.html").read_text()
    assert (
        "FAILS: PADS: design rules violated: 1 width"
        in page[page.index("<h1") : page.index("<h2")]
    )
    assert run(folder, pads.replace("true", "false"), tmp_path / "m", "--gds") == 0


@pytest.mark.slow  # two corrections and certificates: 20 s
def test_doses_of_lenses_and_their_surroundings_are_corrected_each(
    folder, tmp_path, capsys
):
    (folder / "process.toml").write_text(
        "[exposure]\nalpha_um = 0.012\nbeta_um = 12.0\neta = 0.7\n"
    )
    text = 'name = "DUO"\n[die]\nsize_um = [1500, 800]\n[[lens]]\nfile = "a.h5"\nname = "A"\n'
    text += "at = [{x_um = -40, y_um = 21}, {x_um = 60, turn_deg = 90}]\n"
    assert run(folder, text, tmp_path / "m", "--json") == 0
    values = printed(capsys)
    assert values["failures"] == []
    held = job_files.read_dose_table(tmp_path / "m" / "doses.csv")
    assert len({round(v, 6) for (number, _), v in held.items() if number == 1}) == sum(
        n == 1 for n, _ in held
    )
    content = layout.read_oasis(tmp_path / "m" / "mask.oas")
    drawn = {layer for cell in content.cells.values() for layer in cell.polygons}
    assert not drawn - set(held) - {(10, 0), (7, 0)}
    near = text.replace("x_um = 60", "x_um = -30")
    assert run(folder, near, tmp_path / "m") == 1
    assert (
        "backscatter of one that the doses of the other do not know of"
        in capsys.readouterr().out
    )


def test_a_negative_tone_takes_lenses_with_frames_of_their_own_alone(
    folder, tmp_path, capsys
):
    (folder / "negative.toml").write_text(
        'tone = "negative"\n[die]\nmargin_um = 330\nverniers = false\n'
    )
    words = (
        f"layout {folder}/arrangement.toml --process {folder}/negative.toml --oasis"
        " --quiet"
    )
    one = '[[lens]]\nfile = "b.h5"\nname = "B"\n'
    for text in (
        one + "furnished = false\n",
        one + '[[cell]]\nfile = "pads.gds"\nname = "P"\n',
        one + "furnished = true\n[die]\nsize_um = [900, 800]\n",
    ):
        (folder / "arrangement.toml").write_text(text)
        assert call(f"{words} -o {tmp_path}/n") == 2
        assert "need lenses that are furnished" in capsys.readouterr().err


def test_bad_arrangements_are_refused_by_file_and_key(folder, tmp_path, capsys):
    for text, said in (
        ('name = "X"\n', "need a [[lens]] or a [[cell]]"),
        ('[[cell]]\nfile = "none.gds"\nname = "N"\n', "none.gds"),
        (
            '[[cell]]\nfile = "pads.gds"\nname = "P"\ncell = "PIT"\n',
            "no cell 'PIT' in the mask",
        ),
        ('[[lens]]\nfile = "a.h5"\nname = "A"\nat = [{columns = 2}]\n', "step_um"),
        (
            '[[lens]]\nfile = "a.h5"\nname = "A"\n[wafer]\npitch_um = [100, 900]\n',
            "wafer.pitch_um is 100 along x",
        ),
        ('[[lens]]\nfile = "a.h5"\nname = "A B"\n', "cell name 'A B'"),
    ):
        assert run(folder, text, tmp_path / "n", "--oasis", "--quiet") == 2
        assert said in capsys.readouterr().err
        assert not (tmp_path / "n").exists()
