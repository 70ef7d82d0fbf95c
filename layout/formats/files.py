"""Bytes, names and limits of mask files."""

import mmap
import os
from pathlib import Path

import numpy as np

from metalens.core.arrays import Array
from metalens.core.errors import MaskFileError


def map_bytes(path: str | Path) -> Array:
    """The bytes of a file as uint8, read when they are looked at.

    Args:
        path: of the file.

    Raises:
        MaskFileError: an empty file. OSError: it cannot be opened.
    """
    if not os.stat(path).st_size:
        raise MaskFileError(f"{path}: byte 0: empty file, need a mask")
    with open(path, "rb") as file:
        return np.frombuffer(
            mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ), np.uint8
        )


MOST_PLACEMENTS = 2**29  # that are read from bytes of unknown origin
CONTEXT_CELL = "$$$CONTEXT_INFO$$$"  # KLayout's record of library cells: no drawing


def decode_name(data: bytes) -> str:
    """A name of a mask file: UTF-8, or Latin-1 where it is none; trailing NULs go.

    Args:
        data: bytes of the name.
    """
    data = data.rstrip(b"\0")
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def placement_limit(path: Path) -> int:
    """Placements and shapes that a mask file is expanded to by default.

    4 million take less than 1 GB however small the file; 20 more for each byte admit
    long lists (OASIS masks of this package have 4 to 17 pillars a byte).

    Args:
        path: of the mask file.
    """
    return 4_000_000 + 20 * path.stat().st_size


def release_bytes(data: Array, end: int) -> None:
    """Give back the memory of the bytes before ``end`` of a mapped file.

    They are read again if they are looked at.

    Args:
        data: from :func:`map_bytes`.
        end: byte after the last.
    """
    base: object = data.base.obj if isinstance(data.base, memoryview) else data.base
    if (
        isinstance(base, mmap.mmap)
        and hasattr(mmap, "MADV_DONTNEED")
        and end >= mmap.PAGESIZE
    ):
        base.madvise(mmap.MADV_DONTNEED, 0, end // mmap.PAGESIZE * mmap.PAGESIZE)
