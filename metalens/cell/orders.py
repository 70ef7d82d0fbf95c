"""Which diffraction orders of a lattice carry power, and the refusal of cells where
others than zero do.
"""

import math
from dataclasses import dataclass
from typing import Literal

from metalens.cell import materials
from metalens.cell.lattice import Lattice
from metalens.cell.record import Cell
from metalens.ground.errors import CellError


@dataclass(frozen=True, slots=True)
class Order:
    """A propagating diffraction order (m, n) along x and y, in the substrate or in the
    cover.

    On a hexagonal lattice m and n count on its rectangle (pitch by sqrt(3) pitches),
    with m + n even.
    """

    side: Literal["substrate", "cover"]
    m: int
    n: int


def propagating(
    cell: Cell,
    wavelength_um: float,
    *,
    angle_rad: float = 0.0,
    azimuth_rad: float = 0.0,
) -> tuple[Order, ...]:
    """All orders with |k| <= n k0, grazing ones included, the zero order first on each
    side.

    angle_rad: of the light outside, in vacuum: the tangential wave vector is k0
    sin(angle_rad).

    Raises:
        MaterialError: a wavelength outside the range of a material.
    """
    found = []
    kx, ky = (
        math.sin(angle_rad) * math.cos(azimuth_rad),
        math.sin(angle_rad) * math.sin(azimuth_rad),
    )
    across = [
        wavelength_um / period for period in cell.lattice.periods_um(cell.pitch_um)
    ]
    sides: tuple[Literal["substrate"], Literal["cover"]] = ("substrate", "cover")
    for side in sides:
        n_side = materials.index(getattr(cell, side), wavelength_um).real
        rows, columns = (
            sorted(range(-reach, reach + 1), key=abs)
            for reach in (math.ceil((n_side + 1) / step) for step in across)
        )
        for m in rows:
            reached = [
                n
                for n in columns
                if math.hypot(kx + m * across[0], ky + n * across[1]) <= n_side
            ]
            found += [
                Order(side, m, n)
                for n in reached
                if not (cell.lattice.centred and (m + n) % 2)
            ]
    return tuple(found)


def no_resonance_um(cell: Cell, wavelength_um: float) -> float:
    """Pitch below which no diffraction order propagates even in the densest material of
    a cell, at normal incidence.

    The layer then guides no wave that the lattice couples to light from outside, so
    that no resonance of the lattice
    (guided-mode resonances, leaky modes of films with holes) is left: wavelength /
    index, times 2 / sqrt(3) for a
    hexagonal lattice.

    Raises:
        MaterialError: a wavelength outside the range of a material.
    """
    films = [film.material for film in (*cell.under, *cell.over)]
    layered = [
        m
        for layer in cell.layers
        for m in (layer.material, layer.between, layer.coat)
        if m is not None
    ]
    every = (cell.pillar, cell.between, cell.substrate, cell.cover, *films, *layered)
    densest = max(materials.index(material, wavelength_um).real for material in every)
    return cell.lattice.least_order * wavelength_um / densest


def check_subwavelength(
    cell: Cell,
    wavelength_um: float,
    *,
    angle_rad: float = 0.0,
    azimuth_rad: float = 0.0,
) -> None:
    """Refuse a cell that sends light into other orders than zero.

    Raises:
        CellError: names the orders, and the pitch below which none propagates.
        MaterialError: a wavelength outside the range of a material.
    """
    orders = propagating(
        cell, wavelength_um, angle_rad=angle_rad, azimuth_rad=azimuth_rad
    )
    stray = [order for order in orders if order.m or order.n]
    if not stray:
        return
    n_side = max(
        materials.index(m, wavelength_um).real for m in (cell.substrate, cell.cover)
    )
    limit = _limit_um(
        cell.lattice,
        wavelength_um / n_side,
        min(abs(math.sin(angle_rad)) / n_side, 1.0),
        azimuth_rad,
    )
    named = ", ".join(
        f"({order.m}, {order.n}) in the {order.side}" for order in stray[:8]
    )
    more = f" and {len(stray) - 8} more" if len(stray) > 8 else ""
    raise CellError(
        f"pitch {cell.pitch_um:.6g} um at {wavelength_um:.6g} um: diffraction orders {named}{more} propagate; "
        f"need pitch_um < {limit:.6g}, or a longer wavelength"
    )


def _limit_um(
    lattice: Lattice, wavelength_um: float, sine: float, azimuth_rad: float
) -> float:
    """Pitch below which no other order propagates in a medium, for the wavelength and
    the sine of the angle in it.

    The shortest reciprocal vectors of each direction meet the circle of the medium
    first: of (2π/pitch) g along u,
    |k sine ± (2π/pitch) g u| = k at pitch / wavelength = g / (|c| + sqrt(1 - s²)), with c of the sine along u and s
    across.
    """
    if lattice.centred:
        short = [(lattice.least_order, math.pi * (2 * m + 1) / 6) for m in range(3)]
    else:
        short = [(1.0, 0.0), (1 / lattice.ratio, math.pi / 2)]
    off = [(g, azimuth_rad - turn) for g, turn in short]
    return min(
        wavelength_um
        * g
        / (abs(sine * math.cos(t)) + math.sqrt(1 - (sine * math.sin(t)) ** 2))
        for g, t in off
    )
