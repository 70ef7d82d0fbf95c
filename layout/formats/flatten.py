"""The shapes of a mask with the hierarchy taken apart: each different polygon once,
with all its places.
"""

from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass

import numpy as np

from layout.formats.content import QUARTERS, CellPlacements, MaskContent, Orientation
from layout.process import LayerNumber
from metalens.core.arrays import Array
from metalens.core.errors import MaskFileError

_DEEPEST = 64
_CIRCLE = 64  # corners of a true circle
_AT_ONCE = 1 << 22  # placements that are sorted by cell at once


@dataclass(frozen=True, eq=False, slots=True)
class PolygonCopies:
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
class PolygonStack:
    """Polygons of one cell and layer with equally many corners, at the same places.

    outlines: (k, n, 2), counter-clockwise, turned as placed. x, y: (m,) places of the
    cell.
    """

    cell: str
    layer: LayerNumber
    outlines: Array
    x: Array
    y: Array


def flatten_shapes(content: MaskContent, top: str) -> Iterator[PolygonCopies]:
    """Every polygon below ``top``; true circles as polygons of 64 corners of their
    area.

    Raises:
        MaskFileError: a cell that places itself or is missing, a place beyond 32 bits.
    """
    for stack in flatten_stacks(content, top):
        for outline in stack.outlines:
            yield PolygonCopies(stack.cell, stack.layer, outline, stack.x, stack.y)


def flatten_stacks(content: MaskContent, top: str) -> Iterator[PolygonStack]:
    """As :func:`flatten_shapes`, polygons of a cell that have equally many corners
    together.
    """
    for name, x, y, turn in _cells(content, top, (0, 0), QUARTERS[0], ()):
        cell = content.cells[name]
        drawn = {layer: list(polygons) for layer, polygons in cell.polygons.items()}
        for layer, circles in cell.circles.items():
            drawn.setdefault(layer, []).extend(circle_polygon(*one) for one in circles)
        for layer, polygons in drawn.items():
            by_corners: dict[int, list[Array]] = {}
            for points in polygons:
                by_corners.setdefault(len(points), []).append(points)
            for group in by_corners.values():
                outlines = _turned(np.stack(group).astype(np.int64), turn)
                yield PolygonStack(name, layer, outlines, x, y)


def equal_shapes(
    content: MaskContent, key: Callable[[PolygonCopies], Hashable]
) -> dict[Hashable, list[PolygonCopies]]:
    """Shapes below all top cells by ``key`` and outline, wherever they are placed.

    Raises:
        MaskFileError: as :func:`flatten_shapes`.
    """
    found: dict[Hashable, list[PolygonCopies]] = {}
    for top in content.tops:
        for shape in flatten_shapes(content, top):
            outline = np.ascontiguousarray(shape.outline).tobytes()
            found.setdefault((key(shape), outline), []).append(shape)
    return found


def circle_polygon(x: int, y: int, radius: int) -> Array:
    """(64, 2) corners of a polygon of the area of a circle, on whole units."""
    angle = 2 * np.pi * (np.arange(_CIRCLE) + 0.5) / _CIRCLE
    reach = radius * np.sqrt(2 * np.pi / _CIRCLE / np.sin(2 * np.pi / _CIRCLE))
    return np.asarray(
        np.rint(
            np.column_stack([x + reach * np.cos(angle), y + reach * np.sin(angle)])
        ),
        np.int64,
    )


def _turned(outlines: Array, turn: Orientation) -> Array:
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
    turn: Orientation,
    above: tuple[str, ...],
) -> Iterator[tuple[str, Array, Array, Orientation]]:
    """(cell, x, y, turn) of every cell below ``name`` and of itself.

    Equal leaves come together, four million placements of a cell at once.
    """
    if name not in content.cells:
        raise MaskFileError(f"cell {name!r} is placed, but the file does not hold it")
    if name in above or len(above) > _DEEPEST:
        raise MaskFileError(
            f"cell {name!r} places itself through {' > '.join(above[:9])}; the file is "
            "no mask"
        )
    yield name, np.array([at[0]]), np.array([at[1]]), turn
    placed = content.cells[name].kept()
    for first in range(0, len(placed.child), _AT_ONCE):
        block = slice(first, first + _AT_ONCE)
        px, py = _moved(placed, block, turn, at, name)
        key = placed.child[block].astype(np.int64) * len(placed.turns)
        key += placed.turn[block]
        order = np.argsort(key, kind="stable")
        kinds, starts = np.unique(key[order], return_index=True)
        groups = np.split(order, starts[1:])
        for kind, members in zip(kinds.tolist(), groups, strict=True):
            number, way = divmod(kind, len(placed.turns))
            child, inner = placed.children[number], turn.after(placed.turns[way])
            cell = content.cells.get(child)
            if cell is not None and not len(cell.kept().child):
                yield child, px[members], py[members], inner
                continue
            for i in members.tolist():
                place = int(px[i]), int(py[i])
                yield from _cells(content, child, place, inner, (*above, name))


def _moved(
    placed: CellPlacements,
    some: slice,
    turn: Orientation,
    at: tuple[int, int],
    name: str,
) -> tuple[Array, Array]:
    """(n,) int32 places of some copies below a cell that is turned and stands ``at``."""
    px, py = turn.apply(
        placed.x[some].astype(np.int64), placed.y[some].astype(np.int64)
    )
    px, py = px + at[0], py + at[1]
    if max(px.max(), py.max(), -px.min(), -py.min()) > 2**31 - 1:
        raise MaskFileError(f"cell {name!r} holds places beyond 32 bits")
    return px.astype(np.int32), py.astype(np.int32)
