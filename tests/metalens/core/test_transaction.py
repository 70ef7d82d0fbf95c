# ruff: noqa: PT012 (what ends a block is the subject here)
"""Outputs appear whole or not at all, whatever ends the work; what is not ours stays,
even with force.
"""

import json
import os
import random
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest

from metalens.core import store, transaction
from metalens.core.errors import OutputError, StoreError
from metalens.core.transaction import ClaimTerms

FORCE = ClaimTerms(force=True)


def tree(folder):
    """{name: content} of all files below, locks and scratch included."""
    return {
        p.relative_to(folder).as_posix(): p.read_bytes()
        for p in sorted(folder.rglob("*"))
        if p.is_file()
    }


def put(target, **contents):
    with transaction.claim_folder(target, terms=FORCE) as draft:
        for name, text in contents.items():
            (draft.path / name).write_text(text)


def save(target, value, *, force=True):
    with transaction.claim_file(
        target, companions=(".png", "_old.png"), terms=ClaimTerms(force=force)
    ) as draft:
        store.save(draft.path, "lens", {}, attributes={"value": value})
        draft.path.with_suffix(".png").write_bytes(
            b"\x89PNG....Software\0metalens" + str(value).encode()
        )


def test_a_folder_appears_whole_with_its_manifest(tmp_path):
    with transaction.claim_folder(tmp_path / "out") as draft:
        (draft.path / "sub").mkdir()
        (draft.path / "sub" / "b.txt").write_text("two")
        assert not (tmp_path / "out").exists()
    found = transaction.read_manifest(tmp_path / "out")
    assert list(found["files"]) == ["sub/b.txt"]
    assert found["files"]["sub/b.txt"]["bytes"] == 3
    assert sorted(os.listdir(tmp_path)) == ["out"]
    transaction.check_manifest(tmp_path / "out")


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, SystemExit])
def test_whatever_ends_the_block_leaves_what_was_there(tmp_path, error):
    put(tmp_path / "out", a="old")
    save(tmp_path / "f.h5", 1)
    before = tree(tmp_path)
    for claim in (transaction.claim_folder, transaction.claim_file):
        target = tmp_path / ("out" if claim is transaction.claim_folder else "f.h5")
        with pytest.raises(error), claim(target, terms=FORCE) as draft:
            (draft.path / "half" if draft.path.is_dir() else draft.path).write_text(
                "half"
            )
            raise error
    assert tree(tmp_path) == before


def test_force_replaces_only_folders_that_are_ours(tmp_path):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.tex").write_text("years")
    put(tmp_path / "mixed", a="ours")
    (tmp_path / "mixed" / "photo.jpg").write_text("mine")
    before = tree(tmp_path)
    for name, what in (("thesis", "chapter.tex"), ("mixed", "photo.jpg")):
        with (
            pytest.raises(OutputError, match=what),
            transaction.claim_folder(tmp_path / name, terms=FORCE),
        ):
            pass
    assert tree(tmp_path) == before
    put(tmp_path / "mine", a="old", b="old")
    put(tmp_path / "mine", a="new")
    assert (tmp_path / "mine" / "a").read_text() == "new"
    assert not (tmp_path / "mine" / "b").exists()


def test_nothing_is_replaced_without_force(tmp_path):
    save(tmp_path / "f.h5", 1)
    (tmp_path / "g_old.png").write_text("x")
    (tmp_path / "empty").mkdir()
    before = tree(tmp_path)
    for name in ("f.h5", "g.h5"):
        with pytest.raises(OutputError, match="--force"):
            save(tmp_path / name, 2, force=False)
    assert tree(tmp_path) == before
    with transaction.claim_folder(tmp_path / "empty") as draft:
        (draft.path / "a").write_text("x")
    assert (tmp_path / "empty" / "a").exists()


def test_an_output_is_never_an_input(tmp_path):
    save(tmp_path / "lens.h5", 1)
    (tmp_path / "soft.h5").symlink_to("lens.h5")
    os.link(tmp_path / "lens.h5", tmp_path / "hard.h5")
    put(tmp_path / "shots", a="1")
    before = tree(tmp_path)
    for name in ("lens.h5", "soft.h5", "hard.h5"):
        terms = ClaimTerms(force=True, inputs=(tmp_path / "lens.h5",))
        with (
            pytest.raises(OutputError, match="also an input"),
            transaction.claim_file(tmp_path / name, terms=terms),
        ):
            pass
    terms = ClaimTerms(force=True, inputs=(tmp_path / "shots" / "a",))
    with (
        pytest.raises(OutputError, match="holds the input"),
        transaction.claim_folder(tmp_path / "shots", terms=terms),
    ):
        pass
    assert tree(tmp_path) == before


def test_refusals_come_before_the_work(tmp_path):
    (tmp_path / "file").write_text("x")
    cases = (
        (transaction.claim_folder, tmp_path / "file", "is a file"),
        (transaction.claim_folder, tmp_path / "no" / "out", "does not exist"),
        (transaction.claim_file, Path("a\0b.h5"), "need the name"),
    )
    for claim, target, words in cases:
        with pytest.raises(OutputError, match=words), claim(target):
            pytest.fail("the work began")


def test_a_second_writer_is_told_who_is_first(tmp_path):
    with transaction.claim_folder(tmp_path / "out") as draft:
        (draft.path / "a").write_text("first")
        with (
            pytest.raises(OutputError, match=f"process {os.getpid()} "),
            transaction.claim_folder(tmp_path / "out"),
        ):
            pytest.fail("two writers")
    assert (tmp_path / "out" / "a").read_text() == "first"


def test_long_work_survives_an_interruption_and_goes_on(tmp_path):
    target, keep = tmp_path / "run", ("check",)
    put(target, old="old")
    with (
        pytest.raises(KeyboardInterrupt) as stopped,
        transaction.claim_long_work(target, keep=keep, terms=FORCE) as draft,
    ):
        (draft.path / "check").write_text("half way")
        raise KeyboardInterrupt
    assert "--resume" in stopped.value.__notes__[0]
    assert (target / "old").read_text() == "old"
    with pytest.raises(StoreError, match="unfinished"):
        transaction.check_manifest(draft.path)
    with transaction.claim_long_work(target, keep=keep, resume=True) as draft:
        assert draft.resumed
        (draft.path / "end").write_text((draft.path / "check").read_text())
    assert sorted(os.listdir(tmp_path)) == ["run"]
    assert sorted(transaction.read_manifest(target)["files"]) == ["check", "end"]


def test_long_work_without_anything_to_keep_leaves_nothing(tmp_path):
    with (
        pytest.raises(OSError, match="bad"),
        transaction.claim_long_work(tmp_path / "run", keep=("check",)),
    ):
        raise OSError("bad")
    assert os.listdir(tmp_path) == []


def test_unfinished_work_is_not_thrown_away_unasked(tmp_path):
    with (
        pytest.raises(OSError, match="x"),
        transaction.claim_long_work(tmp_path / "run", keep=("c",)) as draft,
    ):
        (draft.path / "c").write_text("hours")
        raise OSError("x")
    with (
        pytest.raises(OutputError, match="--resume"),
        transaction.claim_long_work(tmp_path / "run", keep=("c",)),
    ):
        pass
    assert (draft.path / "c").read_text() == "hours"
    with transaction.claim_long_work(
        tmp_path / "run", keep=("c",), terms=FORCE
    ) as draft:
        assert not draft.resumed
    assert sorted(os.listdir(tmp_path)) == ["run"]


@pytest.mark.parametrize("how", [{"resume": True}, {"grow": True}])
def test_work_goes_on_in_no_folder_that_holds_files_of_others(tmp_path, how):
    target = tmp_path / "run"
    put(target, ours="old")
    put(target / "part", inner="ours too")
    (target / "part" / "photo.jpg").write_text("mine")
    before = tree(tmp_path)
    goes_on = transaction.claim_long_work(target, keep=("ours",), **how)
    with pytest.raises(OutputError, match=r"photo\.jpg, which metalens did"), goes_on:
        pytest.fail("the work began")
    assert tree(tmp_path) == before
    (target / "part" / "photo.jpg").unlink()
    with transaction.claim_long_work(target, keep=("ours",), **how) as draft:
        (draft.path / "more").write_text("new")
    assert (target / "ours").read_text() == "old"
    assert (target / "more").read_text() == "new"


def test_a_folder_of_others_does_not_grow(tmp_path):
    """It would be copied whole, and could be a home."""
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.tex").write_text("years")
    before = tree(tmp_path)
    grown = transaction.claim_long_work(tmp_path / "thesis", keep=(), grow=True)
    with pytest.raises(OutputError, match=r"chapter\.tex"), grown:
        pass
    assert tree(tmp_path) == before
    (tmp_path / "thesis" / "chapter.tex").unlink()
    put(tmp_path / "thesis" / "part", inner="ours")
    with transaction.claim_long_work(tmp_path / "thesis", keep=(), grow=True) as draft:
        (draft.path / "more").write_text("x")
    assert set(transaction.read_manifest(tmp_path / "thesis")["files"]) == {
        "more",
        "part/inner",
        "part/manifest.json",
    }


def test_a_changed_folder_is_refused_by_name(tmp_path):
    put(tmp_path / "out", a="1", b="2")
    (tmp_path / "out" / "added").write_text("a note")
    transaction.check_manifest(tmp_path / "out")
    (tmp_path / "out" / "a").write_text("3")
    with pytest.raises(StoreError, match="a is not what was written"):
        transaction.check_manifest(tmp_path / "out")
    (tmp_path / "out" / "a").unlink()
    with pytest.raises(StoreError, match="a is missing"):
        transaction.check_manifest(tmp_path / "out")
    for text in ("{", "[]", json.dumps({"kind": "metalens folder"}), "[" * 100_000):
        (tmp_path / "out" / transaction.NAME).write_text(text)
        with pytest.raises(StoreError, match="no manifest"):
            transaction.check_manifest(tmp_path / "out")


def test_scratch_files_of_the_dead_are_cleared_by_the_next_save(tmp_path):
    (tmp_path / ".f.h5.part").write_text("half")
    (tmp_path / ".f.h5.lock").write_text("1 psf lens.h5")
    (tmp_path / ".g.h5.part").write_text("of another file")
    store.save(tmp_path / "f.h5", "lens", {})
    assert sorted(os.listdir(tmp_path)) == [".g.h5.part", "f.h5"]


LOOP = """
    import sys
    sys.path.insert(0, sys.argv[1])
    from test_transaction import put, save
    from pathlib import Path
    print("begun", flush=True)
    for i in range(10**9):
        if sys.argv[2] == "folder":
            put(Path("out"), **{f"part_{k}": str(i) for k in range(5)}, **{f"extra_{i % 3}": str(i)})
        else:
            save(Path("out.h5"), i)
"""


@pytest.mark.parametrize("kind", ["folder", "file"])
def test_kills_at_random_moments_mix_nothing_and_leave_nothing(tmp_path, kind):
    """Every state a kill leaves is one run's alone; the next run leaves no scratch."""
    moments = random.Random(7)
    (tmp_path / "loop.py").write_text(textwrap.dedent(LOOP))
    work = tmp_path / "work"
    work.mkdir()
    words = [sys.executable, tmp_path / "loop.py", Path(__file__).parent, kind]
    for _ in range(6):
        child = subprocess.Popen(words, cwd=work, stdout=subprocess.PIPE)
        child.stdout.readline()
        time.sleep(moments.uniform(0, 0.3))
        os.kill(child.pid, signal.SIGKILL)
        child.wait()
        child.stdout.close()
        if kind == "folder" and (work / "out").exists():
            transaction.check_manifest(work / "out")
            assert (
                len(
                    {
                        p.read_text()
                        for p in (work / "out").iterdir()
                        if p.name != transaction.NAME
                    }
                )
                == 1
            )
        if (
            kind == "file"
            and (work / "out.h5").exists()
            and (work / "out.png").exists()
        ):
            value = store.load(work / "out.h5").attributes["value"]
            assert (
                (work / "out.png")
                .read_bytes()
                .endswith(b"metalens" + str(value).encode())
            )
    if kind == "folder":
        put(work / "out", a="last")
    else:
        save(work / "out.h5", -1)
    assert sorted(os.listdir(work)) == (
        ["out"] if kind == "folder" else ["out.h5", "out.png"]
    )
