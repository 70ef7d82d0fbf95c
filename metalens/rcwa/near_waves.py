"""Orders of the field at any height of a stack of slabs, and their sums on points; see
:mod:`metalens.rcwa.near`.
"""

import math
from dataclasses import dataclass

import numpy as np

from metalens.cell import Incidence
from metalens.core.arrays import Array
from metalens.rcwa import layer as modes
from metalens.rcwa import made, pattern
from metalens.rcwa.conditions import incidence_of
from metalens.rcwa.orders import mirrors
from metalens.rcwa.orders.waves import PlaneWaves, half_space, normal_component
from metalens.rcwa.problem import CellProblem, waves_of
from metalens.rcwa.stack import TangentialFields, match_layers, outgoing_amplitudes


@dataclass(frozen=True, slots=True)
class FieldSlab:
    """A film (an index alone) or a section; height times k0."""

    index: complex
    section: pattern.PillarSection | None
    height: float


@dataclass(frozen=True, eq=False, slots=True)
class SolvedClass:
    """One symmetry class: its waves, the modes of every slab, 1/eps for Ez, incident
    amplitudes (n,), the fields.
    """

    space: mirrors.ReducedOrders
    ways: PlaneWaves
    layers: list[modes.FourierModes]
    inverse_z: list[Array]
    incident: Array
    found: TangentialFields


@dataclass(frozen=True, eq=False, slots=True)
class OrderAmplitudes:
    """Amplitudes (nz, k) of the orders of every component at every height, h times the
    impedance of vacuum.
    """

    ex: Array
    ey: Array
    ez: Array
    hx: Array
    hy: Array
    hz: Array
    dx: Array
    dy: Array


def slabs_of(this: CellProblem, steps: int) -> list[FieldSlab]:
    """Films under the pillar, sections from the foot up, films over it; a tilted wall
    in equal steps.
    """
    k0, cell = 2 * math.pi / this.light.wavelength_um, this.cell
    found = [FieldSlab(index, None, thickness) for index, thickness in this.media.under]
    for part, grow in made.sections_with_growth(cell):
        for i in range(steps):
            lift = ((i + 0.5) / steps - 0.5) * part.height_um * made.width_slope(cell)
            section = pattern.pillar_section(
                cell, part, this.size_um, this.light.wavelength_um, grow_um=grow + lift
            )
            found.append(FieldSlab(0j, section, k0 * part.height_um / steps))
    return found + [
        FieldSlab(index, None, thickness) for index, thickness in this.media.over
    ]


def interface_heights(this: CellProblem, slabs: list[FieldSlab]) -> Array:
    """Interfaces along z times k0, 0 at the foot of the pillar."""
    heights = [slab.height for slab in slabs]
    return np.concatenate([[0.0], np.cumsum(heights)]) - sum(
        heights[: len(this.media.under)]
    )


def slab_indices(this: CellProblem, slabs: list[FieldSlab], z_um: Array) -> Array:
    """(nz,) 0 for the substrate, then the slabs, last the cover."""
    ends, heights = (
        interface_heights(this, slabs),
        2 * math.pi / this.light.wavelength_um * z_um,
    )
    return np.asarray(
        np.searchsorted(ends, heights + _ON * (ends[-1] - ends[0]), side="right")
    )


_ON = 1e-12  # of the height: a point so little below an interface lies on it


def solve_class(
    this: CellProblem,
    slabs: list[FieldSlab],
    light: Incidence,
    space: mirrors.ReducedOrders,
) -> SolvedClass | None:
    """The waves, modes and fields of one symmetry class; None where the light has no
    part in it.
    """
    ways, columns = waves_of(space, this.cell, this.light)
    incident = np.zeros(len(ways.kappa), complex)
    for column, (place, sign) in columns.items():
        incident[place] = sign * incident_amplitudes(light)[column]
    if not incident.any():
        return None
    symmetric = this.cell.outline(this.size_um).keeps(-1, -1)
    layers, inverse_z = [], []
    for slab in slabs:
        if slab.section is None:
            P, Q = film_operators(ways, slab.index)
            z = np.eye(len(space.ez.m)) / slab.index**2
        else:
            P, Q = pattern.section_operators(space, ways, slab.section, this.cell)
            z = np.linalg.inv(
                mirrors.toeplitz_product(
                    space,
                    pattern.permittivity_coefficients(
                        slab.section, this.cell, space.reach
                    )[0],
                    2,
                )
            )
        layers.append(modes.solve_eigenmodes(P, Q, symmetric=symmetric))
        inverse_z.append(z)
    below, above = (
        half_space(ways, this.media.substrate),
        half_space(ways, this.media.cover),
    )
    found = match_layers(
        layers,
        tuple(slab.height for slab in slabs),
        above,
        below,
        2 * below[0] * below[1] * incident,
    )
    return SolvedClass(space, ways, layers, inverse_z, incident, found)


def incident_amplitudes(light: Incidence) -> tuple[float, float]:
    """Amplitudes of the incident wave along x and y at normal incidence, of s and p
    else.
    """
    c, s = math.cos(light.azimuth_rad), math.sin(light.azimuth_rad)
    if light.angle_rad == 0:
        return {"x": (1.0, 0.0), "y": (0.0, 1.0), "p": (c, s), "s": (-s, c)}[
            light.polarization
        ]
    wave = incidence_of(light)[-1]
    if light.polarization in ("s", "p"):
        return (1.0, 0.0) if wave == "s" else (0.0, 1.0)
    across, along = (
        (-s, c) if light.polarization == "x" else (c, s)
    )  # of the unit vectors of s and p
    return (
        (math.copysign(1.0, across), 0.0)
        if wave == "s"
        else (0.0, math.copysign(1.0, along))
    )


def film_operators(ways: PlaneWaves, index: complex) -> tuple[Array, Array]:
    """P and Q of a film."""
    is_p, square = np.arange(len(ways.kappa)) < ways.p_count, ways.kappa**2
    eps = index**2 if complex(index).imag else complex(index).real ** 2
    return np.diag(np.where(is_p, 1 - square / eps, 1.0)), np.diag(
        np.where(is_p, eps, eps - square)
    )


def orders_at(
    this: CellProblem, slabs: list[FieldSlab], one: SolvedClass, z_um: Array
) -> OrderAmplitudes:
    """Every component at every height, by (1) of :mod:`metalens.rcwa.near`."""
    ways, space = one.ways, one.space
    u, w = _heights(this, slabs, one, z_um)
    ez, d = np.zeros((len(z_um), len(space.ez.m)), complex), np.zeros_like(u)
    p = slice(ways.bare, ways.p_count)
    turning = np.where(
        np.arange(len(ways.kappa)) >= ways.p_count, ways.kappa**2, 0.0
    )  # R R^T: of s waves alone
    for i, place in enumerate(slab_indices(this, slabs, z_um)):
        along = ways.kappa[p] * w[i, p]
        if 0 < place <= len(slabs):
            ez[i] = -one.inverse_z[place - 1] @ along
            d[i] = one.layers[place - 1].Q @ u[i] + turning * u[i]
        else:
            ez[i] = -along / (this.media.cover if place else this.media.substrate) ** 2
    hz = (ways.kappa * u)[:, len(ways.kappa) - len(space.hz.m) :]
    x = slice(len(space.ex.m))
    y = slice(len(space.ex.m), None)
    e, h, d = (values @ ways.fold.T for values in (u, w, d))
    return OrderAmplitudes(
        e[:, x], e[:, y], ez, -h[:, y], h[:, x], hz, d[:, x], d[:, y]
    )


def _heights(
    this: CellProblem, slabs: list[FieldSlab], one: SolvedClass, z_um: Array
) -> tuple[Array, Array]:
    """(nz, n) amplitudes u and w of the waves at every height."""
    ends, heights = (
        interface_heights(this, slabs),
        2 * math.pi / this.light.wavelength_um * z_um,
    )
    u, w = (np.zeros((len(z_um), len(one.incident)), complex) for _ in range(2))
    for i, (place, z) in enumerate(
        zip(slab_indices(this, slabs, z_um), heights, strict=True)
    ):
        if 0 < place <= len(slabs):
            part = one.layers[place - 1]
            up = (
                np.exp(1j * part.q * max(z - ends[place - 1], 0.0))
                * one.found.up[place - 1]
            )
            down = np.exp(1j * part.q * (ends[place] - z)) * one.found.down[place - 1]
            u[i], w[i] = part.W @ (up + down), part.V @ (up - down)
        else:
            u[i], w[i] = _outside(
                this, one, z - (ends[-1] if place else ends[0]), above=bool(place)
            )
    return u, w


def _outside(
    this: CellProblem, one: SolvedClass, z: float, *, above: bool
) -> tuple[Array, Array]:
    """u and w in a half-space, z times k0 from the slabs."""
    index = this.media.cover if above else this.media.substrate
    U, V = half_space(one.ways, index)
    kz = normal_component(one.ways.kappa, index)
    if above:
        up = outgoing_amplitudes((U, V), one.found.u_top, one.found.w_top) * np.exp(
            1j * kz * max(z, 0.0)
        )
        return U * up, V * up
    comes = np.flatnonzero(one.incident)
    up = one.incident.copy()
    up[comes] *= np.exp(1j * kz[comes] * z)
    back = outgoing_amplitudes(
        (U, V), one.found.u - U * one.incident, V * one.incident - one.found.w
    )
    down = back * np.exp(-1j * kz * z)
    return U * (up + down), V * (up - down)


class PointSums:
    """Sums of orders on points x (nx,) and y (ny,): amplitudes (nz, k), unfolded by the
    symmetries, to (nz, ny, nx).
    """

    def __init__(
        self,
        this: CellProblem,
        operations: tuple[mirrors.Operation, ...],
        reach: tuple[int, int],
        axes_um: tuple[Array, Array],
    ) -> None:
        k0, periods = (
            2 * math.pi / this.light.wavelength_um,
            this.cell.lattice.periods_um(this.cell.pitch_um),
        )
        self.operations, self.reach = operations, reach
        self.along, self.across = (
            np.exp(
                1j
                * (k0 * k + 2 * np.pi / period * np.arange(-r, r + 1))
                * axis[:, None]
            )
            for k, period, r, axis in zip(
                (this.light.kx, this.light.ky), periods, reach, axes_um, strict=True
            )
        )

    def __call__(self, part: mirrors.OrderSet, amplitude: Array) -> Array:
        mx, my = self.reach
        table = np.zeros((len(amplitude), 2 * my + 1, 2 * mx + 1), complex)
        for (sx, sy, _), sign in zip(self.operations, part.signs, strict=True):
            table[:, sy * part.n + my, sx * part.m + mx] = (
                sign * amplitude / np.sqrt(part.size)
            )
        return np.asarray(self.across @ table @ self.along.T)
