# ruff: noqa: PT012 (what ends a block is the subject here)
"""What others do meanwhile: inputs replaced, clocks set back, other machines, names in
another case, links, disks.
"""

import errno
import fcntl
import hashlib
import json
import multiprocessing
import os
import socket
import subprocess
import sys
import tempfile
from pathlib import Path

import h5py
import numpy as np
import pytest

from metalens.ground import config, lock, manifest, reading, store, transaction
from metalens.ground.errors import OutputError, StoreError
from metalens.ground.transaction import JOURNAL, UNFINISHED, Terms
from metalens.lens.rows import RowsOnDisk

FORCE = Terms(force=True)
FUTURE_S = 4e9  # of a clock that was set back since


def save(target, value, terms=FORCE):
    with transaction.file(target, beside=(".png",), terms=terms) as draft:
        store.save(draft.path, "lens", {}, attributes={"value": value})
        draft.path.with_suffix(".png").write_bytes(
            b"\x89PNG....Software\0metalens" + str(value).encode()
        )


def names(folder):
    return sorted(os.listdir(folder))


# an input that is replaced while it is read


def test_an_input_that_is_replaced_between_its_probe_and_its_reading_is_refused(
    tmp_path,
):
    """What was probed is not what would be read."""
    store.save(tmp_path / "a.h5", "lens", {"x": np.arange(7.0)})
    store.save(tmp_path / "b.h5", "lens", {"x": np.arange(9.0)})
    parent = os.getpid()

    def read(file):
        if os.getpid() == parent and (tmp_path / "b.h5").exists():
            (tmp_path / "b.h5").replace(tmp_path / "a.h5")
        return file["x"][...]

    with pytest.raises(StoreError, match=r"a\.h5 was changed or replaced while"):
        reading.survived(tmp_path / "a.h5", read)
    assert reading.survived(tmp_path / "a.h5", read).size == 9


def test_a_folder_that_is_replaced_while_it_is_read_is_refused_before_what_it_made(
    tmp_path,
):
    """Frames of one run beside the stage of another; also where the mixture itself
    would be refused.
    """
    for name, text in (("a", "old"), ("b", "new")):
        with transaction.folder(tmp_path / name) as draft:
            (draft.path / "stage.csv").write_text(text)
            (draft.path / "f.tif").write_text(text)
    for then in (None, StoreError("made of both")):
        with (
            pytest.raises(StoreError, match="a was changed or replaced"),
            reading.steady(tmp_path / "a"),
        ):
            assert lock.exchange(tmp_path / "a", tmp_path / "b") or pytest.skip(
                "this system swaps no folders"
            )
            if then:
                raise then
    with reading.steady(tmp_path / "a"):
        pass


def test_a_swap_of_two_names_says_whether_it_was_done(tmp_path):
    """Both folders under the other's name, or both as they were; of a name that is not
    there nothing.
    """
    for name in "ab":
        (tmp_path / name).mkdir()
        (tmp_path / name / f"of {name}").touch()
    done = lock.exchange(tmp_path / "a", tmp_path / "b")
    assert type(done) is bool
    for name, other in ("ab", "ba"):
        assert [p.name for p in (tmp_path / name).iterdir()] == [
            f"of {other if done else name}"
        ]
    assert lock.exchange(tmp_path / "a", tmp_path / "c") is False
    assert not (tmp_path / "c").exists()


def test_the_hash_of_an_input_is_that_of_what_was_read(tmp_path):
    """Settings that are edited while a command works are hashed as they were; another
    input is refused.
    """
    path, before = tmp_path / "c.toml", b"[cell]\npitch_um = 0.31\n"
    path.write_bytes(before)
    store.save(tmp_path / "a.h5", "lens", {})
    with reading.remembered():
        config.read(path, dict)
        store.load(tmp_path / "a.h5")
        path.write_text("[cell]\npitch_um = 0.37\n")
        assert reading.sha256(path) == hashlib.sha256(before).hexdigest()
        store.save(tmp_path / "a.h5", "lens", {"x": np.ones(3)})
        with pytest.raises(StoreError, match=r"a\.h5 was changed or replaced"):
            reading.sha256(tmp_path / "a.h5")
    assert reading.sha256(path) == store.sha256(path)  # the next command


def test_rows_of_a_file_that_was_written_to_since_are_refused(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset(
            "d", data=np.random.default_rng(3).random((40, 6)), chunks=(8, 6)
        )
    rows = RowsOnDisk(tmp_path / "a.h5", "d")
    assert rows[3:7].shape == (4, 6)
    with open(tmp_path / "a.h5", "ab") as file:
        file.write(b"more")
    for look in (lambda: rows[30:34], lambda: np.asarray(rows)):
        with pytest.raises(StoreError, match="was changed or replaced"):
            look()


# a clock that was set back between two runs


def test_files_of_the_future_are_no_obstacle(tmp_path):
    """Journal, lock, scratch and manifest that seem to come from the next century,
    since the clock was set back.
    """
    with (
        pytest.raises(KeyboardInterrupt),
        transaction.long_work(tmp_path / "run", keep=("c",)) as draft,
    ):
        (draft.path / "c").write_text("half")
        raise KeyboardInterrupt
    journal = tmp_path / f"run{JOURNAL}"
    assert manifest.journal(journal, '["1"]') == []
    store.append_line(journal, "done")
    (tmp_path / ".run.lock").write_text(
        json.dumps({"process": 1, "host": socket.gethostname(), "command": "x"})
    )
    (tmp_path / ".run.part-left").mkdir()
    for path in (*tmp_path.rglob("*"), tmp_path):
        os.utime(path, (FUTURE_S, FUTURE_S))
    assert manifest.journal(journal, '["1"]') == ["done"]
    with transaction.long_work(tmp_path / "run", keep=("c",), resume=True) as draft:
        assert (draft.path / "c").read_text() == "half"
    for path in (tmp_path / "run").iterdir():
        os.utime(path, (FUTURE_S, FUTURE_S))
    manifest.check(tmp_path / "run")
    assert names(tmp_path) == ["run", journal.name]


def test_no_module_asks_which_file_is_the_later_one():
    """Times of files are compared for being the same; the fit's cache alone is cleared
    by them.
    """
    root = Path(__file__).parents[3]
    found = {
        path.relative_to(root).as_posix()
        for package in ("metalens", "layout", "characterize", "codesign")
        for path in (root / package).rglob("*.py")
        if "st_mtime" in path.read_text("utf-8").replace("st_mtime_ns", "")
        or "getmtime" in path.read_text("utf-8")
    }
    assert found == {"characterize/model/kept.py"}


# names that differ only in case


@pytest.mark.parametrize("name", ["lens.png", "lens.PNG", "Lens.Png"])
def test_a_name_that_is_its_companions_in_another_case_is_refused(tmp_path, name):
    """On a file system that tells no case apart the picture would replace the result."""
    with pytest.raises(OutputError, match="a file of that name is written beside"):
        save(tmp_path / name, 1)
    assert names(tmp_path) == []


def one_case(folder):
    """Whether a folder takes names that differ in case for one."""
    (folder / "case").touch()
    same = (folder / "CASE").exists()
    (folder / "case").unlink()
    return same


def test_outputs_whose_names_differ_in_case_are_one_where_the_system_says_so(tmp_path):
    """Two writers, an input, and what a killed one left; in a folder of
    METALENS_ONE_CASE, or where it lies anyway.
    """
    place = Path(os.environ.get("METALENS_ONE_CASE", tmp_path))
    if not one_case(place):
        pytest.skip(
            "this file system tells case apart; name a folder of one that does not in METALENS_ONE_CASE"
        )
    with tempfile.TemporaryDirectory(dir=place) as made:
        folder = Path(made)
        save(folder / "lens.h5", 1)
        with pytest.raises(OutputError, match="also an input"):
            save(folder / "LENS.h5", 2, Terms(force=True, inputs=(folder / "lens.h5",)))
        with (
            lock.held(folder / "lens.h5"),
            pytest.raises(OutputError, match="is being written by"),
        ):
            save(folder / "LENS.h5", 2)
        (folder / ".lens.h5.part-left").mkdir()
        save(folder / "LENS.h5", 2)
        assert store.load(folder / "lens.h5").attributes["value"] == 2
        assert [name.lower() for name in names(folder)] == ["lens.h5", "lens.png"]


def test_scratch_of_an_output_in_another_case_is_that_of_another_where_case_counts(
    tmp_path,
):
    (tmp_path / ".LENS.h5.part-left").mkdir()
    (tmp_path / ".LENS.h5.lock").touch()
    (tmp_path / ".lens.h5.lock").touch()
    found = list(lock.left(tmp_path / "lens.h5"))
    assert found == ([tmp_path / ".LENS.h5.part-left"] if one_case(tmp_path) else [])
    (tmp_path / ".LENS.h5.lock").unlink()
    (tmp_path / ".LENS.h5.lock").hardlink_to(
        tmp_path / ".lens.h5.lock"
    )  # one file, as where case does not count
    assert list(lock.left(tmp_path / "lens.h5")) == [tmp_path / ".LENS.h5.part-left"]


# two commands on one journal


def lines(path, letter):
    for i in range(60):
        store.append_line(path, f"{letter * 900}{i}")


def test_two_writers_of_one_journal_lose_no_line(tmp_path):
    """From Python, where no output is claimed: what one has half written is not cut off
    by the other.
    """
    path = tmp_path / f"out{JOURNAL}"
    spawn = multiprocessing.get_context("fork")
    writers = [spawn.Process(target=lines, args=(path, letter)) for letter in "ab"]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert sorted(store.whole_lines(path)) == sorted(
        f"{x * 900}{i}" for x in "ab" for i in range(60)
    )


@pytest.mark.parametrize("ending", [JOURNAL, UNFINISHED])
def test_no_output_has_the_name_of_what_another_one_keeps(tmp_path, ending):
    """`-o lib.resume` would be written into by a sweep of `-o lib`."""
    for claim in (transaction.file, transaction.folder):
        with (
            pytest.raises(OutputError, match="interrupted work"),
            claim(tmp_path / f"lib{ending}"),
        ):
            pytest.fail("the work began")
    assert names(tmp_path) == []


def test_scratch_of_a_journal_whose_writer_was_killed_goes_with_the_next_claim(
    tmp_path,
):
    """Also where that one comes to no journal of its own."""
    (tmp_path / f".out{JOURNAL}.abc.part").write_text("half a title")
    with pytest.raises(KeyboardInterrupt), transaction.folder(tmp_path / "out"):
        raise KeyboardInterrupt
    assert names(tmp_path) == []


# another file system


@pytest.fixture
def elsewhere(tmp_path):
    """A folder on another file system than that of the test."""
    place = Path("/dev/shm")
    if not os.access(place, os.W_OK) or place.stat().st_dev == tmp_path.stat().st_dev:
        pytest.skip("no second file system that this user may write to")
    with tempfile.TemporaryDirectory(dir=place) as name:
        yield Path(name)


def test_an_output_on_another_disk_than_temporary_files_and_the_current_folder(
    tmp_path, elsewhere, monkeypatch
):
    """Scratch lies beside the output: nothing has to be moved from disk to disk."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    for value in (1, 2):
        save(elsewhere / "lens.h5", value)
        with transaction.folder(elsewhere / "out", terms=FORCE) as draft:
            assert draft.path.stat().st_dev == elsewhere.stat().st_dev
            (draft.path / "a").write_text(str(value))
    assert (elsewhere / "out" / "a").read_text() == "2"
    assert names(elsewhere) == ["lens.h5", "lens.png", "out"]
    assert names(tmp_path) == []


def test_a_link_to_another_disk_is_followed(tmp_path, elsewhere):
    """To what stands there and to what does not yet; room is asked of that disk,
    companions lie beside the file.
    """
    (tmp_path / "lens.h5").symlink_to(elsewhere / "real.h5")
    (tmp_path / "out").symlink_to(elsewhere / "out")
    for value in (1, 2):
        save(tmp_path / "lens.h5", value)
        with transaction.folder(tmp_path / "out", terms=FORCE) as draft:
            (draft.path / "a").write_text(str(value))
    assert store.load(elsewhere / "real.h5").attributes["value"] == 2
    assert (elsewhere / "out" / "a").read_text() == "2"
    assert names(elsewhere) == ["out", "real.h5", "real.png"]
    assert all((tmp_path / name).is_symlink() for name in ("lens.h5", "out"))


# links


def test_long_work_through_a_link_is_done_and_resumed_where_it_leads(tmp_path):
    (tmp_path / "far").mkdir()
    (tmp_path / "run").symlink_to("far/run")
    with (
        pytest.raises(KeyboardInterrupt),
        transaction.long_work(tmp_path / "run", keep=("c",)) as draft,
    ):
        (draft.path / "c").write_text("half")
        raise KeyboardInterrupt
    assert (
        transaction.unfinished(tmp_path / "run")
        == draft.path
        == tmp_path / "far" / f"run{UNFINISHED}"
    )
    with transaction.long_work(tmp_path / "run", keep=("c",), resume=True) as draft:
        assert draft.resumed
    assert (names(tmp_path), names(tmp_path / "far")) == (["far", "run"], ["run"])
    manifest.check(tmp_path / "run")


def test_two_writers_through_a_link_and_the_name_itself_meet(tmp_path):
    save(tmp_path / "lens.h5", 1)
    (tmp_path / "link.h5").symlink_to("lens.h5")
    for one, other in (("lens.h5", "link.h5"), ("link.h5", "lens.h5")):
        with transaction.file(tmp_path / one, beside=(".png",), terms=FORCE) as draft:
            with pytest.raises(OutputError, match="is being written by"):
                save(tmp_path / other, 3)
            store.save(draft.path, "lens", {})


def test_what_others_made_is_not_replaced_through_a_link(tmp_path):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "a.tex").write_text("years")
    (tmp_path / "note").write_text("mine")
    for link, there in (("out", "thesis"), ("lens.h5", "note")):
        (tmp_path / link).symlink_to(there)
    with (
        pytest.raises(OutputError, match=r"a\.tex"),
        transaction.folder(tmp_path / "out", terms=FORCE),
    ):
        pytest.fail("the work began")
    with pytest.raises(OutputError, match="not made by metalens"):
        save(tmp_path / "lens.h5", 1)
    (tmp_path / "round").symlink_to("round")
    with (
        pytest.raises(OutputError, match="round"),
        transaction.file(tmp_path / "round"),
    ):
        pytest.fail("the work began")


# locks of other machines


def left_by(folder, host, process):
    (folder / ".out.lock").write_text(
        json.dumps({"process": process, "host": host, "command": "psf lens.h5"})
    )


def dead():
    return int(
        subprocess.run(
            [sys.executable, "-c", "import os; print(os.getpid())"],
            capture_output=True,
            check=True,
        ).stdout
    )


def claimed(folder):
    with transaction.folder(folder / "out", terms=FORCE) as draft:
        (draft.path / "a").write_text("x")


def test_a_lock_that_a_dead_process_of_another_machine_left_is_free(tmp_path):
    """Where the file server keeps the locks: it would have refused ours."""
    left_by(tmp_path, "node17", 4711)
    claimed(tmp_path)
    assert names(tmp_path) == ["out"]


def test_where_locks_are_of_one_machine_alone_the_name_of_another_one_counts(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(lock, "_locks_are_local", lambda path: True)
    left_by(tmp_path, "node17", 4711)
    with pytest.raises(
        OutputError,
        match=r"process 4711 on node17 .*if that one has ended, remove the file",
    ):
        claimed(tmp_path)
    left_by(tmp_path, socket.gethostname(), dead())
    claimed(tmp_path)
    assert names(tmp_path) == ["out"]


@pytest.mark.parametrize("code", [errno.ENOLCK, errno.ENOTSUP])
def test_without_locks_the_words_in_the_file_decide(tmp_path, monkeypatch, code):
    """A living process of this machine, one of another machine, a dead one."""

    def refused(handle, how):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(fcntl, "flock", refused)
    for host, process in ((socket.gethostname(), os.getppid()), ("node17", 4711)):
        left_by(tmp_path, host, process)
        with pytest.raises(
            OutputError, match=f"is being written by process {process} on {host}"
        ):
            claimed(tmp_path)
    left_by(tmp_path, socket.gethostname(), dead())
    claimed(tmp_path)
    with (
        lock.held(tmp_path / "out"),
        pytest.raises(OutputError, match=f"process {os.getpid()} on"),
    ):
        claimed(tmp_path)
    assert names(tmp_path) == ["out"]


@pytest.mark.parametrize(
    ("line", "local"),
    [
        ("40 1 {} / /data rw - nfs4 server:/d rw,vers=4.2,local_lock=none", False),
        ("40 1 {} / /data rw - nfs server:/d rw,vers=3,nolock,local_lock=all", True),
        ("40 1 {} / /data rw - nfs server:/d rw,vers=3,local_lock=flock", True),
        ("40 1 {} / /data rw - lustre mds:/d rw,flock", False),
        ("40 1 {} / /data rw - lustre mds:/d rw,localflock", True),
        ("40 1 {} / /data rw - fuse.sshfs me@server:/d rw", True),
        ("40 1 {} / /data rw - 9p share rw", True),
        ("40 1 {} / /data rw - ext4 /dev/sda1 rw", False),
        ("40 1 7777:1 / /data rw - fuse.sshfs me@server:/d rw", False),
    ],
)
def test_the_table_of_mounts_tells_whose_locks_they_are(
    tmp_path, monkeypatch, line, local
):
    device = tmp_path.stat().st_dev
    text = line.format(f"{os.major(device)}:{os.minor(device)}") + "\n"
    monkeypatch.setattr(Path, "read_text", lambda path, *_: text)
    assert lock._locks_are_local(tmp_path) is local
