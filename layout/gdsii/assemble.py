"""GDSII of an assembly: cells of any kind, arrays of copies as AREF."""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from layout.files import (
    QUARTERS,
    Assembly,
    CellContent,
    Copies,
    Placed,
    Sites,
    Turn,
    flat,
)
from layout.gdsii import bytes as gds
from layout.gdsii.write import begin, boundary, references
from metalens.ground import store
from metalens.ground.arrays import Array
from metalens.ground.errors import ProcessError

_AT_ONCE = 1 << 18  # references
_MOST_ACROSS = 32767  # columns and rows of an array are signed 16-bit


def write(made: Assembly, path: str | Path) -> None:
    """Write an assembly; the file appears whole or not at all. True circles become
    polygons of 64 corners.

    Raises:
        ProcessError: a layer number beyond 32 767, a polygon beyond 8190 points, an
            array of more than 32 767 columns.
        OSError: the target cannot be written, or the disk is full; what was there
            before stays.
    """
    with store.replacing(path) as part, open(part, "wb", buffering=1 << 16) as file:
        file.write(gds.library(made.name, made.unit_nm))
        for name, cell in made.cells.items():
            file.write(begin(name))
            for layer, polygons in _drawn(cell):
                file.writelines(boundary(layer, polygon) for polygon in polygons)
            file.writelines(_array(one) for one in made.copies.get(name, ()))
            file.writelines(_references(cell.kept()))
            if name in made.sites:
                file.writelines(_sites(made.sites[name]))
            file.write(gds.record(gds.ENDSTR))
        file.write(gds.record(gds.ENDLIB))


def _drawn(cell: CellContent) -> Iterator[tuple[tuple[int, int], list[Array]]]:
    yield from cell.polygons.items()
    for layer, circles in cell.circles.items():
        yield layer, [flat.circle(*circle) for circle in circles]


def _head(name: str, turn: Turn, *, array: bool = False) -> bytes:
    """A reference up to its places."""
    head = gds.record(gds.AREF if array else gds.SREF) + gds.text(gds.SNAME, name)
    if turn == QUARTERS[0]:
        return head
    head += gds.record(gds.STRANS, bytes([128 if turn.mirrored else 0, 0]))
    if turn.scale != 1:
        head += gds.record(gds.MAG, gds.real(turn.scale))
    return head + (
        gds.record(gds.ANGLE, gds.real(turn.angle_deg)) if turn.angle_deg else b""
    )


def _array(one: Copies) -> bytes:
    if one.count == 1:
        return (
            _head(one.child, one.turn)
            + gds.points(np.array([[one.x, one.y]]))
            + gds.record(gds.ENDEL)
        )
    if max(one.columns, one.rows) > _MOST_ACROSS:
        raise ProcessError(
            f"an array of {one.columns} x {one.rows} copies of {one.child}: GDSII holds {_MOST_ACROSS} each way; "
            "write OASIS"
        )
    corners = np.array([(0, 0), (one.columns, 0), (0, one.rows)]) @ np.array(
        [one.across, one.up]
    ) + (one.x, one.y)
    if np.abs(corners).max() > 2**31 - 1:
        raise ProcessError(
            f"an array of {one.child} reaches beyond 32 bits; GDSII cannot hold it, write OASIS"
        )
    size = gds.shorts(gds.COLROW, one.columns, one.rows)
    return (
        _head(one.child, one.turn, array=True)
        + size
        + gds.points(corners)
        + gds.record(gds.ENDEL)
    )


def _sites(some: Sites) -> Iterator[memoryview]:
    """References of a lattice, cells with equally long names together."""
    for long in sorted({len(child) for child in some.children if child}):
        alike = [child for child in some.children if len(child) == long]
        lattice = some.numbered({child: n for n, child in enumerate(alike)})
        yield from references(alike, lattice, np.zeros(len(alike) + 1, np.int64))


def _references(placed: Placed) -> Iterator[bytes]:
    """All placements, those of one cell and turn together."""
    key = placed.child.astype(np.int64) * len(placed.turns) + placed.turn
    order = np.argsort(key, kind="stable")
    edges = (
        np.flatnonzero(np.diff(key[order], prepend=-1, append=-1))
        if len(key)
        else np.empty(0, np.int64)
    )
    for first, end in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        child, turn = divmod(int(key[order[first]]), len(placed.turns))
        head = np.frombuffer(
            _head(placed.children[child], placed.turns[turn])
            + gds.points(np.zeros((1, 2))),
            np.uint8,
        )
        tail = np.frombuffer(gds.record(gds.ENDEL), np.uint8)
        for some in np.array_split(
            order[first:end], math.ceil((end - first) / _AT_ONCE)
        ):
            block = np.empty((len(some), len(head) + len(tail)), np.uint8)
            block[:, : len(head)], block[:, len(head) :] = head, tail
            xy = np.column_stack([placed.x[some], placed.y[some]]).astype(">i4")
            block[:, len(head) - 8 : len(head)] = xy.view(np.uint8).reshape(
                len(some), 8
            )
            yield block.tobytes()
