"""What a folder of ours holds: manifest.json with the SHA-256 of every file, the
command and the versions.
"""

import json
import os
import re
import shutil
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

from metalens.core import store
from metalens.core.errors import StoreError

NAME, KIND, VERSION = "manifest.json", "metalens folder", 1
_LARGEST = 1 << 26  # bytes of a manifest
_HEAD, _TAIL = 4096, 64
_TITLE = re.compile(rb'\[?"[0-9]|$')  # of a journal; nothing: it was just begun
# first bytes of a file, and what ours has soon after or at its end
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
    (
        b"",
        b" 0 0 0\t \t\n",
    ),  # Zemax grid phase: blanks at the end of its first line, for want of comments
)


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
        if path.stat().st_size > _LARGEST:
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
        for name in names:
            handle = os.open(os.path.join(place, name), os.O_RDONLY)
            try:
                os.fsync(handle)
            finally:
                os.close(handle)
        store.sync_folder(Path(place))


def iterate_files(folder: Path) -> Iterator[str]:
    """Names of all files below a folder, the manifest aside; folders that hold nothing
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
        path: file to read or write.
    """
    if path.is_dir():
        return _foreign_folder(path)
    try:
        with open(path, "rb") as file:
            head = file.read(_HEAD)
            file.seek(max(0, os.fstat(file.fileno()).st_size - _TAIL))
            known = head + file.read()
    except OSError as error:
        return f"cannot be read ({error.strerror})"
    if any(head.startswith(first) and mark in known for first, mark in _MARKS):
        return ""
    if head[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        return "" if _is_our_tiff(path) else "was not made by metalens"
    return "" if store.kind_of(path) else "was not made by metalens"


def open_journal(path: Path, title: str) -> list[str]:
    """Whole lines of the journal of a piece of work after its title, its first; other
    work's is begun afresh.

    title: one line of JSON, a text or a list, that begins with the version.

    Args:
        path: file to read or write.

    Raises:
        StoreError: a file that is no journal stands there.
    """
    lines = store.whole_lines(path)
    if lines and lines[0] == title:
        return lines[1:]
    if path.is_dir() or (path.is_file() and not _TITLE.match(path.read_bytes()[:64])):
        raise StoreError(
            f"{path} is in the way of what is kept for an interruption, and no journal of metalens; move it"
        )
    store.write_text(path, title + "\n")
    return []


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


def _is_our_tiff(path: Path) -> bool:
    with open(path, "rb") as file:
        head = file.read(65536)
        file.seek(max(0, path.stat().st_size - 65536))
        return b"metalens" in head + file.read()
