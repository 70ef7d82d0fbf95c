"""Which cells of a mask are looked at once for all their copies, and how often each of
them is drawn.
"""

import itertools
from collections import Counter
from collections.abc import Iterator, Set
from dataclasses import dataclass

import numpy as np

from layout.files import MaskContent, Turn, flat, hierarchy
from metalens.ground.arrays import Array
from metalens.ground.errors import MaskFileError

ROOT = ""  # stands for all top cells, each placed once
_LEAST = 1 << 12  # shapes of a cell whose copies are not taken apart


Offset = tuple[float, float]


@dataclass(frozen=True, eq=False, slots=True)
class Copies:
    """Copies of one cell within another, all turned alike. x, y: (n,) int32."""

    child: str
    turn: Turn
    x: Array
    y: Array


@dataclass(frozen=True, eq=False, slots=True)
class Parts:
    """The cells that are looked at by themselves.

    times: {cell: how often it is drawn, not turned other than by quarters}, each after
    those that place it, ROOT first.
    placed: of each, the copies of others that it holds. apart: shapes of all of them
    once, copies counted as one.
    """

    times: dict[str, int]
    placed: dict[str, list[Copies]]
    apart: int

    def tops(self, content: MaskContent, name: str) -> list[str]:
        """The cells that one of ``times`` stands for."""
        return content.tops if name == ROOT else [name]

    def copies(
        self, name: str, most: int, *, step: float = 1.0, offset: Offset | None = None
    ) -> list[tuple[Turn, int, int]]:
        """Turn and place of the first copies of a cell below the top cells, at most
        ``most``.

        offset: of these only those that stand so on the grid.
        """
        holding = {name}
        for above in reversed(self.times):
            holding |= (
                {above}
                if any(some.child in holding for some in self.placed[above])
                else set()
            )
        first = itertools.islice(
            self._within(ROOT, Turn(), (0, 0), name, holding), most
        )
        return [
            (t, x, y)
            for t, x, y in first
            if offset is None or _offset(t, x, y, step)[0] == offset
        ]

    def offsets(self, step: float) -> dict[str, dict[Offset, int]]:
        """{cell: {where its copies stand on a grid, seen by the cell: how many}}."""
        found: dict[str, dict[Offset, int]] = {name: {} for name in self.times} | {
            ROOT: {(0.0, 0.0): 1}
        }
        for name in self.times:
            for some in self.placed[name]:
                counts = found[some.child]
                for (x, y), times in found[name].items():
                    for own, number in Counter(
                        _offset(some.turn, some.x + x, some.y + y, step)
                    ).items():
                        counts[own] = counts.get(own, 0) + times * number
        return found

    def _within(
        self, above: str, turn: Turn, at: tuple[int, int], name: str, holding: Set[str]
    ) -> Iterator[tuple[Turn, int, int]]:
        if above == name:
            yield turn, *at
            return
        for some in self.placed[above]:
            if some.child in holding:
                x, y = turn.apply(some.x.astype(np.int64), some.y.astype(np.int64))
                for place in zip(
                    (x + at[0]).tolist(), (y + at[1]).tolist(), strict=True
                ):
                    yield from self._within(
                        some.child, turn.after(some.turn), place, name, holding
                    )


def found(content: MaskContent) -> Parts:
    """Cells of at least 4096 shapes that are placed more than once, upright or turned
    by quarters.

    Raises:
        MaskFileError: a hierarchy that is broken, places beyond 32 bits.
    """
    order = hierarchy.ordered(content)
    counts = {name: _counts(content, name) for name in order}
    below, placed = dict.fromkeys(order, 0), dict.fromkeys(order, 0)
    for name in reversed(order):
        own = content.cells[name].taken
        below[name] = own + sum(
            n * below[child] for some in counts[name] for child, n in some.items()
        )
    times = dict.fromkeys(order, 0) | dict.fromkeys(content.tops, 1)
    for name in order:
        for child, n in counts[name][0].items():
            times[child] += times[name] * n
            placed[child] += n * (times[name] > 0)
    whole = {name for name in order if placed[name] > 1 and below[name] >= _LEAST}
    apart: dict[str, int] = {}
    for name in reversed(order):
        upright, turned = counts[name]
        apart[name] = content.cells[name].taken + sum(
            n * below[child] for child, n in turned.items()
        )
        apart[name] += sum(
            n * (1 if child in whole else apart[child]) for child, n in upright.items()
        )
    kept = [name for name in order if name in whole]
    total = sum(apart[name] for name in (*content.tops, *kept))
    return Parts({ROOT: 1} | {name: times[name] for name in kept}, {}, total)


def _offset(
    turn: Turn, x: "Array | float", y: "Array | float", step: float
) -> list[Offset]:
    """Where places stand on a grid, seen by what is turned there."""
    back = np.column_stack(
        turn.back.apply(np.atleast_1d(x).astype(float), np.atleast_1d(y).astype(float))
    )
    return [(u, v) for u, v in (np.round(np.mod(back, step), 6) % step).tolist()]


def _counts(content: MaskContent, name: str) -> tuple[dict[str, int], dict[str, int]]:
    """{child: copies} that are upright or turned by quarters, and those that are turned
    or scaled in another way.
    """
    placed = content.cells[name].kept()
    counts, upright = placed.counts(), np.array([turn.quarter for turn in placed.turns])
    made = []
    for some in (upright, ~upright):
        numbers = counts[:, some].sum(1).tolist()
        made.append(
            {child: n for child, n in zip(placed.children, numbers, strict=True) if n}
        )
    return made[0], made[1]


def with_places(parts: Parts, content: MaskContent) -> Parts:
    """The same with the copies that each cell holds."""
    whole = parts.times.keys() - {ROOT}
    if not whole:
        return Parts(parts.times, {ROOT: []}, parts.apart)
    placed = {
        name: [
            Copies(*one)
            for top in parts.tops(content, name)
            for one in flat.places(content, top, whole)
        ]
        for name in parts.times
    }
    return Parts(parts.times, placed, parts.apart)


def refuse_beyond(parts: Parts, content: MaskContent, most: int) -> None:
    """Raises: MaskFileError: more than ``most`` shapes, even where copies of large
    cells are looked at once.
    """
    if parts.apart <= most:
        return
    total = hierarchy.shapes(content).total()
    raise MaskFileError(
        f"the mask draws {total:,} shapes; with copies of its cells looked at once {parts.apart:,} are left to be "
        f"taken apart, at most {most:,} are taken ({advice(parts.apart)})"
    )


def advice(needed: int) -> str:
    """What a user may do."""
    low, high = (0.15 + size * needed for size in (25e-9, 150e-9))
    memory = f"{low:,.2g} GB of memory where they are copies of cells, up to {high:,.2g} GB where each is drawn"
    return f"metalens check --most-shapes {needed} takes them, with some {memory}"
