"""Write fields: the e-beam tool writes squares, and no border may cut a pillar.

Borders run midway between lattice sites, so that every pillar lies whole in one field and keeps at least half a gap
from the border. A field is then a block of rows and columns: no pillar needs a field number of its own.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from layout.process import Process, WriteField
from metalens.ground.arrays import Array
from metalens.ground.errors import ProcessError
from metalens.ground.units import nm
from metalens.lens import DiameterMap

_BLOCK_SITES = 1 << 20
_ROWS = 64


@dataclass(frozen=True, eq=False, slots=True)
class FieldPlan:
    """Fields of a lens, as blocks of lattice rows and columns.

    rows, columns: (fields + 1,) first row (column) of each field and the end of the last; a fixed raster may begin
        before the first site and end after the last.
    shape: (y, x) sites; pitch_um: lattice constant.
    mode: ``floating`` or ``shift``, see :class:`layout.process.process.WriteField`.
    used: fields that hold pillars.
    cut_before: pillars that the same raster, left where the axis of the lens is a field corner, would cut.
    clearance_um: least distance from a border to the edge of a pillar as it is drawn.
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
    """Fields for the pillars as they are drawn (bias taken off), found in blocks of rows.

    Raises:
        ProcessError: a field smaller than the pitch.
    """
    settings, pitch = process.write_field, diameters.pitch_um
    sites = int(settings.size_um / pitch + 1e-9)
    if sites < 1:
        raise ProcessError(f"a write field of {settings.size_um} um is smaller than the pitch {pitch} um; enlarge it")
    seen = _Seen.of(diameters, process)
    rows, columns = _edges(settings, seen.rows, sites), _edges(settings, seen.columns, sites)
    shape = diameters.diameter_um.shape
    used = _used(diameters.diameter_um, rows, columns)
    clearance = (pitch - seen.widest_um) / 2
    return FieldPlan(rows, columns, (shape[0], shape[1]), pitch, settings.mode, used, seen.cut, clearance)


@dataclass(eq=False, slots=True)
class _Seen:
    """rows, columns: which hold pillars; cut: pillars that a raster about the axis cuts; widest_um: as drawn."""

    rows: Array
    columns: Array
    cut: int = 0
    widest_um: float = 0.0

    @classmethod
    def of(cls, diameters: DiameterMap, process: Process) -> "_Seen":
        """In one pass over the map."""
        d, size_um = diameters.diameter_um, process.write_field.size_um
        found = cls(np.zeros(d.shape[0], bool), np.zeros(d.shape[1], bool))
        near_x, near_y = _near(diameters.x_um, size_um), _near(diameters.y_um, size_um)
        columns, widest = np.flatnonzero(near_x < np.inf), 0.0
        for first, block in _blocks(d):
            there = block > 0
            found.rows[first : first + len(block)] = there.any(1)
            found.columns |= there.any(0)
            widest = max(widest, float(block.max()))
            rows = np.flatnonzero(near_y[first : first + len(block)] < np.inf)
            upright = _drawn_um(block[:, columns], process) > 2 * near_x[columns]
            level = _drawn_um(block[rows], process) > 2 * near_y[first + rows, None]
            found.cut += int(upright.sum() + level.sum() - (upright[rows] & level[:, columns]).sum())
        found.widest_um = float(_drawn_um(np.array([widest]), process)[0])
        return found


def _blocks(d: Array) -> Iterator[tuple[int, Array]]:
    size = max(1, _BLOCK_SITES // max(1, d.shape[1]))
    for first in range(0, d.shape[0], size):
        yield first, np.asarray(d[first : first + size])


def _drawn_um(designed_um: Array, process: Process) -> Array:
    """Diameters of the written polygons; 0 where there is no pillar."""
    written = process.written_diameter_nm(designed_um / nm) * nm
    return np.where(designed_um > 0, written, 0.0)


def _used(d: Array, rows: Array, columns: Array) -> int:
    """Fields that hold pillars."""
    inside = np.clip(columns, 0, d.shape[1])
    total = 0
    for first, end in itertools.pairwise(np.clip(rows, 0, d.shape[0]).tolist()):
        held = np.zeros(d.shape[1], bool)
        for begin in range(first, end, _ROWS):
            held |= (np.asarray(d[begin : min(begin + _ROWS, end)]) > 0).any(0)
        total += sum(bool(held[a:b].any()) for a, b in itertools.pairwise(inside.tolist()))
    return total


def _edges(settings: WriteField, occupied: Array, sites: int) -> Array:
    """Field borders along one axis, from which lattice lines hold pillars."""
    held = np.flatnonzero(occupied)
    first, span = int(held[0]), int(held[-1] - held[0] + 1)
    count = -(-span // sites)
    if settings.mode == "floating":
        return np.asarray(first + np.arange(count + 1) * span // count)
    return np.asarray(first - (count * sites - span) // 2 + sites * np.arange(count + 1))


def _near(positions_um: Array, size_um: float) -> Array:
    """Distance from each lattice line to the nearest border, inf where it is beyond the pitch."""
    away = abs(positions_um - size_um * np.rint(positions_um / size_um))
    pitch = positions_um[1] - positions_um[0] if len(positions_um) > 1 else np.inf
    return np.asarray(np.where(away < pitch / 2 + 1e-9, away, np.inf))
