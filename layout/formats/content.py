"""What a mask file holds, as it was read: cells, their polygons, circles and
placements.
"""

import dataclasses
import math
import mmap
import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from layout.formats.digest import PlacementDigest, RunningDigest
from layout.process import LayerNumber
from metalens.core.arrays import Array
from metalens.core.errors import MaskFileError


@dataclass(frozen=True, slots=True)
class Orientation:
    """A mirror at the x axis (or none), then a turn counter-clockwise, then a scale."""

    angle_deg: float = 0.0
    mirrored: bool = False
    scale: float = 1.0

    @property
    def quarter(self) -> bool:
        """Whether lengths and right angles stay as they are: no scale, and quarter
        turns alone.
        """
        return self.scale == 1 and self.angle_deg % 90 == 0

    def apply(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Points turned; exact for quarter turns without a scale, else rounded to whole
        units.
        """
        if self.mirrored:
            y = -y
        if self.quarter:
            for _ in range(int(self.angle_deg // 90) & 3):
                x, y = -y, x
            return x, y
        c, s = (
            self.scale * f(math.radians(self.angle_deg)) for f in (math.cos, math.sin)
        )
        return np.rint(c * x - s * y).astype(np.int64), np.rint(s * x + c * y).astype(
            np.int64
        )

    def after(self, inner: "Orientation") -> "Orientation":
        """The turn that equals ``inner`` followed by this one."""
        angle = self.angle_deg + (
            -inner.angle_deg if self.mirrored else inner.angle_deg
        )
        return Orientation(
            angle % 360, self.mirrored != inner.mirrored, self.scale * inner.scale
        )


QUARTERS = tuple(Orientation(90.0 * (k & 3), bool(k & 4)) for k in range(8))


@dataclass(frozen=True, eq=False, slots=True)
class CellPlacements:
    """Placements in one cell.

    children: names. child: (n,) index into them. x, y: (n,) int32 database units.
    turn: (n,) index into ``turns``. The first eight are quarter turns counter-clockwise
    (bits 0-1) after a mirror at
    the x axis (bit 2); any other follows where the file has it.
    """

    children: tuple[str, ...]
    child: Array
    x: Array
    y: Array
    turn: Array
    turns: tuple[Orientation, ...] = QUARTERS

    def counts(self) -> Array:
        """(children, turns) how often each child is placed with each turn."""
        kinds, size = len(self.turns), len(self.children) * len(self.turns)
        found = np.zeros(size, np.int64)
        for first in range(0, len(self.child), _AT_ONCE):
            some = slice(first, first + _AT_ONCE)
            found += np.bincount(
                self.child[some].astype(np.int64) * kinds + self.turn[some],
                minlength=size,
            )
        return found.reshape(-1, kinds)


_DEEPEST = 64
_AT_ONCE = 1 << 20  # placements that are counted at once
_LARGE = 1 << 23  # placements of which each column has 32 MB
NOTHING = CellPlacements(
    (),
    np.empty(0, np.int32),
    np.empty(0, np.int32),
    np.empty(0, np.int32),
    np.empty(0, np.uint8),
)


@dataclass(frozen=True, eq=False, slots=True)
class CellContent:
    """One cell: {(layer, datatype): polygons (n, 2)}, {(layer, datatype): circles (n,
    3) of x, y, radius}.

    texts: number of texts. skipped: other elements of the file that draw nothing.
    sums: where the cell has more placements than are kept, their sums, one for each of
    ``placed.children``; ``placed``
    then holds none.
    """

    name: str
    polygons: dict[LayerNumber, list[Array]] = field(default_factory=dict)
    circles: dict[LayerNumber, list[tuple[int, int, int]]] = field(default_factory=dict)
    placed: CellPlacements = NOTHING
    texts: int = 0
    sums: PlacementDigest | None = None
    skipped: Counter[str] = field(default_factory=Counter)

    def kept(self) -> CellPlacements:
        """The placements.

        Raises:
            MaskFileError: only their sums were kept.
        """
        if self.sums is not None:
            raise MaskFileError(
                f"cell {self.name!r}: of its placements only the sums were kept; read all of them"
            )
        return self.placed

    def counts(self) -> Array:
        """(children,) how often each of ``placed.children`` is placed; of sums too."""
        if self.sums is not None:
            return self.sums.count
        return np.asarray(self.placed.counts().sum(1))

    @property
    def taken(self) -> int:
        """Shapes that are taken up for each copy: its own; 1 for a cell that holds
        nothing at all.
        """
        own = sum(map(len, self.polygons.values())) + sum(
            map(len, self.circles.values())
        )
        return own or int(not self.placed.children)


@dataclass(frozen=True, eq=False, slots=True)
class MaskContent:
    """All of a mask file.

    kind: ``GDSII`` or ``OASIS``. unit_nm: database unit. cells: by name, in the order
    of the file.
    """

    kind: str
    unit_nm: float
    cells: dict[str, CellContent]
    layer_names: dict[LayerNumber, str] = field(default_factory=dict)

    @property
    def tops(self) -> list[str]:
        """Cells that no other cell places."""
        used = {name for cell in self.cells.values() for name in cell.placed.children}
        return [name for name in self.cells if name not in used]

    @property
    def skipped(self) -> Counter[str]:
        """Elements of the cells that draw nothing: {kind: number}, texts among them."""
        found = sum((cell.skipped for cell in self.cells.values()), Counter())
        texts = sum(cell.texts for cell in self.cells.values())
        return found + Counter(text=texts)

    def below(self, top: str) -> "MaskContent":
        """The cells that one cell draws, itself as the only top cell.

        Args:
            top: name of the cell.

        Raises:
            MaskFileError: the mask has no such cell.
        """
        if top not in self.cells:
            raise MaskFileError(
                f"no cell {top!r} in the mask; top cells: {', '.join(self.tops[:8])}"
            )
        kept: set[str] = set()
        waiting = [top]
        while waiting:
            name = waiting.pop()
            if name in self.cells and name not in kept:
                kept.add(name)
                waiting += self.cells[name].placed.children
        cells = {name: cell for name, cell in self.cells.items() if name in kept}
        return dataclasses.replace(self, cells=cells)

    def leaves(self, top: str) -> Iterator[CellPlacements]:
        """All placements below ``top`` of cells that place nothing themselves, at their
        final places.

        Raises:
            MaskFileError: a cell that places itself, or one that is placed and not
                there.
        """
        yield from self._walk(top, 0, 0, QUARTERS[0], ())

    def sites(self, top: str) -> dict[str, tuple[Array, Array]]:
        """{leaf cell: (x, y) of all its placements below ``top``}, the hierarchy taken
        apart.
        """
        found: dict[str, list[tuple[Array, Array]]] = {}
        for placed in self.leaves(top):
            order = np.argsort(placed.child, kind="stable")
            edges = np.searchsorted(
                placed.child[order], np.arange(len(placed.children) + 1)
            )
            for k, child in enumerate(placed.children):
                chosen = order[edges[k] : edges[k + 1]]
                if len(chosen):
                    found.setdefault(child, []).append(
                        (placed.x[chosen], placed.y[chosen])
                    )
        return {
            name: (
                np.concatenate([x for x, _ in parts]),
                np.concatenate([y for _, y in parts]),
            )
            for name, parts in found.items()
        }

    def counts(self, top: str) -> dict[str, int]:
        """{leaf cell: number of placements below ``top``}."""
        found: dict[str, int] = {}
        for placed in self.leaves(top):
            for k, count in enumerate(
                np.bincount(placed.child, minlength=len(placed.children)).tolist()
            ):
                if count:
                    found[placed.children[k]] = found.get(placed.children[k], 0) + count
        return found

    def _walk(
        self, name: str, x: int, y: int, turn: Orientation, above: tuple[str, ...]
    ) -> Iterator[CellPlacements]:
        if name in above or len(above) > _DEEPEST:
            raise MaskFileError(
                f"cell {name!r} places itself through {' > '.join(above[:9])}; the file is no mask"
            )
        placed = self._cell(name).kept()
        if not len(placed.child):
            return
        deep = np.array(
            [bool(len(self._cell(child).kept().child)) for child in placed.children],
            bool,
        )
        px, py = (_within(v, name) for v in _moved(placed, turn, x, y))
        turns = (
            placed.turns
            if turn == QUARTERS[0]
            else tuple(turn.after(inner) for inner in placed.turns)
        )
        if not deep.any():
            yield CellPlacements(
                placed.children, placed.child, px, py, placed.turn, turns
            )
            return
        inner = deep[placed.child]
        for i in np.flatnonzero(inner):
            down = turns[int(placed.turn[i])]
            yield from self._walk(
                placed.children[placed.child[i]],
                int(px[i]),
                int(py[i]),
                down,
                (*above, name),
            )
        if not inner.all():
            yield CellPlacements(
                placed.children,
                placed.child[~inner],
                px[~inner],
                py[~inner],
                placed.turn[~inner],
                turns,
            )

    def _cell(self, name: str) -> CellContent:
        if name not in self.cells:
            raise MaskFileError(
                f"cell {name!r} is placed, but the file does not hold it"
            )
        return self.cells[name]


def _moved(
    placed: CellPlacements, turn: Orientation, x: int, y: int
) -> tuple[Array, Array]:
    """Places turned about (0, 0), then moved."""
    px, py = turn.apply(placed.x.astype(np.int64), placed.y.astype(np.int64))
    return px + x, py + y


def _within(places: Array, name: str) -> Array:
    """``places`` as int32; MaskFileError where nested places leave 32 bits."""
    farthest = int(np.abs(places).max(initial=0))
    if farthest > 2**31 - 1:
        raise MaskFileError(
            f"cell {name!r} is placed {farthest} units from the origin, beyond 32 bits"
        )
    return np.asarray(places, np.int32)


def map_bytes(path: str | Path) -> Array:
    """The bytes of a file as uint8, read when they are looked at.

    Raises:
        MaskFileError: an empty file. OSError: it cannot be opened.
    """
    if not os.stat(path).st_size:
        raise MaskFileError(f"{path}: byte 0: empty file, need a mask")
    with open(path, "rb") as file:
        return np.frombuffer(
            mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ), np.uint8
        )


CONTEXT_CELL = "$$$CONTEXT_INFO$$$"  # KLayout's record of library cells: no drawing


def decode_name(data: bytes) -> str:
    """A name of a mask file: UTF-8, or Latin-1 where it is none; trailing NULs go."""
    data = data.rstrip(b"\0")
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def has_area(points: Array) -> bool:
    """Whether the corners (n, 2) of a polygon do not all lie on one line."""
    steps = points[1:] - points[0]
    if not len(steps):
        return False
    longest = steps[np.abs(steps).sum(1).argmax()]
    return bool((steps[:, 0] * longest[1] != steps[:, 1] * longest[0]).any())


def placement_limit(path: Path) -> int:
    """Placements and shapes that a mask file is expanded to by default.

    4 million take less than 1 GB however small the file; 20 more for each byte admit
    long lists (OASIS masks of this package have 4 to 17 pillars a byte).
    """
    return 4_000_000 + 20 * path.stat().st_size


def release_bytes(data: Array, end: int) -> None:
    """Give back the memory of the bytes before ``end`` of a mapped file; they are read
    again if they are looked at.
    """
    base: object = data.base.obj if isinstance(data.base, memoryview) else data.base
    if (
        isinstance(base, mmap.mmap)
        and hasattr(mmap, "MADV_DONTNEED")
        and end >= mmap.PAGESIZE
    ):
        base.madvise(mmap.MADV_DONTNEED, 0, end // mmap.PAGESIZE * mmap.PAGESIZE)


@dataclass(eq=False, slots=True)
class PlacementSums:
    """Placements of a cell while it is read: kept up to a number (None: all), beyond it
    only their sums.

    parts: (child, x, y, turn) of what is kept; child as the reader numbers it. merged:
    how many of them are large;
    small: placements in the others.
    """

    keep: int | None = None
    parts: list[tuple[Array, Array, Array, Array]] = field(default_factory=list)
    count: int = 0
    digest: RunningDigest | None = None
    merged: int = 0
    small: int = 0

    def add(self, child: Array, x: Array, y: Array, turn: Array) -> None:
        """Take in some more."""
        self.count += len(child)
        if self.digest is None:
            self.parts.append((child, x, y, turn))
            if self.keep is None or self.count <= self.keep:
                self._merge(len(child))
                return
            self.digest = RunningDigest()
            for part in self.parts:
                self.digest.take(*part)
            self.parts = []
            return
        self.digest.take(child, x, y, turn)

    def _merge(self, more: int) -> None:
        """Make one of the last parts where they are many: large arrays go back to the
        system when they are let go.
        """
        self.small += more
        if self.small >= _LARGE:
            child, x, y, turn = (
                np.concatenate(part)
                for part in zip(*self.parts[self.merged :], strict=True)
            )
            self.parts[self.merged :] = [(child, x, y, turn)]
            self.merged, self.small = self.merged + 1, 0

    def columns(self) -> tuple[Array, Array, Array, Array]:
        """child, x, y, turn of all that is kept; the parts are let go, one column after
        the other.
        """
        columns = [list(part) for part in zip(*self.parts, strict=True)]
        self.parts, made = [], []
        while columns:
            made.append(np.concatenate(columns.pop(0)))
        return made[0], made[1], made[2], made[3]
