"""The shapes of a mask with the hierarchy taken apart: each different polygon once,
with all its places.
"""

from collections.abc import Callable, Hashable, Iterator, Sequence, Set
from dataclasses import dataclass
from typing import Any

import numpy as np

from layout.files.content import QUARTERS, MaskContent, Placed, Turn
from layout.process import LayerNumber
from metalens.ground.arrays import Array
from metalens.ground.errors import MaskFileError

_DEEPEST = 64
_CIRCLE = 64  # corners of a true circle
_AT_ONCE = 1 << 22  # placements that are sorted by cell at once
NONE: Set[str] = frozenset()


@dataclass(frozen=True, eq=False, slots=True)
class Shapes:
    """Copies of one polygon.

    cell: that holds it. outline: (n, 2), counter-clockwise, turned as placed. x, y:
    (m,) places.
    """

    cell: str
    layer: LayerNumber
    outline: Array
    x: Array
    y: Array


@dataclass(frozen=True, eq=False, slots=True)
class Stack:
    """Polygons of one cell and layer with equally many corners, at the same places.

    outlines: (k, n, 2), counter-clockwise, turned as placed. x, y: (m,) places of the
    cell.
    """

    cell: str
    layer: LayerNumber
    outlines: Array
    x: Array
    y: Array


def shapes(
    content: MaskContent, top: str, *, whole: Set[str] = NONE
) -> Iterator[Shapes]:
    """Every polygon below ``top``; true circles as polygons of 64 corners of their
    area.

    whole: cells that are not taken apart, and left out, where they stand upright or
    turned by quarters.

    Raises:
        MaskFileError: a cell that places itself or is missing, a place beyond 32 bits.
    """
    for stack in stacks(content, top, whole=whole):
        for outline in stack.outlines:
            yield Shapes(stack.cell, stack.layer, outline, stack.x, stack.y)


def stacks(
    content: MaskContent, top: str, *, whole: Set[str] = NONE
) -> Iterator[Stack]:
    """As :func:`shapes`, polygons of a cell that have equally many corners together."""
    for name, x, y, turn, is_whole in _cells(
        content, top, (0, 0), QUARTERS[0], (), whole
    ):
        if is_whole:
            continue
        cell = content.cells[name]
        drawn = {layer: list(polygons) for layer, polygons in cell.polygons.items()}
        for layer, circles in cell.circles.items():
            drawn.setdefault(layer, []).extend(circle(*one) for one in circles)
        for layer, polygons in drawn.items():
            alike: dict[int, list[Array]] = {}
            for points in polygons:
                alike.setdefault(len(points), []).append(points)
            for group in alike.values():
                yield Stack(
                    name, layer, _turned(np.stack(group).astype(np.int64), turn), x, y
                )


def places(
    content: MaskContent, top: str, whole: Set[str]
) -> Iterator[tuple[str, Turn, Array, Array]]:
    """(cell, turn, x, y) of the cells that :func:`shapes` leaves out."""
    for name, x, y, turn, is_whole in _cells(
        content, top, (0, 0), QUARTERS[0], (), whole
    ):
        if is_whole:
            yield name, turn, x, y


def alike(
    content: MaskContent,
    key: Callable[[Shapes], Hashable],
    *,
    tops: Sequence[str] | None = None,
    whole: Set[str] = NONE,
) -> dict[Hashable, list[Shapes]]:
    """Shapes below all top cells by ``key`` and outline, wherever in the hierarchy they
    are placed; None: passed over.

    tops: cells in place of the top cells. whole: as in :func:`shapes`.

    Raises:
        MaskFileError: as :func:`shapes`.
    """
    found: dict[Hashable, list[Shapes]] = {}
    for top in content.tops if tops is None else tops:
        for shape in shapes(content, top, whole=whole):
            if (own := key(shape)) is not None:
                found.setdefault(
                    (own, np.ascontiguousarray(shape.outline).tobytes()), []
                ).append(shape)
    return found


def circle(x: int, y: int, radius: int) -> Array:
    """(64, 2) corners of a polygon of the area of a circle, on whole units."""
    angle = 2 * np.pi * (np.arange(_CIRCLE) + 0.5) / _CIRCLE
    reach = radius * np.sqrt(2 * np.pi / _CIRCLE / np.sin(2 * np.pi / _CIRCLE))
    return np.asarray(
        np.rint(
            np.column_stack([x + reach * np.cos(angle), y + reach * np.sin(angle)])
        ),
        np.int64,
    )


def _turned(outlines: Array, turn: Turn) -> Array:
    """(k, n, 2) corners turned, counter-clockwise again."""
    made = np.stack(turn.apply(outlines[..., 0], outlines[..., 1]), -1)
    after = np.roll(made, -1, axis=1)
    backwards = (made[..., 0] * after[..., 1] - after[..., 0] * made[..., 1]).sum(1) < 0
    made[backwards] = made[backwards, ::-1]
    return made


def _cells(
    content: MaskContent,
    name: str,
    at: tuple[int, int],
    turn: Turn,
    above: tuple[str, ...],
    whole: Set[str],
) -> Iterator[tuple[str, Array, Array, Turn, bool]]:
    """(cell, x, y, turn, whether it is kept whole) of every cell below ``name`` and of
    itself.

    Equal ones come together where they are leaves or whole, four million placements of
    a cell at once.

    Below a cell that is turned by no quarter nothing is whole.
    """
    if name not in content.cells:
        raise MaskFileError(f"cell {name!r} is placed, but the file does not hold it")
    if name in above or len(above) > _DEEPEST:
        raise MaskFileError(
            f"cell {name!r} places itself through {' > '.join(above[:9])}; the file is no mask"
        )
    yield name, np.array([at[0]]), np.array([at[1]]), turn, False
    placed = content.cells[name].kept()
    if not len(placed.child):
        return
    below = whole if turn.quarter else NONE
    for first in range(0, len(placed.child), _AT_ONCE):
        px, py = _moved(placed, slice(first, first + _AT_ONCE), turn, at, name)
        child_of, turn_of = (
            v[first : first + _AT_ONCE] for v in (placed.child, placed.turn)
        )
        small: type[np.integer[Any]] = (
            np.uint16
            if len(placed.children) * len(placed.turns) < 1 << 16
            else np.int64
        )
        key = np.asarray(child_of, small) * len(placed.turns) + np.asarray(
            turn_of, small
        )
        order = np.argsort(key, kind="stable")
        key = key[order]
        starts = np.flatnonzero(np.r_[True, key[1:] != key[:-1]])
        kinds = key[starts]
        for kind, some in zip(kinds.tolist(), np.split(order, starts[1:]), strict=True):
            number, way = divmod(kind, len(placed.turns))
            child, inner = placed.children[number], turn.after(placed.turns[way])
            kept = child in below and inner.quarter
            if kept or (
                child in content.cells and not len(content.cells[child].kept().child)
            ):
                yield child, px[some], py[some], inner, kept
            else:
                for i in some.tolist():
                    yield from _cells(
                        content,
                        child,
                        (int(px[i]), int(py[i])),
                        inner,
                        (*above, name),
                        below,
                    )


def _moved(
    placed: Placed, some: slice, turn: Turn, at: tuple[int, int], name: str
) -> tuple[Array, Array]:
    """(n,) int32 places of some copies below a cell that is turned and stands ``at``."""
    px, py = turn.apply(
        placed.x[some].astype(np.int64), placed.y[some].astype(np.int64)
    )
    px, py = px + at[0], py + at[1]
    if max(px.max(), py.max(), -px.min(), -py.min()) > 2**31 - 1:
        raise MaskFileError(f"cell {name!r} holds places beyond 32 bits")
    return px.astype(np.int32), py.astype(np.int32)
