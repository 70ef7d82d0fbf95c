"""Write fields: the e-beam tool writes squares, and no border may cut a pillar."""

import itertools
from dataclasses import dataclass
from typing import Literal

import numpy as np

from layout.mask.cells import DrawnClasses, quantise_diameters
from layout.mask.plan import BLOCK_SITES, FigureCell, MaskPlan
from layout.process.process import Process, WriteField
from metalens.core.arrays import Array
from metalens.core.errors import ProcessError
from metalens.core.units import nm
from metalens.lens import DiameterMap


@dataclass(frozen=True, eq=False, slots=True)
class FieldPlan:
    """Fields of a lens, as blocks of lattice rows and columns.

    rows, columns: (fields + 1,) first row (column) of each field and the end of the
    last; a fixed raster may begin
        before the first site and end after the last.
    shape: (y, x) sites; pitch_um: from column to column; row_um: from row to row.
    mode: ``floating`` or ``shift``, see :class:`layout.process.process.WriteField`.
    pillars: (y fields, x fields) pillars in each.
    clearance_um: least distance from a border to the edge of a pillar as it is drawn.
    """

    rows: Array
    columns: Array
    shape: tuple[int, int]
    pitch_um: float
    mode: Literal["shift", "floating"]
    pillars: Array
    clearance_um: float
    row_um: float = 0.0

    @property
    def used(self) -> int:
        """Fields that hold pillars."""
        return int(np.count_nonzero(self.pillars))

    @property
    def x_um(self) -> Array:
        """Positions of the borders along x, lens axis at 0."""
        return np.asarray((self.columns - self.shape[1] / 2) * self.pitch_um)

    @property
    def y_um(self) -> Array:
        """Positions of the borders along y."""
        return np.asarray(
            (self.rows - self.shape[0] / 2) * (self.row_um or self.pitch_um)
        )

    @property
    def size_um(self) -> tuple[float, float]:
        """(x, y) sides of the largest field."""
        return float(np.diff(self.x_um).max()), float(np.diff(self.y_um).max())

    def of(self, row: Array, column: Array) -> Array:
        """Field of sites, counted along x first."""
        across = np.searchsorted(self.columns, column, side="right") - 1
        down = np.searchsorted(self.rows, row, side="right") - 1
        return np.asarray(down * (len(self.columns) - 1) + across)

    def blocks(self) -> list[tuple[slice, slice]]:
        """(rows, columns) of the sites of each field, in the order of :meth:`of`."""
        spans = [
            [
                slice(*np.clip(pair, 0, count))
                for pair in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)
            ]
            for edges, count in zip((self.rows, self.columns), self.shape, strict=True)
        ]
        return [(row, column) for row in spans[0] for column in spans[1]]


def split_write_fields(
    diameters: DiameterMap,
    process: Process,
    *,
    pillar_classes: DrawnClasses | None = None,
) -> FieldPlan:
    """Write fields for the pillars as they are drawn (bias taken off).

    Args:
        diameters: of the lens.
        process: bias, steps and write field.
        pillar_classes: the pillars of this map, quantised; None: quantised here.

    Raises:
        ProcessError: a field smaller than the pitch; as
            :func:`layout.mask.cells.quantise_diameters`.
    """
    settings, (pitch, row_pitch) = process.write_field, diameters.steps_um
    field_columns, field_rows = (
        int(settings.size_um / step + 1e-9) for step in (pitch, row_pitch)
    )
    if min(field_columns, field_rows) < 1:
        raise ProcessError(
            f"a write field of {settings.size_um} um is smaller than the pitch {pitch} um; enlarge it"
        )
    classes = (
        quantise_diameters(diameters, process)
        if pillar_classes is None
        else pillar_classes
    )
    occupied_rows = np.zeros(classes.sites.shape[0], bool)
    occupied_columns = np.zeros(classes.sites.shape[1], bool)
    for first, block in classes.sites.blocks():
        occupied_rows[first : first + len(block)] = block.any(1)
        occupied_columns |= block.any(0)
    rows = _edges(settings, occupied_rows, field_rows)
    columns = _edges(settings, occupied_columns, field_columns)
    clearance = (
        min(pitch, row_pitch) - float(classes.diameters_nm[-1]) * nm
    ) / 2  # below 0 where borders cut pillars
    counts = _counted(classes, rows, columns)
    return FieldPlan(
        rows,
        columns,
        classes.sites.shape,
        pitch,
        settings.mode,
        counts,
        clearance,
        row_pitch,
    )


def _counted(classes: DrawnClasses, rows: Array, columns: Array) -> Array:
    """(y fields, x fields) pillars in each field."""
    down = np.clip(rows, 0, classes.sites.shape[0]).tolist()
    across = np.clip(columns, 0, classes.sites.shape[1]).tolist()
    step = max(1, BLOCK_SITES // max(1, classes.sites.shape[1]))
    counts = np.zeros((len(rows) - 1, len(columns) - 1), np.int64)
    for field_row, (first, end) in enumerate(itertools.pairwise(down)):
        column_counts = np.zeros(classes.sites.shape[1], np.int64)
        for begin in range(first, end, step):
            column_counts += np.count_nonzero(
                classes.sites.source(begin, min(begin + step, end)), axis=0
            )
        counts[field_row] = [
            column_counts[left:right].sum()
            for left, right in itertools.pairwise(across)
        ]
    return counts


def _edges(settings: WriteField, occupied: Array, sites: int) -> Array:
    """Field borders along one axis, as numbers of lattice lines.

    ``floating``: equal parts of the occupied span. Else fields of ``sites`` lines, the
    raster centred on the span.

    Args:
        settings: mode of the write fields.
        occupied: (lines,) which lattice lines hold pillars.
        sites: most lines of a field.
    """
    lines = np.flatnonzero(occupied)
    first = int(lines[0])
    span = int(lines[-1] - lines[0] + 1)
    count = -(-span // sites)
    if settings.mode == "floating":
        return np.asarray(first + np.arange(count + 1) * span // count)
    return np.asarray(
        first - (count * sites - span) // 2 + sites * np.arange(count + 1)
    )


def with_fields(plan: MaskPlan, split: FieldPlan, process: Process) -> MaskPlan:
    """The plan with one rectangle for each write field, clipped to the lens.

    Args:
        plan: with the lens as its first lattice.
        split: write fields of the lens.
        process: layers.
    """
    lattice = plan.lattices[0]

    def borders(sites: Array, last_site: int, step: int) -> list[int]:
        return [
            int(site) * step - step // 2
            for site in np.unique(np.clip(sites, 0, last_site))
        ]

    xs = [
        lattice.x0 + border
        for border in borders(split.columns, lattice.columns, lattice.pitch)
    ]
    first_row = lattice.y0 - (lattice.rows - 1) * lattice.down
    ys = [
        first_row + border for border in borders(split.rows, lattice.rows, lattice.down)
    ]
    boxes = tuple(
        np.array([[left, bottom], [right, bottom], [right, top], [left, top]])
        // plan.grid
        * plan.grid
        for (left, right), (bottom, top) in itertools.product(
            itertools.pairwise(xs), itertools.pairwise(ys)
        )
    )
    layer = process.layers.fields
    figure = FigureCell("FIELDS", {layer: boxes})
    return plan.replace(
        figures=(*plan.figures, figure),
        layer_names={**plan.layer_names, layer: "fields"},
    )
