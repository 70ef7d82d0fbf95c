"""One symmetry class of one truncation: t and r, and the fields of the light and of the
waves sent back.
"""

import functools
from dataclasses import dataclass

import numpy as np

from metalens.core.arrays import Array
from metalens.rcwa import layer as modes
from metalens.rcwa import made, pattern
from metalens.rcwa.layer import film_layer
from metalens.rcwa.orders import mirrors
from metalens.rcwa.orders.mirrors import Operation, ReducedOrders
from metalens.rcwa.orders.waves import PlaneWaves, half_space
from metalens.rcwa.problem import CellProblem, waves_of
from metalens.rcwa.rates.regions import (
    LayerRegion,
    RegionFields,
    match_regions,
    of_modes,
    of_wall,
)
from metalens.rcwa.stack import outgoing_amplitudes, power_flux


@dataclass(frozen=True, eq=False, slots=True)
class AdjointClass:
    """One symmetry class.

    columns: the k polarisations that its zero orders are. regions, light, sent: what
    lies between the half-spaces,
    fields of the k waves that come, and of 2 k waves sent back, from above (for t) and
    from below (for r).
    both: (2, k, k) t and r; energy, scale: (k,) power of all orders, and what makes
    light of unit power of ``light``.
    """

    space: ReducedOrders
    ways: PlaneWaves
    operations: tuple[Operation, ...]
    columns: list[int]
    regions: list[LayerRegion]
    light: list[RegionFields]
    sent: list[RegionFields]
    both: Array
    energy: Array
    scale: Array

    @property
    def uprights(self) -> slice:
        """The waves that have an Ez."""
        return slice(self.ways.bare, self.ways.p_count)


def solve_adjoint_class(
    this: CellProblem, operations: tuple[Operation, ...], reach: int, stages: int
) -> AdjointClass:
    """At one truncation; stages: of the collocation of a tilted wall, 0 for an upright
    one.
    """
    space = mirrors.reduced_orders(reach, pattern.lattice_frame(this.cell, operations))
    ways, places = waves_of(space, this.cell, this.light)
    regions = _regions(this, space, ways, stages)
    below, above = (
        half_space(ways, this.media.substrate),
        half_space(ways, this.media.cover),
    )
    unit = np.zeros((len(ways.kappa), len(places)))
    for k, (at, sign) in enumerate(places.values()):
        unit[at, k] = sign
    foot_share, top_share = (
        np.sqrt(power_flux(below))[:, None],
        np.sqrt(power_flux(above))[:, None],
    )
    scale = 1 / (np.abs(unit) * foot_share).sum(axis=0)
    source = 2 * (below[0] * below[1])[:, None] * unit
    light, foot, top = match_regions(
        [part.plain for part in regions], above, below, source
    )
    from_below, _, _ = match_regions(
        [part.transposed for part in regions], above, below, foot_share * unit
    )
    from_above, _, _ = match_regions(
        [part.reverse for part in regions[::-1]], below, above, top_share * unit
    )
    sent = [
        high.upside_down.beside(low)
        for high, low in zip(from_above[::-1], from_below, strict=True)
    ]
    n = len(unit)
    U, V = below[0][:, None], below[1][:, None]
    t = (
        outgoing_amplitudes((above[0][:, None], above[1][:, None]), top[:n], top[n:])
        * top_share
        * scale
    )
    r = (
        outgoing_amplitudes((U, V), foot[:n] - U * unit, V * unit - foot[n:])
        * foot_share
        * scale
    )
    energy = (np.abs(t) ** 2 + np.abs(r) ** 2).sum(axis=0)
    both = np.stack([unit.T @ t, unit.T @ r])
    return AdjointClass(
        space, ways, operations, list(places), regions, light, sent, both, energy, scale
    )


def _regions(
    this: CellProblem, space: ReducedOrders, ways: PlaneWaves, stages: int
) -> list[LayerRegion]:
    """Films and sections, foot first."""
    symmetric = this.cell.outline(this.size_um).keeps(-1, -1)
    operators = functools.partial(
        pattern.section_operators, space, ways, cell=this.cell
    )
    walls = made.section_walls(
        this.cell, this.size_um, this.light.wavelength_um, operators
    )
    if stages:
        middle = [of_wall(wall, stages, symmetric=symmetric) for wall in walls]
    else:
        parts = [
            modes.solve_eigenmodes(*wall.sample(0.5), symmetric=symmetric)
            for wall in walls
        ]
        middle = [
            of_modes(part, wall.reduced_height)
            for part, wall in zip(parts, walls, strict=True)
        ]
    under, over = (
        [
            of_modes(film_layer(ways, index, symmetric=symmetric), thickness)
            for index, thickness in films
        ]
        for films in (this.media.under, this.media.over)
    )
    return [*under, *middle, *over]
