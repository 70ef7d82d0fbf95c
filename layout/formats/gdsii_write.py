"""GDSII writer: references of pillars in blocks of rows, arrays of copies as AREF.

Bytes are the same for the same mask: the time stamps are fixed. Memory is one block,
whatever the lens.
"""

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from layout.formats import gdsii_records as gds
from layout.formats.gdsii_records import GdsiiRecord
from layout.formats.library import (
    UPRIGHT,
    CellPlacements,
    CellReference,
    MaskLibrary,
    Orientation,
    PillarSites,
    library_of,
)
from layout.mask.plan import BLOCK_SITES, FARTHEST, MaskPlan, PillarArray
from layout.process.jit import compile_loop
from layout.process.process import LayerNumber
from metalens.core import store
from metalens.core.arrays import Array
from metalens.core.errors import ProcessError

# bytes of references filled before they are written: within the processor's cache
_BLOCK = 1 << 19
_FLUSHED = 16  # pieces after which the disk is given what was written
MAX_NUMBER = np.iinfo(np.int16).max  # of layers, columns and rows


def write_gdsii(mask: MaskPlan | MaskLibrary, path: str | Path) -> None:
    """Write a mask as GDSII; the file appears whole or not at all.

    Args:
        mask: plan of a die, or cells.
        path: of the file.

    Raises:
        ProcessError: a layer number beyond 32 767, a polygon beyond 8190 points, an
            array of more than 32 767 columns or beyond 32 bits.
        OSError: the target cannot be written; what was there before stays.
    """
    library = library_of(mask) if isinstance(mask, MaskPlan) else mask
    with store.replace_atomically(path) as part, open(part, "wb", buffering=0) as file:
        _write_concurrently(file, _pieces(library))


def _write_concurrently(file: BinaryIO, pieces: Iterator[bytes | memoryview]) -> None:
    """Write each piece while the next is filled, and flush meanwhile.

    Args:
        file: unbuffered.
        pieces: each unchanged until the next but one is requested.
    """
    with (
        ThreadPoolExecutor(1, thread_name_prefix="mask") as pool,
        ThreadPoolExecutor(1, thread_name_prefix="disk") as disk,
    ):
        busy: Future[None] | None = None
        flush: Future[None] | None = None
        for count, piece in enumerate(pieces, 1):
            if busy is not None:
                busy.result()
            busy = pool.submit(_write_all, file, piece)
            if count % _FLUSHED == 0 and (flush is None or flush.done()):
                flush = disk.submit(os.fsync, file.fileno())
        for job in (busy, flush):
            if job is not None:
                job.result()


def _write_all(file: BinaryIO, piece: bytes | memoryview) -> None:
    """Raw files may take less than they are given."""
    view = memoryview(piece)
    while len(view):
        view = view[file.write(view) :]


def _pieces(library: MaskLibrary) -> Iterator[bytes | memoryview]:
    """Bytes of a GDSII file, piece by piece."""
    yield gds.library_head(library.name, library.unit_nm)
    for name, cell in library.cells.items():
        head = gds.integer_record(GdsiiRecord.BGNSTR, *gds.TIMES) + gds.text_record(
            GdsiiRecord.STRNAME, name
        )
        shapes = [
            boundary_element(layer, points)
            for layer, polygons in cell.polygons.items()
            for points in polygons
        ]
        yield b"".join([head, *shapes])
        for one in cell.references:
            if isinstance(one, CellReference):
                yield _copies(one)
            else:
                yield from _placements(one)
        if cell.pillars is not None:
            yield from _pillars(cell.pillars)
        yield gds.gdsii_record(GdsiiRecord.ENDSTR)
    yield gds.gdsii_record(GdsiiRecord.ENDLIB)


def boundary_element(layer: LayerNumber, polygon: Array) -> bytes:
    """A polygon.

    Raises:
        ProcessError: a layer number or a polygon that the format cannot hold.
    """
    if len(polygon) + 1 > gds.MOST_POINTS:
        raise ProcessError(
            f"polygon of {len(polygon)} vertices on layer {layer}: GDSII holds "
            f"{gds.MOST_POINTS - 1}; split it"
        )
    if max(layer) > MAX_NUMBER:
        raise ProcessError(
            f"layer {layer[0]}/{layer[1]}: GDSII holds numbers to {MAX_NUMBER}; change "
            "the layer map"
        )
    head = gds.gdsii_record(GdsiiRecord.BOUNDARY) + gds.integer_record(
        GdsiiRecord.LAYER, layer[0]
    )
    closed = np.concatenate([polygon, polygon[:1]])
    return (
        head
        + gds.integer_record(GdsiiRecord.DATATYPE, layer[1])
        + gds.xy_record(closed)
        + gds.gdsii_record(GdsiiRecord.ENDEL)
    )


def _head(name: str, turn: Orientation = UPRIGHT, *, array: bool = False) -> bytes:
    """A reference up to its places."""
    head = gds.gdsii_record(
        GdsiiRecord.AREF if array else GdsiiRecord.SREF
    ) + gds.text_record(GdsiiRecord.SNAME, name)
    if turn == UPRIGHT:
        return head
    head += gds.gdsii_record(
        GdsiiRecord.STRANS, bytes([128 if turn.mirrored else 0, 0])
    )
    if turn.scale != 1:
        head += gds.gdsii_record(GdsiiRecord.MAG, gds.gdsii_real(turn.scale))
    if turn.angle_deg:
        head += gds.gdsii_record(GdsiiRecord.ANGLE, gds.gdsii_real(turn.angle_deg))
    return head


def _copies(one: CellReference) -> bytes:
    """A reference, or an array of them."""
    if one.count == 1:
        place = gds.xy_record(np.array([[one.x, one.y]]))
        return _head(one.child, one.turn) + place + gds.gdsii_record(GdsiiRecord.ENDEL)
    if max(one.columns, one.rows) > MAX_NUMBER:
        raise ProcessError(
            f"an array of {one.columns} x {one.rows} copies of {one.child}: GDSII holds "
            f"{MAX_NUMBER} each way; write OASIS"
        )
    ends = np.array([(0, 0), (one.columns, 0), (0, one.rows)])
    corners = ends @ np.array([one.across, one.up]) + (one.x, one.y)
    if np.abs(corners).max() > FARTHEST:
        raise ProcessError(
            f"an array of {one.child} reaches beyond 32 bits; GDSII cannot hold it, "
            "write OASIS"
        )
    return (
        _head(one.child, one.turn, array=True)
        + gds.integer_record(GdsiiRecord.COLROW, one.columns, one.rows)
        + gds.xy_record(corners)
        + gds.gdsii_record(GdsiiRecord.ENDEL)
    )


def _placements(placed: CellPlacements) -> Iterator[bytes]:
    """References to a cell in one orientation."""
    start = _head(placed.child, placed.turn)
    head = np.frombuffer(start + gds.xy_record(np.zeros((1, 2))), np.uint8)
    tail = np.frombuffer(gds.gdsii_record(GdsiiRecord.ENDEL), np.uint8)
    for first in range(0, placed.count, BLOCK_SITES):
        x, y = (v[first : first + BLOCK_SITES] for v in placed.places())
        block = np.tile(np.r_[head, tail], (len(x), 1))
        xy = np.column_stack([x, y]).astype(">i4")
        block[:, len(head) - 8 : len(head)] = xy.view(np.uint8).reshape(-1, 8)
        yield block.tobytes()


def _pillars(some: PillarSites) -> Iterator[memoryview]:
    """References of a lattice, cells with equally long names together."""
    for length in sorted({len(child.encode()) for child in some.children if child}):
        children = [child for child in some.children if len(child.encode()) == length]
        numbers = {child: n for n, child in enumerate(children)}
        yield from _references(children, some.numbered(numbers))


def _references(children: Sequence[str], lattice: PillarArray) -> Iterator[memoryview]:
    """References of a lattice to cells, in two buffers filled in turn."""
    records = [
        _head(name)
        + gds.xy_record(np.zeros((1, 2)))
        + gds.gdsii_record(GdsiiRecord.ENDEL)
        for name in children
    ]
    dtype = np.dtype(np.uint16 if len(records[0]) % 4 else np.uint32)
    templates = np.frombuffer(b"".join(records), dtype).reshape(len(records), -1)
    size = templates.shape[1]
    buffers = np.empty((2, _BLOCK // (size * dtype.itemsize), size), dtype)
    current = 0
    xs = _words(lattice.x0 + lattice.pitch * np.arange(lattice.columns), dtype)
    for first, block in lattice.blocks():
        rows = np.arange(first, first + len(block))
        ys = _words(lattice.y0 - lattice.down * rows, dtype)
        row, column = 0, 0
        while row < len(block):
            row, column, used = _fill(
                buffers[current], block, row, column, templates, xs, ys
            )
            if used:
                yield buffers[current, :used].data.cast("B")
                current = 1 - current  # the last one is still being written


def _words(values: Array, dtype: np.dtype[Any]) -> Array:
    """(n, words) big-endian 32-bit numbers as they lie in the file."""
    return (
        np.ascontiguousarray(values.astype(">i4")).view(dtype).reshape(len(values), -1)
    )


@compile_loop
def _fill(
    buffer: Array,
    block: Array,
    row: int,
    column: int,
    templates: Array,
    xs: Array,
    ys: Array,
) -> tuple[int, int, int]:
    """Fill a buffer with references of the sites from (row, column) on.

    Args:
        buffer: (n, words) output.
        block: (rows, columns) class numbers; 0: no reference.
        row, column: first site.
        templates: (classes, words) record of each class, with places of 0.
        xs: (columns, words) big-endian x.
        ys: (rows, words) big-endian y.

    Returns:
        Row and column of the next site, and number of references.
    """
    size = templates.shape[1]
    words = xs.shape[1]
    coordinates_at = size - 3 * words
    used = 0
    while row < block.shape[0]:
        while column < block.shape[1]:
            kind = block[row, column]
            if kind:
                if used == buffer.shape[0]:
                    return row, column, used
                for i in range(size):
                    buffer[used, i] = templates[kind - 1, i]
                for i in range(words):
                    buffer[used, coordinates_at + i] = xs[column, i]
                    buffer[used, coordinates_at + words + i] = ys[row, i]
                used += 1
            column += 1
        row, column = row + 1, 0
    return row, column, used
