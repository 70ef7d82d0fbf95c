"""Bytes, names and limits of mask files, and placements while they are read."""

import mmap
import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from layout.formats.digest import RunningDigest
from metalens.core.arrays import Array
from metalens.core.errors import MaskFileError

LARGE_PART = 1 << 23  # placements of which each column has 32 MB


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


def has_area(points: Array) -> bool:
    """Whether the corners (n, 2) of a polygon do not all lie on one line.

    Args:
        points: (n, 2) corners.
    """
    steps = points[1:] - points[0]
    if not len(steps):
        return False
    longest = steps[np.abs(steps).sum(1).argmax()]
    return bool((steps[:, 0] * longest[1] != steps[:, 1] * longest[0]).any())


def placement_limit(path: Path) -> int:
    """Placements and shapes that a mask file is expanded to by default.

    4 million take less than 1 GB however small the file; 20 more for each byte admit
    long lists (OASIS masks of this package have 4 to 17 pillars a byte).

    Args:
        path: of the mask file.
    """
    return 4_000_000 + 20 * path.stat().st_size


def release_bytes(data: Array, end: int) -> None:
    """Give back the memory of the bytes before ``end`` of a mapped file; they are read
    again if they are looked at.

    Args:
        data: from :func:`map_bytes`.
    """
    base: object = data.base.obj if isinstance(data.base, memoryview) else data.base
    if (
        isinstance(base, mmap.mmap)
        and hasattr(mmap, "MADV_DONTNEED")
        and end >= mmap.PAGESIZE
    ):
        base.madvise(mmap.MADV_DONTNEED, 0, end // mmap.PAGESIZE * mmap.PAGESIZE)


@dataclass(eq=False, slots=True)
class PlacementSums:
    """Placements of a cell while it is read: kept up to a number (None: all), beyond it
    only their sums.

    parts: (child, x, y, turn) of what is kept; child as the reader numbers it. merged:
    how many of them are large;
    small: placements in the others.
    """

    keep: int | None = None
    parts: list[tuple[Array, Array, Array, Array]] = field(default_factory=list)
    count: int = 0
    digest: RunningDigest | None = None
    merged: int = 0
    small: int = 0

    def add(self, child: Array, x: Array, y: Array, turn: Array) -> None:
        """Take in some more."""
        self.count += len(child)
        if self.digest is None:
            self.parts.append((child, x, y, turn))
            if self.keep is None or self.count <= self.keep:
                self._merge(len(child))
                return
            self.digest = RunningDigest()
            for part in self.parts:
                self.digest.take(*part)
            self.parts = []
            return
        self.digest.take(child, x, y, turn)

    def _merge(self, more: int) -> None:
        """Make one of the last parts where they are many: large arrays go back to the
        system when they are let go.
        """
        self.small += more
        if self.small >= LARGE_PART:
            child, x, y, turn = (
                np.concatenate(part)
                for part in zip(*self.parts[self.merged :], strict=True)
            )
            self.parts[self.merged :] = [(child, x, y, turn)]
            self.merged, self.small = self.merged + 1, 0

    def columns(self) -> tuple[Array, Array, Array, Array]:
        """child, x, y, turn of all that is kept; the parts are let go, one column after
        the other.
        """
        columns = [list(part) for part in zip(*self.parts, strict=True)]
        self.parts, made = [], []
        while columns:
            made.append(np.concatenate(columns.pop(0)))
        return made[0], made[1], made[2], made[3]
