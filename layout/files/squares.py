"""Places sorted into squares: what is near a place lies in the squares beside its own,
found in sorted order, no tree.

Squares are numbered row by row, with an empty one at either end of each row: those
beside square k are k - 1 and k + 1
in its row and follow each other in the rows below and above. Only places take memory,
not the room between them.
"""

from dataclasses import dataclass

import numpy as np

from layout.process import compiled
from metalens.ground.arrays import Array


@dataclass(frozen=True, eq=False, slots=True)
class Squares:
    """Places by square: order (n,) numbers, key (n,) squares, rising; rows of
    ``columns`` from (left, bottom).
    """

    order: Array
    key: Array
    side: float
    left: float
    bottom: float
    columns: int

    @classmethod
    def of(
        cls,
        x: Array,
        y: Array,
        side: float,
        *,
        kind: Array | None = None,
        middle: Array | None = None,
    ) -> "Squares":
        """Squares of ``side`` around places (n,), each moved by ``middle`` (kinds, 2)
        of its ``kind``.
        """
        kind, middle = _moved(len(x), kind, middle)
        low, high = middle.min(0), middle.max(0)
        left, bottom = float(x.min() + low[0]), float(y.min() + low[1])
        columns = int((x.max() + high[0] - left) // side) + 3
        key = np.empty(len(x), np.int64)
        _keys(x, y, kind, middle, left, bottom, side, columns, key)
        order = np.argsort(key, kind="stable").astype(np.int32)
        return cls(order, key[order], side, left, bottom, columns)

    def seen_by(self, x: Array, y: Array) -> tuple[Array, Array]:
        """(n,) order and key of other places in these squares."""
        key = np.empty(len(x), np.int64)
        _keys(
            x,
            y,
            *_moved(len(x), None, None),
            self.left,
            self.bottom,
            self.side,
            self.columns,
            key,
        )
        order = np.argsort(key, kind="stable").astype(np.int32)
        return order, key[order]


def _moved(count: int, kind: Array | None, middle: Array | None) -> tuple[Array, Array]:
    if kind is None or middle is None:
        return np.zeros(count, np.int32), np.zeros((1, 2))
    return kind, middle


@compiled
def _keys(
    x: Array,
    y: Array,
    kind: Array,
    middle: Array,
    left: float,
    bottom: float,
    side: float,
    columns: int,
    key: Array,
) -> None:
    for n in range(x.shape[0]):
        column = int((x[n] + middle[kind[n], 0] - left) // side) + 1
        row = int((y[n] + middle[kind[n], 1] - bottom) // side)
        key[n] = row * columns + column


@compiled
def first_from(key: Array, wanted: int, at: int) -> int:
    """First place from ``at`` on whose square is ``wanted`` or beyond; for squares
    asked for in rising order.
    """
    while at < key.shape[0] and key[at] < wanted:
        at += 1
    return at
