"""Propagating diffraction orders of a lattice: those of the cover are refused, those of
the substrate are a loss.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from metalens.cell import materials
from metalens.cell.lattice import Lattice
from metalens.cell.record import Cell
from metalens.core.errors import CellError


@dataclass(frozen=True, slots=True)
class DiffractionOrder:
    """A propagating diffraction order (m, n) along x and y, in the substrate or in the
    cover.

    On a hexagonal lattice m and n count on its rectangle (pitch by sqrt(3) pitches),
    with m + n even.
    """

    side: Literal["substrate", "cover"]
    m: int
    n: int


def propagating_orders(
    cell: Cell,
    wavelength_um: float,
    *,
    angle_rad: float = 0.0,
    azimuth_rad: float = 0.0,
) -> tuple[DiffractionOrder, ...]:
    """All diffraction orders with |k| <= n k0, grazing ones included, the zero order
    first on each side.

    Args:
        cell: its lattice and half-spaces. wavelength_um: in vacuum.
        angle_rad: of the light outside, in vacuum: the tangential wave vector is k0
            sin(angle_rad).
        azimuth_rad: of the plane of incidence, from +x to +y.

    Raises:
        MaterialError: a wavelength outside the range of a material.
    """
    orders = []
    kx = math.sin(angle_rad) * math.cos(azimuth_rad)
    ky = math.sin(angle_rad) * math.sin(azimuth_rad)
    steps = [
        wavelength_um / period for period in cell.lattice.periods_um(cell.pitch_um)
    ]
    sides: tuple[Literal["substrate"], Literal["cover"]] = ("substrate", "cover")
    for side in sides:
        n_side = materials.index(getattr(cell, side), wavelength_um).real
        rows, columns = (
            sorted(range(-reach, reach + 1), key=abs)
            for reach in (math.ceil((n_side + 1) / step) for step in steps)
        )
        for m in rows:
            inside = [
                n
                for n in columns
                if math.hypot(kx + m * steps[0], ky + n * steps[1]) <= n_side
            ]
            orders += [
                DiffractionOrder(side, m, n)
                for n in inside
                if not (cell.lattice.centred and (m + n) % 2)
            ]
    return tuple(orders)


def no_resonance_um(cell: Cell, wavelength_um: float) -> float:
    """Pitch below which no diffraction order propagates even in the densest material of
    a cell, at normal incidence: wavelength / index, times 2 / sqrt(3) for a hexagonal
    lattice.

    The layer then guides no wave that the lattice couples to light from outside: no
    guided-mode resonance is left.

    Args:
        cell: all its materials count. wavelength_um: in vacuum.

    Raises:
        MaterialError: a wavelength outside the range of a material.
    """
    densest = max(
        materials.index(material, wavelength_um).real for material in cell.materials
    )
    return cell.lattice.least_order * wavelength_um / densest


def substrate_orders(
    cell: Cell,
    wavelength_um: float,
    *,
    angle_rad: float = 0.0,
    azimuth_rad: float = 0.0,
) -> tuple[DiffractionOrder, ...]:
    """Diffraction orders other than zero that propagate in the substrate: what they
    carry is lost.

    Args:
        cell, wavelength_um, angle_rad, azimuth_rad: as for :func:`propagating_orders`.
    """
    orders = propagating_orders(
        cell, wavelength_um, angle_rad=angle_rad, azimuth_rad=azimuth_rad
    )
    return tuple(
        order for order in orders if order.side == "substrate" and (order.m or order.n)
    )


def named_orders(orders: Sequence[DiffractionOrder]) -> str:
    """``orders`` in words, at most eight of them: "(1, 0), (0, -1) and 3 more"."""
    named = ", ".join(f"({order.m}, {order.n})" for order in orders[:8])
    return named + (f" and {len(orders) - 8} more" if len(orders) > 8 else "")


def describe_order_loss(cell: Cell, wavelength_um: float) -> str:
    """Which orders of the substrate take light at normal incidence, in a line; empty
    where none propagates.

    Args:
        cell, wavelength_um: as for :func:`propagating_orders`.
    """
    orders = substrate_orders(cell, wavelength_um)
    if not orders:
        return ""
    return (
        f"\n  diffraction orders {named_orders(orders)} propagate in the substrate and "
        "take light: a loss that |T| of the pillars includes"
    )


def check_subwavelength(
    cell: Cell,
    wavelength_um: float,
    *,
    angle_rad: float = 0.0,
    azimuth_rad: float = 0.0,
) -> None:
    """Refuse a cell that transmits orders other than zero into the cover, which would
    reach the sensor.

    Orders of the substrate alone are a loss: :func:`substrate_orders` lists them, the
    solvers' ``energy`` includes them.

    Args:
        cell, wavelength_um, angle_rad, azimuth_rad: as for :func:`propagating_orders`.

    Raises:
        CellError: names the orders, and the pitch below which none propagates.
        MaterialError: a wavelength outside the range of a material.
    """
    orders = propagating_orders(
        cell, wavelength_um, angle_rad=angle_rad, azimuth_rad=azimuth_rad
    )
    stray = [
        order for order in orders if order.side == "cover" and (order.m or order.n)
    ]
    if not stray:
        return
    n_cover = materials.index(cell.cover, wavelength_um).real
    limit = _limit_um(
        cell.lattice,
        wavelength_um / n_cover,
        min(abs(math.sin(angle_rad)) / n_cover, 1.0),
        azimuth_rad,
    )
    raise CellError(
        f"pitch {cell.pitch_um:.6g} um at {wavelength_um:.6g} um: diffraction orders "
        f"{named_orders(stray)} propagate in the cover; "
        f"need pitch_um < {limit:.6g}, or a longer wavelength"
    )


def _limit_um(
    lattice: Lattice, wavelength_um: float, sine: float, azimuth_rad: float
) -> float:
    """Pitch (um) below which only the zero order propagates in a medium.

    A shortest reciprocal vector (2π/pitch) g u meets the circle |k| of the medium at
    pitch = wavelength g / (|c| + sqrt(1 - s²)), with c and s the sine's parts along u
    and across.

    Args:
        lattice: with its shortest reciprocal vectors.
        wavelength_um: in the medium. sine: of the angle in the medium.
        azimuth_rad: of the plane of incidence.
    """
    if lattice.centred:
        shortest = [(lattice.least_order, math.pi * (2 * m + 1) / 6) for m in range(3)]
    else:
        shortest = [(1.0, 0.0), (1 / lattice.ratio, math.pi / 2)]
    relative = [(length, azimuth_rad - turn) for length, turn in shortest]
    return min(
        wavelength_um
        * length
        / (abs(sine * math.cos(angle)) + math.sqrt(1 - (sine * math.sin(angle)) ** 2))
        for length, angle in relative
    )
