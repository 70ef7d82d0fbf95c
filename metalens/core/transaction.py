"""Outputs appear whole or not at all; folders carry a manifest of their files."""

import contextlib
import ctypes
import json
import os
import shutil
import sys
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from metalens.core import store
from metalens.core.errors import OutputError, StoreError

ROOM = 1 << 22  # bytes that every output may need
# endings of what an interruption leaves for the next run
UNFINISHED, JOURNAL = ".unfinished", ".resume"
NAME, KIND, VERSION = "manifest.json", "metalens folder", 1
_ENDS = 1 << 16  # bytes at either end of a file in which its mark is looked for
# first bytes of a file, and what ours has in it
_MARKS = (
    (b"\x89PNG", b"Software\0metalens"),
    (b"<!doctype html>", b'name="generator" content="metalens'),
    (b"MATLAB 5.0 MAT-file, metalens", b""),
    (b"file,depth_um,angle_deg,exposure_s", b""),
    (
        b'<?xml version="1.0" encoding="utf-8"?>\n<report-database>',
        b"<generator>metalens",
    ),
    (b"PK", b"metalens"),  # NumPy's archive, with a comment
    (b"II*\0", b"metalens"),  # TIFF, BigTIFF
    (b"MM\0*", b"metalens"),
    (b"II+\0", b"metalens"),
    (b"MM\0+", b"metalens"),
    (b"", b" 0 0 0\t \t\n"),  # Zemax grid phase: blanks end its first line
)


@dataclass(frozen=True, slots=True)
class OutputDraft:
    """A claimed output.

    path: where to write it; companions of a file go into the same folder under their own
    names.
    target: where all appears at the end; where a link leads. resumed: whether ``path``
    holds work of an earlier run.
    """

    path: Path
    target: Path
    resumed: bool = False


@dataclass(frozen=True, kw_only=True, slots=True)
class ClaimTerms:
    """What a claim allows.

    force: whether what exists may be replaced, if it is ours. inputs: files and folders
    that are read.
    room: bytes that the output needs. parents: whether missing folders above it are
    made.
    """

    force: bool = False
    inputs: Sequence[Path] = ()
    room: int = ROOM
    parents: bool = False


@contextlib.contextmanager
def claim_file(
    target: Path, *, companions: Sequence[str] = (), terms: ClaimTerms = ClaimTerms()
) -> Iterator[OutputDraft]:
    """Claim a file and its companions, give a scratch path, and put all in place if the
    block succeeds.

    Args:
        target: the file.
        companions: endings of the companions: ``_xz.png`` is NAME_xz.png for NAME.h5.
        terms: what the claim allows.

    Raises:
        OutputError: see :func:`_refuse`; OSError: it cannot be written.
    """
    target = _followed(target)
    names = [target.stem + end for end in companions]
    if target.name.lower() in (name.lower() for name in names):
        raise OutputError(
            f"{target}: a file of that name is written with the result; give another ending, as .h5"
        )
    with _claim(target, terms, is_folder=False) as scratch:
        _refuse(target, names, terms, is_folder=False)
        new = scratch / "new"
        new.mkdir()
        yield OutputDraft(new / target.name, target)
        written = {path.name for path in new.iterdir()} - {target.name}
        sync_files(new)
        _refuse(target, {*names} | written, terms, is_folder=False)
        # a picture is missing after a kill, never another's
        for name in {*names} | written:
            target.with_name(name).unlink(missing_ok=True)
        (new / target.name).replace(target)
        for name in written:
            (new / name).replace(target.with_name(name))
        store.sync_file(target.parent)


@contextlib.contextmanager
def claim_folder(
    target: Path, *, terms: ClaimTerms = ClaimTerms()
) -> Iterator[OutputDraft]:
    """Claim a folder, give a scratch folder to fill, and put it in place with a
    manifest if the block succeeds.

    Args:
        target: the folder.
        terms: what the claim allows.

    Raises:
        OutputError: see :func:`_refuse`; OSError: it cannot be written.
    """
    target = _followed(target)
    with _claim(target, terms, is_folder=True) as scratch:
        _refuse(target, (), terms, is_folder=True)
        new = scratch / "new"
        new.mkdir()
        yield OutputDraft(new, target)
        _finish(new)
        _refuse(target, (), terms, is_folder=True)
        _put(scratch, new, target)


@contextlib.contextmanager
def claim_long_work(
    target: Path,
    *,
    keep: Sequence[str],
    resume: bool = False,
    grow: bool = False,
    terms: ClaimTerms = ClaimTerms(),
) -> Iterator[OutputDraft]:
    """As :func:`claim_folder` for work of minutes to days: it is done in
    ``NAME.unfinished``
    in the folder of the target.

    That folder survives an interruption if it holds a file that matches a pattern of
    ``keep``; with ``resume`` the next run goes on in it, or in a copy of the finished
    folder. What stands at ``target`` stays until the end. What others put into a folder
    of ours goes with it, and does not become ours.

    Args:
        target: the folder.
        keep: patterns of files that are worth keeping.
        resume: go on with unfinished work.
        grow: always go on, from a copy of what stands at ``target``, and put the whole
            back; it must have a manifest, or hold nothing but folders that have one.
        terms: what the claim allows.

    Raises:
        OutputError: nothing to resume, or unfinished work that would be lost; see
            :func:`_refuse`.
    """
    target = _followed(target)
    with _claim(target, terms, is_folder=True) as scratch:
        work = unfinished_path(target)
        if not (resume or grow):
            _refuse(target, (), terms, is_folder=True)
        check_room(target, terms.room)
        resumed = _open_work(scratch, target, terms, resume=resume or grow, grow=grow)
        try:
            yield OutputDraft(work, target, resumed=resumed)
            _finish(work)
            if not (resume or grow):
                _refuse(target, (), terms, is_folder=True)
            _put(scratch, work, target)
        except BaseException as error:
            if any(True for pattern in keep for _ in work.glob(pattern)):
                how = "the same command" if grow else "--resume"
                error.add_note(f"{work} holds what is done so far; {how} goes on")
            else:
                shutil.rmtree(work, ignore_errors=True)
            raise


def unfinished_path(target: Path) -> Path:
    """Where the work on a folder is done until it is finished.

    Args:
        target: output file.
    """
    target = _followed(target)
    return target.with_name(target.name + UNFINISHED)


def check_room(target: Path, room: int) -> None:
    """Refuse an output that its disk has no room for; for sizes known after the claim.

    Args:
        target: the output.
        room: bytes that it needs.

    Raises:
        OutputError: naming what is free and what is needed.
    """
    spare = shutil.disk_usage(target.parent).free
    if spare < room:
        raise OutputError(
            f"{target}: {spare / 1e6:.3g} MB free, need {room / 1e6:.3g} MB; make room first"
        )


def _followed(target: Path) -> Path:
    """What a link leads to, also where that does not stand yet."""
    try:
        return target.resolve() if os.path.islink(target) else target
    except (OSError, RuntimeError) as error:
        raise OutputError(
            f"{target}: a link that leads nowhere ({error}); give another name"
        ) from None


@contextlib.contextmanager
def _claim(target: Path, terms: ClaimTerms, *, is_folder: bool) -> Iterator[Path]:
    """Lock an output and give an empty scratch folder in its folder, which goes in the
    end; that of a killed owner goes first.
    """
    if "\0" in str(target) or target.name in ("", ".", ".."):
        raise OutputError(
            f"{str(target)!r}: need the name of a {'folder' if is_folder else 'file'} to write"
        )
    if target.name.endswith((UNFINISHED, JOURNAL)):
        raise OutputError(
            f"{target}: names that end in {UNFINISHED} or {JOURNAL} are those of interrupted work"
        )
    missing = [one for one in target.parents if not one.exists()] * terms.parents
    if terms.parents:
        target.parent.mkdir(parents=True, exist_ok=True)
    if not target.parent.is_dir():
        how = (
            "is a file: give"
            if target.parent.exists()
            else "does not exist; make it or give"
        )
        raise OutputError(f"{target}: folder {target.parent} {how} another name")
    try:
        with _scratch(target) as scratch:
            yield scratch
    except BaseException as error:
        for one in missing:  # those that were made here and hold nothing
            with contextlib.suppress(OSError):
                one.rmdir()
        if isinstance(error, OSError) and error.filename is None:  # a full disk
            error.add_note(f"{target} could not be made")
        raise


@contextlib.contextmanager
def _scratch(target: Path) -> Iterator[Path]:
    scratch = target.with_name(f".{target.name}.new")
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(store.hold_lock(target))
            if scratch.exists():
                shutil.rmtree(scratch)
            scratch.mkdir()
        except OSError as error:
            raise OutputError(
                f"{target}: its folder cannot be written ({error.strerror}); give another"
            ) from error
        stack.callback(shutil.rmtree, scratch, ignore_errors=True)
        yield scratch


def _refuse(
    target: Path, companions: Iterable[str], terms: ClaimTerms, *, is_folder: bool
) -> None:
    """Refuse an output that is an input, exists without --force, is none of ours, or
    finds no room.

    Raises:
        OutputError: naming what stands there and what to do.
    """
    for path in terms.inputs:
        if path.exists() and target.exists() and path.samefile(target):
            raise OutputError(
                f"{target} is also an input ({path}): it would be replaced; give another name"
            )
        if (
            is_folder
            and path.exists()
            and target.resolve() in path.resolve().parents
            and _is_taken(target)
        ):
            raise OutputError(
                f"{target} holds the input {path}: it would be replaced; give another name"
            )
    if os.path.ismount(target):
        raise OutputError(
            f"{target} is a mount point, which cannot be replaced whole; give another name"
        )
    if target.exists() and target.is_dir() != is_folder:
        found, needed = ("folder", "file") if target.is_dir() else ("file", "folder")
        raise OutputError(f"{target} is a {found}; need the name of a {needed}")
    for path in (target, *(target.with_name(name) for name in companions)):
        if not _is_taken(path):
            continue
        if not terms.force:
            raise OutputError(f"{path} exists; give --force to overwrite it")
        why = foreign_reason(path)
        if why:
            raise OutputError(
                f"{path} {why}: not overwritten, not even with --force; move it or give another name"
            )
    check_room(target, terms.room)


def _is_taken(path: Path) -> bool:
    """Whether a path is taken by more than an empty folder."""
    if path.is_dir():
        return any(path.iterdir())
    return path.exists() or path.is_symlink()


def _finish(folder: Path) -> None:
    """Give a folder its manifest, and sync all that is in it."""
    begun = read_manifest(folder)
    others = begun["others"] if begun else ()
    write_manifest(folder, store.COMMAND.get(), others=others)
    sync_files(folder)


def _put(scratch: Path, new: Path, target: Path) -> None:
    """Exchange a finished folder with what stands."""
    if not target.exists():
        new.rename(target)
    elif _exchange_names(new, target):
        new.rename(scratch / "old")
    else:
        target.rename(scratch / "old")
        new.rename(target)
    store.sync_file(target.parent)


def _exchange_names(one: Path, other: Path) -> bool:
    """Swap two names in one step; False where the system cannot."""
    if not sys.platform.startswith("linux"):
        return False
    call = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    here, exchange = -100, 2  # AT_FDCWD, RENAME_EXCHANGE
    first = os.fsencode(one.absolute())
    second = os.fsencode(other.absolute())
    return call is not None and not call(here, first, here, second, exchange)


def _open_work(
    scratch: Path, target: Path, terms: ClaimTerms, *, resume: bool, grow: bool
) -> bool:
    """Make or find the folder of unfinished work; whether it holds some already."""
    work = unfinished_path(target)
    found = read_manifest(work) if work.is_dir() else None
    if work.exists() and found is None:
        raise OutputError(
            f"{work} is in the way and was not made by metalens; move it or give another name"
        )
    if found is not None and resume:
        return True
    if found is not None and not terms.force:
        raise OutputError(
            f"{work} holds an unfinished run; give --resume to go on, or --force to start over"
        )
    if found is not None:
        work.rename(scratch / "given_up")
    fresh = scratch / "work"
    copied, others = resume and _is_taken(target), set[str]()
    if copied:
        others = unlisted_files(target)
        if others and read_manifest(target) is None:
            raise OutputError(
                f"{target} holds {min(others)} and no {NAME}: not made by metalens"
            )
        if not grow:
            check_manifest(target)
        shutil.copytree(target, fresh, symlinks=True)
    else:
        fresh.mkdir()
    write_manifest(fresh, store.COMMAND.get(), finished=False, others=others)
    fresh.rename(work)
    return copied


def write_manifest(
    folder: Path, command: str, *, finished: bool = True, others: Collection[str] = ()
) -> None:
    """Write the manifest of everything in a folder but ``others``, which are not ours
    and are named as such.

    Unfinished: of a folder that is still being made.
    """
    listed = {name: {"sha256": store.sha256(folder / name), "bytes": (folder / name).stat().st_size}
              for name in (sorted({*iterate_files(folder)} - {*others}) if finished else ())}  # fmt: skip
    about = {
        "kind": KIND,
        "version": VERSION,
        "finished": finished,
        "command": command,
        "versions": dict(store.package_versions()),
        "files": listed,
        "others": sorted(others),
    }
    store.write_text(folder / NAME, json.dumps(about, indent=1) + "\n")


def read_manifest(folder: Path) -> dict[str, Any] | None:
    """The manifest of a folder; None where it has none.

    Raises:
        StoreError: it is damaged or none of ours.
    """
    path = folder / NAME
    if not path.is_file():
        return None
    try:
        if path.stat().st_size > 1 << 26:
            raise ValueError("too large")
        found: dict[str, Any] = json.loads(path.read_bytes())
        if (found["kind"], found["version"]) != (KIND, VERSION):
            raise ValueError(
                f"kind {found['kind']!r} version {found['version']!r}, need {KIND!r} version {VERSION}"
            )
        entries = {
            str(n): {"sha256": str(e["sha256"]), "bytes": int(e["bytes"])}
            for n, e in found["files"].items()
        }
        others = [str(name) for name in found.get("others", ())]
        plain = {"finished": bool(found["finished"]), "command": str(found["command"])}
        return found | plain | {"files": entries, "others": others}
    except (
        OSError,
        ValueError,
        KeyError,
        TypeError,
        AttributeError,
        RecursionError,
    ) as error:
        raise StoreError(
            f"{path}: damaged or no manifest of a metalens folder ({error}); make it again"
        ) from None


def check_manifest(folder: Path) -> None:
    """Refuse a folder of ours that is unfinished or no longer what was written; one
    without a manifest passes.

    Files that were added since are left alone.

    Raises:
        StoreError: what is missing or differs, and what to do.
    """
    found = read_manifest(folder)
    if found is None:
        return
    if not found["finished"]:
        raise StoreError(
            f"{folder} is unfinished: go on with --resume, or make it again"
        )
    for name, entry in found["files"].items():
        path = folder / name
        if not path.is_file():
            raise StoreError(
                f"{path} is missing; {NAME} lists it: make the folder again"
            )
        if (
            path.stat().st_size != entry["bytes"]
            or store.sha256(path) != entry["sha256"]
        ):
            raise StoreError(
                f"{path} is not what was written (SHA-256 differs): make the folder again, or remove {NAME} to use it "
                "as it stands"
            )


def sync_files(folder: Path) -> None:
    """Flush a folder and all that is in it."""
    for place, _, names in os.walk(folder):
        for path in (*(Path(place, name) for name in names), Path(place)):
            store.sync_file(path)


def iterate_files(folder: Path) -> Iterator[str]:
    """Names of all files below a folder, without the manifest; folders that hold nothing
    end in a slash.
    """
    for place, folders, names in os.walk(folder):
        here = Path(place).relative_to(folder)
        yield from (
            (here / n).as_posix() for n in names if (here / n).as_posix() != NAME
        )
        yield from (
            (here / n).as_posix()
            for n in folders
            if os.path.islink(os.path.join(place, n))
        )


def empty_folder(folder: Path) -> None:
    """Remove all that is in a folder but its manifest."""
    for path in folder.iterdir():
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        elif path.name != NAME:
            path.unlink()


def foreign_reason(path: Path) -> str:
    """Why a file or folder may not be replaced as one of ours; '' where it may.

    A folder is ours with a manifest and no file beyond those that it lists; a file by
    its kind or mark.

    Args:
        path: of what stands there.
    """
    if path.is_dir():
        return _foreign_folder(path)
    try:
        with open(path, "rb") as file:
            known = file.read(_ENDS)
            file.seek(max(0, os.fstat(file.fileno()).st_size - _ENDS))
            known += file.read()
    except OSError as error:
        return f"cannot be read ({error.strerror})"
    marked = any(known.startswith(first) and mark in known for first, mark in _MARKS)
    return "" if marked or store.kind_of(path) else "was not made by metalens"


def _foreign_folder(path: Path) -> str:
    present = set(iterate_files(path))
    if not present and not (path / NAME).exists():
        return ""
    try:
        found = read_manifest(path)
    except StoreError as error:
        return str(error)
    if found is None:
        return f"holds {min(present)} and no {NAME}: not made by metalens"
    others = present - found["files"].keys()
    if found["finished"] and others:
        return f"holds {min(others)}, which metalens did not make"
    return ""


def unlisted_files(folder: Path) -> set[str]:
    """Files that neither the manifest of a folder lists nor that of a folder inside it.

    Raises:
        StoreError: a manifest is damaged.
    """
    present = set(iterate_files(folder))
    for place in (folder, *(path.parent for path in folder.rglob(NAME))):
        found, inside = read_manifest(place), place.relative_to(folder)
        present -= (
            {(inside / name).as_posix() for name in (*found["files"], NAME)}
            if found
            else set()
        )
    return present
