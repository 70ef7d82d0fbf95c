"""OASIS: one cell for each pillar class, placed in tiles (small, fast) or by one
repetition a class (reader).

Strict name tables, layer names, CRC-32. Memory is a block of rows, except for the
reader's form, which needs the
lens at once. Bytes are the same for the same plan.
"""

import itertools
import zlib
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import BinaryIO, Literal

import numpy as np

from layout.mask import Lattice, MaskPlan, PillarClass, symmetry
from layout.oasis import bytes as oasis
from layout.oasis import tiles
from layout.process import names
from metalens.ground import store
from metalens.ground.arrays import Array
from metalens.ground.errors import ProcessError

Form = Literal["small", "fast", "reader"]
_LEVELS: dict[str, int] = {"small": 6, "fast": 2, "reader": 6}
_STRIP = 32  # columns of a strip in the reader's form
_THREADS = 2
_QUARTER, _MIRROR = np.array([[0, 1], [-1, 0]]), np.array([[-1, 0], [0, 1]])


@dataclass(frozen=True, slots=True)
class _Settings:
    """level: of deflate. circles: CIRCLE records for pillars. reader: one repetition a
    class.
    """

    level: int
    circles: bool
    reader: bool


def write(
    plan: MaskPlan,
    path: str | Path,
    *,
    form: Form = "small",
    circles: bool = False,
    fold: bool = True,
) -> None:
    """Write ``plan`` as OASIS; the file appears whole or not at all.

    Args:
        form: ``small``: least bytes; ``fast``: least time; ``reader``: one repetition
            for each class.
        circles: pillars as true circles in place of polygons (the diameter must be an
            even number of units).
        fold: store a lens that is symmetric under the square once, as an eighth.

    Raises:
        ProcessError: an odd diameter with ``circles``; a drawn shape that is no pillar
            (negative tone) or not round;
            the reader's form of another lattice than a square one.
        OSError: the target cannot be written, or the disk is full; what was there
            before stays.
    """
    if form not in _LEVELS:
        raise ProcessError(f"OASIS form {form!r}: need small, fast or reader")
    settings = _Settings(_LEVELS[form], circles, form == "reader")
    with store.replacing(path) as part, open(part, "wb", buffering=1 << 16) as file:
        _write_file(file, plan, settings, fold)


def _write_file(
    file: BinaryIO, plan: MaskPlan, settings: _Settings, fold: bool
) -> None:
    alike = fold and all(_square_symmetric(made) for made in plan.classes)
    placed = [_piece_list(lattice, alike) for lattice in plan.lattices]
    if settings.reader and not all(lattice.square for lattice in plan.lattices):
        raise ProcessError(
            "OASIS form 'reader' lists sites of a square lattice; take small or fast"
        )
    folded = [piece.lattice.name for made in placed if len(made) > 1 for piece in made]
    cell_names = [*plan.cell_names[:-1], *folded, plan.name]
    names.distinct(cell_names)
    number = {name: k for k, name in enumerate(cell_names)}
    head = oasis.start(plan.unit_nm)
    layer_table = b"".join(
        layer_name(layer, name) for layer, name in sorted(plan.layer_names.items())
    )
    counts = np.zeros(len(plan.classes) + 1, np.int64)
    written, checksum = 0, 0
    for piece in itertools.chain(
        [head, layer_table], _cells(plan, placed, number, settings, counts)
    ):
        file.write(piece)
        checksum, written = zlib.crc32(piece, checksum), written + len(piece)
    unused = {
        made.name for made, n in zip(plan.classes, counts[1:], strict=True) if not n
    }
    cell_table = b"".join(
        cell_name(k, name) for name, k in number.items() if name not in unused
    )
    file.write(cell_table)
    layers_at = len(head) if layer_table else 0
    file.write(
        oasis.end((written, 0, 0, 0, layers_at, 0), zlib.crc32(cell_table, checksum))
    )


def cell_name(number: int, name: str) -> bytes:
    """Record of a cell's name."""
    return bytes([oasis.CELLNAME_REF]) + oasis.string(name) + oasis.unsigned(number)


def _square_symmetric(made: PillarClass) -> bool:
    """Whether a quarter turn and a mirror leave the pillar, and what is drawn around
    it, as it is.
    """

    def corners(*shapes: Array) -> set[tuple[int, int]]:
        return {(int(x), int(y)) for shape in shapes for x, y in shape}

    def edges(*shapes: Array) -> set[frozenset[tuple[int, int]]]:
        ends = [
            np.concatenate([s, np.roll(s, -1, axis=0)], axis=1).tolist() for s in shapes
        ]
        return {
            frozenset(((a, b), (c, d)))
            for a, b, c, d in itertools.chain.from_iterable(ends)
        }

    own, drawn = edges(*made.contours), corners(*made.polygons)
    return all(
        edges(*(c @ m for c in made.contours)) == own
        and corners(*(p @ m for p in made.polygons)) == drawn
        for m in (_QUARTER, _MIRROR)
    )


def _piece_list(lattice: Lattice, fold: bool) -> list[symmetry.Piece]:
    return (
        symmetry.pieces(lattice)
        if fold and symmetry.is_square_symmetric(lattice)
        else [symmetry.Piece(lattice, ((0, False),))]
    )


def layer_name(layer: tuple[int, int], name: str) -> bytes:
    """Record of the name of a layer and datatype."""
    exactly = b"\x03"
    numbers = b"".join(exactly + oasis.unsigned(n) for n in layer)
    return bytes([oasis.LAYERNAME]) + oasis.string(name) + numbers


def _cells(
    plan: MaskPlan,
    placed: list[list[symmetry.Piece]],
    number: dict[str, int],
    settings: _Settings,
    counts: Array,
) -> Iterator[bytes]:
    """All cells, those of the pillar classes that occur last; ``counts`` adds up the
    sites of each class.
    """
    for figure in plan.figures:
        shapes = [
            polygon(layer, p)
            for layer, polygons in figure.polygons.items()
            for p in polygons
        ]
        yield cell_begin(number[figure.name]) + b"".join(shapes)
    for lattice, parts in zip(plan.lattices, placed, strict=True):
        if len(parts) > 1:
            for part in parts:
                yield cell_begin(number[part.lattice.name])
                yield from _sites(part.lattice, settings, counts)
            yield cell_begin(number[lattice.name])
            yield b"".join(
                _placement(number[p.lattice.name], turn)
                for p in parts
                for turn in p.placed
            )
        else:
            yield cell_begin(number[lattice.name])
            yield from _sites(lattice, settings, counts)
    used = [made for made, n in zip(plan.classes, counts[1:], strict=True) if n]
    yield b"".join(
        cell_begin(number[made.name]) + _pillar(made, settings.circles) for made in used
    )
    top = b"".join(_placement(number[name]) for name in plan.placed_names)
    yield cell_begin(number[plan.name]) + top


def cell_begin(number: int) -> bytes:
    """Begin of a cell."""
    return bytes([oasis.CELL_REF]) + oasis.unsigned(number)


def _placement(number: int, turn: tuple[int, bool] = (0, False)) -> bytes:
    return (
        bytes([oasis.PLACEMENT, 0xF0 | turn[0] << 1 | turn[1]])
        + oasis.unsigned(number)
        + b"\0\0"
    )


def _pillar(made: PillarClass, circles: bool) -> bytes:
    if not circles:
        return b"".join(polygon(made.layer, points) for points in made.polygons)
    if not made.round:
        raise ProcessError(
            f"class {made.name} is not round: circles cannot stand for it; leave circles out"
        )
    if made.drawn:
        raise ProcessError(
            "circles can be written for a positive tone only; leave circles out"
        )
    width = made.diameter_units
    if width % 2:
        raise ProcessError(
            f"class {made.name}: a circle of {width} database units has no whole radius; take an even "
            "diameter_step_nm, or polygons"
        )
    layer = oasis.unsigned(made.layer[0]) + oasis.unsigned(made.layer[1])
    return (
        bytes([oasis.CIRCLE, 0b00111011]) + layer + oasis.unsigned(width // 2) + b"\0\0"
    )


def polygon(layer: tuple[int, int], points: Array) -> bytes:
    """POLYGON with a point list of type 4: any vectors from vertex to vertex, the last
    one implied.
    """
    numbers = oasis.unsigned(layer[0]) + oasis.unsigned(layer[1])
    steps = np.diff(points.astype(np.int64), axis=0)
    moves = b"".join(vector(int(dx), int(dy)) for dx, dy in steps)
    x, y = (oasis.signed(int(v)) for v in points[0])
    return (
        bytes([oasis.POLYGON, 0b00111011])
        + numbers
        + b"\x04"
        + oasis.unsigned(len(steps))
        + moves
        + x
        + y
    )


def vector(dx: int, dy: int) -> bytes:
    """A g-delta of any direction."""
    return oasis.unsigned(abs(dx) << 2 | (dx < 0) << 1 | 1) + oasis.signed(dy)


def _sites(lattice: Lattice, settings: _Settings, counts: Array) -> Iterator[bytes]:
    form = _repetitions if settings.reader else tiled
    return form(lattice, settings.level, counts)


def placed_lattices(plan: MaskPlan) -> dict[str, Lattice]:
    """{cell: its lattice} of the files of a plan: of all lattices, and of the pieces of
    those that are folded.
    """
    alike = all(_square_symmetric(made) for made in plan.classes)
    folded = [
        piece.lattice
        for lattice in plan.lattices
        for piece in _piece_list(lattice, alike)
    ]
    return {lattice.name: lattice for lattice in (*folded, *plan.lattices)}


def tiled(lattice: Lattice, level: int, counts: Array) -> Iterator[bytes]:
    """Placements, tile by tile, of the cells 0, 1, ... that a lattice numbers from 1;
    ``counts`` adds them up.
    """

    def jobs() -> Iterator[Callable[[], bytes]]:
        for first, block in lattice.blocks(tiles.TILE_ROWS):
            tiles.count_classes(block, counts)
            y = lattice.y0 - first * lattice.down
            for left in range(0, lattice.columns, tiles.TILE_COLUMNS):
                tile, x = (
                    block[:, left : left + tiles.TILE_COLUMNS],
                    lattice.x0 + left * lattice.pitch,
                )
                yield partial(_tile, tile, (lattice.pitch, lattice.down), x, y, level)

    yield from _in_order(jobs())


def _tile(tile: Array, pitch: tuple[int, int], x0: int, y0: int, level: int) -> bytes:
    out = np.empty(tile.size * tiles.LARGEST_RECORD, np.uint8)
    used = tiles.encode_tile(tile, *pitch, x0, y0, out)
    return oasis.compressed(out[:used].data, level) if used else b""


def _repetitions(lattice: Lattice, level: int, total: Array) -> Iterator[bytes]:
    """One placement a class, at its first site, repeated at all others by a list of
    lattice steps.
    """
    sites = lattice.whole()
    counts, lengths = np.zeros_like(total), np.zeros_like(total)
    tiles.count_classes(sites, counts)
    total += counts
    first, last = np.full((len(total), 2), -1), np.full((len(total), 2), -1)
    tiles.walk_classes(
        sites, _STRIP, first, last, lengths, np.empty(0, np.uint8), False
    )
    ends = np.cumsum(lengths)
    begins, out = ends - lengths, np.empty(int(ends[-1]), np.uint8)
    last[:] = -1
    tiles.walk_classes(sites, _STRIP, first, last, begins.copy(), out, True)

    def one(kind: int) -> bytes:
        x, y = (int(v) * lattice.pitch for v in first[kind])
        many = counts[kind] > 1
        head = bytes([oasis.PLACEMENT, 0xF0 | many << 3]) + oasis.unsigned(kind - 1)
        head += oasis.signed(lattice.x0 + x) + oasis.signed(lattice.y0 - y)
        if many:
            head += (
                b"\x0b"
                + oasis.unsigned(int(counts[kind]) - 2)
                + oasis.unsigned(lattice.pitch)
            )
        return oasis.compressed(head + out[begins[kind] : ends[kind]].tobytes(), level)

    used = np.flatnonzero(counts[1:]) + 1
    yield from _in_order(partial(one, int(k)) for k in used)


def _in_order(jobs: Iterable[Callable[[], bytes]], ahead: int = 8) -> Iterator[bytes]:
    """Results of the jobs in their order, a few of them worked on at once."""
    waiting: deque[Future[bytes]] = deque()
    with ThreadPoolExecutor(_THREADS, thread_name_prefix="mask") as pool:
        for job in jobs:
            waiting.append(pool.submit(job))
            if len(waiting) > ahead:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
