"""Outputs appear whole or not at all; folders carry a manifest of their files."""

import contextlib
import ctypes
import json
import os
import shutil
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from metalens.core import store
from metalens.core.errors import OutputError, StoreError

# endings of the names that an interruption leaves for the next run
UNFINISHED, JOURNAL = ".unfinished", ".resume"
NAME, KIND, VERSION = "manifest.json", "metalens folder", 1


@dataclass(frozen=True, slots=True)
class OutputDraft:
    """A claimed output.

    path: where to write it; companions of a file go into the same folder under their
        own names.
    target: its final path; where a link leads.
    resumed: whether ``path`` holds work of an earlier run.
    """

    path: Path
    target: Path
    resumed: bool = False


@dataclass(frozen=True, kw_only=True, slots=True)
class ClaimTerms:
    """What a claim allows.

    force: whether an existing output may be replaced; of folders only ours.
    inputs: files and folders that are read.
    parents: whether missing folders above it are created.
    """

    force: bool = False
    inputs: Sequence[Path] = ()
    parents: bool = False


@contextlib.contextmanager
def claim_file(
    target: Path, *, companions: Sequence[str] = (), terms: ClaimTerms = ClaimTerms()
) -> Iterator[OutputDraft]:
    """Context of a scratch path for a file; it and its companions are put in place if
    the block succeeds.

    Args:
        target: the file.
        companions: endings of the companions: ``_xz.png`` is NAME_xz.png for NAME.h5.
        terms: what the claim allows.

    Raises:
        OutputError: see :func:`_refuse`; OSError: it cannot be written.
    """
    target = _resolve_link(target)
    names = [target.stem + end for end in companions]
    if target.name.lower() in (name.lower() for name in names):
        raise OutputError(
            f"{target}: a file of that name is written with the result; give another ending, as .h5"
        )
    with _claim(target, terms, is_folder=False) as scratch:
        _refuse(target, names, terms, is_folder=False)
        folder = scratch / "new"
        folder.mkdir()
        yield OutputDraft(folder / target.name, target)
        written = {path.name for path in folder.iterdir()} - {target.name}
        sync_files(folder)
        _refuse(target, {*names} | written, terms, is_folder=False)
        # a picture is missing after a kill, never another's
        for name in {*names} | written:
            target.with_name(name).unlink(missing_ok=True)
        (folder / target.name).replace(target)
        for name in written:
            (folder / name).replace(target.with_name(name))
        store.sync_file(target.parent)


@contextlib.contextmanager
def claim_folder(
    target: Path, *, terms: ClaimTerms = ClaimTerms()
) -> Iterator[OutputDraft]:
    """Context of a scratch folder to fill; it is put in place with a manifest if the
    block succeeds.

    Args:
        target: the folder.
        terms: what the claim allows.

    Raises:
        OutputError: see :func:`_refuse`; OSError: it cannot be written.
    """
    target = _resolve_link(target)
    with _claim(target, terms, is_folder=True) as scratch:
        _refuse(target, (), terms, is_folder=True)
        folder = scratch / "new"
        folder.mkdir()
        yield OutputDraft(folder, target)
        _finish(folder)
        _refuse(target, (), terms, is_folder=True)
        _put(scratch, folder, target)


@contextlib.contextmanager
def claim_long_work(
    target: Path,
    *,
    keep: Sequence[str],
    resume: bool = False,
    grow: bool = False,
    terms: ClaimTerms = ClaimTerms(),
) -> Iterator[OutputDraft]:
    """As :func:`claim_folder`, for work of minutes to days that is done in
    ``NAME.unfinished`` next to the target.

    That folder survives an interruption if it holds a file that matches a pattern of
    ``keep``. With ``resume`` the next run continues in it, or in a copy of the finished
    folder. The content of ``target`` stays until the end.

    Args:
        target: the folder.
        keep: patterns of files that are worth keeping.
        resume: continue unfinished work.
        grow: always continue, from a copy of ``target``, and replace the whole.
        terms: what the claim allows.

    Raises:
        OutputError: unfinished work that would be lost, or a finished folder with files
            that no manifest lists; see :func:`_refuse`.
    """
    target = _resolve_link(target)
    with _claim(target, terms, is_folder=True) as scratch:
        work = unfinished_path(target)
        if not (resume or grow):
            _refuse(target, (), terms, is_folder=True)
        resumed = _open_work(scratch, target, terms, resume=resume or grow, grow=grow)
        try:
            yield OutputDraft(work, target, resumed=resumed)
            _finish(work)
            if not (resume or grow):
                _refuse(target, (), terms, is_folder=True)
            _put(scratch, work, target)
        except BaseException as error:
            if any(True for pattern in keep for _ in work.glob(pattern)):
                command = "the same command" if grow else "--resume"
                error.add_note(f"{work} holds what is done so far; {command} goes on")
            else:
                shutil.rmtree(work, ignore_errors=True)
            raise


def unfinished_path(target: Path) -> Path:
    """Folder ``NAME.unfinished``, where the work on a folder is done until it is
    finished.

    Args:
        target: the finished folder.
    """
    target = _resolve_link(target)
    return target.with_name(target.name + UNFINISHED)


def _resolve_link(target: Path) -> Path:
    """Target of a symbolic link, which need not exist; any other path unchanged.

    Raises:
        OutputError: a link that cannot be resolved.
    """
    try:
        return target.resolve() if os.path.islink(target) else target
    except (OSError, RuntimeError) as error:
        raise OutputError(
            f"{target}: a link that leads nowhere ({error}); give another name"
        ) from None


@contextlib.contextmanager
def _claim(target: Path, terms: ClaimTerms, *, is_folder: bool) -> Iterator[Path]:
    """Context that locks an output and gives an empty scratch folder ``.NAME.new`` next
    to it, removed at the end.

    Args:
        target: the output.
        terms: what the claim allows.
        is_folder: whether the output is a folder.

    Raises:
        OutputError: a name that cannot be written, or no folder to write it in.
    """
    if "\0" in str(target) or target.name in ("", ".", ".."):
        raise OutputError(
            f"{str(target)!r}: need the name of a {'folder' if is_folder else 'file'} to write"
        )
    if target.name.endswith((UNFINISHED, JOURNAL)):
        raise OutputError(
            f"{target}: names that end in {UNFINISHED} or {JOURNAL} are those of interrupted work"
        )
    if terms.parents:
        target.parent.mkdir(parents=True, exist_ok=True)
    if not target.parent.is_dir():
        problem = (
            "is a file: give"
            if target.parent.exists()
            else "does not exist; make it or give"
        )
        raise OutputError(f"{target}: folder {target.parent} {problem} another name")
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
        try:
            yield scratch
        except OSError as error:
            if error.filename is None:  # a full disk
                error.add_note(f"{target} could not be written")
            raise


def _refuse(
    target: Path, companions: Iterable[str], terms: ClaimTerms, *, is_folder: bool
) -> None:
    """Refuse an output that is an input, exists without --force, or is a folder of
    others.

    Args:
        target: the output.
        companions: names of files that are written with it.
        terms: what the claim allows.
        is_folder: whether the output is a folder.

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
    if target.exists() and target.is_dir() != is_folder:
        present, needed = ("folder", "file") if target.is_dir() else ("file", "folder")
        raise OutputError(f"{target} is a {present}; need the name of a {needed}")
    for path in (target, *(target.with_name(name) for name in companions)):
        if not _is_taken(path):
            continue
        if not terms.force:
            raise OutputError(f"{path} exists; give --force to overwrite it")
        if path.is_dir() and (reason := _foreign_folder(path)):
            raise OutputError(
                f"{path} {reason}: not overwritten, not even with --force; move it or give another name"
            )


def _is_taken(path: Path) -> bool:
    """Whether a path is anything but free or an empty folder."""
    if path.is_dir():
        return any(path.iterdir())
    return path.exists() or path.is_symlink()


def _finish(folder: Path) -> None:
    """Write the manifest of a finished folder, and sync all of its files."""
    write_manifest(folder, store.COMMAND.get())
    sync_files(folder)


def _put(scratch: Path, finished: Path, target: Path) -> None:
    """Put a finished folder in place of the target, in one step where the system can;
    the old folder goes to the scratch folder.
    """
    if not target.exists():
        finished.rename(target)
    elif _exchange_names(finished, target):
        finished.rename(scratch / "old")
    else:
        target.rename(scratch / "old")
        finished.rename(target)
    store.sync_file(target.parent)


def _exchange_names(one: Path, other: Path) -> bool:
    """Exchange two names in one step (Linux renameat2); False where that fails."""
    renameat2 = getattr(ctypes.pythonapi, "renameat2", None)
    current_folder, exchange = -100, 2  # AT_FDCWD, RENAME_EXCHANGE
    first = os.fsencode(one.absolute())
    second = os.fsencode(other.absolute())
    return renameat2 is not None and not renameat2(
        current_folder, first, current_folder, second, exchange
    )


def _open_work(
    scratch: Path, target: Path, terms: ClaimTerms, *, resume: bool, grow: bool
) -> bool:
    """Create or reopen the folder of unfinished work; returns whether it holds earlier
    work.

    A copy of the finished target counts as earlier work.

    Args:
        scratch: folder for files on their way in or out.
        target: the output folder.
        terms: what the claim allows.
        resume: continue unfinished work, or a copy of the target.
        grow: the target need not match its manifest.

    Raises:
        OutputError: a folder that is not ours, or unfinished work without resume or
            force.
    """
    work = unfinished_path(target)
    manifest = read_manifest(work) if work.is_dir() else None
    if work.exists() and manifest is None:
        raise OutputError(
            f"{work} is in the way and was not made by metalens; move it or give another name"
        )
    if manifest is not None:
        if resume:
            return True
        if not terms.force:
            raise OutputError(
                f"{work} holds an unfinished run; give --resume to go on, or --force to start over"
            )
        work.rename(scratch / "given_up")
    fresh = scratch / "work"
    copied = resume and _is_taken(target)
    if copied:
        others = unlisted_files(target)
        if others:
            raise OutputError(
                f"{target} holds {min(others)}, which metalens did not make: move it or give another name"
            )
        if not grow:
            check_manifest(target)
        shutil.copytree(target, fresh, symlinks=True)
    else:
        fresh.mkdir()
    write_manifest(fresh, store.COMMAND.get(), finished=False)
    fresh.rename(work)
    return copied


def write_manifest(folder: Path, command: str, *, finished: bool = True) -> None:
    """Write the manifest of all files in a folder: SHA-256 and size of each.

    Args:
        folder: that is listed.
        command: that wrote it.
        finished: False while the folder is being filled; no files are listed then.
    """
    listed = {
        name: {
            "sha256": store.sha256(folder / name),
            "bytes": (folder / name).stat().st_size,
        }
        for name in (sorted(iterate_files(folder)) if finished else ())
    }
    manifest = {
        "kind": KIND,
        "version": VERSION,
        "finished": finished,
        "command": command,
        "versions": dict(store.package_versions()),
        "files": listed,
    }
    store.write_text(folder / NAME, json.dumps(manifest, indent=1) + "\n")


def read_manifest(folder: Path) -> dict[str, Any] | None:
    """Manifest of a folder with its entries' types checked; None where it has none.

    Raises:
        StoreError: it is damaged or not ours.
    """
    path = folder / NAME
    if not path.is_file():
        return None
    try:
        if path.stat().st_size > 1 << 26:
            raise ValueError("too large")
        manifest: dict[str, Any] = json.loads(path.read_bytes())
        if (manifest["kind"], manifest["version"]) != (KIND, VERSION):
            raise ValueError(
                f"kind {manifest['kind']!r} version {manifest['version']!r}, need {KIND!r} version {VERSION}"
            )
        entries = {
            str(n): {"sha256": str(e["sha256"]), "bytes": int(e["bytes"])}
            for n, e in manifest["files"].items()
        }
        stated = {
            "finished": bool(manifest["finished"]),
            "command": str(manifest["command"]),
        }
        return manifest | stated | {"files": entries}
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
    """Refuse a folder of ours that is unfinished or no longer as written; one without a
    manifest passes.

    Files that were added since are ignored.

    Raises:
        StoreError: what is missing or differs, and what to do.
    """
    manifest = read_manifest(folder)
    if manifest is None:
        return
    if not manifest["finished"]:
        raise StoreError(
            f"{folder} is unfinished: go on with --resume, or make it again"
        )
    for name, entry in manifest["files"].items():
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
    """Flush a folder and all files below it to the disk."""
    for path in (*folder.rglob("*"), folder):
        store.sync_file(path)


def iterate_files(folder: Path) -> Iterator[str]:
    """Names of all files below a folder, relative to it, without its manifest; links to
    folders are named too.
    """
    for path in folder.rglob("*"):
        name = path.relative_to(folder).as_posix()
        if name != NAME and (path.is_symlink() or not path.is_dir()):
            yield name


def empty_folder(folder: Path) -> None:
    """Remove everything in a folder but its manifest."""
    for path in folder.iterdir():
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        elif path.name != NAME:
            path.unlink()


def _foreign_folder(path: Path) -> str:
    """Why a folder may not be replaced as one of ours: files without a manifest, a
    damaged manifest, or files beyond those listed. '' where it may.
    """
    present = set(iterate_files(path))
    if not present and not (path / NAME).exists():
        return ""
    try:
        manifest = read_manifest(path)
    except StoreError as error:
        return str(error)
    if manifest is None:
        return f"holds {min(present)} and no {NAME}: not made by metalens"
    others = present - manifest["files"].keys()
    if manifest["finished"] and others:
        return f"holds {min(others)}, which metalens did not make"
    return ""


def unlisted_files(folder: Path) -> set[str]:
    """Names of files that no manifest lists, neither that of a folder nor that of one
    inside it.

    Raises:
        StoreError: a manifest is damaged.
    """
    present = set(iterate_files(folder))
    for parent in (folder, *(path.parent for path in folder.rglob(NAME))):
        manifest = read_manifest(parent)
        relative = parent.relative_to(folder)
        if manifest:
            names = (*manifest["files"], NAME)
            present -= {(relative / name).as_posix() for name in names}
    return present
