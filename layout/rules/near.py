"""Pairs of shapes that can be nearer than a rule, of any sizes, by bins in sorted
order: no tree, no object for each.

Shapes of like size (within a factor of four) are sorted into squares as wide as two of
the largest and the rule: those
that can be near each other lie in neighbouring squares. Of many shapes a band of rows
is sorted after the other.
"""

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from layout.files.squares import Squares, first_from
from layout.process import compiled
from metalens.ground.arrays import Array
from metalens.ground.errors import MaskFileError

MOST_PAIRS = 1 << 22
_OCTAVES = 2  # of size that are sorted together
_AT_ONCE = 1 << 20
_BAND = 1 << 22  # shapes that are sorted at once, at some 60 bytes each
_BEYOND = 1 << 31  # above all places


@dataclass(frozen=True, eq=False, slots=True)
class Discs:
    """Circles around shapes: x, y, kind (n,) int32; middle (kinds, 2), seen from the
    place, and reach (kinds,).
    """

    x: Array
    y: Array
    kind: Array
    middle: Array
    reach: Array


@dataclass(frozen=True, eq=False, slots=True)
class _Group:
    """Shapes of like size by square. order: (n,) their numbers, in the order of the
    squares; widest: largest reach.

    seeks: pairs with them are wanted.
    """

    order: Array
    squares: Squares
    widest: float
    seeks: bool


def pairs(
    discs: Discs, gap: float, *, beside: Array | None = None
) -> tuple[Array, Array]:
    """(m,) first and second of all pairs whose circles are nearer than ``gap``, each
    once.

    beside: (kinds,) bool: only pairs with one of these kinds at least. None: all pairs.

    Raises:
        MaskFileError: more than 4e6 pairs.
    """
    ones, twos, total = [], [], 0
    for one, two in _banded(discs, gap, beside):
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


def _banded(
    discs: Discs, gap: float, beside: Array | None
) -> Iterator[tuple[Array, Array]]:
    """As :func:`pairs`, piece by piece.

    A band holds its own rows and those above them that its shapes can reach; a pair
    counts where its lower place is.
    The few widest kinds, which reach over many rows, join every band, and count with
    the other one of their pair.
    """
    if len(discs.kind) <= _BAND:
        yield from _found(discs, _groups(discs, gap, beside), gap)
        return
    wide, edges, reach = _bands(discs, gap)
    for low, high in itertools.pairwise(edges):
        within = (discs.y >= low) & (discs.y < high + reach)
        members = np.flatnonzero(within | wide[discs.kind]).astype(np.int32)
        x, y, kind = (v[members] for v in (discs.x, discs.y, discs.kind))
        some = Discs(x, y, kind, discs.middle, discs.reach)
        place = np.where(wide[kind], np.int64(_BEYOND), y)
        for one, two in _found(some, _groups(some, gap, beside), gap):
            here = np.minimum(place[one], place[two]) < high
            yield members[one[here]], members[two[here]]


def _bands(discs: Discs, gap: float) -> tuple[Array, list[int], int]:
    """(kinds,) which join every band; edges of the bands along y; how far above its
    band a place can be reached.
    """
    extent = np.abs(discs.middle[:, 1]) + discs.reach
    order = np.argsort(-extent)
    before = np.cumsum(np.bincount(discs.kind, minlength=len(extent))[order])
    wide = np.zeros(len(extent), bool)
    wide[order[before <= _BAND // 8]] = True
    reach = int(np.ceil(2 * extent[~wide].max() + gap))
    low, high = int(discs.y.min()), int(discs.y.max())
    count = int(np.clip((high - low) // (2 * reach), 1, -(-len(discs.kind) // _BAND)))
    inner = np.quantile(
        discs.y[:: max(1, len(discs.kind) >> 16)], np.arange(1, count) / count
    ).astype(np.int64)
    return wide, [low, *inner.tolist(), _BEYOND + 1], reach


def _groups(discs: Discs, gap: float, beside: Array | None) -> list[_Group]:
    """Shapes by size, and apart whether pairs with them are wanted."""
    sized = np.floor(np.log2(np.maximum(discs.reach, 1)) / _OCTAVES).astype(np.int64)
    used = np.bincount(discs.kind, minlength=len(sized)) > 0
    wanted = np.ones(len(sized), bool) if beside is None else beside
    return [
        _group(discs, (sized == size) & used & (wanted == mark), gap, seeks=mark)
        for size in np.unique(sized[used])
        for mark in (False, True)
        if ((sized == size) & used & (wanted == mark)).any()
    ]


def _group(discs: Discs, kinds: Array, gap: float, *, seeks: bool) -> _Group:
    members = np.flatnonzero(kinds[discs.kind]).astype(np.int32)
    widest = float(discs.reach[kinds].max())
    x, y, kind = (v[members] for v in (discs.x, discs.y, discs.kind))
    squares = Squares.of(x, y, 2 * widest + gap, kind=kind, middle=discs.middle)
    return _Group(members[squares.order], squares, widest, seeks)


def _found(
    discs: Discs, groups: list[_Group], gap: float
) -> Iterator[tuple[Array, Array]]:
    """Pairs within each group, and of each with all before it, that are not larger."""
    shapes = (discs.x, discs.y, discs.kind, discs.middle, discs.reach)
    out = np.empty((2, _AT_ONCE), np.int32)
    for n, one in enumerate(groups):
        own: tuple[Any, ...] = (one.order, one.squares.key, one.squares.columns)
        if one.seeks:
            yield from _collected(
                partial(_within, *own, *shapes, gap),  # type: ignore[call-arg]
                len(one.order),
                out,
            )
        for two in (some for some in groups[:n] if one.seeks or some.seeks):
            s = two.squares
            other: tuple[Any, ...] = (
                one.order,
                two.order,
                s.key,
                s.left,
                s.bottom,
                s.side,
                s.columns,
                two.widest,
            )
            yield from _collected(
                partial(_across, *other, *shapes, gap),  # type: ignore[call-arg]
                len(one.order),
                out,
            )


def _collected(
    step: Callable[[int, Array], tuple[int, int]], total: int, out: Array
) -> Iterator[tuple[Array, Array]]:
    """Pairs of all shapes, as many at once as ``out`` holds; ``step``: from a shape on,
    (next shape, pairs).
    """
    first = 0
    while first < total:
        first, count = step(first, out)
        if count == 0 and first < total:
            raise MaskFileError(
                f"more than {out.shape[1]:,} shapes lie on one; the file is no mask"
            )
        yield out[0, :count].copy(), out[1, :count].copy()


@compiled
def _close(
    i: int,
    j: int,
    x: Array,
    y: Array,
    kind: Array,
    middle: Array,
    reach: Array,
    gap: float,
) -> bool:
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
    first: int,
    out: Array,
) -> tuple[int, int]:
    """Pairs of a group from its shape ``first`` on, until ``out`` is full: next shape,
    pairs.
    """
    count, total = 0, key.shape[0]
    above = np.searchsorted(key, key[first] + columns - 1)
    for at in range(first, total):
        begin, i, here = count, order[at], key[at]
        above = first_from(key, here + columns - 1, above)
        for part in range(2):
            other, last = (
                (at + 1, here + 1)
                if part == 0
                else (max(above, at + 1), here + columns + 1)
            )
            while other < total and key[other] <= last:
                if _close(i, order[other], x, y, kind, middle, reach, gap):
                    if count == out.shape[1]:
                        return at, begin
                    out[0, count], out[1, count] = i, order[other]
                    count += 1
                other += 1
    return total, count


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
    """Pairs of shapes ``some`` from ``first`` on with a sorted group of smaller ones:
    next shape, pairs.
    """
    count, total = 0, key.shape[0]
    last_row = key[total - 1] // columns
    for n in range(first, some.shape[0]):
        begin, i = count, some[n]
        px, py = x[i] + middle[kind[i], 0] - left, y[i] + middle[kind[i], 1] - bottom
        far = reach[kind[i]] + widest + gap
        low, high = (
            max(int((px - far) // side) + 1, 0),
            min(int((px + far) // side) + 1, columns - 1),
        )
        for row in range(
            max(int((py - far) // side), 0), min(int((py + far) // side), last_row) + 1
        ):
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
