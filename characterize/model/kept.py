"""Arrays that are dear to compute, kept in the user's cache folder by all that they
come from.

A file is named by the SHA-256 of what its arrays were made from: their description,
every source file of the packages
that make them, the versions of the numerical libraries. What is found is what would be
computed, bit for bit; nothing
is ever out of date. A folder that cannot be written or read, or a damaged file (zip
keeps a checksum of every
array), costs time and nothing else.
"""

import contextlib
import functools
import hashlib
import os
import zipfile
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path

import numpy as np
import scipy

from metalens.core import store
from metalens.core.arrays import Array

MOST = 64  # files of one title; the least recently used go first
_ENDING = ".npz"


def cache_folder() -> Path | None:
    """Where they are: ``metalens`` in $XDG_CACHE_HOME, or in ~/.cache; None for
    somebody without a home.
    """
    base, home = os.environ.get("XDG_CACHE_HOME", ""), os.path.expanduser("~")
    if os.path.isabs(base):
        return Path(base) / "metalens"
    return (
        Path(home) / ".cache" / "metalens"
        if os.path.isabs(home) and os.path.isdir(home)
        else None
    )


def cached_arrays(
    title: str,
    about: str,
    packages: Sequence[str],
    make: Callable[[], Mapping[str, Array]],
) -> Mapping[str, Array]:
    """Arrays by name: those of an earlier run, or those of ``make``, which are then
    kept.

    Args:
        title: first part of the file's name. about: all that the arrays depend on, as
            text.
        packages: names of the packages whose source files enter too.
    """
    place = cache_folder()
    if place is None:
        return make()
    told = "\n".join(
        [title, about, _sources(tuple(packages)), np.__version__, scipy.__version__]
    )
    path = place / f"{title}_{hashlib.sha256(told.encode()).hexdigest()[:40]}{_ENDING}"
    found = _read(path)
    if found is None:
        found = make()
        _write(path, title, found)
    return found


def _read(path: Path) -> Mapping[str, Array] | None:
    with contextlib.suppress(
        OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile
    ):
        with np.load(path, allow_pickle=False) as file:
            found = {name: file[name] for name in file.files}
        with contextlib.suppress(OSError):
            os.utime(path)
        return found
    return None


def _write(path: Path, title: str, arrays: Mapping[str, Array]) -> None:
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with store.replace_atomically(path) as part, open(part, "wb") as file:
            np.savez(file, **dict(arrays))  # type: ignore[arg-type]  # the stub takes its own flags for all names
        ours = sorted(
            path.parent.glob(f"{title}_*{_ENDING}"), key=lambda p: p.stat().st_mtime
        )
        for old in ours[:-MOST]:
            old.unlink(missing_ok=True)


@functools.cache
def _sources(packages: tuple[str, ...]) -> str:
    """SHA-256 of every source file of some packages."""
    digest = hashlib.sha256()
    for name in packages:
        home = Path(str(import_module(name).__file__))
        files = (
            sorted(home.parent.rglob("*.py")) if home.name == "__init__.py" else [home]
        )
        for file in files:
            digest.update(file.read_bytes())
    return digest.hexdigest()
