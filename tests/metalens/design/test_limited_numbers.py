"""What a child that reads a foreign file may take, and what is said of its end."""

import subprocess

import numpy as np
import pytest

from metalens.design import limited
from metalens.ground.errors import StoreError


def test_the_child_has_two_gigabytes_forty_bytes_a_byte_of_the_file_and_two_minutes(
    tmp_path, monkeypatch
):
    """The words of its call; what takes longer is refused with how long it may."""
    path, seen = tmp_path / "map.npz", []
    np.savez(path, phase=np.arange(12.0).reshape(3, 4))

    def watched(words, **more):
        seen.append((words, more["timeout"]))
        raise subprocess.TimeoutExpired(words, more["timeout"])

    with monkeypatch.context() as patch:
        patch.setattr(limited.subprocess, "run", watched)
        with pytest.raises(
            StoreError,
            match=r"map\.npz: not an NPZ file: its reader took more than 120 s",
        ):
            limited.arrays(path, "NPZ")
    (words, timeout) = seen[0]
    at = words.index("NPZ")
    assert [int(word) for word in words[at + 1 : at + 3]] == [
        2147483648 + 40 * path.stat().st_size,
        120,
    ]
    assert timeout == 120


@pytest.mark.parametrize(
    ("status", "errors", "told"),
    [
        (
            3,
            b"noise REFUSED ValueError: it says",
            "not an NPZ file: ValueError: it says",
        ),
        (3, b"", "its reader ended with 3"),
        (1, b"Traceback", "its reader ended with 1"),
        (137, b"", "its reader ended with 137"),
        (-11, b"", "its reader was ended by signal 11"),
        (-1, b"", "its reader was ended by signal 1"),
    ],
)
def test_what_its_reader_says_is_told_and_how_it_ended_otherwise(
    tmp_path, monkeypatch, status, errors, told
):
    """By a signal (below 0, as POSIX has it for children) or with a status."""
    path = tmp_path / "map.npz"
    path.write_bytes(b"no archive at all")
    done = subprocess.CompletedProcess((), status, b"", errors)
    monkeypatch.setattr(limited.subprocess, "run", lambda *_, **__: done)
    with pytest.raises(StoreError, match=rf"map\.npz: .*{told}$"):
        limited.arrays(path, "NPZ")


def test_numeric_arrays_of_an_archive_come_back(tmp_path):
    path = tmp_path / "map.npz"
    np.savez(
        path,
        phase=np.arange(12.0).reshape(3, 4),
        level=np.array([1 + 2j]),
        name=np.array("words"),
    )
    found = limited.arrays(path, "NPZ")
    assert sorted(found) == ["level", "phase"]
    assert np.array_equal(found["phase"], np.arange(12.0).reshape(3, 4))
    path.write_bytes(b"no archive at all")
    with pytest.raises(
        StoreError, match=r"map\.npz: not an NPZ file: [A-Za-z]+Error: "
    ):
        limited.arrays(path, "NPZ")


def test_a_child_that_needs_more_than_it_may_take_is_refused(tmp_path, monkeypatch):
    """With 48 MB in place of 2 GB numpy itself does not load."""
    path = tmp_path / "map.npz"
    np.savez(path, phase=np.zeros(3))
    monkeypatch.setattr(limited, "_MEMORY", 48 << 20)
    with pytest.raises(
        StoreError,
        match=r"not an NPZ file: its reader (ended with|was ended by signal)",
    ):
        limited.arrays(path, "NPZ")
