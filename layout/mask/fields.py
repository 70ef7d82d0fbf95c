"""Write fields: the e-beam tool writes squares, and no border may cut a pillar.

Borders run midway between lattice sites, so that every pillar lies whole in one field and keeps at least half a gap
from the border. A field is then a block of rows and columns: no pillar needs a field number of its own.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from layout.process import Process, WriteField
from metalens.ground.arrays import Array
from metalens.ground.errors import ProcessError
from metalens.lens import DiameterMap


@dataclass(frozen=True, eq=False, slots=True)
class FieldPlan:
    """Fields of a lens, as blocks of lattice rows and columns.

    rows, columns: (fields + 1,) first row (column) of each field and the end of the last; a fixed raster may begin
        before the first site and end after the last.
    shape: (y, x) sites; pitch_um: lattice constant.
    mode: ``floating`` or ``shift``, see :class:`layout.process.process.WriteField`.
    used: fields that hold pillars.
    cut_before: pillars that the same raster, left where the axis of the lens is a field corner, would cut.
    clearance_um: least distance from a border to the edge of a pillar.
    """

    rows: Array
    columns: Array
    shape: tuple[int, int]
    pitch_um: float
    mode: Literal["shift", "floating"]
    used: int
    cut_before: int
    clearance_um: float

    @property
    def x_um(self) -> Array:
        """Positions of the borders along x, lens axis at 0."""
        return np.asarray((self.columns - self.shape[1] / 2) * self.pitch_um)

    @property
    def y_um(self) -> Array:
        """Positions of the borders along y."""
        return np.asarray((self.rows - self.shape[0] / 2) * self.pitch_um)

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
            [slice(*np.clip(pair, 0, count)) for pair in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)]
            for edges, count in zip((self.rows, self.columns), self.shape, strict=True)
        ]
        return [(row, column) for row in spans[0] for column in spans[1]]


def split(diameters: DiameterMap, process: Process) -> FieldPlan:
    """Fields for the drawn pillars.

    Raises:
        ProcessError: a field smaller than the pitch.
    """
    settings, d, pitch = process.write_field, diameters.diameter_um, diameters.pitch_um
    sites = int(settings.size_um / pitch + 1e-9)
    if sites < 1:
        raise ProcessError(f"a write field of {settings.size_um} um is smaller than the pitch {pitch} um; enlarge it")
    rows = _edges(settings, np.asarray(d.any(axis=1)), sites)
    columns = _edges(settings, np.asarray(d.any(axis=0)), sites)
    plan = FieldPlan(rows, columns, (d.shape[0], d.shape[1]), pitch, settings.mode, 0, 0, 0.0)
    used = sum(bool(d[block].any()) for block in plan.blocks())
    cut = _cut(diameters, settings.size_um)
    clearance = (pitch - float(d.max())) / 2
    return FieldPlan(rows, columns, plan.shape, pitch, settings.mode, used, cut, clearance)


def _edges(settings: WriteField, occupied: Array, sites: int) -> Array:
    """Field borders along one axis, from which lattice lines hold pillars."""
    held = np.flatnonzero(occupied)
    first, span = int(held[0]), int(held[-1] - held[0] + 1)
    count = -(-span // sites)
    if settings.mode == "floating":
        return np.asarray(first + np.arange(count + 1) * span // count)
    return np.asarray(first - (count * sites - span) // 2 + sites * np.arange(count + 1))


def _cut(diameters: DiameterMap, size_um: float) -> int:
    """Pillars that borders at multiples of ``size_um`` from the axis go through."""
    d = diameters.diameter_um
    through_x, through_y = _near(diameters.x_um, size_um), _near(diameters.y_um, size_um)
    columns, rows = np.flatnonzero(through_x < np.inf), np.flatnonzero(through_y < np.inf)
    by_x = d[:, columns] > 2 * through_x[columns]
    by_y = d[rows] > 2 * through_y[rows, None]
    both = (d[np.ix_(rows, columns)] > 2 * through_x[columns]) & (d[np.ix_(rows, columns)] > 2 * through_y[rows, None])
    return int(by_x.sum() + by_y.sum() - both.sum())


def _near(positions_um: Array, size_um: float) -> Array:
    """Distance from each lattice line to the nearest border, inf where it is beyond the pitch."""
    away = abs(positions_um - size_um * np.rint(positions_um / size_um))
    pitch = positions_um[1] - positions_um[0] if len(positions_um) > 1 else np.inf
    return np.asarray(np.where(away < pitch / 2 + 1e-9, away, np.inf))
