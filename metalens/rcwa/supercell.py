"""Rows of different pillars as one supercell: the exact answer, without the locally
periodic approximation.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from metalens.cell import Cell, Lattice, materials
from metalens.cell.shapes import Outline
from metalens.cell.shapes.outline import EllipseArc
from metalens.core.arrays import Array
from metalens.core.errors import CellError
from metalens.rcwa.basis import (
    normal_component,
    plane_waves,
    reduced_orders,
    symmetry_operation,
    tangential_wave,
)
from metalens.rcwa.permittivity import PillarSection, section_modes
from metalens.rcwa.smatrix import scatter_zero_order
from metalens.rcwa.solver import half_space_indices


@dataclass(frozen=True, eq=False, slots=True)
class RowResponse:
    """Diffraction orders of a row of pillars, for normal incidence from the substrate.

    orders: (n,) diffraction orders along the row. t: (n,) transverse amplitude of each
        in the cover for unit power in, 0 where it is evanescent; the phase runs from
        foot to top, as for :class:`metalens.cell.response.Response`.
    energy: transmitted plus reflected power of all orders, 1 where nothing absorbs.
    """

    orders: Array
    t: Array
    energy: float

    def order(self, m: int) -> complex:
        """Amplitude of one order."""
        return complex(self.t[int(np.flatnonzero(self.orders == m)[0])])


@dataclass(frozen=True, slots=True)
class RowBlock:
    """Square that repeats along a row: with one pillar, or along the diagonal with two.

    width_um: of the square.
    """

    width_um: float
    pillars: int

    @property
    def spacing_um(self) -> float:
        """Distance between neighbouring pillars along the row."""
        return self.width_um / self.pillars

    def places_um(self, count: int) -> Array:
        """(count, 2) x and y of the pillars of a row about its middle."""
        position = np.arange(count)
        y_um = (
            (position % 2) * self.width_um / 2 if self.pillars > 1 else np.zeros(count)
        )
        return np.stack([(position - (count - 1) / 2) * self.spacing_um, y_um], axis=1)


def block_of(pitch_um: float, diagonal: bool) -> RowBlock:
    """The square that repeats along a row of a square lattice of ``pitch_um``, or along
    its ``diagonal``.
    """
    return RowBlock(math.sqrt(2) * pitch_um, 2) if diagonal else RowBlock(pitch_um, 1)


def solve_row(
    cell: Cell,
    diameters_um: Sequence[float] | Array,
    wavelength_um: float,
    *,
    polarization: Literal["x", "y"],
    harmonics: int = 4,
    diagonal: bool = False,
) -> RowResponse:
    """Diffraction orders of a periodic row of pillars, by RCWA of the supercell.

    Args:
        wavelength_um: vacuum wavelength, um.
        diameters_um: (n,) of the pillars along x, one pitch from each to the next.
        polarization: axis of the incident field, x along the row.
        harmonics: h; all orders within the circle that holds (2 h + 1)² orders of one
            pillar's cell.
        diagonal: whether the row follows the lattice's diagonal, with a spacing of
            pitch / √2 along it and an even number of pillars.

    Accuracy: that of RCWA at this truncation, a few 1e-2 of t for silicon; differences
        between rows at one truncation are better by an order of magnitude. Energy holds
        to rounding.

    Raises:
        CellError: films or tilted walls, no round pillars on a square lattice, no
            pillar, an odd number along the diagonal, or pillars that touch.

    >>> from metalens.cell import Cell, Index
    >>> cell = Cell(0.3, 0.6, pillar=Index(2.0), substrate=Index(1.45))
    >>> row = solve_row(cell, [0.1, 0.15, 0.2], 0.85, polarization="y", harmonics=2)
    >>> round(row.energy, 9)
    1.0
    """
    _check_row(cell, diameters_um)
    block = block_of(cell.pitch_um, diagonal)
    count = len(diameters_um)
    if count % block.pillars:
        raise CellError(
            f"row of {count} pillars along the diagonal: need an even number"
        )
    blocks = count // block.pillars
    supercell = replace(
        cell,
        pitch_um=blocks * block.width_um,
        lattice=Lattice("rectangular", 1 / blocks),
    )
    discs = [
        EllipseArc(diameter / 2, diameter / 2, centre_um=(float(x), float(y)))
        for diameter, (x, y) in zip(diameters_um, block.places_um(count), strict=True)
    ]
    inside, outside = (
        materials.index(material, wavelength_um) ** 2
        for material in (cell.pillar, cell.fill)
    )
    slab = PillarSection((Outline(tuple(discs)),), (inside,), outside)
    light = tangential_wave(wavelength_um, 0.0, 0.0)
    mirror = symmetry_operation(1, -1, 1 if polarization == "x" else -1)
    operations = (symmetry_operation(1, 1), mirror)
    radius = (2 * harmonics + 1) / math.sqrt(math.pi)
    space = reduced_orders(
        radius * math.sqrt(blocks) * block.width_um / cell.pitch_um,
        supercell.lattice,
        operations,
    )
    waves = plane_waves(space, supercell, light)
    height = 2 * math.pi / wavelength_um * cell.height_um
    modes = section_modes(space, waves, slab, supercell, height)
    substrate, cover = half_space_indices(cell, light)
    zero, sign = waves.zero["xy".index(polarization)]
    scattered = scatter_zero_order(
        waves, (substrate, cover), [modes], zero, symmetric=False
    )
    # in the plane of the row, light along x is p and light along y is s
    along_row = np.flatnonzero((waves.n == 0) & (waves.is_p == (polarization == "x")))
    along_row = along_row[np.argsort(waves.m[along_row])]
    cosine = normal_component(waves.kappa[along_row], cover.real).real / cover.real
    factor = cosine**0.5 if polarization == "x" else _inverse_root(cosine)
    direction = np.where(waves.m[along_row] == 0, sign, waves.along[0, along_row])
    return RowResponse(
        waves.m[along_row],
        sign * direction * factor * scattered.t[along_row],
        scattered.energy,
    )


def _inverse_root(cosine: Array) -> Array:
    """1 / sqrt(cosine), 0 for evanescent orders."""
    return np.power(cosine, -0.5, out=np.zeros_like(cosine), where=cosine > 0)


def _check_row(cell: Cell, diameters_um: Sequence[float] | Array) -> None:
    """Raise for cells and diameters that make no row of upright pillars."""
    if not cell.round:
        raise CellError(
            f"rows are solved for round pillars on a square lattice, not {cell.described}"
        )
    if cell.under or cell.over or cell.sidewall_rad or cell.height_um <= 0:
        raise CellError(
            "rows are solved for upright pillars without films; leave the films out"
        )
    if not len(diameters_um) or not all(0 < d < cell.pitch_um for d in diameters_um):
        raise CellError(
            f"row of {len(diameters_um)} pillars: need diameters above 0 and below "
            f"{cell.pitch_um} um"
        )
