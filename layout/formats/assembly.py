"""Cells of several masks and files put together in one: what a writer needs, arrays of
copies kept as arrays.
"""

import dataclasses
import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from layout.formats.content import QUARTERS, CellContent, CellPlacements, Orientation
from layout.formats.digest import RunningDigest
from layout.mask import MaskPlan, PillarClass, PillarLattice, symmetry
from layout.process import LayerNumber
from metalens.core.arrays import Array
from metalens.core.errors import ProcessError

_LEAST = 4  # copies that are worth an array
_MOST = 1 << 20  # placements of a cell that are looked through for arrays


@dataclass(frozen=True, slots=True)
class CellCopies:
    """A cell placed once, or as an array: copy (i, j) stands at (x, y) + i across + j
    up, in database units.
    """

    child: str
    x: int
    y: int
    turn: Orientation = QUARTERS[0]
    columns: int = 1
    rows: int = 1
    across: tuple[int, int] = (0, 0)
    up: tuple[int, int] = (0, 0)

    @property
    def count(self) -> int:
        """Number of copies."""
        return self.columns * self.rows

    def places(self) -> tuple[Array, Array]:
        """x and y of all copies, (count,) each, row by row."""
        i, j = np.arange(self.columns), np.arange(self.rows)[:, None]
        x, y = (
            at + i * a + j * u
            for at, a, u in zip((self.x, self.y), self.across, self.up, strict=True)
        )
        return x.ravel(), y.ravel()


@dataclass(frozen=True, eq=False, slots=True)
class PillarSites:
    """What a cell of pillars places, never all in memory: class k of ``lattice`` is the
    cell ``children[k - 1]``.
    """

    lattice: PillarLattice
    children: tuple[str, ...]

    def renamed(self, new: Mapping[str, str]) -> "PillarSites":
        """With cells of other names; classes that do not occur have none."""
        return dataclasses.replace(
            self, children=tuple(new.get(child, "") for child in self.children)
        )

    def numbered(self, number: Mapping[str, int]) -> PillarLattice:
        """The lattice with ``number`` + 1 of each cell in place of its class; 0 for
        those without one.
        """
        lookup = np.array(
            [0, *(number.get(child, -1) + 1 for child in self.children)], np.int32
        )
        source = self.lattice.source
        made: PillarLattice = dataclasses.replace(
            self.lattice, source=lambda a, b: lookup[source(a, b)], array=None
        )
        return made

    def sums(self) -> dict[str, tuple[int, ...]]:
        """{cell: count, sums of x and y, turned, hash} of those that occur."""
        l, digest = self.lattice, RunningDigest()
        for first, block in l.blocks(max(1, _MOST // max(1, l.columns))):
            digest.sites(block, l.x0, l.y0 - first * l.down, (l.pitch, l.down))
        found = digest.of(np.arange(1, len(self.children) + 1))
        every = (tuple(int(v[k]) for v in found) for k in range(len(self.children)))
        return {
            child: sums
            for child, sums in zip(self.children, every, strict=True)
            if sums[0]
        }


@dataclass(frozen=True, eq=False, slots=True)
class MaskAssembly:
    """A mask file to be written.

    name: of the library. cells: by name, all that are placed among them. copies, sites:
    of a cell, beside what its
    content places. layer_names: shown by viewers. doses: relative dose of each (layer,
    datatype) that is exposed.
    """

    name: str
    cells: Mapping[str, CellContent]
    copies: Mapping[str, tuple[CellCopies, ...]]
    unit_nm: float = 1.0
    layer_names: Mapping[LayerNumber, str] = field(default_factory=dict)
    doses: Mapping[LayerNumber, float] = field(default_factory=dict)
    sites: Mapping[str, PillarSites] = field(default_factory=dict)

    @property
    def layers(self) -> set[LayerNumber]:
        """All that are drawn on."""
        return {
            layer
            for cell in self.cells.values()
            for layer in (*cell.polygons, *cell.circles)
        }


def library_of(plan: MaskPlan, *, fold: bool = False) -> MaskAssembly:
    """A plan as cells: pillar classes that occur, figures, lattices, and the top cell.

    Args:
        plan: of a die.
        fold: store a lattice that is symmetric under the square as an eighth.
    """
    occurs = plan.counts()[1:] > 0
    children = tuple(
        made.name if used else ""
        for made, used in zip(plan.classes, occurs, strict=True)
    )
    cells = {
        made.name: CellContent(made.name, {made.layer: list(made.polygons)})
        for made, used in zip(plan.classes, occurs, strict=True)
        if used
    }
    for figure in plan.figures:
        shapes = {layer: list(some) for layer, some in figure.polygons.items()}
        cells[figure.name] = CellContent(figure.name, shapes)
    fold = fold and all(map(_is_square_symmetric, plan.classes))
    sites: dict[str, PillarSites] = {}
    copies: dict[str, tuple[CellCopies, ...]] = {}
    for lattice in plan.lattices:
        cells[lattice.name] = CellContent(lattice.name)
        if not (fold and symmetry.is_square_symmetric(lattice)):
            sites[lattice.name] = PillarSites(lattice, children)
            continue
        for piece in symmetry.symmetry_pieces(lattice):
            name = piece.lattice.name
            if name in cells:
                raise ProcessError(f"two cells of the name {name}: rename one")
            cells[name] = CellContent(name)
            sites[name] = PillarSites(piece.lattice, children)
            turns = [QUARTERS[k + 4 * flip] for k, flip in piece.placed]
            placed = tuple(CellCopies(name, 0, 0, turn) for turn in turns)
            copies[lattice.name] = copies.get(lattice.name, ()) + placed
    cells[plan.name] = CellContent(plan.name)
    copies[plan.name] = tuple(CellCopies(name, 0, 0) for name in plan.placed_names)
    return MaskAssembly(
        plan.name, cells, copies, plan.unit_nm, plan.layer_names, plan.doses, sites
    )


def _is_square_symmetric(made: PillarClass) -> bool:
    """Whether a quarter turn and a mirror leave the pillar and its drawing as is."""

    def edges(*shapes: Array) -> set[frozenset[tuple[int, int]]]:
        ends = (np.hstack([s, np.roll(s, -1, axis=0)]).tolist() for s in shapes)
        pairs = itertools.chain.from_iterable(ends)
        return {frozenset(((a, b), (c, d))) for a, b, c, d in pairs}

    def corners(*shapes: Array) -> set[tuple[int, int]]:
        return {(int(x), int(y)) for shape in shapes for x, y in shape}

    outline, drawn = edges(*made.contours), corners(*made.polygons)
    return all(
        edges(*(contour @ turn for contour in made.contours)) == outline
        and corners(*(shape @ turn for shape in made.polygons)) == drawn
        for turn in (np.array([[0, 1], [-1, 0]]), np.array([[-1, 0], [0, 1]]))
    )


def find_arrays(
    placed: CellPlacements,
) -> tuple[tuple[CellCopies, ...], CellPlacements]:
    """Rows and rectangles of equally spaced copies as arrays, and the placements that
    are in none.

    Files made elsewhere come with their arrays taken apart; put together again they do
    not grow. Rows of four or more
    are found along x, columns along y, and equal rows at equal distances are one array.
    Cells of more than a million
    placements stay as they are.
    """
    if not _LEAST <= len(placed.child) <= _MOST:
        return (), placed
    key = placed.child.astype(np.int64) * len(placed.turns) + placed.turn
    order = np.lexsort((placed.x, placed.y, key))
    first, count, step = _runs(
        key[order], placed.y[order].astype(np.int64), placed.x[order].astype(np.int64)
    )
    kind, x, y = (
        key[order][first],
        placed.x[order][first].astype(np.int64),
        placed.y[order][first].astype(np.int64),
    )
    again = np.lexsort((y, step, count, x, kind))
    alike = np.unique(
        np.column_stack([kind, x, count, step]), axis=0, return_inverse=True
    )[1].ravel()
    begin, rows, up = _runs(alike[again], np.zeros(len(again), np.int64), y[again])
    made: list[CellCopies] = []
    single = np.zeros(len(placed.child), bool)
    for b, height, rise in zip(begin.tolist(), rows.tolist(), up.tolist(), strict=True):
        members = again[b : b + height]
        n, wide = int(members[0]), int(count[members[0]])
        if height * wide < _LEAST:
            for m in members.tolist():
                single[order[first[m] : first[m] + wide]] = True
            continue
        child, turn = divmod(int(kind[n]), len(placed.turns))
        place, across = (int(x[n]), int(y[n])), (int(step[n]), 0)
        made.append(
            CellCopies(
                placed.children[child],
                *place,
                placed.turns[turn],
                wide,
                height,
                across,
                (0, int(rise)),
            )
        )
    left = (
        placed.child[single],
        placed.x[single],
        placed.y[single],
        placed.turn[single],
    )
    return tuple(made), CellPlacements(placed.children, *left, placed.turns)


def _runs(key: Array, line: Array, at: Array) -> tuple[Array, Array, Array]:
    """First, count and step of runs of equal steps along ``at`` (sorted by key, line,
    at); pairs are no run.
    """
    first, count, step = [], [], []
    for start, end, by in _spans(key, line, at):
        if end - start >= 3:
            first.append(np.array([start]))
            count.append(np.array([end - start]))
            step.append(np.array([by]))
        else:
            first.append(np.arange(start, end))
            count.append(np.ones(end - start, np.int64))
            step.append(np.zeros(end - start, np.int64))
    return np.concatenate(first), np.concatenate(count), np.concatenate(step)


def _spans(key: Array, line: Array, at: Array) -> Iterator[tuple[int, int, int]]:
    """(start, end, step) that cover all places, each as long as the step stays the
    same; greedy from the left.
    """
    same = (np.diff(key) == 0) & (np.diff(line) == 0)
    by = np.where(same, np.diff(at), -1)
    change = (
        np.flatnonzero(np.r_[True, by[1:] != by[:-1], True])
        if len(by)
        else np.array([0])
    )
    start = 0
    for a, b in zip(change[:-1].tolist(), change[1:].tolist(), strict=True):
        if by[a] <= 0:  # to another key or line, or onto the same place
            for one in range(a, b):
                if start <= one:
                    yield start, one + 1, 0
                    start = one + 1
            continue
        if start < a:
            yield start, a, 0
            start = a
        elif start > a:
            a = start
        if b - a >= 2:
            yield a, b + 1, int(by[a])
            start = b + 1
    if start < len(at):
        yield start, len(at), 0
