"""A cell of a mask file while it is read."""

import dataclasses
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from layout.formats.digest import RunningDigest
from layout.formats.library import (
    NOTHING,
    QUARTERS,
    CellPlacements,
    MaskCell,
    Orientation,
)
from layout.process.process import LayerNumber
from metalens.core.arrays import Array

Child = int | str  # reference number, or name
LARGE_PART = 1 << 23  # placements of which each column has 32 MB
_BATCH = 1 << 18


def has_area(points: Array) -> bool:
    """Whether the corners (n, 2) of a polygon do not all lie on one line.

    Args:
        points: (n, 2) corners.
    """
    steps = points[1:] - points[0]
    if not len(steps):
        return False
    longest = steps[np.abs(steps).sum(1).argmax()]
    return bool((steps[:, 0] * longest[1] != steps[:, 1] * longest[0]).any())


@dataclass(eq=False, slots=True)
class PlacementSums:
    """Placements of a cell while it is read: stored up to a number, summed beyond it.

    keep: that number; None: all are stored. parts: (child, x, y, turn) of the stored
    placements; child as the reader numbers it. count: placements so far. digest: sums,
    where there are more than ``keep``. merged: how many of the parts are large. small:
    placements in the other parts.
    """

    keep: int | None = None
    parts: list[tuple[Array, Array, Array, Array]] = field(default_factory=list)
    count: int = 0
    digest: RunningDigest | None = None
    merged: int = 0
    small: int = 0

    def add(self, child: Array, x: Array, y: Array, turn: Array) -> None:
        """Add placements: kept up to ``keep`` of them, summed beyond it.

        Args:
            child: (n,) numbers.
            x: (n,) places.
            y: (n,) places.
            turn: (n,) orientations.
        """
        self.count += len(child)
        if self.digest is None:
            self.parts.append((child, x, y, turn))
            if self.keep is None or self.count <= self.keep:
                self._merge(len(child))
                return
            self.digest = RunningDigest()
            for part in self.parts:
                self.digest.take(*part)
            self.parts = []
            return
        self.digest.take(child, x, y, turn)

    def _merge(self, more: int) -> None:
        """Join the last parts once they are large; memory then returns to the system.

        Args:
            more: placements of the part added last.
        """
        self.small += more
        if self.small >= LARGE_PART:
            child, x, y, turn = (
                np.concatenate(part)
                for part in zip(*self.parts[self.merged :], strict=True)
            )
            self.parts[self.merged :] = [(child, x, y, turn)]
            self.merged = self.merged + 1
            self.small = 0

    def columns(self) -> tuple[Array, Array, Array, Array]:
        """child, x, y, turn of all placements; parts are released column by column."""
        columns = [list(part) for part in zip(*self.parts, strict=True)]
        self.parts = []
        joined = []
        while columns:
            joined.append(np.concatenate(columns.pop(0)))
        return joined[0], joined[1], joined[2], joined[3]


@dataclass(eq=False, slots=True)
class OpenCell:
    """A cell while it is read.

    key: its name or number.
    names: {cell: number} of those placed by name, from -2 down.
    turns: {orientation: number}.
    """

    key: Child
    held: PlacementSums
    polygons: dict[LayerNumber, list[Array]] = field(default_factory=dict)
    names: dict[str, int] = field(default_factory=dict)
    turns: dict[Orientation, int] = field(
        default_factory=lambda: {turn: k for k, turn in enumerate(QUARTERS)}
    )
    skipped: Counter[str] = field(default_factory=Counter)

    def number(self, name: str) -> int:
        """Number of a cell that is placed by its name."""
        return self.names.setdefault(name, -2 - len(self.names))

    def place(
        self, child: int | Array, x: Array, y: Array, turn: Orientation = QUARTERS[0]
    ) -> None:
        """Take in placements of a cell, or of (n,) cells, in one orientation.

        Args:
            child: number or numbers.
            x: (n,) places.
            y: (n,) places.
            turn: of all.
        """
        number = self.turns.setdefault(turn, len(self.turns))
        children = np.broadcast_to(child, len(x)).astype(np.int32)
        turns = np.full(len(x), number, np.uint8 if number < 256 else np.int32)
        self.held.add(children, x.astype(np.int32), y.astype(np.int32), turns)

    def close(self, name: str, table: Mapping[int, str] | Sequence[str]) -> MaskCell:
        """The finished cell.

        Args:
            name: of the cell.
            table: names of the reference numbers.

        Raises:
            KeyError: a reference number without a name.
        """
        child_of_number = {number: child for child, number in self.names.items()}

        def named(numbers: Array) -> tuple[str, ...]:
            return tuple(
                child_of_number[k] if k < 0 else table[k] for k in numbers.tolist()
            )

        placed = NOTHING
        sums = None
        digest = self.held.digest
        if digest is not None:
            placed = dataclasses.replace(NOTHING, children=named(digest.children))
            sums = digest.of(digest.children)
        elif self.held.count:
            child, x, y, turn = self.held.columns()
            used, index = _numbered(child)
            turns = tuple(self.turns)
            placed = CellPlacements(named(used), index, x, y, turn, turns)
        return MaskCell(name, self.polygons, placed, sums, self.skipped)


def _numbered(child: Array) -> tuple[Array, Array]:
    """Numbers that occur, and the index of each child among them.

    Args:
        child: (n,) int32 numbers; changed in place.

    Returns:
        (used,) numbers, rising, and (n,) int32 index into them.
    """
    low, high = int(child.min()), int(child.max())
    if high - low >= 1 << 22:
        used, index = np.unique(child, return_inverse=True)
        return used, index.astype(np.int32)
    occurs = np.zeros(high - low + 1, bool)
    pieces = range(0, len(child), _BATCH)  # numpy widens what it indexes by
    for n in pieces:
        occurs[child[n : n + _BATCH] - low] = True
    lookup = np.cumsum(occurs, dtype=np.int32) - 1
    for n in pieces:
        child[n : n + _BATCH] = lookup[child[n : n + _BATCH] - low]
    return np.flatnonzero(occurs) + low, child
