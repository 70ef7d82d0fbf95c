"""A cell of a mask file while it is read."""

import dataclasses
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from layout.formats.digest import RunningDigest
from layout.formats.library import (
    QUARTERS,
    UPRIGHT,
    CellPlacements,
    MaskCell,
    Orientation,
    group_equal,
)
from layout.process.process import LayerNumber
from layout.shapes import polygon, region
from metalens.core.arrays import Array

Child = int | str  # reference number, or name


def has_area(points: Array) -> bool:
    """Whether a polygon encloses anything.

    Args:
        points: (n, 2) corners.
    """
    if len(points) < 3:
        return False
    return bool(polygon.twice_area(points) or region.union_contours([points]))


@dataclass(eq=False)
class OpenCell:
    """A cell while it is read: its placements are stored up to a number, summed beyond.

    key: its name or number.
    keep: that number; None: all are stored.
    parts: (child, x, y, turn) of the stored placements; child as the reader numbers it.
    count: placements so far.
    digest: sums, where there are more than ``keep``.
    names: {cell: number} of those placed by name, from -2 down.
    turns: {orientation: number}.
    """

    key: Child
    keep: int | None = None
    parts: list[tuple[Array, Array, Array, Array]] = field(default_factory=list)
    count: int = 0
    digest: RunningDigest | None = None
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
        self, child: int | Array, x: Array, y: Array, turn: Orientation = UPRIGHT
    ) -> None:
        """Add placements of a cell, or of (n,) cells, in one orientation.

        Args:
            child: number or numbers.
            x: (n,) places.
            y: (n,) places.
            turn: of all.
        """
        number = self.turns.setdefault(turn, len(self.turns))
        children = np.broadcast_to(child, len(x)).astype(np.int32)
        turns = np.full(len(x), number, np.uint8 if number < 256 else np.int32)
        self.add(children, x.astype(np.int32), y.astype(np.int32), turns)

    def add(self, *part: Array) -> None:
        """Add placements: (n,) child, x, y and turn, by their numbers."""
        self.count += len(part[0])
        self.parts.append((part[0], part[1], part[2], part[3]))
        if self.keep is not None and self.count > self.keep:
            self.digest = self.digest or RunningDigest()
            for stored in self.parts:
                self.digest.take(*stored)
            self.parts = []

    def close(self, name: str, table: Mapping[int, str] | Sequence[str]) -> MaskCell:
        """The finished cell.

        Args:
            name: of the cell.
            table: names of the reference numbers.

        Raises:
            KeyError: a reference number without a name.
        """
        child_of_number = {number: child for child, number in self.names.items()}

        def named(number: int) -> str:
            return child_of_number[number] if number < 0 else table[number]

        cell = MaskCell(name, self.polygons, skipped=self.skipped)
        if self.digest is not None:
            numbers = self.digest.children
            rows = map(tuple, self.digest.of(numbers).tolist())
            sums = dict(zip(map(named, numbers.tolist()), rows, strict=True))
            return dataclasses.replace(cell, sums=sums)
        if not self.count:
            return cell
        child, x, y, turn = map(np.concatenate, zip(*self.parts, strict=True))
        turns = tuple(self.turns)
        references = []
        for kind, members in group_equal(child.astype(np.int64) * len(turns) + turn):
            number, k = divmod(kind, len(turns))
            references.append(
                CellPlacements(named(number), turns[k], x[members], y[members])
            )
        return dataclasses.replace(cell, references=tuple(references))
