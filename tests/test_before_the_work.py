"""What a command will need is checked before its work begins."""

import importlib
from types import SimpleNamespace

import numpy as np
import pytest
import tifffile

import layout
from characterize.captures import capture as captures
from layout.gdsii import read as gdsii_read
from layout.process import Process
from metalens import lens
from metalens.cell.record import Cell, Index
from metalens.cli import BAD_INPUT, main
from metalens.commands import design
from metalens.lens.record import DiameterMap, Lens
from metalens.pillars.proxy import Proxy


@pytest.fixture
def untouched(monkeypatch):
    """The work of the commands, which must not begin."""

    def begin(*_, **__):
        pytest.fail("the work began")

    monkeypatch.setattr(captures, "load", begin)
    monkeypatch.setattr(gdsii_read, "read", begin)
    monkeypatch.setattr(design, "_phase", begin)


def test_outputs_that_cannot_be_written_are_refused_before_inputs_are_read(tmp_path, untouched, capsys):
    (tmp_path / "mask.gds").write_bytes(b"\0\6\0\2\0\7")
    (tmp_path / "taken").write_text("mine")
    for words in (
        ["measure", str(tmp_path), "-o", str(tmp_path / "no" / "out")],
        ["check", str(tmp_path / "mask.gds"), "-o", str(tmp_path / "no" / "out.lyrdb")],
        ["measure", str(tmp_path), "-o", str(tmp_path / "taken")],
        ["check", str(tmp_path / "mask.gds"), "-o", str(tmp_path / "taken"), "--force"],
    ):
        assert main(words) == BAD_INPUT
        told = capsys.readouterr().err
        assert "does not exist" in told or "taken" in told
    assert (tmp_path / "taken").read_text() == "mine"


def test_a_wavelength_outside_the_library_is_refused_before_the_search(tmp_path, untouched, monkeypatch, capsys):
    proxy = Proxy(np.array([[8.0, 3.5]]), np.array([[0.9]]), (0.08, 0.21), (0.84, 0.86), 0.0, 0.0)
    swept = SimpleNamespace(cell=Cell(0.3, pillar=Index(3.6)))
    monkeypatch.setattr(design, "_pillars", lambda *_: (swept, {}))
    monkeypatch.setattr(design.library, "proxy_of", lambda _: proxy)
    (tmp_path / "d.toml").write_text('profile = "fisher"\nwavelength_nm = 940.0\naperture_mm = 0.05\n')
    assert main(["design", str(tmp_path / "d.toml"), "-o", str(tmp_path / "l.h5")]) == BAD_INPUT
    assert "um, but the proxy holds from 0.84 to 0.86 um" in capsys.readouterr().err


# verb: words that need an output, with inputs that are there; and what must not be called
NEEDS = {
    "library": ("cell.toml", "metalens.pillars.sweep:sweep"),
    "design": ("design.toml", "metalens.commands.design:_make"),
    "psf": ("lens.h5", "metalens.commands.psf:_make"),
    "export": ("lens.h5 --samples 9", "metalens.lens.export:write"),
    "scene": ("scene.toml", "codesign.commands.scene:_make"),
    "layout": ("lens.h5", "layout.commands.layout:_prepare"),
    "capture": ("lens.h5 --truth truth.toml", "characterize.bench.bench:shoot"),
    "measure": ("captures", "characterize.commands.measure:_frames"),
    "fit": ("captures --design lens.h5", "characterize.commands.fit:fit"),
    "codesign": ("run.toml", "codesign.commands.codesign:_work"),
    "evaluate": ("optics lens.h5", "codesign.commands.evaluate_optics:_measure"),
    "budget": ("lens.h5", "codesign.budget.links:entries"),
    "plan": ("--gaze-error 1deg", "codesign.budget.plan:pilot"),
    "check": ("mask.gds", "layout.rules.foreign:check"),
    "study": ("", "metalens.pillars.study:run"),
    "view": ("lens.h5", "metalens.commands.view:_shown"),
}
NAMES = {"library": "o.h5", "design": "o.h5", "psf": "o.h5", "export": "o.npz", "fit": "o.h5", "budget": "o.h5",
         "check": "o.lyrdb", "view": "o.html"}  # fmt: skip


@pytest.fixture
def inputs(tmp_path, monkeypatch):
    """Small good inputs of every verb, in the current folder."""
    monkeypatch.chdir(tmp_path)
    proxy = Proxy(np.array([[8.0, 3.5]]), np.array([[0.9]]), (0.08, 0.21), (0.85, 0.85), 0.0, 0.0)
    diameters = np.linspace(0.08, 0.21, 36, dtype=np.float32).reshape(6, 6)
    made = Lens(DiameterMap(diameters, 0.3), Cell(0.3, pillar=Index(3.6)), proxy, 0.85, 2000.0, 20_000.0, "map")
    lens.save("lens.h5", made)
    layout.write_gdsii(layout.plan(made, Process()), "mask.gds")
    texts = {"cell": "[cell]\npitch_um = 0.3\npillar = {n = 3.6}\n", "design": "aperture_mm = 0.02\n", "scene": "",
             "truth": "depths_um = [20000.0]\n", "run": 'preset = "smoke"\n'}  # fmt: skip
    for name, text in texts.items():
        (tmp_path / f"{name}.toml").write_text(text)
    (tmp_path / "captures").mkdir()
    frames = np.arange(3 * 12 * 14, dtype=np.uint16).reshape(3, 12, 14) % 97
    tifffile.imwrite(tmp_path / "captures" / "f.tif", frames, photometric="minisblack")
    rows = "".join(f"f.tif,{k},{18 + k},0.0,0.01\n" for k in range(3))
    (tmp_path / "captures" / "stage.csv").write_text("file,page,depth_mm,angle_deg,exposure_s\n" + rows)
    (tmp_path / "captures" / "capture.toml").write_text("pixel_um = 3.0\nwavelength_um = 0.85\nbits = 10\n")
    return tmp_path


def tree(folder):
    return {p.relative_to(folder).as_posix(): p.is_file() and p.read_bytes() for p in folder.rglob("*")}


@pytest.mark.parametrize("verb", sorted(NEEDS))
def test_no_command_begins_where_its_output_cannot_stand(inputs, monkeypatch, capsys, verb):
    """No folder, a file for a folder, another's work, its own input by links, no name, the folder of its input."""
    words, work = NEEDS[verb]
    module, _, name = work.partition(":")
    monkeypatch.setattr(importlib.import_module(module), name, lambda *_, **__: pytest.fail("the work began"))
    output = NAMES.get(verb, "o")
    (inputs / "thesis").mkdir()
    (inputs / "thesis" / output).write_text("years of work")
    (inputs / "file").write_text("mine")
    first = next((w for w in words.split() if "." in w and not w.startswith("-")), "lens.h5")
    targets = [f"no/{output}", f"file/{output}", f"thesis/{output}", ".", "/", f"{'x' * 300}{output}"]
    if verb in NAMES:
        (inputs / f"link{output}").symlink_to(inputs / first)
        (inputs / f"hard{output}").hardlink_to(inputs / first)
        targets += ["thesis", f"link{output}", f"hard{output}"]
    else:
        targets += ["thesis", "file", str(inputs)]
    if verb == "codesign":  # which makes the folders above its own
        targets.remove(f"no/{output}")
    before = tree(inputs)
    for target in targets:
        assert main([verb, *words.split(), "-o", target, "--force"]) == BAD_INPUT, target
        told = capsys.readouterr().err
        assert "not foreseen" not in told
        assert told.count("\n") == 1, told
        assert tree(inputs) == before


@pytest.mark.parametrize(
    "words", ["library cell.toml -o o.png", "design design.toml -o o.png", "budget lens.h5 -o o.png"]
)
def test_a_result_does_not_take_the_name_of_its_own_picture(inputs, capsys, words):
    assert main(words.split()) == BAD_INPUT
    assert "o.png" in capsys.readouterr().err
    assert not (inputs / "o.png").exists()
