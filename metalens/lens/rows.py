"""A large 2-D data set of a file, read in bands of rows when it is looked at."""

from pathlib import Path
from typing import Any

import h5py
import numpy as np

from metalens.core import reading
from metalens.core.arrays import Array

_BAND = 256  # rows, where the file is not cut into chunks


class RowsOnDisk:
    """Stands for an array (y, x) where blocks of rows are all that is needed;
    ``numpy.asarray`` reads all of it.

    A slice of rows (and columns), a row number, least and most: anything else needs
    ``numpy.asarray`` first. The band
    of rows read last is kept, whole chunks of the file. The file is to have been read
    with
    :func:`metalens.core.reading.read_hdf5` before; reading rows of one that was
    written to since is a StoreError.
    """

    def __init__(self, path: str | Path, name: str) -> None:
        self._path, self._stamp = path, reading.file_stamp(path)
        self._file = h5py.File(path, "r")
        self._data: h5py.Dataset = self._file[name]
        self.shape: tuple[int, int] = self._data.shape
        self.dtype, self.ndim, self.nbytes = (
            self._data.dtype,
            self._data.ndim,
            self._data.nbytes,
        )
        self._height = int(self._data.chunks[0]) if self._data.chunks else _BAND
        self._first, self._kept = 0, np.empty((0, self.shape[1]), self.dtype)
        self._ends: tuple[float, float, int] | None = None

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, key: Any) -> Any:
        rows, rest = (key[0], key[1:]) if isinstance(key, tuple) else (key, ())
        if isinstance(rows, slice):
            first, end, step = rows.indices(len(self))
            block = self._rows(first, max(first, end))[::step]
            return block[(slice(None), *rest)]
        row = int(rows)
        return self._rows(row, row + 1)[(0, *rest)]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Array:
        found = np.asarray(self._data[...], dtype)
        reading.check_same(self._path, self._stamp)
        return found

    def max(self, initial: float = 0.0) -> float:
        """Largest value; NaN where one is not a number."""
        return float(np.maximum(self._extremes()[1], initial))

    def min(self, initial: float = 0.0) -> float:
        """Least value; NaN where one is not a number."""
        return float(np.minimum(self._extremes()[0], initial))

    @property
    def count(self) -> int:
        """Values that are not 0."""
        return self._extremes()[2]

    def _extremes(self) -> tuple[float, float, int]:
        """Least and largest value, and how many are not 0."""
        if self._ends is None:
            low, high, count = np.inf, -np.inf, 0
            for first in range(0, len(self), self._height):
                band = self[first : first + self._height]
                low, high = np.minimum(low, band.min()), np.maximum(high, band.max())
                count += int(np.count_nonzero(band))
            self._ends = float(low), float(high), count
        return self._ends

    def _rows(self, first: int, end: int) -> Array:
        """Rows from whole bands; within the band that is kept without a copy."""
        pieces = []
        while first < end:
            if not self._first <= first < self._first + len(self._kept):
                self._first = first // self._height * self._height
                self._kept = self._data[self._first : self._first + self._height]
                reading.check_same(self._path, self._stamp)
            stop = min(end, self._first + len(self._kept))
            pieces.append(self._kept[first - self._first : stop - self._first])
            first = stop
        if len(pieces) == 1:
            return pieces[0]
        return (
            np.concatenate(pieces)
            if pieces
            else np.empty((0, self.shape[1]), self.dtype)
        )
