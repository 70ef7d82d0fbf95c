"""What boxes cover, as marked squares over a box: told again by few boxes, and asked
who lies on them.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from metalens.ground.arrays import Array


@dataclass(frozen=True, eq=False, slots=True)
class Squared:
    """Squares over a box ``around`` (4,), row by row from its left bottom corner, and
    which of them are marked.

    side: of a square. marked: (rows, columns). sums: (rows + 1, columns + 1) of the
    marked ones below and to the left.
    Boxes are (n, 4) left, bottom, right, top, their edges belong to them.
    """

    around: Array
    side: float
    marked: Array
    sums: Array

    @classmethod
    def of(cls, around: Array, squares: int, boxes: Iterable[Array]) -> "Squared":
        """Squares, at most ``squares`` and one along the longer side; those are marked
        that any of some boxes touch.
        """
        around = np.asarray(around, np.int64)
        extent = around[2:] - around[:2]
        side = max(float(extent.max()) / squares, 1.0)
        count = (extent // side).astype(np.int64) + 1
        steps = np.zeros(
            count[::-1] + 1, np.int32
        )  # where boxes begin and end, both ways
        for some in boxes:
            left, bottom, right, top = _range(some, around[:2], side, count)
            for row, column, step in (
                (bottom, left, 1),
                (bottom, right, -1),
                (top, left, -1),
                (top, right, 1),
            ):
                np.add.at(steps, (row, column), step)
        marked = steps.cumsum(0)[:-1].cumsum(1)[:, :-1] > 0
        sums = np.pad(
            marked.cumsum(0, dtype=np.int32).cumsum(1, dtype=np.int32), ((1, 0), (1, 0))
        )
        return cls(around, side, marked, sums)

    def touched(self, boxes: Array) -> Array:
        """(n,) whether boxes touch a marked square."""
        count = np.array(self.marked.shape[::-1])
        left, bottom, right, top = _range(boxes, self.around[:2], self.side, count)
        inside = (
            self.sums[top, right]
            - self.sums[bottom, right]
            - self.sums[top, left]
            + self.sums[bottom, left]
        )
        return np.asarray(inside > 0)

    def boxes(self) -> Array:
        """(n, 4) boxes around the marked squares: runs along x, equal ones of rows that
        follow each other as one.
        """
        change = np.diff(np.pad(self.marked.astype(np.int8), ((0, 0), (1, 1))), axis=1)
        (row, left), right = np.nonzero(change > 0), np.nonzero(change < 0)[1]
        order = np.lexsort((row, right, left))
        row, left, right = row[order], left[order], right[order]
        new = (
            (np.diff(left, prepend=-1) != 0)
            | (np.diff(right, prepend=-1) != 0)
            | (np.diff(row, prepend=-2) != 1)
        )
        last = np.roll(new, -1)
        ends = (
            np.column_stack([left[new], row[new], right[new], row[last] + 1])
            * self.side
        )
        low, high = np.tile(self.around[:2], 2), np.tile(self.around[2:], 2)
        whole = (
            np.hstack([np.floor(ends[:, :2]), np.ceil(ends[:, 2:])]).astype(np.int64)
            + low
        )
        return np.asarray(np.clip(whole, low, high))


def _range(boxes: Array, low: Array, side: float, count: Array) -> Array:
    """(4, n) first column and row that boxes touch, and those after the last; nothing
    of boxes beyond the squares.
    """
    first = np.clip((boxes[:, :2] - low) // side, 0, count)
    last = np.clip((boxes[:, 2:] - low) // side + 1, first, count)
    return np.asarray(np.hstack([first, last]).T, np.int64)
