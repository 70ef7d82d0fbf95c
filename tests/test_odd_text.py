"""NUL bytes, a byte order mark, names of files in no encoding: every command takes them
or refuses in one line.
"""

import importlib
import os
from pathlib import Path

import numpy as np
import pytest

from metalens.cli import BAD_INPUT, main
from metalens.ground import reading, store
from metalens.ground.errors import MetalensError
from tests.test_before_the_work import NAMES, NEEDS, inputs, tree  # noqa: F401 (a fixture)

CELL = "[cell]\npitch_um = 0.3\npillar = {n = 3.6}\n"
PUPIL = "numerical_aperture = 0.5\nwavelength_um = 0.6\npixel_um = 0.1\nstep_um = 0.5\n"
CHAIN = "cell = 'cell.toml'\ndesign = 'design.toml'\nprocess = 'process.toml'\n"
WORK = {verb: work for verb, (_, work) in NEEDS.items()} | {
    "layout": "layout.mask.build:prepare"
}
LENS = "lens = [{file = 'lens.h5', name = 'A', at = [{x_um = 3.0}]}]\n"
# what reads settings: words with the file's name, a good text, and the work that must
# begin with it
SETTINGS = {
    "library": ("library s.toml -o o.h5", CELL, WORK["library"]),
    "study": ("study s.toml -o o", "pitches_um = [0.3]\n", WORK["study"]),
    "field": ("field s.toml --diameter-um 0.12 -o o.h5", CELL, WORK["field"]),
    "design": ("design s.toml -o o.h5", "aperture_mm = 0.02\n", WORK["design"]),
    "psf": ("psf lens.h5 --config s.toml -o o.h5", "samples = 32\n", WORK["psf"]),
    "scene": ("scene s.toml -o o", "frames = 1\n", WORK["scene"]),
    "layout": ("layout lens.h5 --process s.toml -o o", "name = 'x'\n", WORK["layout"]),
    "arrangement": ("layout s.toml -o o", LENS, "layout.commands.arranged:_whole"),
    "check": ("check mask.gds --process s.toml -o o.lyrdb", "name = 'x'\n", WORK["check"]),
    "capture": ("capture lens.h5 --truth s.toml -o o", "depths_um = [20000.0]\n", WORK["capture"]),
    "protocol": ("capture lens.h5 --protocol s.toml -o o.csv", "depths_um = [18e3, 22e3]\n",
                 "characterize.bench.protocol:plan"),
    "metrology": ("fit captures --design lens.h5 --metrology s.toml -o o.h5", "window = 40\n", WORK["fit"]),
    "pupil": ("fit captures --pupil s.toml -o o.h5", PUPIL, "characterize.commands.fit:fit_pupil"),
    "codesign": ("codesign s.toml -o o", "preset = 'smoke'\n", WORK["codesign"]),
    "evaluate": ("evaluate optics lens.h5 --config s.toml -o o", "[axial]\ncount = 3\n", WORK["evaluate"]),
    "budget": ("budget lens.h5 --process s.toml -o o.h5", "name = 'x'\n", WORK["budget"]),
    "demo": ("demo o --config s.toml", CHAIN, "metalens.commands.demo:_chain"),
}  # fmt: skip


@pytest.fixture
def begins(inputs, monkeypatch):  # noqa: F811
    """Words of a command, and the work that is to say so in place of being done:
    whether it began.
    """
    (inputs / "process.toml").write_text("name = 'x'\n")

    def said(capsys, words, work):
        def begin(*_, **__):
            raise MetalensError("the work began")

        module, _, name = work.partition(":")
        if name:
            monkeypatch.setattr(importlib.import_module(module), name, begin)
        assert main(words) == BAD_INPUT
        told = capsys.readouterr().err
        assert told.count("\n") == 1, told
        assert "not foreseen" not in told
        return told == "metalens: error: the work began\n" or told

    return said


@pytest.mark.parametrize("case", sorted(SETTINGS))
def test_a_byte_order_mark_before_settings_changes_nothing(
    inputs,  # noqa: F811
    begins,
    capsys,
    case,
):
    words, text, work = SETTINGS[case]
    (inputs / "s.toml").write_bytes(text.replace("\n", "\r\n").encode("utf-8-sig"))
    assert begins(capsys, words.split(), work) is True


@pytest.mark.parametrize("case", sorted(SETTINGS))
def test_settings_with_nul_bytes_or_of_no_encoding_are_refused_by_name(
    inputs,  # noqa: F811
    begins,
    capsys,
    case,
):
    words, text, work = SETTINGS[case]
    for odd in (
        text.encode().replace(b"=", b"=\0", 1),
        text.encode() + b"#\0\n",
        b"\0" * 9,
        text.encode("utf-16"),
    ):
        (inputs / "s.toml").write_bytes(odd)
        before = tree(inputs)
        assert "s.toml" in begins(capsys, words.split(), work)
        assert tree(inputs) == before


@pytest.mark.parametrize("verb", sorted(NEEDS))
def test_no_command_begins_with_nul_in_a_name(inputs, begins, capsys, verb):  # noqa: F811
    words, work = NEEDS[verb][0], WORK[verb]
    given, output = [verb, *words.split()], NAMES.get(verb, "o")
    trials = [[*given, "-o", f"a\0{output}"], [*given, "-o", f"no\0where/{output}"]]
    for i, word in enumerate(given[1:], 1):
        if Path(word).exists():
            trials.append([*given[:i], f"a\0{word}", *given[i + 1 :], "-o", output])
    before = tree(inputs)
    for trial in trials:
        assert (
            begins(capsys, trial, "" if verb in ("view", "measure") else work)
            is not True
        ), trial  # work that reads
        assert tree(inputs) == before


@pytest.mark.parametrize("verb", sorted(NEEDS))
def test_a_name_in_bytes_of_no_encoding_is_a_name(inputs, begins, capsys, verb):  # noqa: F811
    words, work = NEEDS[verb][0], WORK[verb]
    given = [verb, *words.split()]
    first = next((i for i, word in enumerate(given) if i and Path(word).exists()), None)
    if first is not None:
        name = f"gr\udcf6\udcdfe{given[first]}"
        os.rename(given[first], name)
        given[first] = name
    assert begins(capsys, [*given, "-o", f"\udcb5{NAMES.get(verb, 'o')}"], work) is True


def test_names_in_bytes_of_no_encoding_are_written_as_text(tmp_path):
    """UTF-8 under a locale of ASCII becomes what it stands for, other bytes become
    codes.
    """
    name = "gr\udcc3\udcb6sse \udcff"
    assert reading.shown(name) == "grösse \\xff"
    assert reading.shown("\ud800 ö") == "\\ud800 ö"
    store.write_text(tmp_path / "t.txt", name + "\n")
    store.append_line(tmp_path / "t.txt", name)
    assert (tmp_path / "t.txt").read_text("utf-8") == "grösse \\xff\n" * 2
    made = store.Provenance(config=name, inputs={name: "00"})
    store.save(
        tmp_path / "f.h5",
        "psf",
        {"a": np.array([name, "b"])},
        attributes={"x": name},
        provenance=made,
    )
    back = store.load(tmp_path / "f.h5", "psf")
    assert [
        back.arrays["a"][0].decode(),
        back.attributes["x"],
        back.provenance.config,
    ] == ["grösse \\xff"] * 3
    assert dict(back.provenance.inputs) == {"grösse \\xff": "00"}
