"""Write fields: the e-beam tool writes squares, and no border may cut a pillar."""

import itertools
from dataclasses import dataclass
from typing import Literal

import numpy as np

from layout.mask.cells import DrawnClasses, quantise_diameters
from layout.mask.plan import FigureCell, MaskPlan, row_blocks
from layout.process.process import Process, WriteField
from layout.shapes import rectilinear
from metalens.core.arrays import Array
from metalens.core.errors import ProcessError
from metalens.core.units import nm
from metalens.lens import DiameterMap


@dataclass(frozen=True, eq=False)
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

    def blocks(self) -> list[tuple[slice, slice]]:
        """(rows, columns) of the sites of each field, counted along x first."""
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
    occupied_rows, occupied_columns = (np.zeros(n, bool) for n in classes.shape)
    for first, block in row_blocks(classes.source, classes.shape):
        occupied_rows[first : first + len(block)] = block.any(1)
        occupied_columns |= block.any(0)
    rows = _edges(settings, occupied_rows, field_rows)
    columns = _edges(settings, occupied_columns, field_columns)
    clearance = (
        min(pitch, row_pitch) - float(classes.diameters_nm[-1]) * nm
    ) / 2  # below 0 where borders cut pillars
    counts = _counted(classes, rows, columns)
    return FieldPlan(
        rows, columns, classes.shape, pitch, settings.mode, counts, clearance, row_pitch
    )


def _counted(classes: DrawnClasses, rows: Array, columns: Array) -> Array:
    """(y fields, x fields) pillars in each field."""
    down, across = (
        np.clip(edges, 0, count).tolist()
        for edges, count in zip((rows, columns), classes.shape, strict=True)
    )
    counts = np.zeros((len(rows) - 1, len(columns) - 1), np.int64)
    for field_row, (first, end) in enumerate(itertools.pairwise(down)):
        per_column = np.count_nonzero(classes.source(first, end), axis=0)
        for column, (left, right) in enumerate(itertools.pairwise(across)):
            counts[field_row, column] = per_column[left:right].sum()
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

    bottom = lattice.y0 - (lattice.rows - 1) * lattice.down

    def borders(origin: int, sites: Array, last_site: int, step: int) -> list[int]:
        lines = origin + np.unique(np.clip(sites, 0, last_site)) * step - step // 2
        return [int(line) // plan.grid * plan.grid for line in lines]

    xs = borders(lattice.x0, split.columns, lattice.columns, lattice.pitch)
    ys = borders(bottom, split.rows, lattice.rows, lattice.down)
    boxes = tuple(
        rectilinear.box_corners([left, low, right, high])
        for (low, high), (left, right) in itertools.product(
            itertools.pairwise(ys), itertools.pairwise(xs)
        )
    )
    layer = process.layers.fields
    figure = FigureCell("FIELDS", {layer: boxes})
    return plan.replace(
        figures=(*plan.figures, figure),
        layer_names={**plan.layer_names, layer: "fields"},
    )
