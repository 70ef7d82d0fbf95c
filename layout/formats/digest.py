"""Millions of placements by their sums alone: for each child how many, where on
average, and a hash of all places.
"""

import numpy as np

from layout.process.jit import compile_loop
from metalens.core.arrays import Array
from metalens.core.errors import MaskFileError

_FIRST, _SECOND, _THIRD = (
    np.uint64(0x9E3779B97F4A7C15),
    np.uint64(0xBF58476D1CE4E5B9),
    np.uint64(0x94D049BB133111EB),
)
_MOST = 1 << 24  # children
_OTHER = 8  # turns from here on are no quarter turns: equal in the hash


class RunningDigest:
    """Running sums over placements; children are numbered from any integer."""

    def __init__(self) -> None:
        self._sums = np.zeros((0, 4), np.int64)
        self._hashes = np.zeros(0, np.uint64)

    def take(self, child: Array, x: Array, y: Array, turn: Array) -> None:
        """Add placements: (n,) numbers, places and turns (0: as it is)."""
        if not len(child):
            return
        slot = _slots(child.astype(np.int64))
        self._grow(int(slot.max()) + 1)
        _take(
            slot, x.astype(np.int64), y.astype(np.int64), turn, self._sums, self._hashes
        )

    @property
    def children(self) -> Array:
        """(children,) numbers of those that occur."""
        slot = np.flatnonzero(self._sums[:, 0])
        return np.where(slot % 2 == 0, slot // 2, -(slot + 1) // 2)

    def of(self, children: Array) -> Array:
        """(children, 5) count, sums of x and y, number turned, and hash, by number."""
        slot = _slots(children)
        self._grow(int(slot.max(initial=0)) + 1)
        return np.column_stack([self._sums[slot], self._hashes[slot].view(np.int64)])

    def _grow(self, size: int) -> None:
        """Make room for ``size`` slots; refuse more than 2^24."""
        if size > _MOST:
            raise MaskFileError(
                f"cells numbered beyond {_MOST // 2}: too many for sums; read all placements"
            )
        if size > len(self._hashes):
            more = 2 * size - len(self._hashes)
            self._sums = np.concatenate([self._sums, np.zeros((more, 4), np.int64)])
            self._hashes = np.concatenate([self._hashes, np.zeros(more, np.uint64)])


def _slots(child: Array) -> Array:
    """Slot of each child: even from number 0 on, odd below."""
    return np.where(child >= 0, 2 * child, -2 * child - 1)


@compile_loop
def _mixed(x: int, y: int) -> np.uint64:
    """splitmix64 hash of x and y, 32 bits each."""
    z = (np.uint64(x & 0xFFFFFFFF) << np.uint64(32)) | np.uint64(y & 0xFFFFFFFF)
    z = z + _FIRST
    z = (z ^ (z >> np.uint64(30))) * _SECOND
    z = (z ^ (z >> np.uint64(27))) * _THIRD
    return z ^ (z >> np.uint64(31))


@compile_loop
def _take(
    slot: Array, x: Array, y: Array, turn: Array, sums: Array, hashes: Array
) -> None:
    """Add placements to the sums of their slots, in place.

    Args:
        slot: (n,) slot of each child.
        x, y: (n,) places.
        turn: (n,) orientations, 0: as it is.
        sums: (slots, 4) count, sum of x, sum of y, number turned.
        hashes: (slots,) sum of the hashes of the places.
    """
    for n in range(slot.shape[0]):
        number = slot[n]
        sums[number, 0] += 1
        sums[number, 1] += x[n]
        sums[number, 2] += y[n]
        sums[number, 3] += turn[n] != 0
        hashes[number] += _mixed(x[n], y[n]) * np.uint64(2 * min(turn[n], _OTHER) + 1)
