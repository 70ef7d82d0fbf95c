"""Configs: unknown keys name the nearest, wrong values name their place, and records
survive the round trip.
"""

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from metalens.cell.record import Cell, Film, Index
from metalens.core import config
from metalens.core.errors import ConfigError


@dataclass(frozen=True)
class Inner:
    width_um: float
    name: str = "x"


@dataclass(frozen=True)
class Outer:
    pitch_um: float
    mode: Literal["fast", "small"] = "fast"
    inner: Inner = Inner(1.0)
    steps: tuple[int, ...] = ()
    pair: tuple[float, float] = (0.0, 1.0)
    file: Path | None = None
    films: tuple[Inner, ...] = ()

    def __post_init__(self):
        if self.pitch_um <= 0:
            raise ValueError(f"pitch_um = {self.pitch_um}: need above 0")


def test_nested_tables_lists_and_defaults():
    text = 'pitch_um = 1\nsteps = [1, 2]\nfile = "a.h5"\n[inner]\nwidth_um = 2\n[[films]]\nwidth_um = 3\nname = "f"\n'
    found = config.loads(text, Outer)
    assert found == Outer(
        1.0, inner=Inner(2.0), steps=(1, 2), file=Path("a.h5"), films=(Inner(3.0, "f"),)
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("pich_um = 1", r"unknown key 'pich_um'; did you mean 'pitch_um'\?"),
        (
            "pitch_um = 1\n[inner]\nwidht_um = 2",
            r"unknown key 'inner\.widht_um'; did you mean 'width_um'\?",
        ),
        ("", "missing key 'pitch_um'"),
        ('pitch_um = "wide"', r"pitch_um is 'wide' \(str\), need float"),
        ("pitch_um = true", r"pitch_um is True \(bool\), need float"),
        ("pitch_um = nan", "pitch_um is nan"),
        ("pitch_um = -1", "need above 0"),
        ('pitch_um = 1\nmode = "smal"', r"mode is 'smal'; did you mean 'small'\?"),
        ("pitch_um = 1\nsteps = [1, 2.5]", r"steps\[1\] is 2.5"),
        ("pitch_um = 1\npair = [1.0]", "pair has 1 entries, need 2"),
        ("pitch_um = 1\ninner = 3", "need a table"),
        ("pitch_um = = 1", "not valid TOML"),
    ],
)
def test_bad_config_is_refused_by_name(text, message):
    with pytest.raises(ConfigError, match=message):
        config.loads(text, Outer)


def test_missing_file_and_binary_file_are_named(tmp_path):
    with pytest.raises(ConfigError, match="no such file"):
        config.load(tmp_path / "absent.toml", Outer)
    (tmp_path / "b.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="not a text file"):
        config.load(tmp_path / "b.toml", Outer)


def test_a_material_is_a_name_or_plain_numbers():
    cell = config.loads(
        'pitch_um = 0.4\npillar = {n = 3.6, k = 0.01}\nsubstrate = "SiO2"\n', Cell
    )
    assert cell.pillar == Index(3.6, 0.01)
    assert cell.substrate == "SiO2"


@given(
    st.builds(
        Cell,
        pitch_um=st.floats(0.01, 10),
        height_um=st.floats(0, 5),
        pillar=st.builds(Index, st.floats(0.1, 5), st.floats(0, 3)),
        substrate=st.sampled_from(["SiO2", 'a "quoted" name', "back\\slash"]),
        sidewall_rad=st.floats(-0.7, 0.7),
        under=st.lists(
            st.builds(Film, st.sampled_from(["Si", "air"]), st.floats(0, 2)), max_size=2
        ).map(tuple),
    )
)
def test_a_record_written_as_toml_reads_back_the_same(cell):
    assert config.loads(config.dumps(cell), Cell) == cell


@dataclass(frozen=True)
class Part:
    size_um: float = 0.3
    at_um: tuple[float, ...] = ()


@dataclass(frozen=True)
class Whole:
    depths_um: tuple[float, ...] = ()
    names: tuple[str, ...] = ()
    one: Part = Part()
    parts: tuple[Part, ...] = ()
    none: tuple[Part, ...] = ()
    left_out: float | None = None
    free: bool = False


def test_numbers_stay_lists_and_records_become_tables():
    """What is written is TOML that another reader takes for the same; what is empty or
    left out makes no table.
    """
    made = Whole(
        (2.5, 9.0),
        ("a", "b"),
        Part(0.7, (1.0, 2.0)),
        (Part(0.1), Part(0.2, (3.0,))),
        (),
        None,
        True,
    )
    read = tomllib.loads(config.dumps(made))
    assert read.pop("none", []) == []
    assert read == {
        "depths_um": [2.5, 9.0],
        "names": ["a", "b"],
        "free": True,
        "one": {"size_um": 0.7, "at_um": [1.0, 2.0]},
        "parts": [{"size_um": 0.1, "at_um": []}, {"size_um": 0.2, "at_um": [3.0]}],
    }
    assert config.loads(config.dumps(made), Whole) == made


@dataclass(frozen=True)
class Files:
    """Names a file and a length."""

    file: Path = Path("a")
    size_um: float = 0.1


@pytest.mark.parametrize("path", [r"C:\Users\lab\a.npy", r"C:\temp\new.npy"])
def test_a_path_of_windows_in_double_quotes_gets_its_cure(path):
    """\\U begins an escape that fails; \\t and \\n are a tab and a line end."""
    with pytest.raises(ConfigError, match=r"single quotes .* or with /"):
        config.loads(f'file = "{path}"', Files)
    assert config.loads(f"file = '{path}'", Files).file == Path(path)


def test_numbers_of_numpy_are_written_as_numbers():
    text = config.dumps(Files(size_um=np.float64(0.08)))
    assert config.loads(text, Files).size_um == 0.08
    assert tomllib.loads(text)["size_um"] == 0.08


def test_settings_in_utf_16_are_settings(tmp_path):
    (tmp_path / "s.toml").write_text("size_um = 0.3\n", encoding="utf-16")
    assert config.load(tmp_path / "s.toml", Files).size_um == 0.3
