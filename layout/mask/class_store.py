"""Class numbers of a lattice between the stages, in memory or in a scratch file."""

import dataclasses
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from layout.mask.plan import BLOCK_SITES, PillarArray, RowSource
from metalens.core.arrays import Array

MOST_BYTES = 1 << 27  # of an array in memory


@dataclass(frozen=True, eq=False, slots=True)
class ScratchArray:
    """Class numbers.

    shape: rows and columns.
    source: (first row, end row) to a block of rows.
    array: all of them, where they are in memory.
    """

    shape: tuple[int, int]
    source: RowSource
    array: Array | None

    def blocks(self) -> Iterator[tuple[int, Array]]:
        """(first row, class numbers) in blocks of about a million sites."""
        size = max(1, BLOCK_SITES // max(1, self.shape[1]))
        for first in range(0, self.shape[0], size):
            yield first, self.source(first, min(first + size, self.shape[0]))

    def within(self, lattice: PillarArray) -> PillarArray:
        """A lattice with these class numbers.

        Args:
            lattice: name and places.
        """
        return dataclasses.replace(lattice, source=self.source, array=self.array)

    def upside_down(self) -> "ScratchArray":
        """The last row first."""
        rows = self.shape[0]

        def turned(first: int, end: int) -> Array:
            return np.ascontiguousarray(self.source(rows - end, rows - first)[::-1])

        array = None if self.array is None else turned(0, rows)
        return dataclasses.replace(self, source=turned, array=array)


def hold_on_disk(
    shape: tuple[int, ...], dtype: "np.dtype[Any]", blocks: Iterable[tuple[int, Array]]
) -> ScratchArray:
    """Keep class numbers; beyond 128 MB in a nameless file of the temporary folder.

    Args:
        shape: rows and columns.
        dtype: of the class numbers.
        blocks: (first row, class numbers) of consecutive rows, all of them.
    """
    rows, columns = shape[0], shape[1]
    if rows * columns * dtype.itemsize <= MOST_BYTES:
        array = np.empty((rows, columns), dtype)
        for first, block in blocks:
            array[first : first + len(block)] = block
        return ScratchArray((rows, columns), lambda first, end: array[first:end], array)
    scratch = tempfile.TemporaryFile()  # noqa: SIM115 - closed with its last reader
    for _, block in blocks:
        scratch.write(np.ascontiguousarray(block, dtype).data)
    scratch.flush()

    def read(first: int, end: int) -> Array:
        start = first * columns * dtype.itemsize
        size = (end - first, columns)
        return np.array(np.memmap(scratch, dtype, "r", start, size))

    return ScratchArray((rows, columns), read, None)
