"""The mask as a record: lattices of pillar classes, fixed figures, layers. Writers and
checks need nothing else.
"""

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from layout.process import names
from layout.process.process import LayerNumber
from layout.shapes import polygon
from layout.shapes.rectilinear import IntBox
from metalens.core.arrays import Array
from metalens.core.errors import ProcessError

MOST_CLASSES = np.iinfo(np.uint16).max
Role = Literal["pillar", "dose", "witness"]
FARTHEST = np.iinfo(np.int32).max  # coordinate of any mask file
BLOCK_SITES = 1 << 20  # sites, or placements, that are worked on at once
UNDRAWN = ("OUTLINE", "FIELDS")  # figures for people: no resist sees them
EXPOSED = (
    "MARKS",
    "LABEL",
    "VERNIERS",
)  # figures that are written in the same exposure as the pillars
RowSource = Callable[
    [int, int], Array
]  # (first row, end row) -> (rows, columns) class numbers


def row_blocks(
    source: RowSource, shape: tuple[int, int], rows: int | None = None
) -> Iterator[tuple[int, Array]]:
    """(first row, class numbers) of blocks of rows.

    Args:
        source: of the class numbers.
        shape: rows and columns.
        rows: in a block; None: about a million sites.
    """
    size = rows or max(1, BLOCK_SITES // max(1, shape[1]))
    for first in range(0, shape[0], size):
        block = source(first, min(first + size, shape[0]))
        yield first, np.ascontiguousarray(block)


@dataclass(frozen=True, eq=False)
class PillarClass:
    """All pillars of one diameter (and dose): one cell of the mask.

    name: of the cell. diameter_nm, diameter_units: of the circle that ``outline``
    stands for, as drawn. layer: (layer, datatype). outline: (n, 2) of the pillar,
    convex or not, counter-clockwise. drawn: polygons that are written: the outline
    itself; pieces where it has holes; or the lattice square without the pillar, for a
    negative tone. dose: relative to the base dose. goal: exposure of the edge that is
    sought, relative to dose to size (1 but in a dose test). round: whether the outline
    stands for a circle of that diameter; else the diameter is the size of the shape.
    holes: in the outline, clockwise. role: a pillar of the lens, of the dose test or of
    the witness cells.
    """

    name: str
    diameter_nm: float
    diameter_units: int
    layer: LayerNumber
    outline: Array
    drawn: tuple[Array, ...] = ()
    dose: float = 1.0
    goal: float = 1.0
    round: bool = True
    holes: tuple[Array, ...] = ()
    role: Role = "pillar"

    @property
    def contours(self) -> tuple[Array, ...]:
        """The outline and the holes in it."""
        return self.outline, *self.holes

    @property
    def twice_area(self) -> int:
        """Twice the area of the pillar, holes left out, in squared database units."""
        return sum(polygon.twice_area(contour) for contour in self.contours)

    @property
    def polygons(self) -> tuple[Array, ...]:
        """What is written."""
        return self.drawn or (self.outline,)


@dataclass(frozen=True, eq=False)
class PillarArray:
    """Pillars on a lattice, written as one cell.

    name: of the cell.
    rows, columns: of sites.
    pitch: from column to column, database units.
    x0, y0: site of the first row and column; x = x0 + column * pitch, y = y0 - row *
        down.
    source: (first row, end row) to (rows, columns) class numbers, 0 for no pillar.
    row_pitch: from row to row, 0 for that of the columns.
    centred: every other site stays empty (a hexagonal lattice: the pitch is half its
        constant).
    unit_um: database unit.
    """

    name: str
    rows: int
    columns: int
    pitch: int
    x0: int
    y0: int
    source: RowSource
    row_pitch: int = 0
    centred: bool = False
    unit_um: float = 1e-3

    def __post_init__(self) -> None:
        """Refuse an illegal name, and sites beyond 32 bits."""
        names.check_cell_name(self.name)
        right = self.x0 + self.columns * self.pitch
        bottom = self.y0 - self.rows * self.down
        farthest = max(map(abs, (self.x0, self.y0, right, bottom)))
        if farthest > FARTHEST:
            raise ProcessError(
                f"lattice {self.name} reaches {farthest} database units from the "
                f"origin, beyond 32 bits ({FARTHEST}); take a smaller aperture or a "
                "coarser unit"
            )

    @classmethod
    def of(
        cls, name: str, classes: Array, *, pitch: int, x0: int, y0: int
    ) -> "PillarArray":
        """A square lattice in memory.

        Args:
            name: of its cell.
            classes: (rows, columns) class numbers, uint8 or uint16.
            pitch: database units.
            x0: of the first column.
            y0: of the first row.
        """
        rows, columns = classes.shape
        return cls(name, rows, columns, pitch, x0, y0, lambda a, b: classes[a:b])

    @property
    def down(self) -> int:
        """From row to row, database units."""
        return self.row_pitch or self.pitch

    @property
    def constant(self) -> int:
        """From a pillar to the next one of its row, database units."""
        return self.pitch * (2 if self.centred else 1)

    def blocks(self, rows: int | None = None) -> Iterator[tuple[int, Array]]:
        """(first row, class numbers) of blocks of rows.

        Args:
            rows: in a block; None: about a million sites.
        """
        yield from row_blocks(self.source, (self.rows, self.columns), rows)

    def whole(self) -> Array:
        """All class numbers (rows, columns)."""
        return self.source(0, self.rows)

    def present(self, first: int, end: int) -> Array:
        """(rows, columns) whether a pillar stands at each site of some rows.

        Args:
            first: row.
            end: row after the last; rows beyond the lattice are left out.
        """
        return self.source(first, min(end, self.rows)) > 0

    def positions(self, row: Array, column: Array) -> tuple[Array, Array]:
        """x and y of sites, database units.

        Args:
            row: numbers of their rows.
            column: numbers of their columns.
        """
        return self.x0 + column * self.pitch, self.y0 - row * self.down

    def counts(self, classes: int) -> Array:
        """(classes + 1,) sites of each class number.

        Args:
            classes: their number.
        """
        total = np.zeros(classes + 1, np.int64)
        for _, block in self.blocks():
            total += np.bincount(block.ravel(), minlength=len(total))
        return total

    @property
    def pitch_um(self) -> float:
        """From column to column."""
        return self.pitch * self.unit_um

    @property
    def down_um(self) -> float:
        """From row to row."""
        return self.down * self.unit_um

    @property
    def steps_um(self) -> Array:
        """(n, 2) from a site to its nearest neighbours on all sides."""
        x, y = self.pitch_um, self.down_um
        straight = [(x, 0.0), (-x, 0.0), (0.0, y), (0.0, -y)]
        if not self.centred:
            return np.array(straight)
        return np.array(
            [(2 * i, 2 * j) for i, j in straight]
            + [(i, j) for i in (x, -x) for j in (y, -y)]
        )

    @property
    def nearest_um(self) -> float:
        """From a site to the nearest."""
        return float(np.hypot(*self.steps_um.T).min())

    @property
    def columns_um(self) -> Array:
        """(columns,) x of the sites."""
        return (self.x0 + np.arange(self.columns) * self.pitch) * self.unit_um

    def rows_um(self, first: int, count: int) -> Array:
        """(count,) y of rows.

        Args:
            first: number of the first.
            count: of rows.
        """
        rows = np.arange(first, first + count)
        return (self.y0 - rows * self.down) * self.unit_um

    @property
    def box(self) -> IntBox:
        """Left, bottom, right, top of the sites, database units."""
        right = self.x0 + (self.columns - 1) * self.pitch
        return self.x0, self.y0 - (self.rows - 1) * self.down, right, self.y0

    @property
    def box_um(self) -> tuple[float, float, float, float]:
        """Left, bottom, right, top of the sites."""
        left, bottom, right, top = (side * self.unit_um for side in self.box)
        return left, bottom, right, top

    def sites_in(
        self, box: tuple[float, float, float, float]
    ) -> tuple[Array, Array, Array]:
        """Class, x and y (n,) of the pillars whose site lies in a box, database units.

        Args:
            box: left, bottom, right, top; sites on the upper sides are left out.
        """
        left, bottom, right, top = box
        columns = (left - self.x0, right - self.x0), self.pitch, self.columns
        rows = (self.y0 - top, self.y0 - bottom), self.down, self.rows
        (left_column, end_column), (first, end) = (
            [min(max(math.ceil(distance / step), 0), count) for distance in distances]
            for distances, step, count in (columns, rows)
        )
        if first >= end or left_column >= end_column:
            return (np.empty(0, np.int64),) * 3
        block = self.source(first, end)[:, left_column:end_column]
        row, column = np.nonzero(block)
        return block[row, column], *self.positions(first + row, left_column + column)


@dataclass(frozen=True, eq=False)
class FigureCell:
    """A cell of fixed polygons, such as marks or the label.

    polygons: {(layer, datatype): polygons}, each (n, 2) in database units.
    """

    name: str
    polygons: Mapping[LayerNumber, tuple[Array, ...]]

    def __post_init__(self) -> None:
        names.check_cell_name(self.name)
        for shapes in self.polygons.values():
            for shape in shapes:
                if len(shape) and np.abs(np.asarray(shape, np.int64)).max() > FARTHEST:
                    raise ProcessError(
                        f"figure {self.name} reaches beyond 32 bits; take a smaller die"
                    )


@dataclass(frozen=True, eq=False)
class MaskPlan:
    """Everything that goes into a mask file.

    name: of the top cell. unit_nm: database unit. grid: step of all coordinates, in
    database units. classes: pillar classes; number k of a lattice is ``classes[k -
    1]``. lattices: the lens first. layer_names: shown by viewers. doses: relative dose
    of each (layer, datatype) that is exposed. axis: of the lens in database units (off
    (0, 0) by at most half a grid step, where the lattice cannot be centred on the
    grid). standing: for a negative tone, the mask of what stays; None where the drawn
    shapes stay.
    """

    name: str
    classes: tuple[PillarClass, ...]
    lattices: tuple[PillarArray, ...]
    figures: tuple[FigureCell, ...] = ()
    unit_nm: float = 1.0
    grid: int = 1
    layer_names: Mapping[LayerNumber, str] = field(default_factory=dict)
    doses: Mapping[LayerNumber, float] = field(default_factory=dict)
    axis: tuple[float, float] = (0.0, 0.0)
    standing: "MaskPlan | None" = None

    def __post_init__(self) -> None:
        if not 0 < len(self.classes) <= MOST_CLASSES:
            raise ProcessError(
                f"{len(self.classes)} pillar classes, need 1 to {MOST_CLASSES}; take a coarser diameter_step_nm"
            )
        names.check_distinct_names(self.cell_names)

    @property
    def cell_names(self) -> list[str]:
        """Pillar classes, figures, lattices, top: in the order of the file."""
        return [
            *(pillar.name for pillar in self.classes),
            *self.placed_names,
            self.name,
        ]

    @property
    def placed_names(self) -> list[str]:
        """Cells that the top cell places: figures and lattices."""
        return [
            *(figure.name for figure in self.figures),
            *(lattice.name for lattice in self.lattices),
        ]

    @property
    def layers(self) -> set[LayerNumber]:
        """All that are drawn on."""
        used = {pillar.layer for pillar in self.classes}
        return used | {layer for figure in self.figures for layer in figure.polygons}

    def counts(self) -> Array:
        """(classes + 1,) sites of each class number in all lattices."""
        none = np.zeros(len(self.classes) + 1, np.int64)
        return sum(
            (lattice.counts(len(self.classes)) for lattice in self.lattices), none
        )

    def replace(self, **changes: object) -> "MaskPlan":
        """A copy with other values."""
        return dataclasses.replace(self, **changes)  # type: ignore[arg-type]


def pillar_classes(
    diameters: Array, *, layer: LayerNumber, grid: int, unit_nm: float, vertices: int
) -> tuple[PillarClass, ...]:
    """One class for each drawn diameter (database units, whole), thinnest first;
    equally long names.

    Args:
        diameters: drawn, rising.
        layer: number and datatype.
        grid: step of the coordinates, database units.
        unit_nm: database unit.
        vertices: of the polygons, at most.
    """
    digits = max((len(str(int(diameter))) for diameter in diameters), default=1)
    classes = []
    for diameter in diameters:
        points = polygon.pillar_polygon(int(diameter) / grid, vertices=vertices)
        classes.append(
            PillarClass(
                f"D{int(diameter):0{digits}}",
                float(diameter) * unit_nm,
                int(diameter),
                layer,
                points * grid,
            )
        )
    return tuple(classes)
