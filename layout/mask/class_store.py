"""Class numbers of a lattice between the stages, in memory or in a scratch file."""

import tempfile
from collections.abc import Iterable
from typing import Any

import numpy as np

from layout.mask.plan import RowSource
from metalens.core.arrays import Array

MOST_BYTES = 1 << 27  # of an array in memory


def hold_on_disk(
    shape: tuple[int, ...], dtype: "np.dtype[Any]", blocks: Iterable[tuple[int, Array]]
) -> RowSource:
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
        return lambda first, end: array[first:end]
    scratch = tempfile.TemporaryFile()  # noqa: SIM115 - closed with its last reader
    for _, block in blocks:
        scratch.write(np.ascontiguousarray(block, dtype).data)
    scratch.flush()

    def read(first: int, end: int) -> Array:
        start = first * columns * dtype.itemsize
        size = (end - first, columns)
        return np.array(np.memmap(scratch, dtype, "r", start, size))

    return read
