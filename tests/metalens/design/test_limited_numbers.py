"""What a child that reads a foreign file may take, and what is said of its end."""

import subprocess

import numpy as np
import pytest

from metalens.design import limited
from metalens.ground.errors import StoreError


def test_the_child_has_two_gigabytes_forty_bytes_a_byte_of_the_file_and_two_minutes(tmp_path, monkeypatch):
    """The words of the real call; what it reads is what was written."""
    path = tmp_path / "map.npz"
    np.savez(path, phase=np.arange(12.0).reshape(3, 4), level=np.array([1 + 2j]), name=np.array("words"))
    seen, run = [], subprocess.run

    def watched(words, **more):
        seen.append((words, more["timeout"]))
        return run(words, **more)

    monkeypatch.setattr(limited.subprocess, "run", watched)
    found = limited.arrays(path, "NPZ")
    assert sorted(found) == ["level", "phase"]
    assert np.array_equal(found["phase"], np.arange(12.0).reshape(3, 4))
    (words, timeout) = seen[0]
    size = path.stat().st_size
    at = words.index("NPZ")
    assert [int(word) for word in words[at + 1 : at + 3]] == [2147483648 + 40 * size, 120]
    assert timeout == 120


def test_what_its_reader_says_is_told_and_how_it_ended_otherwise(tmp_path):
    """By a signal (below 0, as POSIX has it for children) or with a status."""
    path = tmp_path / "map.npz"
    path.write_bytes(b"no archive at all")
    with pytest.raises(StoreError, match=r"map\.npz: not an NPZ file: [A-Za-z]+Error: "):
        limited.arrays(path, "NPZ")
    assert limited._death(-11) == "its reader was ended by signal 11"
    assert limited._death(-1) == "its reader was ended by signal 1"
    assert limited._death(1) == "its reader ended with 1"
    assert limited._death(137) == "its reader ended with 137"


def test_a_child_that_needs_more_than_it_may_take_is_refused(tmp_path, monkeypatch):
    """With 48 MB in place of 2 GB numpy itself does not load."""
    path = tmp_path / "map.npz"
    np.savez(path, phase=np.zeros(3))
    monkeypatch.setattr(limited, "_MEMORY", 48 << 20)
    with pytest.raises(StoreError, match=r"not an NPZ file: its reader (ended with|was ended by signal)"):
        limited.arrays(path, "NPZ")
