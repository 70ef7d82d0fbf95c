"""A byte order mark, NUL bytes and names in no encoding: commands take them or refuse
them in one line.
"""

import os
import shutil

import pytest

from metalens.cli import BAD_INPUT, SUCCESS
from tests.command_line import run

ODD = os.fsdecode(b"gr\xf6\xdfe_\xb5")  # Latin letters where names are UTF-8


@pytest.fixture
def place(small_chain, tmp_path):
    """Files of the small lens in a folder of the test's own."""
    for name in ("library.h5", "lens.h5"):
        shutil.copy(small_chain[name], tmp_path)
    for path in small_chain.folder.glob("*.toml"):
        shutil.copy(path, tmp_path)
    shutil.copy(small_chain.folder / "phase.npy", tmp_path)
    return tmp_path


SETTINGS = {
    "library": ("library", "cell.toml"),
    "design": ("design", "design.toml"),
    "psf": ("psf", "lens.h5", "--config", "psf.toml"),
    "layout": ("layout", "lens.h5", "--process", "process.toml"),
    "capture": ("capture", "lens.h5", "--truth", "truth.toml"),
    "codesign": ("codesign", "run.toml"),
    "demo": ("demo", "--config", "chain.toml"),
}


def one_line(done):
    assert done.returncode == BAD_INPUT
    assert done.stderr.count("\n") == 1, done.stderr
    assert "not foreseen" not in done.stderr


@pytest.mark.parametrize("verb", SETTINGS)
@pytest.mark.parametrize("bad", [b"name = 'a\0b'\n", b"name = '\xff\xfe'\n"])
def test_settings_with_nul_bytes_or_of_no_encoding_are_refused(place, verb, bad):
    words = SETTINGS[verb]
    (place / words[-1]).write_bytes(bad)
    output = ["out"] if verb == "demo" else ["-o", "out"]
    done = run(*words[:1], *output, *words[1:], cwd=place)
    one_line(done)
    assert words[-1] in done.stderr
    assert not (place / "out").exists()


def test_a_byte_order_mark_before_settings_changes_nothing(place):
    (place / "design.toml").write_bytes(
        b"\xef\xbb\xbf" + (place / "design.toml").read_bytes()
    )
    assert run("design", "design.toml", "-o", "new.h5", cwd=place).returncode == SUCCESS
    assert (place / "new.h5").stat().st_size == (place / "lens.h5").stat().st_size


@pytest.mark.parametrize("verb", ["psf", "capture"])
def test_a_name_in_no_encoding_is_a_name(place, verb):
    (place / "lens.h5").rename(place / f"{ODD}.h5")
    words = [f"{ODD}.h5" if word == "lens.h5" else word for word in SETTINGS[verb]]
    output = f"{ODD}_out.h5" if verb == "psf" else f"{ODD}_out"
    done = run(*words, "-o", output, cwd=place)
    assert done.returncode == SUCCESS, ascii(done.stderr)
    assert (place / output).exists()


@pytest.mark.parametrize("words", [("info", "a\0b"), ("psf", "lens.h5", "-o", "a\0b")])
def test_nul_in_a_name_is_refused(place, words):
    one_line(run(*words, cwd=place))
