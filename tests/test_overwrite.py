"""Nothing that exists is overwritten without --force by any command; half-written runs,
other versions are named.
"""

import json

import numpy as np
import pytest

import layout
from layout.process.process import Process
from metalens import cli, lens
from metalens.cell.record import Cell, Index
from metalens.core import store
from metalens.lens.record import DiameterMap, Lens
from metalens.library.proxy import Proxy
from tests.command_line import run

# verb: words after it, and the target that already exists; %s is the folder of inputs
CASES = {
    "library": ("cell.toml -o out.h5", "out.h5"),
    "study": ("-o out", "out"),
    "field": ("cell.toml --diameter-um 0.12 -o out.h5", "out.h5"),
    "design": ("design.toml -o out.h5", "out.h5"),
    "psf": ("lens.h5 -o out.h5", "out.h5"),
    "lens-report": ("lens.h5 -o out.h5", "out.h5"),
    "export": ("lens.h5 -o out.npz", "out.npz"),
    "scene": ("scene.toml -o out", "out"),
    "layout": ("lens.h5 -o out", "out"),
    "capture": ("lens.h5 --truth truth.toml -o out", "out"),
    "fit": ("captures --design lens.h5 -o out.h5", "out.h5"),
    "codesign": ("run.toml -o out", "out"),
    "retrain": ("run --optics asbuilt.h5 -o out", "out"),
    "evaluate": ("optics lens.h5 -o out", "out"),
    "budget": ("lens.h5 -o out.h5", "out.h5"),
    "demo": ("out", "out"),
    "check": ("mask.gds -o out.h5", "out.h5"),
    "dose": ("mask.gds --process scene.toml -o out", "out"),
    "measure": ("captures -o out", "out"),
    "view": ("lens.h5 -o out.h5", "out.h5"),
}
READS_ONLY = {"info"}


@pytest.fixture
def folder(tmp_path):
    """Inputs for every command: good enough to get as far as the question of the
    target.
    """
    proxy = Proxy(
        np.array([[8.0, 3.5]]), np.array([[0.9]]), (0.08, 0.21), (0.85, 0.85), 0.0, 0.0
    )
    diameters = np.linspace(0.08, 0.21, 64, dtype=np.float32).reshape(8, 8)
    made = Lens(
        DiameterMap(diameters, 0.3),
        Cell(0.3, pillar=Index(3.6)),
        proxy,
        0.85,
        2000.0,
        20_000.0,
        "map",
    )
    lens.save(tmp_path / "lens.h5", made)
    layout.write_gdsii(layout.plan(made, Process()), tmp_path / "mask.gds")
    (tmp_path / "cell.toml").write_text("[cell]\npitch_um = 0.3\npillar = {n = 3.6}\n")
    (tmp_path / "design.toml").write_text("aperture_mm = 0.02\n")
    (tmp_path / "truth.toml").write_text("depths_um = [20000.0]\n")
    (tmp_path / "run.toml").write_text('preset = "smoke"\n')
    (tmp_path / "scene.toml").write_text("")
    return tmp_path


def _run(folder, verb, words):
    done = run(f"{verb}", *words.split(), cwd=folder)
    assert "not foreseen" not in done.stderr, done.stderr
    return done


def test_every_verb_is_covered():
    assert set(CASES) | READS_ONLY == set(cli.VERBS)


@pytest.mark.parametrize("verb", sorted(CASES))
def test_what_exists_is_kept(folder, verb):
    words, target = CASES[verb]
    if target.endswith(".h5"):
        precious = folder / target
    else:
        (folder / target).mkdir()
        precious = folder / target / "precious.txt"
    precious.write_text("precious")
    done = _run(folder, verb, words)
    assert done.returncode == cli.BAD_INPUT, done.stdout
    assert precious.read_text() == "precious"
    assert (
        sorted(p.name for p in precious.parent.rglob("*") if p.name.startswith("."))
        == []
    )


def test_a_run_folder_half_written_is_named(folder):
    """Started but never finished: no result, and no checkpoint to resume from."""
    (folder / "half").mkdir()
    (folder / "half" / "run.toml").write_text('preset = "smoke"\n')
    for verb, words in (
        ("budget", "lens.h5 --run half -o b.h5"),
        ("codesign", "run.toml -o half --resume"),
    ):
        done = _run(folder, verb, words)
        assert done.returncode == cli.BAD_INPUT
        assert "half" in done.stderr
        assert not (folder / "b.h5").exists()


def test_an_artefact_of_another_version_is_named(folder):
    held = store.load(folder / "lens.h5")
    store.save(
        folder / "old.h5", "lens", held.arrays, version=99, attributes=held.attributes
    )
    for verb, words in (
        ("psf", "old.h5 -o p.h5"),
        ("layout", "old.h5 -o m"),
        ("budget", "old.h5 -o b.h5"),
    ):
        done = _run(folder, verb, words)
        assert done.returncode == cli.BAD_INPUT
        assert "version 99, need 'lens' version 1" in done.stderr
    assert json.loads(_run(folder, "info", "old.h5 --json").stdout)["version"] == 99
