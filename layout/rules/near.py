"""Pairs of shapes that can be nearer than a rule, of any sizes, by bins in sorted order: no tree, no object for each.

Shapes of like size (within a factor of four) are sorted into squares as wide as two of the largest and the rule; those
that can be near each other lie in neighbouring squares, which are neighbours in the sorted order too.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from layout.process import compiled
from metalens.ground.arrays import Array
from metalens.ground.errors import MaskFileError

MOST_PAIRS = 1 << 22
_OCTAVES = 2  # of size that are sorted together
_AT_ONCE = 1 << 20


@dataclass(frozen=True, eq=False, slots=True)
class Discs:
    """Circles around shapes: x, y, kind (n,) int32; middle (kinds, 2), seen from the place, and reach (kinds,)."""

    x: Array
    y: Array
    kind: Array
    middle: Array
    reach: Array


@dataclass(frozen=True, eq=False, slots=True)
class _Sorted:
    """Shapes of like size by square: order (n,) numbers, key (n,) rising; rows of ``columns`` from (left, bottom)."""

    order: Array
    key: Array
    side: float
    left: float
    bottom: float
    columns: int
    widest: float


def pairs(discs: Discs, gap: float) -> tuple[Array, Array]:
    """(m,) first and second of all pairs whose circles are nearer than ``gap``, each once.

    Raises:
        MaskFileError: more than 4e6 pairs.
    """
    sized = np.floor(np.log2(np.maximum(discs.reach, 1)) / _OCTAVES).astype(np.int64)
    used = np.bincount(discs.kind, minlength=len(sized)) > 0
    groups = [_sorted(discs, sized == size, gap) for size in np.unique(sized[used])]
    ones, twos, total = [], [], 0
    for one, two in _found(discs, groups, gap):
        total += len(one)
        if total > MOST_PAIRS:
            raise MaskFileError(
                f"more than {MOST_PAIRS:,} pairs of shapes can be closer than the rule; shapes lie on each other, or "
                "the rule's gap is far wider than they are"
            )
        ones.append(one)
        twos.append(two)
    nothing = np.empty(0, np.int32)
    return np.concatenate([nothing, *ones]), np.concatenate([nothing, *twos])


def _sorted(discs: Discs, kinds: Array, gap: float) -> _Sorted:
    members = np.flatnonzero(kinds[discs.kind]).astype(np.int32)
    widest = float(discs.reach[kinds].max())
    side = 2 * widest + gap
    low = np.array([discs.x[members].min(), discs.y[members].min()]) + discs.middle[kinds].min(0)
    wide = int((discs.x[members].max() + discs.middle[kinds, 0].max() - low[0]) // side) + 3
    key = np.empty(len(members), np.int64)
    _keys(members, discs.x, discs.y, discs.kind, discs.middle, low[0], low[1], side, wide, key)
    order = np.argsort(key, kind="stable").astype(np.int32)
    return _Sorted(members[order], key[order], side, float(low[0]), float(low[1]), wide, widest)


def _found(discs: Discs, groups: list[_Sorted], gap: float) -> Iterator[tuple[Array, Array]]:
    """Pairs within each group, and of each with all smaller ones."""
    shapes = (discs.x, discs.y, discs.kind, discs.middle, discs.reach)
    out = np.empty((2, _AT_ONCE), np.int32)
    for n, group in enumerate(groups):
        at, above = 0, 0
        while at < len(group.key):
            at, above, count = _within(group.order, group.key, group.columns, *shapes, gap, at, above, out)
            yield out[0, :count].copy(), out[1, :count].copy()
            if count == 0 and at < len(group.key):
                raise MaskFileError(f"more than {_AT_ONCE:,} shapes lie on one; the file is no mask")
        for other in groups[:n]:
            place = other.left, other.bottom, other.side, other.columns, other.widest
            first = 0
            while first < len(group.order):
                first, count = _across(group.order, other.order, other.key, *place, *shapes, gap, first, out)
                yield out[0, :count].copy(), out[1, :count].copy()
                if count == 0 and first < len(group.order):
                    raise MaskFileError(f"more than {_AT_ONCE:,} shapes lie on one; the file is no mask")


@compiled
def _keys(
    members: Array,
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
    for n in range(members.shape[0]):
        i = members[n]
        column = int((x[i] + middle[kind[i], 0] - left) // side) + 1
        row = int((y[i] + middle[kind[i], 1] - bottom) // side)
        key[n] = row * columns + column


@compiled
def _close(i: int, j: int, x: Array, y: Array, kind: Array, middle: Array, reach: Array, gap: float) -> bool:
    a, b = kind[i], kind[j]
    dx = (x[i] + middle[a, 0]) - (x[j] + middle[b, 0])
    dy = (y[i] + middle[a, 1]) - (y[j] + middle[b, 1])
    far = reach[a] + reach[b] + gap
    return dx * dx + dy * dy < far * far  # type: ignore[no-any-return]


@compiled
def _within(
    order: Array,
    key: Array,
    columns: int,
    x: Array,
    y: Array,
    kind: Array,
    middle: Array,
    reach: Array,
    gap: float,
    at: int,
    above: int,
    out: Array,
) -> tuple[int, int, int]:
    """Pairs of a group from its shape ``at`` on, until ``out`` is full: next shape, first in the row above, pairs."""
    count, total = 0, key.shape[0]
    while at < total:
        begin, i, here = count, order[at], key[at]
        while above < total and key[above] < here + columns - 1:
            above += 1
        for part in range(2):
            other, last = (at + 1, here + 1) if part == 0 else (max(above, at + 1), here + columns + 1)
            while other < total and key[other] <= last:
                if _close(i, order[other], x, y, kind, middle, reach, gap):
                    if count == out.shape[1]:
                        return at, above, begin
                    out[0, count], out[1, count] = i, order[other]
                    count += 1
                other += 1
        at += 1
    return at, above, count


@compiled
def _across(
    some: Array,
    order: Array,
    key: Array,
    left: float,
    bottom: float,
    side: float,
    columns: int,
    widest: float,
    x: Array,
    y: Array,
    kind: Array,
    middle: Array,
    reach: Array,
    gap: float,
    first: int,
    out: Array,
) -> tuple[int, int]:
    """Pairs of shapes ``some`` from ``first`` on with a sorted group of smaller ones: next shape, pairs."""
    count, total = 0, key.shape[0]
    last_row = key[total - 1] // columns
    for n in range(first, some.shape[0]):
        begin, i = count, some[n]
        px, py = x[i] + middle[kind[i], 0] - left, y[i] + middle[kind[i], 1] - bottom
        far = reach[kind[i]] + widest + gap
        low, high = max(int((px - far) // side) + 1, 0), min(int((px + far) // side) + 1, columns - 1)
        for row in range(max(int((py - far) // side), 0), min(int((py + far) // side), last_row) + 1):
            if low > high:
                break
            other = np.searchsorted(key, row * columns + low)
            while other < total and key[other] <= row * columns + high:
                if _close(i, order[other], x, y, kind, middle, reach, gap):
                    if count == out.shape[1]:
                        return n, begin
                    out[0, count], out[1, count] = i, order[other]
                    count += 1
                other += 1
    return some.shape[0], count
