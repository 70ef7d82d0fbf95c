"""A written mask is read back and compared with its plan, site by site and vertex by
vertex.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np

from layout.files.content import QUARTERS, CellContent, MaskContent, Placed
from layout.files.digest import Digest, Sums
from layout.mask import Figure, Lattice, MaskPlan, PillarClass, symmetry
from layout.process import LayerNumber
from metalens.ground.arrays import Array

_CHUNK = 1 << 20


@dataclass(frozen=True, slots=True)
class Comparison:
    """Outcome of reading a mask back.

    pillars: placements found on the lattices. differences: what does not agree with the
    plan, in words.
    """

    pillars: int
    differences: tuple[str, ...]

    @property
    def ok(self) -> bool:
        """Whether file and plan are the same."""
        return not self.differences


def compare(plan: MaskPlan, content: MaskContent) -> Comparison:
    """Whether a file holds exactly the plan: cells, layers, polygons or circles, and
    every pillar at its site.
    """
    found: list[str] = []
    if abs(content.unit_nm / plan.unit_nm - 1) > 1e-12:
        found.append(f"database unit {content.unit_nm} nm, planned {plan.unit_nm}")
    if content.tops != [plan.name]:
        found.append(f"top cells {content.tops[:5]}, planned {plan.name!r} alone")
    used = [
        made
        for made, count in zip(plan.classes, plan.counts()[1:], strict=True)
        if count
    ]
    needed = [*(made.name for made in used), *plan.placed_names, plan.name]
    missing = [name for name in needed if name not in content.cells]
    if missing:
        return Comparison(
            0, (*found, f"{len(missing)} cells are missing: {', '.join(missing[:5])}")
        )
    for made in used:
        found += _compare_class(made, content.cells[made.name])
    for figure in plan.figures:
        found += _compare_figure(figure, content.cells[figure.name])
    for name in (plan.name, *(lattice.name for lattice in plan.lattices)):
        if _layers(content.cells[name]):
            found.append(f"cell {name} holds shapes of its own, which the plan lacks")
    found += _compare_top(plan, content.cells[plan.name])
    pillars = 0
    for lattice in plan.lattices:
        sums = content.cells[lattice.name].sums
        count, wrong = (
            _compare_lattice(plan, lattice, content)
            if sums is None
            else _compare_sums(
                plan, lattice, content.cells[lattice.name].placed.children, sums
            )
        )
        pillars, found = pillars + count, found + wrong
    return Comparison(pillars, tuple(found))


def _layers(cell: CellContent) -> set[LayerNumber]:
    """Layers on which a cell holds shapes itself."""
    return {
        layer
        for shapes in (cell.polygons, cell.circles)
        for layer, some in shapes.items()
        if some
    }


def _compare_figure(figure: Figure, cell: CellContent) -> list[str]:
    found = []
    for layer in sorted(figure.polygons.keys() | _layers(cell)):
        planned, read = figure.polygons.get(layer, ()), cell.polygons.get(layer, [])
        if cell.circles.get(layer) or not _same(planned, read):
            found.append(f"figure {figure.name}: polygons on layer {layer} differ")
    return found


def _compare_class(made: PillarClass, cell: CellContent) -> list[str]:
    circles = cell.circles.get(made.layer)
    if _layers(cell) != {made.layer}:
        same = False
    elif circles:
        same = circles == [(0, 0, made.diameter_units // 2)] and not cell.polygons.get(
            made.layer
        )
    else:
        same = _same(made.polygons, cell.polygons[made.layer])
    return [] if same else [f"class {made.name}: the shape differs"]


def _same(planned: tuple[Array, ...], read: list[Array]) -> bool:
    return sorted(map(_canonical, planned)) == sorted(map(_canonical, read))


def _canonical(points: Array) -> list[tuple[int, int]]:
    """Vertices from the smallest on, counter-clockwise."""
    p = [(int(x), int(y)) for x, y in points]
    twice = sum(
        a[0] * b[1] - b[0] * a[1] for a, b in zip(p, p[1:] + p[:1], strict=True)
    )
    if twice < 0:
        p.reverse()
    first = p.index(min(p))
    return p[first:] + p[:first]


def _compare_top(plan: MaskPlan, top: CellContent) -> list[str]:
    placed = sorted(top.placed.children[k] for k in top.placed.child)
    moved = any(np.any(a) for a in (top.placed.x, top.placed.y, top.placed.turn))
    if placed != sorted(plan.placed_names) or moved:
        return [
            f"cell {plan.name} does not place each figure and lattice once at (0, 0)"
        ]
    return []


def _compare_lattice(
    plan: MaskPlan, lattice: Lattice, content: MaskContent
) -> tuple[int, list[str]]:
    content, wrong_pieces = _with_places(plan, lattice, content)
    if wrong_pieces:
        return 0, wrong_pieces
    number = {made.name: k for k, made in enumerate(plan.classes, 1)}
    read = np.zeros(
        (lattice.rows, lattice.columns),
        np.uint8 if len(plan.classes) <= 255 else np.uint16,
    )
    count = 0
    for placed in content.leaves(lattice.name):
        lookup = np.array(
            [number.get(child, 0) for child in placed.children], read.dtype
        )
        for i in range(0, len(placed.child), _CHUNK):
            part = slice(i, i + _CHUNK)
            column, off_x = np.divmod(
                placed.x[part].astype(np.int64) - lattice.x0, lattice.pitch
            )
            row, off_y = np.divmod(
                lattice.y0 - placed.y[part].astype(np.int64), lattice.down
            )
            outside = (
                (row < 0)
                | (row >= lattice.rows)
                | (column < 0)
                | (column >= lattice.columns)
            )
            wrong = (
                outside
                | (off_x != 0)
                | (off_y != 0)
                | (placed.turn[part] >= len(QUARTERS))
            )
            if wrong.any():
                at = int(wrong.argmax())
                place = (int(placed.x[i + at]), int(placed.y[i + at]))
                return count, [
                    f"{lattice.name}: {int(wrong.sum())} pillars off the lattice, the first at {place}"
                ]
            read[row, column] = lookup[placed.child[part]]
        count += len(placed.child)
    return count, _differences(lattice, read, count)


def _with_places(
    plan: MaskPlan, lattice: Lattice, content: MaskContent
) -> tuple[MaskContent, list[str]]:
    """``content`` with all places in the pieces of a folded lattice of which only sums
    were kept, where these agree.
    """
    summed = {
        name
        for name in content.cells[lattice.name].placed.children
        if content.cells[name].sums is not None
    }
    if not summed:
        return content, []
    made = symmetry.pieces(lattice) if symmetry.is_square_symmetric(lattice) else []
    pieces = {piece.lattice.name: piece.lattice for piece in made}
    strange = sorted(summed - pieces.keys())
    if strange:
        return content, [
            f"{lattice.name} places {', '.join(strange[:5])}, which are no pieces of the plan"
        ]
    cells, wrong = dict(content.cells), []
    for name in sorted(summed):
        cell, piece = cells[name], pieces[name]
        if cell.sums is not None:
            wrong += _compare_sums(plan, piece, cell.placed.children, cell.sums)[1]
        cells[name] = dataclasses.replace(cell, placed=_places(plan, piece), sums=None)
    return dataclasses.replace(content, cells=cells), wrong


def _places(plan: MaskPlan, lattice: Lattice) -> Placed:
    """All pillars of a lattice in memory as a reader gives them."""
    classes = lattice.whole()
    row, column = np.nonzero(classes)
    x, y = lattice.x0 + column * lattice.pitch, lattice.y0 - row * lattice.down
    number = classes[row, column]
    used = np.flatnonzero(np.bincount(number))
    child = np.searchsorted(used, number).astype(np.int32)
    names = tuple(plan.classes[k - 1].name for k in used)
    return Placed(
        names,
        child,
        x.astype(np.int32),
        y.astype(np.int32),
        np.zeros(len(child), np.uint8),
    )


def _compare_sums(
    plan: MaskPlan, lattice: Lattice, children: tuple[str, ...], read: Sums
) -> tuple[int, list[str]]:
    """As :func:`_compare_lattice`, where of each class only sums over its places were
    kept.
    """
    digest = Digest()
    for first, block in lattice.blocks(max(1, _CHUNK // lattice.columns)):
        digest.sites(
            block,
            lattice.x0,
            lattice.y0 - first * lattice.down,
            (lattice.pitch, lattice.down),
        )
    wanted = digest.of(np.arange(len(plan.classes) + 1))
    number = {made.name: k for k, made in enumerate(plan.classes, 1)}
    count, wrong = int(read.count.sum()), []
    strange = [name for name in children if name not in number]
    if strange:
        wrong.append(
            f"{lattice.name} places {', '.join(strange[:5])}, which are no classes of the plan"
        )
    row = {name: n for n, name in enumerate(children)}
    for name, k in number.items():
        n = row.get(name)
        found = (0, 0, 0, 0, 0) if n is None else tuple(int(v[n]) for v in read)
        planned = tuple(int(v[k]) for v in wanted)
        if found != planned:
            wrong.append(f"{lattice.name}: class {name}: {_unlike(planned, found)}")
    return count, wrong


def _unlike(planned: tuple[int, ...], found: tuple[int, ...]) -> str:
    """What differs between (count, x, y, turned, hash) of a class, in words."""
    (n, x, y, _, _), (m, u, v, turned, _) = planned, found
    if turned:
        return f"{turned} pillars are turned"
    if abs(n - m) == 1:
        sign, what = (
            (1, "one pillar is missing") if n > m else (-1, "one pillar too many")
        )
        return f"{what}, at ({sign * (x - u)}, {sign * (y - v)})"
    return (
        f"{m} pillars, planned {n}"
        if n != m
        else f"{n} pillars, not all at their places"
    )


def _differences(lattice: Lattice, read: Array, count: int) -> list[str]:
    planned = 0
    for first, block in lattice.blocks(1024):
        planned += int(np.count_nonzero(block))
        unlike = read[first : first + len(block)] != block
        if unlike.any():
            row, column = np.unravel_index(int(unlike.argmax()), unlike.shape)
            place = f"row {first + int(row)}, column {int(column)}"
            return [
                f"{lattice.name}: {int(unlike.sum()):,} sites differ, the first at {place}"
            ]
    return (
        []
        if count == planned
        else [f"{lattice.name}: {count:,} pillars, planned {planned:,}"]
    )
