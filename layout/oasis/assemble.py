"""OASIS of an assembly: cells of any kind, arrays of copies as repetitions."""

import itertools
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from layout.files import QUARTERS, Assembly, CellContent, Copies, Placed, Turn
from layout.oasis import bytes as oasis
from layout.oasis import tiles
from layout.oasis.write import cell_begin, cell_name, layer_name, polygon, tiled, vector
from layout.process import LayerNumber
from metalens.ground import store
from metalens.ground.arrays import Array

_AT_ONCE = 1 << 16  # placements of a compressed block
_LEVEL = 6
_REPEATED = 8  # bit of a placement that says that a repetition follows


def write(made: Assembly, path: str | Path) -> None:
    """Write an assembly; the file appears whole or not at all.

    Raises:
        OSError: the target cannot be written, or the disk is full; what was there
            before stays.
    """
    with store.replacing(path) as part, open(part, "wb", buffering=1 << 16) as file:
        head = oasis.start(made.unit_nm)
        layers = b"".join(
            layer_name(layer, name) for layer, name in sorted(made.layer_names.items())
        )
        number = {name: k for k, name in enumerate(made.cells)}
        checksum, written = 0, 0
        for piece in itertools.chain((head, layers), _cells(made, number)):
            file.write(piece)
            checksum, written = zlib.crc32(piece, checksum), written + len(piece)
        table = b"".join(cell_name(k, name) for name, k in number.items())
        file.write(table)
        at = (written, 0, 0, 0, len(head) if layers else 0, 0)
        file.write(oasis.end(at, zlib.crc32(table, checksum)))


def _cells(made: Assembly, number: dict[str, int]) -> Iterator[bytes]:
    for name, cell in made.cells.items():
        yield cell_begin(number[name])
        for layer, polygons in cell.polygons.items():
            yield oasis.compressed(
                b"".join(polygon(layer, points) for points in polygons), _LEVEL
            )
        yield b"".join(
            _circle(layer, *one)
            for layer, circles in cell.circles.items()
            for one in circles
        )
        yield b"".join(
            _array(one, number[one.child]) for one in made.copies.get(name, ())
        )
        yield from _placements(cell, number)
        if name in made.sites:
            counts = np.zeros(len(number) + 1, np.int64)
            yield from tiled(made.sites[name].numbered(number), _LEVEL, counts)


def _circle(layer: LayerNumber, x: int, y: int, radius: int) -> bytes:
    numbers = (
        oasis.unsigned(layer[0]) + oasis.unsigned(layer[1]) + oasis.unsigned(radius)
    )
    return (
        bytes([oasis.CIRCLE, 0b00111011]) + numbers + oasis.signed(x) + oasis.signed(y)
    )


def _array(one: Copies, number: int) -> bytes:
    repeated = one.count > 1
    placed = _one(number, one.turn, one.x, one.y, repeated=repeated)
    if not repeated:
        return placed
    if min(one.columns, one.rows) > 1:
        sizes = oasis.unsigned(one.columns - 2) + oasis.unsigned(one.rows - 2)
        return (
            placed + oasis.unsigned(8) + sizes + vector(*one.across) + vector(*one.up)
        )
    along = one.across if one.rows == 1 else one.up
    return placed + oasis.unsigned(9) + oasis.unsigned(one.count - 2) + vector(*along)


def _one(number: int, turn: Turn, x: int, y: int, *, repeated: bool = False) -> bytes:
    """A placement at a place of its own (absolute), turned and scaled in any way."""
    info = 0xF0 | (_REPEATED if repeated else 0)
    place = oasis.signed(x) + oasis.signed(y)
    if turn in QUARTERS:
        k = QUARTERS.index(turn)
        return (
            bytes([oasis.PLACEMENT, info | (k & 3) << 1 | k >> 2])
            + oasis.unsigned(number)
            + place
        )
    info |= 6 | turn.mirrored
    size = (
        b"\7"
        + struct.pack("<d", turn.scale)
        + b"\7"
        + struct.pack("<d", turn.angle_deg)
    )
    return bytes([oasis.PLACEMENT_ANY, info]) + oasis.unsigned(number) + size + place


def _placements(cell: CellContent, number: dict[str, int]) -> Iterator[bytes]:
    placed = cell.kept()
    own = np.array([number[name] for name in placed.children], np.int64)
    quarter = placed.turn < len(QUARTERS)
    yield b"".join(
        _one(
            int(own[placed.child[n]]),
            placed.turns[int(placed.turn[n])],
            int(placed.x[n]),
            int(placed.y[n]),
        )
        for n in np.flatnonzero(~quarter).tolist()
    )
    where = slice(None) if quarter.all() else np.flatnonzero(quarter)
    yield from _listed(own, placed, where)


def _listed(own: Array, placed: Placed, where: "slice | Array") -> Iterator[bytes]:
    child, x, y, turn = (
        v[where] for v in (placed.child, placed.x, placed.y, placed.turn)
    )
    out = np.empty(min(len(x), _AT_ONCE) * tiles.LARGEST_RECORD + 2, np.uint8)
    for first in range(0, len(x), _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        at = (
            x[some].astype(np.int64),
            y[some].astype(np.int64),
            turn[some].astype(np.int64),
        )
        used = tiles.encode_list(own[child[some]], *at, out)
        yield oasis.compressed(out[:used].tobytes(), _LEVEL)
