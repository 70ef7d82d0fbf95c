"""OASIS writer: pillars as placements in tiles, arrays of copies as repetitions.

Strict name tables, layer names, CRC-32. Memory is a block of rows. Bytes are the same
for the same mask.
"""

import itertools
import struct
import zlib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np

from layout.formats import oasis_records as oasis
from layout.formats.library import (
    QUARTERS,
    CellPlacements,
    CellReference,
    MaskLibrary,
    Orientation,
    library_of,
)
from layout.formats.oasis_records import OasisRecord
from layout.mask.plan import MaskPlan, PillarArray
from layout.process.jit import compile_loop
from layout.process.process import LayerNumber
from metalens.core import store
from metalens.core.arrays import Array

_LEVEL, _FAST_LEVEL = 6, 2  # of deflate
_LARGE = 10**8  # sites from which a lattice takes the fast level: half the time
# Raster order inside narrow tiles: the rows above stay within the 32 KiB that deflate
# looks back on. That halves the file against whole rows.
_TILE_COLUMNS, _TILE_ROWS = 96, 512
LARGEST_RECORD = 18  # bytes of one placement
_AT_ONCE = 1 << 16  # placements of a compressed block
_THREADS = 2


def write_oasis(mask: MaskPlan | MaskLibrary, path: str | Path) -> None:
    """Write a mask as OASIS; the file appears whole or not at all.

    Args:
        mask: plan of a die, or cells.
        path: of the file.

    Raises:
        OSError: the target cannot be written; what was there before stays.
    """
    library = library_of(mask) if isinstance(mask, MaskPlan) else mask
    number = {name: k for k, name in enumerate(library.cells)}
    head = oasis.start_record(library.unit_nm)
    layers = b"".join(
        bytes([OasisRecord.LAYERNAME])
        + oasis.oasis_string(name)
        + b"".join(b"\x03" + oasis.unsigned_integer(n) for n in layer)  # exactly n
        for layer, name in sorted(library.layer_names.items())
    )
    checksum, written = 0, 0
    with (
        store.replace_atomically(path) as part,
        open(part, "wb", buffering=1 << 16) as file,
    ):
        for piece in itertools.chain((head, layers), _cells(library, number)):
            file.write(piece)
            checksum = zlib.crc32(piece, checksum)
            written = written + len(piece)
        table = b"".join(
            bytes([OasisRecord.CELLNAME_REF])
            + oasis.oasis_string(name)
            + oasis.unsigned_integer(k)
            for name, k in number.items()
        )
        file.write(table)
        offsets = (written, 0, 0, 0, len(head) if layers else 0, 0)
        file.write(oasis.end_record(offsets, zlib.crc32(table, checksum)))


def _cells(library: MaskLibrary, number: dict[str, int]) -> Iterator[bytes]:
    """Records of all cells, piece by piece."""
    for name, cell in library.cells.items():
        yield bytes([OasisRecord.CELL_REF]) + oasis.unsigned_integer(number[name])
        for layer, polygons in cell.polygons.items():
            shapes = b"".join(polygon_element(layer, points) for points in polygons)
            yield oasis.compressed_block(shapes, _LEVEL)
        for one in cell.references:
            if isinstance(one, CellReference):
                yield _copies(one, number[one.child])
            else:
                yield from _placements(one, number[one.child])
        if cell.pillars is not None:
            yield from _pillars(cell.pillars.numbered(number))


def polygon_element(layer: LayerNumber, points: Array) -> bytes:
    """POLYGON with a point list of type 4: any vectors from vertex to vertex, the last
    one implied.

    Args:
        layer: number and datatype.
        points: (n, 2) corners.
    """
    steps = np.diff(points.astype(np.int64), axis=0).tolist()
    x, y = (oasis.signed_integer(int(v)) for v in points[0])
    return b"".join(
        [
            bytes([OasisRecord.POLYGON, 0b00111011]),
            oasis.unsigned_integer(layer[0]) + oasis.unsigned_integer(layer[1]),
            b"\x04" + oasis.unsigned_integer(len(steps)),
            *(g_delta(dx, dy) for dx, dy in steps),
            x + y,
        ]
    )


def g_delta(dx: int, dy: int) -> bytes:
    """A g-delta of any direction.

    Args:
        dx: step along x.
        dy: step along y.
    """
    return oasis.unsigned_integer(
        abs(dx) << 2 | (dx < 0) << 1 | 1
    ) + oasis.signed_integer(dy)


def _copies(reference: CellReference, number: int) -> bytes:
    """A placement, repeated where it stands for an array."""
    repeated = reference.count > 1
    placed = _placement(
        number, reference.turn, reference.x, reference.y, repeated=repeated
    )
    if not repeated:
        return placed
    if min(reference.columns, reference.rows) > 1:
        sizes = oasis.unsigned_integer(reference.columns - 2) + oasis.unsigned_integer(
            reference.rows - 2
        )
        steps = g_delta(*reference.across) + g_delta(*reference.up)
        return placed + oasis.unsigned_integer(8) + sizes + steps
    step = reference.across if reference.rows == 1 else reference.up
    return (
        placed
        + oasis.unsigned_integer(9)
        + oasis.unsigned_integer(reference.count - 2)
        + g_delta(*step)
    )


def _placement(
    number: int, turn: Orientation, x: int, y: int, *, repeated: bool = False
) -> bytes:
    """A placement at an absolute place, in any orientation."""
    info = 0xF8 if repeated else 0xF0  # bit 8: a repetition follows
    place = oasis.signed_integer(x) + oasis.signed_integer(y)
    if turn in QUARTERS:
        k = QUARTERS.index(turn)
        head = bytes([OasisRecord.PLACEMENT, info | (k & 3) << 1 | k >> 2])
        return head + oasis.unsigned_integer(number) + place
    head = bytes([OasisRecord.PLACEMENT_ANY, info | 6 | turn.mirrored])
    double = struct.Struct("<Bd")
    size = double.pack(7, turn.scale) + double.pack(7, turn.angle_deg)
    return head + oasis.unsigned_integer(number) + size + place


def _placements(placed: CellPlacements, number: int) -> Iterator[bytes]:
    """Placements in one orientation: of a quarter turn in compressed blocks."""
    if placed.turn not in QUARTERS:
        places = zip(placed.x.tolist(), placed.y.tolist(), strict=True)
        yield b"".join(_placement(number, placed.turn, *place) for place in places)
        return
    for first in range(0, placed.count, _AT_ONCE):
        x, y = (v[first : first + _AT_ONCE] for v in placed.places())
        child, turn = np.full((2, len(x)), [[number], [QUARTERS.index(placed.turn)]])
        yield _block(child, x, y, turn, _LEVEL)


def _block(child: Array, x: Array, y: Array, turn: Array, level: int) -> bytes:
    """Compressed block of placements of quarter turns."""
    out = np.empty(len(x) * LARGEST_RECORD + 2, np.uint8)
    child, x, y, turn = (column.astype(np.int64) for column in (child, x, y, turn))
    used = encode_list(child, x, y, turn, out)
    return oasis.compressed_block(out[:used].data, level)


def _pillars(lattice: PillarArray) -> Iterator[bytes]:
    """Placements, tile by tile, of the cells that a lattice numbers from 1 on."""
    is_large = lattice.rows * lattice.columns >= _LARGE
    level = _FAST_LEVEL if is_large else _LEVEL
    tiles = range(0, lattice.columns, _TILE_COLUMNS)
    with ThreadPoolExecutor(_THREADS, thread_name_prefix="mask") as pool:
        for first, block in lattice.blocks(_TILE_ROWS):
            yield from pool.map(partial(_tile, lattice, first, block, level), tiles)


def _tile(
    lattice: PillarArray, first: int, block: Array, level: int, left: int
) -> bytes:
    """Compressed block of the pillars of a tile of sites; empty for none.

    Args:
        lattice: of the pillars.
        first: row of the block.
        block: (rows, columns) class numbers.
        level: of deflate.
        left: first column of the tile.
    """
    tile = block[:, left : left + _TILE_COLUMNS]
    row, column = np.nonzero(tile)
    if not len(row):
        return b""
    x, y = lattice.positions(first + row, left + column)
    return _block(tile[row, column].astype(np.int64) - 1, x, y, 0 * row, level)


@compile_loop
def _put_unsigned(out: Array, at: int, value: int) -> int:
    """Write a variable-length integer; the position after it."""
    while value > 127:
        out[at] = value & 127 | 128
        value >>= 7
        at += 1
    out[at] = value
    return at + 1


@compile_loop
def _put_signed(out: Array, at: int, value: int) -> int:
    """Write a signed integer, the sign in its lowest bit; the position after it."""
    return _put_unsigned(out, at, (-value << 1) | 1 if value < 0 else value << 1)


@compile_loop
def encode_list(child: Array, x: Array, y: Array, turn: Array, out: Array) -> int:
    """Placements in order: the first absolute, each other relative to the previous.

    Args:
        child: (n,) reference numbers.
        x: (n,) places.
        y: (n,) places.
        turn: (n,) quarter turns and mirror, 0 to 7.
        out: room for ``LARGEST_RECORD`` bytes a placement and 2 more.

    Returns:
        Bytes used.
    """
    at, last_x, last_y = 0, 0, 0
    for n in range(x.shape[0]):
        move_x = n == 0 or x[n] != last_x
        move_y = n == 0 or y[n] != last_y
        out[at] = 17  # PLACEMENT
        out[at + 1] = (
            0xC0
            | (0x20 if move_x else 0)
            | (0x10 if move_y else 0)
            | (turn[n] & 3) << 1
            | turn[n] >> 2
        )
        at = _put_unsigned(out, at + 2, child[n])
        if move_x:
            at = _put_signed(out, at, x[n] - last_x)
        if move_y:
            at = _put_signed(out, at, y[n] - last_y)
        if n == 0:
            out[at] = 16  # XYRELATIVE
            at += 1
        last_x, last_y = x[n], y[n]
    out[at] = 15  # XYABSOLUTE, as each cell begins
    return at + 1
