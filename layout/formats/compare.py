"""Comparison of a file that is read back: cells, shapes, every copy at its place."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from layout.formats import flatten
from layout.formats.assembly import MaskAssembly, library_of
from layout.formats.content import QUARTERS, CellContent, MaskContent, Orientation
from layout.formats.digest import RunningDigest
from layout.formats.hierarchy import drawn_counts
from layout.mask import MaskPlan
from metalens.core.arrays import Array
from metalens.core.errors import MaskFileError

Who = tuple[str, Orientation | None]  # a child and its orientation, None: all together
Sum = tuple[int, ...]  # count, sums of x and y, number turned, hash of all places


@dataclass(frozen=True, slots=True)
class ReadbackComparison:
    """Outcome of reading a mask back.

    pillars: placements of the pillar classes below the top cell.
    differences: what does not agree with the plan, in words.
    """

    pillars: int
    differences: tuple[str, ...]

    @property
    def ok(self) -> bool:
        """Whether file and plan are the same."""
        return not self.differences


def compare(plan: MaskPlan, content: MaskContent) -> ReadbackComparison:
    """Whether a file holds exactly the plan, stored whole or as an eighth.

    Args:
        plan: that was written.
        content: of the file; of cells with many placements the sums are enough.
    """
    library = library_of(plan, fold=True)
    if library.cells.keys() != content.cells.keys():
        library = library_of(plan)
    found = mask_differences(library, content)
    try:
        times = drawn_counts(content)
    except MaskFileError as error:
        return ReadbackComparison(0, (*found, str(error)))
    return ReadbackComparison(
        sum(times.get(c.name, 0) for c in plan.classes), tuple(found)
    )


def mask_differences(library: MaskAssembly, content: MaskContent) -> list[str]:
    """What a file does not hold as it was planned, in words; empty where it holds all.

    Circles count as the polygons of 64 corners that GDSII has in their place.

    Args:
        library: that was written.
        content: of the file.
    """
    return list(_differences(library, content))


def _differences(library: MaskAssembly, content: MaskContent) -> Iterator[str]:
    if abs(content.unit_nm / library.unit_nm - 1) > 1e-12:
        yield f"database unit {content.unit_nm} nm, planned {library.unit_nm}"
    missing = sorted(library.cells.keys() - content.cells.keys())
    strange = sorted(content.cells.keys() - library.cells.keys())
    if missing or strange:
        names = ", ".join([*missing, *strange][:5])
        yield f"{len(missing)} cells are missing, {len(strange)} too many: {names}"
        return
    for name, cell in library.cells.items():
        read = content.cells[name]
        if _shapes(cell) != _shapes(read):
            yield f"cell {name}: shapes differ"
        merged = read.sums is not None
        planned = _sums(library, cell, merged=merged)
        there = _sums(None, read, merged=merged)
        for who in sorted(planned.keys() | there.keys(), key=str):
            wanted, found = planned.get(who, (0,) * 5), there.get(who, (0,) * 5)
            if wanted != found:
                yield f"cell {name}: {who[0]}: {_difference(wanted, found)}"


def _difference(planned: Sum, found: Sum) -> str:
    """What differs between the sums of a child, in words."""
    (n, x, y, turned, _), (m, u, v, turned_there, _) = planned, found
    if turned != turned_there:
        return f"{turned_there} copies are turned, planned {turned}"
    if abs(n - m) == 1:
        sign, what = (1, "one is missing") if n > m else (-1, "one too many")
        return f"{what}, at ({sign * (x - u)}, {sign * (y - v)})"
    if n != m:
        return f"{m} copies, planned {n}"
    return f"{n} copies, not all at their places"


def _shapes(cell: CellContent) -> list[tuple[tuple[int, int], list[tuple[int, ...]]]]:
    """Polygons by layer in a form that does not depend on their order."""
    every = {layer: list(shapes) for layer, shapes in cell.polygons.items()}
    for layer, circles in cell.circles.items():
        every.setdefault(layer, []).extend(
            flatten.circle_polygon(*one) for one in circles
        )
    return [
        (layer, sorted(_canonical(points) for points in every[layer]))
        for layer in sorted(every)
        if every[layer]
    ]


def _canonical(points: Array) -> tuple[int, ...]:
    """Corners from the smallest on, counter-clockwise."""
    p = np.asarray(points, np.int64)
    after = np.roll(p, -1, axis=0)
    if (p[:, 0] * after[:, 1] - after[:, 0] * p[:, 1]).sum() < 0:
        p = p[::-1]
    first = int(np.lexsort((p[:, 1], p[:, 0]))[0])
    return tuple(np.roll(p, -first, axis=0).ravel().tolist())


def _sums(
    library: MaskAssembly | None, cell: CellContent, *, merged: bool
) -> dict[Who, Sum]:
    """Sums over the copies of each child and orientation.

    Args:
        library: with arrays of copies and pillars of the cell; None: it has none.
        cell: with placements.
        merged: all orientations together, as a reader sums them.
    """
    if cell.sums is not None:
        every = zip(cell.placed.children, *(v.tolist() for v in cell.sums), strict=True)
        return {(child, None): tuple(sums) for child, *sums in every}
    digests: dict[Who, RunningDigest] = {}
    for child, turn, places in _copies(library, cell):
        who = _rounded(turn)
        digest = digests.setdefault((child, None if merged else who), RunningDigest())
        zeros = np.zeros(len(places[0]), np.int64)
        index = QUARTERS.index(who) if who in QUARTERS else len(QUARTERS)
        turned = np.full(len(zeros), index if merged else 0, np.uint8)
        digest.take(zeros, *places, turned)
    zero = np.zeros(1, np.int64)
    sums = {
        who: tuple(int(value[0]) for value in digest.of(zero))
        for who, digest in digests.items()
    }
    if library is not None and cell.name in library.sites:
        key = None if merged else QUARTERS[0]
        of_pillars = library.sites[cell.name].sums()
        sums |= {(child, key): value for child, value in of_pillars.items()}
    return sums


def _copies(
    library: MaskAssembly | None, cell: CellContent
) -> Iterator[tuple[str, Orientation, tuple[Array, Array]]]:
    """(child, orientation, places) of all copies in a cell but its pillar arrays."""
    placed = cell.kept()
    key = placed.child.astype(np.int64) * len(placed.turns) + placed.turn
    order = np.argsort(key, kind="stable")
    kinds, starts = np.unique(key[order], return_index=True)
    if len(kinds):
        groups = np.split(order, starts[1:])
        for kind, members in zip(kinds.tolist(), groups, strict=True):
            child, turn = divmod(kind, len(placed.turns))
            places = placed.x[members], placed.y[members]
            yield placed.children[child], placed.turns[turn], places
    for one in () if library is None else library.copies.get(cell.name, ()):
        yield one.child, one.turn, one.places()


def _rounded(turn: Orientation) -> Orientation:
    """As both formats hold it: GDSII has 56 bits of a fraction to the base 16."""
    angle = round(turn.angle_deg % 360, 9) % 360
    return Orientation(angle, turn.mirrored, float(f"{turn.scale:.12g}"))
