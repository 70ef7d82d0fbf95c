"""Class numbers of a lattice between the stages: in memory, or in a scratch file where
they would fill it.
"""

import os
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from layout.mask.plan import PillarLattice, RowSource
from metalens.core.arrays import Array

MOST_BYTES = 1 << 27  # kept in memory


@dataclass(frozen=True, eq=False, slots=True)
class ScratchArray:
    """(rows, columns) class numbers; ``source`` gives blocks of rows, ``array`` all,
    where they are in memory.
    """

    shape: tuple[int, int]
    source: RowSource
    array: Array | None

    def whole(self) -> Array:
        """All of them, read from the scratch file where they are there."""
        return self.source(0, self.shape[0]) if self.array is None else self.array

    def blocks(self, sites: int) -> Iterator[tuple[int, Array]]:
        """(first row, class numbers) in blocks of rows of some ``sites``."""
        size = max(1, sites // max(1, self.shape[1]))
        for first in range(0, self.shape[0], size):
            yield first, self.source(first, min(first + size, self.shape[0]))

    def lattice(
        self, name: str, *, pitch: int, x0: int, y0: int, upside_down: bool = False
    ) -> PillarLattice:
        """As a lattice of the mask; ``upside_down``: the last row on top."""
        rows, columns = self.shape
        if self.array is not None:
            array = (
                np.ascontiguousarray(self.array[::-1]) if upside_down else self.array
            )
            return PillarLattice.of(name, array, pitch=pitch, x0=x0, y0=y0)

        def turned(first: int, end: int) -> Array:
            return np.ascontiguousarray(self.source(rows - end, rows - first)[::-1])

        return PillarLattice(
            name, rows, columns, pitch, x0, y0, turned if upside_down else self.source
        )


def hold_on_disk(
    shape: tuple[int, ...], dtype: "np.dtype[Any]", blocks: Iterable[tuple[int, Array]]
) -> ScratchArray:
    """Keep blocks of rows (first row, class numbers), which together are all of them.

    Beyond 128 MB they go to a nameless file in the folder for temporary files
    (``TMPDIR``), gone with the last use.
    """
    rows, columns = shape[0], shape[1]
    if rows * columns * dtype.itemsize <= MOST_BYTES:
        array = np.empty((rows, columns), dtype)
        for first, block in blocks:
            array[first : first + len(block)] = block
        return ScratchArray((rows, columns), lambda first, end: array[first:end], array)
    scratch, line = tempfile.TemporaryFile(), columns * dtype.itemsize  # noqa: SIM115 - closed with its last reader
    for first, block in blocks:
        _write_at(scratch.fileno(), np.ascontiguousarray(block, dtype), first * line)

    def read(first: int, end: int) -> Array:
        out = np.empty((end - first, columns), dtype)
        _read_at(scratch.fileno(), out, first * line)
        return out

    return ScratchArray((rows, columns), read, None)


def _write_at(file: int, block: Array, at: int) -> None:
    view = memoryview(block.data).cast("B")
    while len(view):
        done = os.pwrite(file, view, at)
        view, at = view[done:], at + done


def _read_at(file: int, out: Array, at: int) -> None:
    view = memoryview(out.data).cast("B")
    while len(view):
        done = os.preadv(file, [view], at)
        if not done:
            raise OSError("the scratch file of a mask was cut while it was in use")
        view, at = view[done:], at + done
