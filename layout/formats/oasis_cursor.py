"""Reading the elements of OASIS: integers, reals, strings, point lists, repetitions.
Errors name the byte offset.
"""

import struct

import numpy as np

from layout.formats.files import decode_name
from layout.formats.read_loops import sum_deltas
from layout.mask.plan import FARTHEST
from metalens.core.arrays import Array
from metalens.core.errors import MaskFileError

MOST_BYTES = 9  # of one integer
MOST_COPIES = 1 << 24  # of one regular repetition, which take memory at once
DIRECTIONS = ((1, 0), (0, 1), (-1, 0), (0, -1), (1, 1), (-1, 1), (-1, -1), (1, -1))


class ByteCursor:
    """A position in the bytes of a file, or in those of one decompressed block of it."""

    def __init__(self, path: str, data: Array, *, block: int = -1) -> None:
        self.path = path
        self.data = data
        self.at = 0
        self.block = block
        self.end = len(data)
        self.begin = 0  # of the latest record

    def fail(self, text: str) -> MaskFileError:
        """An error that says where: the byte in the file, or in a compressed block that
        starts there.
        """
        where = (
            f"byte {self.begin}"
            if self.block < 0
            else f"byte {self.block} (compressed block, its byte {self.begin})"
        )
        return MaskFileError(f"{self.path}: {where}: {text}")

    @property
    def left(self) -> int:
        """Bytes not yet read."""
        return self.end - self.at

    def byte(self) -> int:
        """The next byte."""
        if self.at >= self.end:
            raise self.fail("the file ends within a record; it is cut")
        self.at += 1
        return int(self.data[self.at - 1])

    def take(self, count: int) -> bytes:
        """The next ``count`` bytes."""
        if count > self.left:
            raise self.fail(
                f"{count} bytes are announced, {self.left} are left; the file is cut or broken"
            )
        self.at += count
        return self.data[self.at - count : self.at].tobytes()

    def unsigned(self) -> int:
        """A variable-length integer, below 2^63; some writers fill up space with zeros
        at its end.
        """
        value = shift = 0
        while True:
            byte = self.byte()
            if byte & 127 and shift >= 7 * MOST_BYTES:
                raise self.fail(f"an integer of more than {MOST_BYTES} bytes")
            value |= (byte & 127) << min(shift, 7 * MOST_BYTES)
            if byte < 128:
                return value
            shift += 7

    def signed(self) -> int:
        """An integer with its sign in the lowest bit."""
        value = self.unsigned()
        return -(value >> 1) if value & 1 else value >> 1

    def coordinate(self) -> int:
        """A signed integer that must fit 32 bits."""
        return self.within(self.signed())

    def extent(self) -> int:
        """An unsigned integer that must fit 32 bits."""
        return self.within(self.unsigned())

    def within(self, value: int) -> int:
        """``value``, refused beyond 32 bits."""
        if abs(value) > FARTHEST:
            raise self.fail(f"coordinate {value} is beyond 32 bits")
        return value

    def real(self) -> float:
        """One of the eight forms of a real number."""
        form = self.unsigned()
        if form in (0, 1):
            return float(-self.unsigned() if form else self.unsigned())
        if form in (2, 3, 4, 5):
            upper = self.unsigned() if form >= 4 else 1
            lower = self.unsigned()
            if lower == 0:
                raise self.fail("a real number with denominator 0")
            return (-upper if form % 2 else upper) / lower
        if form in (6, 7):
            size, code = (4, "<f") if form == 6 else (8, "<d")
            return float(struct.unpack(code, self.take(size))[0])
        raise self.fail(f"real number of form {form}, need 0 to 7")

    def string(self, *, name: bool = False) -> str:
        """Characters; a ``name`` is not empty."""
        text = decode_name(self.take(self.unsigned()))
        if name and not text:
            raise self.fail("an empty name")
        return text

    def delta(self) -> tuple[int, int]:
        """A g-delta."""
        word = self.unsigned()
        if word & 1:
            return (-(word >> 2) if word & 2 else word >> 2), self.signed()
        dx, dy = DIRECTIONS[word >> 1 & 7]
        return dx * (word >> 4), dy * (word >> 4)

    def points(self, *, closed: bool = True) -> Array:
        """A point list, from (0, 0) on: (n, 2), as it closes to a polygon, or as a path
        has it.
        """
        form = self.unsigned()
        count = self.unsigned()
        if form > 5:
            raise self.fail(f"point list of type {form}, need 0 to 5")
        if not 0 < count <= self.left:
            raise self.fail(f"point list of {count} points with {self.left} bytes left")
        steps = np.array([self._step(form, n) for n in range(count)], object)
        if form == 5:
            steps = np.cumsum(steps, axis=0)
        corners = np.vstack([np.zeros((1, 2), object), np.cumsum(steps, axis=0)])
        self.within(int(np.abs(corners).max()))
        points = corners.astype(np.int64)
        if closed and form < 2:  # the last corner of a rectilinear polygon is implied
            last = points[-1:].copy()
            last[0, (form + count) % 2] = 0
            points = np.vstack([points, last])
        return points

    def _step(self, form: int, n: int) -> tuple[int, int]:
        """Step of a point list: along one axis, in 4 or 8 directions, or any."""
        if form < 2:
            size = self.signed()
            return (size, 0) if n % 2 == form else (0, size)
        if form > 3:
            return self.delta()
        word = self.unsigned()
        dx, dy = DIRECTIONS[word & (1 << form) - 1]
        return dx * (word >> form), dy * (word >> form)

    def repetition(
        self, last: tuple[Array, Array] | None, limit: int
    ) -> tuple[Array, Array]:
        """A repetition of any type: x and y (n,) of all copies from the first.

        Args:
            last: the repetition before, which type 0 repeats.
            limit: number of copies.

        Raises:
            MaskFileError: more copies, or copies beyond 32 bits.
        """
        form = self.unsigned()
        if form == 0 and last is not None:
            return last
        if form in (1, 2, 3, 8, 9):
            columns = self.unsigned() + 2 if form != 3 else 1
            rows = self.unsigned() + 2 if form in (1, 3, 8) else 1
            across, up = (0, 0), (0, 0)
            if form >= 8:
                across = self.delta()
                up = self.delta() if form == 8 else up
            else:
                across = (self.unsigned(), 0) if form != 3 else across
                up = (0, self.unsigned()) if form != 2 else up
            return self._grid(columns, rows, across, up, limit)
        if not 4 <= form <= 11:
            raise self.fail(
                f"repetition of type {form}, need 1 to 11, or 0 after another"
            )
        count = self.unsigned() + 2
        if count > min(self.left + 1, limit):  # each copy needs a byte
            raise self.fail(f"repetition of {count} copies with {self.left} bytes left")
        grid = self.unsigned() if form in (5, 7, 11) else 1
        x, y = np.zeros((2, count), np.int64)
        if form >= 10:
            position = sum_deltas(self.data, self.at, self.end, self.within(grid), x, y)
            if position < 0:
                raise self.fail(
                    f"list of {count - 1} steps that is cut or leaves 32 bits"
                )
            self.at = position
            return x, y
        steps = [self.unsigned() * grid for _ in range(count - 1)]
        self.within(sum(steps))
        (x if form < 6 else y)[1:] = np.cumsum(steps)
        return x, y

    def _grid(
        self,
        columns: int,
        rows: int,
        step: tuple[int, int],
        row_step: tuple[int, int],
        limit: int,
    ) -> tuple[Array, Array]:
        """Offsets of columns x rows copies, row by row, within 32 bits.

        Args:
            columns: number of copies along the first vector.
            rows: along the second.
            step: first vector.
            row_step: second vector.
            limit: number of copies.
        """
        most = min(limit, MOST_COPIES)
        if columns * rows > most:
            raise self.fail(
                f"repetition of {columns} x {rows} = {columns * rows:,} copies, at most {most:,} more are read"
            )
        for axis in (0, 1):
            self.within(abs(columns * step[axis]) + abs(rows * row_step[axis]))
        row, column = np.indices((rows, columns), np.int32).reshape(2, -1)
        x, y = (column * step[axis] + row * row_step[axis] for axis in (0, 1))
        return x, y
