"""What is damaged, endless or foreign is refused by type, before memory is taken; what
nobody foresaw is one line.
"""

import math
import tomllib
from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from metalens import cli, psf
from metalens.commands import design
from metalens.core import config, store
from metalens.core.errors import ConfigError, LensError, StoreError
from metalens.core.foreign_arrays import read_matlab
from tests.command_line import call


@dataclass(frozen=True)
class Inner:
    level: float = 1.5
    far: float = field(default=2.5, metadata={"may_be_inf": True})


@dataclass(frozen=True)
class Record:
    inner: Inner = Inner()
    seed: int = 3
    name: str = "x"
    file: Path = Path("x")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a = " + "[" * 5000 + "]" * 5000, "nested too deep"),
        ("seed = " + "9" * 5000, "4300 digits"),
        ("seed = 0x" + "f" * 9000, "seed is a number of 36000 bits"),
        (
            "seed = 9999999999999999999999",
            "seed is 9999999999999999999999, need at most",
        ),
        ("seed = -4", "seed is -4, need 0 or more"),
        ("[inner]\nlevel = -inf", "inner.level is -inf, need a finite number"),
        ("[inner]\nlevel = nan", "inner.level is nan"),
        (
            'file = "a\\u0000b"',
            "file is 'a\\x00b', need text without control characters",
        ),
        (
            'name = "a\\u001b[2J"',
            "name is 'a\\x1b[2J', need text without control characters",
        ),
        ('file = ""', "file is empty, need a name"),
        ("[inner]\nlevel = 1e20", "inner.level is 1e+20, need at most 1e+09"),
        ("[inner]\nlevel = -0.5", "inner.level is -0.5, need 0 or more"),
        ("name = " + "{a = " * 60 + "1" + "}" * 60, "name is {'a': "),
    ],
)
def test_a_setting_out_of_range_is_refused_by_file_and_key(tmp_path, text, words):
    (tmp_path / "c.toml").write_text(text)
    with pytest.raises(ConfigError) as refused:
        config.load(tmp_path / "c.toml", Record)
    assert words in str(refused.value)
    assert "c.toml" in str(refused.value)
    assert len(str(refused.value)) < 600


def test_a_byte_order_mark_and_infinity_where_it_means_something_are_accepted(tmp_path):
    (tmp_path / "c.toml").write_bytes(b"\xef\xbb\xbf[inner]\r\nfar = inf\r\n")
    assert config.load(tmp_path / "c.toml", Record).inner.far == math.inf


def test_any_text_survives_dumps():
    record = Record(name="".join(map(chr, range(0x20))) + 'ä"\\\x7f')
    assert tomllib.loads(config.dumps(record))["name"] == record.name


def test_an_array_that_the_file_cannot_hold_is_refused_unread(tmp_path):
    store.save(tmp_path / "f.h5", "lens", {"x": np.arange(3.0)})
    with h5py.File(tmp_path / "f.h5", "r+") as file:
        file.create_dataset("huge", (1 << 20, 1 << 20), dtype="f8", chunks=(64, 64))
    with pytest.raises(StoreError, match=r"'huge' claims 8\.79609e"):
        store.load(tmp_path / "f.h5")


def test_an_array_that_lies_in_another_file_is_refused(tmp_path):
    (tmp_path / "secret").write_bytes(b"\1" * 64)
    store.save(tmp_path / "f.h5", "lens", {"x": np.arange(3.0)})
    with h5py.File(tmp_path / "f.h5", "r+") as file:
        file.create_dataset(
            "out", (8,), "f8", external=[(str(tmp_path / "secret"), 0, 64)]
        )
    with pytest.raises(StoreError, match="'out' lies in other files"):
        store.load(tmp_path / "f.h5")


@pytest.mark.parametrize("value", ["nine", [1.0, 2.0], 1j])
def test_an_attribute_of_the_wrong_kind_is_a_store_error(tmp_path, value):
    light = np.full((1, 1, 4, 4), 1 / 16)
    axes = dict(
        depths_um=np.array([9.0]),
        angles_rad=np.zeros((1, 2)),
        wavelengths_um=np.array([0.8]),
    )
    stack = psf.PsfStack(
        light, np.ones((1, 1)), **axes, weights=np.ones(1), centres_um=np.zeros((1, 1, 2)), step_um=0.7,
        sensor_distance_um=30.0, tolerance=0.1, error=0.01, reason="made",
    )  # fmt: skip
    psf.save(tmp_path / "f.h5", stack)
    assert psf.load(tmp_path / "f.h5").step_um == 0.7
    with h5py.File(tmp_path / "f.h5", "r+") as file:
        file.attrs["step_um"] = value
    with pytest.raises(StoreError, match=r"f\.h5: entries of the wrong kind"):
        psf.load(tmp_path / "f.h5")


def test_a_damaged_matlab_file_is_refused_by_type(tmp_path):
    savemat(tmp_path / "a.mat", {"p": np.array([[1.5, 2.0], [3.0, 4.0]]), "words": "x"})
    assert list(read_matlab(tmp_path / "a.mat")) == ["p"]
    whole = (tmp_path / "a.mat").read_bytes()
    for damaged in (whole[:150], whole[:128] + b"\xff" * 64):
        (tmp_path / "b.mat").write_bytes(damaged)
        with pytest.raises(LensError, match=r"b\.mat: not a MATLAB file"):
            read_matlab(tmp_path / "b.mat")


def test_what_nobody_foresaw_is_one_line_and_shown_by_debug(monkeypatch, capsys):
    def fail(options):
        raise ZeroDivisionError("of the program")

    monkeypatch.setattr(design, "run", fail)
    assert call("design d.toml") == cli.BAD_INPUT
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert "ZeroDivisionError: of the program; not foreseen: --debug" in told
    assert call("design d.toml --debug") == cli.BAD_INPUT
    assert "Traceback" in capsys.readouterr().err
