"""GDSII: one structure for each pillar class, one reference for each pillar, written in
blocks of rows.

Bytes are the same for the same plan: the time stamps are fixed. Memory is one block,
whatever the lens.
"""

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from layout.gdsii import bytes as gds
from layout.mask import Figure, Lattice, MaskPlan, PillarClass
from layout.oasis import count_classes
from layout.process import compiled
from metalens.ground import store
from metalens.ground.arrays import Array
from metalens.ground.errors import ProcessError

_BLOCK = (
    1 << 19
)  # bytes of references made before they are written: within the processor's cache
_FLUSHED = 16  # pieces after which the disk is given what was written
REFERENCE_BYTES = (
    28  # of each pillar at least: a reference to a cell of a name of four characters
)
MOST_LAYERS = 32767  # layer numbers are signed 16-bit


def write(plan: MaskPlan, path: str | Path) -> None:
    """Write ``plan`` as GDSII; the file appears whole or not at all.

    Raises:
        ProcessError: a layer number beyond 32 767 or a polygon beyond 8190 points.
        OSError: the target cannot be written, or the disk is full; what was there
            before stays.
    """
    with store.replacing(path) as part, open(part, "wb", buffering=0) as file:
        _write_beside(file, _pieces(plan))


def _write_beside(file: BinaryIO, pieces: Iterator[bytes | memoryview]) -> None:
    """Write each piece while the next is made; a piece must stay as it is until the
    next but one is asked for.

    What was written is sent to the disk meanwhile, so that little is left to wait for
    at the end.
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


def _pieces(plan: MaskPlan) -> Iterator[bytes | memoryview]:
    yield gds.library(plan.name, plan.unit_nm)
    for figure in plan.figures:
        yield _figure_structure(figure)
    counts = np.zeros(len(plan.classes) + 1, np.int64)
    for lattice in plan.lattices:
        yield begin(lattice.name)
        yield from references([made.name for made in plan.classes], lattice, counts)
        yield gds.record(gds.ENDSTR)
    yield b"".join(
        _class_structure(made)
        for made, n in zip(plan.classes, counts[1:], strict=True)
        if n
    )
    yield begin(plan.name)
    yield b"".join(_reference(name) for name in plan.placed_names)
    yield gds.record(gds.ENDSTR) + gds.record(gds.ENDLIB)


def begin(name: str) -> bytes:
    """Begin of a structure."""
    return gds.shorts(gds.BGNSTR, *gds.TIMES) + gds.text(gds.STRNAME, name)


def _class_structure(made: PillarClass) -> bytes:
    shapes = b"".join(boundary(made.layer, polygon) for polygon in made.polygons)
    return begin(made.name) + shapes + gds.record(gds.ENDSTR)


def _figure_structure(figure: Figure) -> bytes:
    shapes = [
        boundary(layer, polygon)
        for layer, polygons in figure.polygons.items()
        for polygon in polygons
    ]
    return begin(figure.name) + b"".join(shapes) + gds.record(gds.ENDSTR)


def boundary(layer: tuple[int, int], polygon: Array) -> bytes:
    """A polygon.

    Raises:
        ProcessError: a layer number or a polygon that the format cannot hold.
    """
    if len(polygon) + 1 > gds.MOST_POINTS:
        raise ProcessError(
            f"polygon of {len(polygon)} vertices on layer {layer}: GDSII holds {gds.MOST_POINTS - 1}; split it"
        )
    if max(layer) > MOST_LAYERS:
        raise ProcessError(
            f"layer {layer[0]}/{layer[1]}: GDSII holds numbers to {MOST_LAYERS}; change the layer map"
        )
    head = (
        gds.record(gds.BOUNDARY)
        + gds.shorts(gds.LAYER, layer[0])
        + gds.shorts(gds.DATATYPE, layer[1])
    )
    return (
        head
        + gds.points(np.concatenate([polygon, polygon[:1]]))
        + gds.record(gds.ENDEL)
    )


def _reference(name: str, x: int = 0, y: int = 0) -> bytes:
    return (
        gds.record(gds.SREF)
        + gds.text(gds.SNAME, name)
        + gds.points(np.array([[x, y]]))
        + gds.record(gds.ENDEL)
    )


def references(
    children: Sequence[str], lattice: Lattice, counts: Array
) -> Iterator[memoryview]:
    """References of a lattice to the cells of its classes, in two buffers filled in
    turn; ``counts`` adds them up.

    A piece stays as it is until the next but one is asked for.
    """
    templates = _templates(children)
    word = templates.dtype.itemsize
    buffers = np.empty(
        (2, _BLOCK // (templates.shape[1] * word), templates.shape[1]), templates.dtype
    )
    turn = 0
    xs = _words(
        lattice.x0 + lattice.pitch * np.arange(lattice.columns), templates.dtype
    )
    for first, block in lattice.blocks(max(1, (1 << 20) // max(lattice.columns, 1))):
        ys = _words(
            lattice.y0 - lattice.down * np.arange(first, first + len(block)),
            templates.dtype,
        )
        count_classes(block, counts)
        row, column = 0, 0
        while row < len(block):
            row, column, used = _fill(
                buffers[turn], block, row, column, templates, xs, ys
            )
            if used:
                yield buffers[turn, :used].data.cast("B")
                turn = 1 - turn  # the last one is still being written


def _templates(children: Sequence[str]) -> Array:
    """(classes, words) a reference to each class at (0, 0), in words of 4 or 2 bytes;
    x, y and the end come last.
    """
    made = [_reference(name) for name in children]
    longest = max(map(len, made))
    if any(len(m) != longest for m in made):
        raise ProcessError(
            "cell names of the pillar classes differ in length; give them as many digits"
        )
    return np.frombuffer(
        b"".join(made), np.uint16 if longest % 4 else np.uint32
    ).reshape(len(made), -1)


def _words(values: Array, dtype: np.dtype[Any]) -> Array:
    """(n, words) big-endian 32-bit numbers as they lie in the file."""
    return (
        np.ascontiguousarray(values.astype(">i4")).view(dtype).reshape(len(values), -1)
    )


@compiled
def _fill(
    buffer: Array,
    block: Array,
    row: int,
    column: int,
    templates: Array,
    xs: Array,
    ys: Array,
) -> tuple[int, int, int]:
    """References of the sites from (row, column) on, until the buffer is full; (next
    row, column, references).
    """
    size, wide = templates.shape[1], xs.shape[1]
    head, used = size - 3 * wide, 0
    while row < block.shape[0]:
        while column < block.shape[1]:
            kind = block[row, column]
            if kind:
                if used == buffer.shape[0]:
                    return row, column, used
                for i in range(head):
                    buffer[used, i] = templates[kind - 1, i]
                for i in range(wide):
                    buffer[used, head + i] = xs[column, i]
                    buffer[used, head + wide + i] = ys[row, i]
                    buffer[used, head + 2 * wide + i] = templates[
                        kind - 1, head + 2 * wide + i
                    ]
                used += 1
            column += 1
        row, column = row + 1, 0
    return row, column, used
