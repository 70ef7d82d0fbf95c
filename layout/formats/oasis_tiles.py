"""Pillars as OASIS placements, encoded from an array of class numbers.

Raster order inside narrow tiles: the rows above stay within the 32 KiB that deflate
looks back on, and a lens
repeats itself from row to row. That halves the file against whole rows.
"""

from layout.process.jit import compile_loop
from metalens.core.arrays import Array

TILE_COLUMNS, TILE_ROWS = 96, 512
LARGEST_RECORD = 18  # bytes of one placement


@compile_loop
def put_unsigned(out: Array, at: int, value: int) -> int:
    """Write a variable-length integer; the position after it.

    Args:
        out: bytes.
        at: position.
        value: 0 or above.
    """
    while value > 127:
        out[at] = value & 127 | 128
        value >>= 7
        at += 1
    out[at] = value
    return at + 1


@compile_loop
def _put_signed(out: Array, at: int, value: int) -> int:
    return put_unsigned(out, at, (-value << 1) | 1 if value < 0 else value << 1)


@compile_loop
def encode_tile(
    tile: Array, pitch: int, down: int, x0: int, y0: int, out: Array
) -> int:
    """Placements of a tile in raster order: the first at its place, each other relative
    to the one before.

    Args:
        tile: (rows, columns) class numbers; pitch, down: of columns and rows; x0, y0:
            its first site.
        out: room for LARGEST_RECORD bytes a site.

    Returns:
        bytes used.
    """
    at, last_x, last_y, fresh = 0, 0, 0, True
    for row in range(tile.shape[0]):
        y = y0 - row * down
        for column in range(tile.shape[1]):
            kind = tile[row, column]
            if kind:
                x = x0 + column * pitch
                move_x, move_y = fresh or x != last_x, fresh or y != last_y
                if fresh:
                    out[0] = 15  # XYABSOLUTE
                    at = 1
                out[at] = 17  # PLACEMENT
                out[at + 1] = 0xC0 | (0x20 if move_x else 0) | (0x10 if move_y else 0)
                at = put_unsigned(out, at + 2, kind - 1)
                if move_x:
                    at = _put_signed(out, at, x - last_x)
                if move_y:
                    at = _put_signed(out, at, y - last_y)
                if fresh:
                    out[at] = 16  # XYRELATIVE
                    at += 1
                last_x, last_y, fresh = x, y, False
    return at


@compile_loop
def encode_list(child: Array, x: Array, y: Array, turn: Array, out: Array) -> int:
    """Placements in their order: the first at its place, each other relative to the one
    before; bytes used.

    Args:
        child: (n,) reference numbers. turn: (n,) quarter turns and mirror, 0 to 7. out:
            as for :func:`encode_tile`.
        x: (n,) places.
        y: (n,) places.
    """
    out[0] = 15  # XYABSOLUTE
    at, last_x, last_y = 1, 0, 0
    for n in range(x.shape[0]):
        move_x, move_y = n == 0 or x[n] != last_x, n == 0 or y[n] != last_y
        out[at] = 17  # PLACEMENT
        out[at + 1] = (
            0xC0
            | (0x20 if move_x else 0)
            | (0x10 if move_y else 0)
            | (turn[n] & 3) << 1
            | turn[n] >> 2
        )
        at = put_unsigned(out, at + 2, child[n])
        if move_x:
            at = _put_signed(out, at, x[n] - last_x)
        if move_y:
            at = _put_signed(out, at, y[n] - last_y)
        if n == 0:
            out[at] = 16  # XYRELATIVE
            at += 1
        last_x, last_y = x[n], y[n]
    return at
