"""A mask as cells: polygons, and references to other cells; the walk through them.

One model for what is read from a file and for what is written to one. Millions of
pillars of a lens stay an array of class numbers (:class:`PillarSites`).
"""

import dataclasses
import graphlib
import math
from collections import Counter
from collections.abc import Hashable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from layout.formats.digest import RunningDigest
from layout.mask.plan import FARTHEST, MaskPlan, PillarArray
from layout.process.process import LayerNumber
from layout.shapes import polygon
from metalens.core.arrays import Array
from metalens.core.errors import MaskFileError

MAX_DEPTH = 64  # of nested references


@dataclass(frozen=True)
class Orientation:
    """A mirror at the x axis (or none), then a turn counter-clockwise, then a scale."""

    angle_deg: float = 0.0
    mirrored: bool = False
    scale: float = 1.0

    @property
    def quarter(self) -> bool:
        """Whether it is a multiple of 90 degrees without a scale."""
        return self.scale == 1 and self.angle_deg % 90 == 0

    def apply(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Points in this orientation.

        Args:
            x: coordinates, database units.
            y: coordinates of the same points.

        Returns:
            x and y; exact where ``quarter``, else rounded to whole units.
        """
        if self.mirrored:
            y = -y
        if self.quarter:
            for _ in range(int(self.angle_deg // 90) & 3):
                x, y = -y, x
            return x, y
        angle = math.radians(self.angle_deg)
        cosine = self.scale * math.cos(angle)
        sine = self.scale * math.sin(angle)
        turned = np.rint(cosine * x - sine * y), np.rint(sine * x + cosine * y)
        return turned[0].astype(np.int64), turned[1].astype(np.int64)

    def after(self, inner: "Orientation") -> "Orientation":
        """The orientation that equals ``inner`` followed by this one."""
        sign = -1 if self.mirrored else 1
        return Orientation(
            (self.angle_deg + sign * inner.angle_deg) % 360,
            self.mirrored != inner.mirrored,
            self.scale * inner.scale,
        )


UPRIGHT = Orientation()
QUARTERS = tuple(Orientation(90.0 * (k & 3), bool(k & 4)) for k in range(8))


@dataclass(frozen=True, eq=False)
class CellPlacements:
    """A cell placed anywhere, in one orientation.

    child: name of the cell.
    turn: orientation of all.
    x, y: (n,) int32 places, database units.
    """

    child: str
    turn: Orientation
    x: Array
    y: Array

    @property
    def count(self) -> int:
        """Number of instances."""
        return len(self.x)

    def places(self) -> tuple[Array, Array]:
        """x and y of all instances, (count,) each."""
        return self.x, self.y


@dataclass(frozen=True)
class CellReference:
    """A cell placed once, or as an array.

    child: name of the cell.
    x, y: place of the first, database units.
    turn: orientation of all.
    columns, rows: of the array; instance (i, j) stands at (x, y) + i across + j up.
    across, up: steps of the array.
    """

    child: str
    x: int
    y: int
    turn: Orientation = UPRIGHT
    columns: int = 1
    rows: int = 1
    across: tuple[int, int] = (0, 0)
    up: tuple[int, int] = (0, 0)

    @property
    def count(self) -> int:
        """Number of instances."""
        return self.columns * self.rows

    def places(self) -> tuple[Array, Array]:
        """x and y of all instances, (count,) each, row by row."""
        column, row = np.arange(self.columns), np.arange(self.rows)[:, None]
        x, y = (
            origin + column * step + row * row_step
            for origin, step, row_step in zip(
                (self.x, self.y), self.across, self.up, strict=True
            )
        )
        return x.ravel(), y.ravel()


@dataclass(frozen=True, eq=False)
class PillarSites:
    """Pillars of a cell, never all in memory.

    lattice: class numbers.
    children: cell of each class from 1 on; empty for one that does not occur.
    """

    lattice: PillarArray
    children: tuple[str, ...]

    def numbered(self, number: Mapping[str, int]) -> PillarArray:
        """The lattice with other class numbers.

        Args:
            number: of each cell; the lattice holds it plus 1, and 0 for other cells.
        """
        lookup = np.array(
            [0, *(number.get(c, -1) + 1 for c in self.children)], np.int32
        )
        source = self.lattice.source
        return dataclasses.replace(
            self.lattice, source=lambda a, b: lookup[source(a, b)]
        )

    def sites(self) -> Iterator[tuple[Array, Array, Array]]:
        """Class number, x and y (n,) of the pillars, some rows at a time."""
        for first, block in self.lattice.blocks():
            row, column = np.nonzero(block)
            yield block[row, column], *self.lattice.positions(first + row, column)

    def places(self) -> Iterator[tuple[str, Array, Array]]:
        """Cell, x and y (n,) of the pillars, some rows at a time."""
        for numbers, x, y in self.sites():
            for number, members in group_equal(numbers):
                yield self.children[number - 1], x[members], y[members]

    def sums(self) -> dict[str, tuple[int, ...]]:
        """{cell: count, sums of x and y, turned, hash} of those that occur."""
        digest = RunningDigest()
        for numbers, x, y in self.sites():
            digest.take(numbers, x, y, np.zeros(len(x), np.uint8))
        rows = digest.of(np.arange(1, len(self.children) + 1)).tolist()
        pairs = zip(self.children, map(tuple, rows), strict=True)
        return {child: sums for child, sums in pairs if sums[0]}


@dataclass(frozen=True, eq=False)
class MaskCell:
    """One cell.

    polygons: {(layer, datatype): (n, 2) corners each}.
    references: placements of other cells.
    sums: {child: count, sums of x and y, number turned, hash} of its placements, where
        there are more than are kept.
    skipped: elements of the file that draw nothing, by kind.
    pillars: a lattice of cells in addition.
    """

    name: str
    polygons: Mapping[LayerNumber, list[Array]] = field(default_factory=dict)
    references: tuple[CellReference | CellPlacements, ...] = ()
    sums: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    skipped: Counter[str] = field(default_factory=Counter)
    pillars: PillarSites | None = None

    @property
    def children(self) -> tuple[str, ...]:
        """Names of the cells that are placed."""
        own = (*self.sums, *(one.child for one in self.references))
        more = self.pillars.children if self.pillars is not None else ()
        return tuple(dict.fromkeys(child for child in (*own, *more) if child))

    def counts(self) -> dict[tuple[str, Orientation], int]:
        """How often each cell is placed in each orientation; of sums all together."""
        counts: Counter[tuple[str, Orientation]] = Counter()
        for child, (count, *_) in self.sums.items():
            counts[child, UPRIGHT] += count
        for reference in self.references:
            counts[reference.child, reference.turn] += reference.count
        if self.pillars is not None:
            pillar_counts = self.pillars.lattice.counts(len(self.pillars.children))
            for child, count in zip(
                self.pillars.children, pillar_counts[1:].tolist(), strict=True
            ):
                counts[child, UPRIGHT] += count
        return {key: count for key, count in counts.items() if count}

    def instances(self) -> Iterator[tuple[str, Orientation, Array, Array]]:
        """Placements by cell and orientation: name, orientation, x and y (n,) each.

        Raises:
            MaskFileError: only sums of the placements were kept.
        """
        if self.sums:
            raise MaskFileError(
                f"cell {self.name!r}: of its placements only the sums were kept; read "
                "all of them"
            )
        for reference in self.references:
            yield reference.child, reference.turn, *reference.places()
        if self.pillars is not None:
            for name, x, y in self.pillars.places():
                yield name, UPRIGHT, x, y

    @property
    def layers(self) -> set[LayerNumber]:
        """Layers of its own shapes."""
        return set(self.polygons)

    @property
    def shapes(self) -> int:
        """Number of its own shapes; 1 for a cell that holds nothing at all."""
        return sum(map(len, self.polygons.values())) or int(not self.children)


@dataclass(frozen=True, eq=False)
class MaskLibrary:
    """All of a mask.

    name: of the library.
    cells: by name, in the order of the file.
    unit_nm: database unit.
    layer_names: shown by viewers.
    doses: relative dose of each (layer, datatype) that is exposed, where it is known.
    kind: of the file that it was read from, ``GDSII`` or ``OASIS``.
    """

    name: str
    cells: Mapping[str, MaskCell]
    unit_nm: float = 1.0
    layer_names: Mapping[LayerNumber, str] = field(default_factory=dict)
    doses: Mapping[LayerNumber, float] = field(default_factory=dict)
    kind: str = ""

    @property
    def layers(self) -> set[LayerNumber]:
        """All that are drawn on."""
        return set().union(*(cell.layers for cell in self.cells.values()))

    @property
    def tops(self) -> list[str]:
        """Cells that no other cell places."""
        used = {name for cell in self.cells.values() for name in cell.children}
        return [name for name in self.cells if name not in used]

    @property
    def skipped(self) -> Counter[str]:
        """Elements of the cells that draw nothing: {kind: number}, texts among them."""
        return sum((cell.skipped for cell in self.cells.values()), Counter())

    def cell(self, name: str) -> MaskCell:
        """The cell of a name.

        Raises:
            MaskFileError: no such cell.
        """
        if name not in self.cells:
            raise MaskFileError(
                f"cell {name!r} is placed, but the file does not hold it"
            )
        return self.cells[name]

    def below(self, top: str) -> "MaskLibrary":
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
        reached: set[str] = set()
        waiting = [top]
        while waiting:
            name = waiting.pop()
            if name in self.cells and name not in reached:
                reached.add(name)
                waiting += self.cells[name].children
        cells = {name: cell for name, cell in self.cells.items() if name in reached}
        return dataclasses.replace(self, cells=cells)

    def walk(self, top: str) -> Iterator[tuple[str, Orientation, Array, Array]]:
        """Every cell below ``top`` and itself: name, orientation, x and y (n,) int32.

        Instances of a cell that places nothing come together, some millions at once.

        Raises:
            MaskFileError: a cell that places itself or is missing, a place beyond 32
                bits.
        """
        zero = np.zeros(1, np.int32)
        yield top, UPRIGHT, zero, zero
        yield from self._walk(top, UPRIGHT, 0, 0, ())

    def _walk(
        self, name: str, turn: Orientation, x: int, y: int, above: tuple[str, ...]
    ) -> Iterator[tuple[str, Orientation, Array, Array]]:
        """All cells below one instance of a cell, depth first.

        Args:
            name: of the cell.
            turn: orientation of the instance.
            x, y: its place.
            above: names of the cells that it is in.
        """
        if name in above or len(above) > MAX_DEPTH:
            raise MaskFileError(
                f"cell {name!r} places itself through {' > '.join(above[:9])}; the "
                "file is no mask"
            )
        for child, child_turn, px, py in self.cell(name).instances():
            inner = turn.after(child_turn)
            px, py = turn.apply(px.astype(np.int64), py.astype(np.int64))
            px, py = px + x, py + y
            if max(np.abs(px).max(), np.abs(py).max()) > FARTHEST:
                raise MaskFileError(f"cell {name!r} holds places beyond 32 bits")
            yield child, inner, px.astype(np.int32), py.astype(np.int32)
            if self.cell(child).children:
                for instance_x, instance_y in zip(
                    px.tolist(), py.tolist(), strict=True
                ):
                    yield from self._walk(
                        child, inner, instance_x, instance_y, (*above, name)
                    )

    def topological_order(self) -> list[str]:
        """All cells, each after those that place it.

        Raises:
            MaskFileError: a cell that places itself, or one that is placed and missing.
        """
        above: dict[str, list[str]] = {name: [] for name in self.cells}
        for name, cell in self.cells.items():
            for child in cell.children:
                self.cell(child)
                above[child].append(name)
        try:
            return list(graphlib.TopologicalSorter(above).static_order())
        except graphlib.CycleError as error:
            name, *others = error.args[1]
            raise MaskFileError(
                f"cell {name!r} places itself through {' > '.join(others[:9])}; the "
                "file is no mask"
            ) from None

    def drawn_counts(self) -> dict[str, int]:
        """{cell: how often the top cells draw it}, by products from the top down.

        Raises:
            MaskFileError: as :meth:`topological_order`.
        """
        return {name: int(n) for name, n in self._sums_of_instances(0).items()}

    def _sums_of_instances(self, power: int) -> dict[str, float]:
        """{cell: sum of scale ** power over its instances below the top cells}."""
        sums: dict[str, float] = dict.fromkeys(self.topological_order(), 0)
        sums |= dict.fromkeys(self.tops, 1)
        for name in sums:
            for (child, turn), count in self.cells[name].counts().items():
                sums[child] += sums[name] * count * turn.scale**power
        return sums

    def count_shapes(self) -> Counter[LayerNumber]:
        """Shapes that the top cells draw on each layer.

        Raises:
            MaskFileError: as :meth:`topological_order`.
        """
        counts: Counter[LayerNumber] = Counter()
        for name, times in self.drawn_counts().items():
            cell = self.cells[name]
            counts.update({k: times * len(v) for k, v in cell.polygons.items()})
        return counts

    def areas_um2(self) -> dict[LayerNumber, float]:
        """{layer: sum of the areas of all shapes below the top cells}."""
        areas: dict[LayerNumber, float] = {}
        for name, weight in self._sums_of_instances(2).items():
            for layer, shapes in self.cells[name].polygons.items():
                units = weight * sum(abs(polygon.twice_area(p)) / 2 for p in shapes)
                um2 = units * (1e-3 * self.unit_nm) ** 2
                areas[layer] = areas.get(layer, 0.0) + um2
        return areas

    def refuse_beyond(self, limit: int) -> None:
        """Refuse a mask that is too large to be expanded.

        Args:
            limit: shapes; instances of an empty cell count as one shape each.

        Raises:
            MaskFileError: more shapes; as :meth:`topological_order`.
        """
        times = self.drawn_counts()
        total = sum(count * self.cells[name].shapes for name, count in times.items())
        if total > limit:
            raise MaskFileError(
                f"the mask draws {total:,} shapes when its arrays are expanded, at "
                f"most {limit:,} are taken (metalens check --max-shapes sets another "
                "limit, at 25 to 150 bytes of memory for each)"
            )


def library_of(plan: MaskPlan) -> MaskLibrary:
    """A plan as cells: pillar classes that occur, figures, lattices, and the top cell."""
    occurs = plan.counts()[1:] > 0
    pairs = list(zip(plan.classes, occurs.tolist(), strict=True))
    children = tuple(pillar.name if used else "" for pillar, used in pairs)
    cells = [
        MaskCell(pillar.name, {pillar.layer: list(pillar.polygons)})
        for pillar, used in pairs
        if used
    ]
    for figure in plan.figures:
        shapes = {layer: list(polygons) for layer, polygons in figure.polygons.items()}
        cells.append(MaskCell(figure.name, shapes))
    cells += [
        MaskCell(lattice.name, pillars=PillarSites(lattice, children))
        for lattice in plan.lattices
    ]
    placed = tuple(CellReference(name, 0, 0) for name in plan.placed_names)
    cells.append(MaskCell(plan.name, references=placed))
    by_name = {cell.name: cell for cell in cells}
    return MaskLibrary(plan.name, by_name, plan.unit_nm, plan.layer_names, plan.doses)


def group_equal(numbers: Array) -> Iterator[tuple[int, Array]]:
    """Each distinct number, and the indices where it stands.

    Args:
        numbers: (n,) integers.
    """
    if not len(numbers):
        return
    order = stable_order(numbers)
    sorted_numbers = numbers[order]
    starts = np.flatnonzero(np.diff(sorted_numbers)) + 1
    parts = np.split(order, starts)
    yield from zip(sorted_numbers[np.r_[0, starts]].tolist(), parts, strict=True)


def stable_order(numbers: Array) -> Array:
    """Indices that sort integers, equal ones in their order (radix sort by 16 bits).

    Args:
        numbers: (n,) integers.
    """
    if not len(numbers):
        return np.empty(0, np.int64)
    rank = numbers.astype(np.int64) - int(numbers.min())
    order = np.argsort(rank.astype(np.uint16), kind="stable")
    for shift in range(16, int(rank.max()).bit_length(), 16):
        digit = (rank[order] >> shift).astype(np.uint16)
        order = order[np.argsort(digit, kind="stable")]
    return order


# flat shapes


@dataclass(frozen=True, eq=False)
class PolygonStack:
    """Polygons of one cell and layer with equally many corners, at the same places.

    outlines: (k, n, 2), counter-clockwise, in the orientation of the instances.
    x, y: (m,) places of the cell.
    """

    cell: str
    layer: LayerNumber
    outlines: Array
    x: Array
    y: Array


def flatten_stacks(library: MaskLibrary, top: str) -> Iterator[PolygonStack]:
    """Every polygon below a cell.

    Args:
        library: of the cells.
        top: name of the cell.

    Raises:
        MaskFileError: as :meth:`MaskLibrary.walk`.
    """
    for name, turn, x, y in library.walk(top):
        for layer, polygons in library.cell(name).polygons.items():
            corners = np.array([len(points) for points in polygons])
            for _, members in group_equal(corners):
                points = np.stack([polygons[n] for n in members.tolist()])
                yield PolygonStack(name, layer, _turned(points, turn), x, y)


def equal_shapes(library: MaskLibrary) -> Iterable[list[PolygonStack]]:
    """Shapes of one cell and layer that are equal, as stacks of one polygon.

    Args:
        library: of a file.

    Raises:
        MaskFileError: as :meth:`MaskLibrary.walk`.
    """
    stacks: dict[Hashable, list[PolygonStack]] = {}
    for top in library.tops:
        for stack in flatten_stacks(library, top):
            for outline in stack.outlines:
                shape_key = stack.cell, stack.layer, outline.tobytes()
                single = dataclasses.replace(stack, outlines=outline[None])
                stacks.setdefault(shape_key, []).append(single)
    return stacks.values()


def _turned(outlines: Array, turn: Orientation) -> Array:
    """(k, n, 2) corners in some orientation, counter-clockwise again."""
    outlines = outlines.astype(np.int64)
    turned = np.stack(turn.apply(outlines[..., 0], outlines[..., 1]), -1)
    following = np.roll(turned, -1, axis=1)
    area = (
        turned[..., 0] * following[..., 1] - following[..., 0] * turned[..., 1]
    ).sum(1)
    turned[area < 0] = turned[area < 0, ::-1]
    return turned


def flatten_polygons(library: MaskLibrary) -> Iterator[tuple[LayerNumber, Array]]:
    """Layer and (n, 2) corners of every polygon below the top cells of a library."""
    for top in library.tops:
        for stack in flatten_stacks(library, top):
            for place in zip(stack.x.tolist(), stack.y.tolist(), strict=True):
                for outline in stack.outlines:
                    yield stack.layer, outline + np.array(place)
