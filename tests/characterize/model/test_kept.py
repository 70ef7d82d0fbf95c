"""Arrays kept between runs: the same bits, never those of something else, never in the
way.
"""

import os
import stat
from pathlib import Path

import numpy as np
import pytest

from characterize.model import kept

MADE = {
    "t": np.array([0.3 - 1.7j, 1 / 3]),
    "numbers": np.array([np.nan, -np.inf, 5e-324]),
}


@pytest.fixture
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "metalens"


def asked(about="a cell", packages=("characterize.model",), title="pillars"):
    """(arrays, how often they had to be made)."""
    calls = []

    def make():
        calls.append(1)
        return MADE

    return kept.cached_arrays(title, about, packages, make), len(calls)


def test_a_second_run_finds_the_same_bits(home):
    first, again = asked(), asked()
    assert (first[1], again[1]) == (1, 0)
    for name, value in MADE.items():
        assert again[0][name].tobytes() == value.tobytes()
    assert len(list(home.iterdir())) == 1


def test_another_description_title_or_source_is_made_anew(home):
    asked()
    assert asked(about="a cell ")[1] == 1
    assert asked(title="others")[1] == 1
    assert asked(packages=("characterize.model", "metalens.cell"))[1] == 1


@pytest.mark.parametrize("place", [0.1, 0.5, 0.9])
def test_a_damaged_file_is_made_anew_and_mended(home, place):
    asked()
    (path,) = home.iterdir()
    content = bytearray(path.read_bytes())
    for i in range(int(place * len(content)), int(place * len(content)) + 40):
        content[i] ^= 0x5A
    path.write_bytes(content)
    again = asked()[0]
    assert {name: value.tobytes() for name, value in again.items()} == {
        n: v.tobytes() for n, v in MADE.items()
    }
    path.write_bytes(b"")
    assert asked()[1] == 1
    assert asked()[1] == 0


def test_a_home_that_cannot_be_written_costs_time_alone(tmp_path, monkeypatch):
    for base in (tmp_path / "file", tmp_path / "shut"):
        monkeypatch.setenv("XDG_CACHE_HOME", str(base))
        if base.name == "file":
            base.write_text("no folder")
        else:
            base.mkdir()
            base.chmod(stat.S_IRUSR | stat.S_IXUSR)
        found, made = asked()
        assert made == 1
        assert found["t"].tobytes() == MADE["t"].tobytes()
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.chdir(tmp_path)
    for home in ("~", str(tmp_path / "nobody")):
        monkeypatch.setattr(os.path, "expanduser", lambda path, home=home: home)
        assert kept.cache_folder() is None
        assert asked()[1] == 1
        assert not Path(home).exists()
    monkeypatch.setattr(os.path, "expanduser", lambda path: str(tmp_path))
    assert kept.cache_folder() == tmp_path / ".cache" / "metalens"


def test_the_oldest_files_go(home, monkeypatch):
    monkeypatch.setattr(kept, "MOST", 3)
    for i in range(3):
        asked(about=f"cell {i}")
    for age, path in enumerate(sorted(home.iterdir())):
        os.utime(path, (1e9 + age, 1e9 + age))
    oldest = min(home.iterdir(), key=lambda p: p.stat().st_mtime)
    asked(about="one more")
    assert len(list(home.iterdir())) == 3
    assert not oldest.exists()
