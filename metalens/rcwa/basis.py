"""Fourier basis of RCWA: orders of any lattice, reduced by the symmetries that shape,
lattice and light share, and the plane waves of these orders.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from metalens.cell import Cell, Lattice, check_direction
from metalens.core.arrays import Array

Sign = tuple[int, int, int, int]  # of Ex, Ey, Ez, Hz
Operation = tuple[int, int, Sign]  # (x, y) -> (sx x, sy y)
ROUNDING = 1e-13  # relative: a difference this small is 0 but for rounding


def symmetry_operation(sx: int, sy: int, ex: int = 1) -> Operation:
    """The map (x, y) -> (``sx`` x, ``sy`` y), under which Ex has the sign ``ex``.

    A mirror keeps E along it and reverses it across: Ey has sx sy times that sign, Ez
    sx times, and Hz, as curl E, sy times.
    """
    return sx, sy, (ex, ex * sx * sy, ex * sx, ex * sy)


@dataclass(frozen=True, slots=True)
class TangentialWave:
    """Tangential wave vector over k0, azimuth (0 at normal incidence), wavelength."""

    kx: float
    ky: float
    azimuth_rad: float
    wavelength_um: float

    @property
    def normal(self) -> bool:
        """Whether the light comes along z."""
        return self.kx == 0 == self.ky


def tangential_wave(
    wavelength_um: float, angle_rad: float, azimuth_rad: float
) -> TangentialWave:
    """Tangential wave vector of a plane wave, k0 sin(angle) along its azimuth.

    Args:
        wavelength_um: in vacuum.
        angle_rad: of incidence, in vacuum. azimuth_rad: of the plane of incidence,
            from +x to +y.

    Raises:
        CellError: no direction of light.
    """
    check_direction(angle_rad, azimuth_rad)
    sine = math.sin(angle_rad)
    kx, ky = (
        0.0 if abs(part) < ROUNDING else part
        for part in (sine * math.cos(azimuth_rad), sine * math.sin(azimuth_rad))
    )
    return TangentialWave(kx, ky, azimuth_rad if kx or ky else 0.0, wavelength_um)


@dataclass(frozen=True, eq=False, slots=True)
class OrderSet:
    """Amplitudes of one scalar field: (k,) orders m, n, one of each orbit; sizes of the
    orbits; sign of each operation.
    """

    m: Array
    n: Array
    size: Array
    signs: tuple[int, ...]

    @property
    def has_zero(self) -> bool:
        """Whether the zero order is one of them."""
        return bool(((self.m == 0) & (self.n == 0)).any())


@dataclass(frozen=True, eq=False, slots=True)
class ReducedOrders:
    """The reduced sets of one truncation.

    reach: largest orders (m, n); coefficients are tabled from -2 reach to 2 reach.
    links: for products in ``ex``, ``ey``, ``ez`` and from Ey to Ex (``mixed``): (k, l,
        operations) places in a table of coefficients, and their weights.
    """

    ex: OrderSet
    ey: OrderSet
    ez: OrderSet
    hz: OrderSet
    reach: tuple[int, int]
    links: Mapping[str, tuple[Array, Array]]


@lru_cache(maxsize=24)
def reduced_orders(
    harmonics: float, lattice: Lattice, operations: tuple[Operation, ...]
) -> ReducedOrders:
    """Circular truncation: all orders within ``harmonics`` orders of a square lattice
    of the cell's area, one for each orbit of the symmetry operations.

    Args:
        harmonics: radius, in orders of that square lattice.
        lattice: of the pillars. operations: symmetries of the fields.

    The rectangle of a hexagonal lattice holds two sites: orders with m + n even.
    """
    along, across = lattice.periods_um(1.0)
    radius = harmonics / np.sqrt(lattice.area_um2(1.0))
    radius_rounded_up = radius * (1 + 1e-9)
    reach = int(radius_rounded_up * along), int(radius_rounded_up * across)
    spans = (np.arange(-r, r + 1) for r in reach)
    m, n = (a.ravel() for a in np.meshgrid(*spans, indexing="ij"))
    inside = (m / along) ** 2 + (n / across) ** 2 <= radius**2 * (1 + 1e-9)
    if lattice.centred:
        inside &= (m + n) % 2 == 0
    m, n = m[inside], n[inside]
    ex, ey, ez, hz = (_reduced(m, n, operations, field) for field in range(4))
    pairs = {"ex": (ex, ex), "ey": (ey, ey), "ez": (ez, ez), "mixed": (ex, ey)}
    links = {
        name: _link(rows, columns, operations, reach)
        for name, (rows, columns) in pairs.items()
    }
    return ReducedOrders(ex, ey, ez, hz, reach, links)


def count_orders(harmonics: int) -> int:
    """Number of orders of a square lattice within a circle of radius ``harmonics``."""
    m = np.arange(-harmonics, harmonics + 1)
    return int(np.count_nonzero(np.hypot(m[:, None], m) <= harmonics))


def _reduced(
    m: Array, n: Array, operations: tuple[Operation, ...], field: int
) -> OrderSet:
    """One order of each orbit under the symmetry operations.

    Orders vanish, and are left out, if an operation maps them to themselves with the
    field reversed.

    Args:
        m, n: (k,) all orders.
        operations: symmetries.
        field: 0 to 3 for Ex, Ey, Ez, Hz.
    """
    images = np.stack([(sx * m) * 4096 + sy * n for sx, sy, _ in operations])
    codes = images[0]
    signs = tuple(sign[field] for _, _, sign in operations)
    first = codes == images.max(axis=0)
    vanishes = ((images == codes) & (np.array(signs)[:, None] < 0)).any(axis=0)
    retained = first & ~vanishes
    size = np.array([len(set(column)) for column in images[:, retained].T], int)
    return OrderSet(m[retained], n[retained], size, signs)


def _link(
    rows: OrderSet,
    columns: OrderSet,
    operations: tuple[Operation, ...],
    reach: tuple[int, int],
) -> tuple[Array, Array]:
    """Coupling of two order sets by a function with all symmetries.

    Returns:
        (k, l, operations) places in the flat table of its Fourier coefficients, and
        their weights.
    """
    dm, dn = (
        np.stack([row[:, None] - s * column for s in flips], axis=-1)
        for row, column, flips in (
            (rows.m, columns.m, [sx for sx, _, _ in operations]),
            (rows.n, columns.n, [sy for _, sy, _ in operations]),
        )
    )
    share = np.sqrt(rows.size[:, None] * columns.size) / len(operations)
    place = (dm + 2 * reach[0]) * (4 * reach[1] + 1) + dn + 2 * reach[1]
    return place, share[..., None] * np.array(columns.signs, float)


def toeplitz_matrix(space: ReducedOrders, table: Array, link: str) -> Array:
    """Toeplitz matrix (k, l) of the product with a function, reduced by symmetry.

    Args:
        space: the orders. link: ``ex``, ``ey``, ``ez`` or ``mixed``.
        table: (4 reach_x + 1, 4 reach_y + 1) Fourier coefficients of the function.
    """
    place, weight = space.links[link]
    return np.asarray(np.einsum("ijg,ijg->ij", table.ravel()[place], weight))


@dataclass(frozen=True, eq=False, slots=True)
class PlaneWaves:
    """Waves of a basis at one wavelength and direction: all p waves, then all s waves.

    m, n: (n,) orders; kappa: (n,) |k| / k0; along: (2, n) direction of k.
    p_count: number of p waves. bare: number of leading p waves without Ez (the zero
        order at normal incidence).
    fold: (ex + ey, n) orthogonal matrix from the waves to Ex and Ey.
    zero: for each polarisation of the basis (0: x or s, 1: y or p) that the class
        holds, the place of its zero order and its sign there.
    """

    m: Array
    n: Array
    kappa: Array
    along: Array
    p_count: int
    bare: int
    fold: Array
    zero: dict[int, tuple[int, float]]

    @property
    def is_p(self) -> Array:
        """(n,) whether a wave is p."""
        return np.arange(len(self.kappa)) < self.p_count


def plane_waves(space: ReducedOrders, cell: Cell, light: TangentialWave) -> PlaneWaves:
    """p and s waves of the reduced orders, around the zero order.

    k = k_tangential + (m λ / px, n λ / py) over k0. A p wave has its electric field
    along k, an s wave across it. ``fold`` maps their amplitudes to Ex and Ey.

    Args:
        space: reduced orders. cell: its lattice gives the steps of k.
        light: tangential wave vector of the zero order.

    At normal incidence the zero order has no Ez or Hz of its own: it is put in front
    where its set lacks it.
    """
    ex, ey, ez, hz = (s.has_zero for s in (space.ex, space.ey, space.ez, space.hz))
    along_y = 0
    if light.normal:
        x_fits = not (ez and not ex) and not (hz and not ey)
        along_y = int(not x_fits or not (ez or hz or ex))
    p_in, s_in = (ey, ex) if along_y else (ex, ey)
    bare_p = int(light.normal and p_in and not ez)
    bare_s = int(light.normal and s_in and not hz)
    zeros = np.zeros(1, int)
    m, n = (
        np.concatenate([zeros[:bare_p], p, zeros[:bare_s], s])
        for p, s in ((space.ez.m, space.hz.m), (space.ez.n, space.hz.n))
    )
    p_count = bare_p + len(space.ez.m)
    px, py = cell.lattice.periods_um(cell.pitch_um)
    wavelength = light.wavelength_um
    k = np.stack([light.kx + wavelength / px * m, light.ky + wavelength / py * n])
    kappa = np.hypot(*k)
    zero_azimuth = light.azimuth_rad + along_y * math.pi / 2
    zero_direction = np.array(
        [round(math.cos(zero_azimuth), 15), round(math.sin(zero_azimuth), 15)]
    )[:, None]
    along = np.where(kappa > 0, k / np.where(kappa > 0, kappa, 1.0), zero_direction)
    is_p = np.arange(len(m)) < p_count
    e = np.where(is_p, along, np.stack([-along[1], along[0]]))

    def selects(rows: OrderSet) -> Array:
        return np.asarray((rows.m[:, None] == m) & (rows.n[:, None] == n), float)

    fold = np.concatenate([selects(space.ex) * e[0], selects(space.ey) * e[1]])
    zero: dict[int, tuple[int, float]] = {}
    for place in np.flatnonzero((m == 0) & (n == 0)).tolist():
        if light.normal:
            column = int(abs(e[1, place]) > 0.5)
            zero[column] = (place, float(np.sign(e[column, place])))
        else:
            zero[int(place < p_count)] = (place, 1.0)
    return PlaneWaves(m, n, kappa, along, p_count, bare_p, fold, zero)


def normal_component(kappa: Array, index: complex) -> Array:
    """kz / k0 = sqrt(n^2 - kappa^2) of outgoing or decaying waves, Im(kz) >= 0.

    Args:
        kappa: (n,) |k| / k0. index: refractive index n of the medium.
    """
    square = (index - kappa) * (index + kappa)
    kz = np.sqrt(square.astype(complex))
    return np.asarray(np.where(kz.imag < 0, -kz, kz))


def half_space(waves: PlaneWaves, index: complex) -> tuple[Array, Array]:
    """(u, w) of outgoing waves of unit electric amplitude; incoming waves have (u, -w).

    Args:
        waves: p and s waves. index: refractive index of the half-space.
    """
    kz = normal_component(waves.kappa, index)
    return np.where(waves.is_p, kz / index, 1.0), np.where(waves.is_p, index, kz)
