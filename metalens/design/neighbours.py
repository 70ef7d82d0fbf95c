"""A row of unlike pillars solved rigorously as one cell: what the local periodic approximation leaves out.

A lens is designed as if every pillar stood among its like. Here N different pillars in a row repeat with period N
times the pitch, so every one feels its real neighbours; light leaves in the orders of that grating, and the wanted one
is compared with what the pillars would give one by one. RCWA with normal vectors (Schuster et al. 2007), mirror
symmetric in y, both solved at the same truncation so that truncation all but cancels.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import linalg
from scipy.special import j1

from metalens.cell import Cell, materials
from metalens.ground.arrays import Array
from metalens.ground.errors import CellError
from metalens.lens import Lens

LONG = 6  # pillars: of shorter rows several are solved
GRID = 48  # points across a cell for the normal field; its coefficients are needed to twice the harmonics
Polarization = Literal["x", "y"]


@dataclass(frozen=True, eq=False, slots=True)
class Row:
    """What a row of pillars does to light at normal incidence from the substrate.

    orders: (n,) diffraction orders along the row. t: (n,) transverse amplitude of each in the cover, for unit power
    in; the phase runs from foot to top, as for :class:`metalens.cell.response.Response`.
    energy: transmitted plus reflected power, 1 where nothing absorbs.
    """

    orders: Array
    t: Array
    energy: float

    def order(self, m: int) -> complex:
        """Amplitude of one order."""
        return complex(self.t[int(np.flatnonzero(self.orders == m)[0])])


def solve_row(
    cell: Cell,
    diameters_um: Sequence[float] | Array,
    wavelength_um: float,
    *,
    polarization: Polarization,
    harmonics: int = 4,
) -> Row:
    """Orders of a row of pillars of these diameters, one pitch apart, repeated without end.

    Args:
        harmonics: orders to each side along y, and along x per pillar.

    Accuracy: that of RCWA at this truncation, a few 1e-2 of t for silicon; differences between rows at one truncation
        are better by an order of magnitude. Energy holds to rounding.

    Raises:
        CellError: films or tilted walls, no round pillars on a square lattice, no pillar, or pillars that touch.
    """
    if not cell.round:
        raise CellError(f"rows are solved for round pillars on a square lattice, not {cell.described}")
    if cell.under or cell.over or cell.sidewall_rad or cell.height_um <= 0:
        raise CellError("rows are solved for upright pillars without films; leave the films out")
    if not len(diameters_um) or not all(0 < d < cell.pitch_um for d in diameters_um):
        raise CellError(f"row of {len(diameters_um)} pillars: need diameters above 0 and below {cell.pitch_um} um")
    count = len(diameters_um)
    m, n = (
        a.ravel()
        for a in np.meshgrid(
            np.arange(-harmonics * count, harmonics * count + 1), np.arange(-harmonics, harmonics + 1), indexing="ij"
        )
    )
    kx, ky = m * wavelength_um / (count * cell.pitch_um), n * wavelength_um / cell.pitch_um
    p, q = _layer(cell, diameters_um, wavelength_um, (m, n, kx, ky))
    electric, magnetic = _mirror(n, polarization)
    p, q = electric.T @ p @ magnetic, magnetic.T @ q @ electric
    return _matched(cell, wavelength_um, (p, q), (m, n, kx, ky), (electric, magnetic, polarization))


Grid = tuple[Array, Array, Array, Array]  # orders m, n and the wave vector kx, ky in units of k0


def _layer(cell: Cell, diameters_um: Sequence[float] | Array, wavelength_um: float, grid: Grid) -> tuple[Array, Array]:
    """Matrices of dE/dz = P H and dH/dz = Q E in the pillar layer, lengths in units of 1 / k0."""
    m, n, kx, ky = grid
    inside, around = (materials.index(name, wavelength_um) ** 2 for name in (cell.pillar, cell.between))
    dm, dn = m[:, None] - m, n[:, None] - n
    disc = _discs(dm, dn, np.asarray(diameters_um), cell.pitch_um)
    one = np.eye(len(m))
    eps = around * one + (inside - around) * disc
    harmonic = np.linalg.inv(one / around + (1 / inside - 1 / around) * disc)
    gap = eps - harmonic
    xx, yy, xy = (_product(gap, field[dm, dn]) for field in _normal_fields(len(diameters_um), m, n))
    inverse = np.linalg.inv(eps)
    x, y = np.diag(kx), np.diag(ky)
    p = np.block([[x @ inverse @ y, one - x @ inverse @ x], [y @ inverse @ y - one, -y @ inverse @ x]])
    q = np.block([[x @ y - xy, eps - yy - x @ x], [y @ y - (eps - xx), -y @ x + xy]])
    return p, q


def _product(gap: Array, normal: Array) -> Array:
    """The two orders of the product averaged, so that energy holds at any truncation."""
    return np.asarray((gap @ normal + normal @ gap) / 2)


def _discs(dm: Array, dn: Array, diameters_um: Array, pitch_um: float) -> Array:
    """Fourier coefficients of the indicator of all discs: sum of f 2 J1(x) / x exp(-iGx)."""
    count = len(diameters_um)
    size = np.hypot(dm / count, dn) / pitch_um
    total = np.zeros(dm.shape, complex)
    for place, diameter in enumerate(diameters_um):
        x = np.pi * diameter * size
        share = np.pi * diameter**2 / (4 * count * pitch_um**2)
        shape = np.where(x > 0, 2 * j1(x) / np.where(x > 0, x, 1), 1.0)
        total += share * shape * np.exp(-2j * np.pi * dm * (place - (count - 1) / 2) / count)
    return total


def _normal_fields(count: int, m: Array, n: Array) -> tuple[Array, Array, Array]:
    """Tables over differences of orders of nx nx, ny ny, nx ny of the radial field about the nearest pillar."""
    u = (np.arange(GRID) + 0.5) / GRID - 0.5
    x, y = u[:, None], u[None, :]
    r2 = x**2 + y**2
    reach_x, reach_y = 2 * int(m.max()), 2 * int(n.max())
    along = np.exp(-2j * np.pi * np.arange(-reach_x, reach_x + 1)[:, None] * u / count) / GRID
    across = np.exp(-2j * np.pi * np.arange(-reach_y, reach_y + 1)[:, None] * u) / GRID
    comb = np.exp(
        -2j * np.pi * np.arange(-reach_x, reach_x + 1)[:, None] * (np.arange(count) - (count - 1) / 2) / count
    ).mean(1)
    tables = []
    for field in (x * x / r2, y * y / r2, x * y / r2):
        table = (along @ field @ across.T) * comb[:, None]
        tables.append(np.roll(table, (-reach_x, -reach_y), (0, 1)))  # so that negative differences index from the end
    return tables[0], tables[1], tables[2]


def _mirror(n: Array, polarization: Polarization) -> tuple[Array, Array]:
    """Bases of (Ex, Ey) and (Hx, Hy) that hold for light along one axis: even or odd under y -> -y."""
    even, odd = _parity(n, 1), _parity(n, -1)
    first, second = (even, odd) if polarization == "x" else (odd, even)
    return linalg.block_diag(first, second), linalg.block_diag(second, first)


def _parity(n: Array, sign: int) -> Array:
    """(orders, combinations) orthonormal: orders come with all n of one m beside each other, from -N to N."""
    reach = int(n.max())
    one = np.zeros((2 * reach + 1, reach + (sign > 0)))
    for k in range(reach):
        one[reach - 1 - k, k], one[reach + 1 + k, k] = sign * math.sqrt(0.5), math.sqrt(0.5)
    if sign > 0:
        one[reach, reach] = 1.0
    return np.asarray(np.kron(np.eye(len(n) // (2 * reach + 1)), one))


def _matched(
    cell: Cell, wavelength_um: float, layer: tuple[Array, Array], grid: Grid, basis: tuple[Array, Array, Polarization]
) -> Row:
    """Modes of the layer matched to substrate and cover."""
    (p, q), (m, n, _, _), (electric, magnetic, polarization) = layer, grid, basis
    square, modes = linalg.eig(p @ q)
    decay = -1j * _forward(np.sqrt(-square.astype(complex)))
    fields = -(q @ modes) / decay
    fall = np.exp(-decay * (2 * np.pi / wavelength_um * cell.height_um))
    below, above = (_homogeneous(materials.index(name, wavelength_um), grid, electric, magnetic) for name in
                    (cell.substrate, cell.cover))  # fmt: skip
    half = len(m)
    wave = np.zeros(2 * half)
    wave[np.flatnonzero((m == 0) & (n == 0))[0] + (half if polarization == "y" else 0)] = 1.0
    incident = electric.T @ wave
    foot, top = below @ modes, above @ modes
    system = np.block([[foot + fields, (foot - fields) * fall], [(top - fields) * fall, top + fields]])
    right = np.concatenate([2 * below @ incident, np.zeros(len(incident))])
    up, down = np.split(np.linalg.solve(system, right), 2)
    out, back = modes @ (fall * up + down), modes @ (up + fall * down) - incident
    powers = [float(np.real(np.vdot(e, 1j * (_cross(electric, magnetic) @ (medium @ e))))) for e, medium in
              ((incident, below), (out, above), (back, below))]  # fmt: skip
    whole = electric @ out
    component = whole[half:] if polarization == "y" else whole[:half]
    kept = n == 0
    indices = [materials.index(name, wavelength_um).real for name in (cell.substrate, cell.cover)]
    amplitude = component[kept] * math.sqrt(indices[1] / indices[0])
    return Row(m[kept], amplitude, (powers[1] + powers[2]) / powers[0])


def _cross(electric: Array, magnetic: Array) -> Array:
    """z part of E* x H in the reduced bases: Ex* Hy - Ey* Hx."""
    half = len(electric) // 2
    turn = np.block([[np.zeros((half, half)), np.eye(half)], [-np.eye(half), np.zeros((half, half))]])
    return np.asarray(electric.T @ turn @ magnetic)


def _homogeneous(index: complex, grid: Grid, electric: Array, magnetic: Array) -> Array:
    """H of waves that travel upwards, from their E."""
    _, _, kx, ky = grid
    kz = _forward(np.sqrt(index**2 - kx**2 - ky**2 + 0j))
    x, y, z = np.diag(kx * ky), np.diag(index**2 - kx**2), np.diag(ky**2 - index**2)
    q = np.block([[x, y], [z, -x]])
    return np.asarray(magnetic.T @ (-q / np.tile(-1j * kz, 2)) @ electric)


def _forward(kz: Array) -> Array:
    """The root that travels or decays upwards."""
    return np.asarray(np.where(kz.real + kz.imag < 0, -kz, kz))


@dataclass(frozen=True, eq=False, slots=True)
class Neighbours:
    """Factor c(s) = 1 + a s + b s² on the amplitude that goes where it should, s the sine that light is turned by.

    The first term is that of the zone borders, whose number grows with s; the second that of the slope between them.

    a, b: complex. sine, factor: (n,) measured on rows. scatter: (n,) share of the transmitted power that goes
    elsewhere, beyond what pillars one by one would send there. wavelength_um: of the rows.
    by_polarization: (2, n) the factor of light whose field lies along the row, and across it.
    """

    a: complex
    b: complex
    sine: Array
    factor: Array
    scatter: Array
    wavelength_um: float
    by_polarization: Array

    def at(self, sine: Array) -> Array:
        """Complex factor where light is turned by this much."""
        s = np.abs(sine)
        return np.asarray(1 + self.a * s + self.b * s**2)

    def without(self, row: int) -> "Neighbours":
        """The same without a row, a and b as they are."""
        sine, factor, scatter = (np.delete(part, row) for part in (self.sine, self.factor, self.scatter))
        both = np.delete(self.by_polarization, row, axis=1)
        return Neighbours(self.a, self.b, sine, factor, scatter, self.wavelength_um, both)

    def share(self, sine: Array, weight: Array, cover: float) -> float:
        """Share of the power in the focus of pillars taken one by one that unlike neighbours leave there.

        |∫ (P + S) / 2|² over the lens, P² = c² / cos θ of the light along the slope, S² = c² cos θ of that across it,
        θ in a cover of this index: tangential fields are c, the power that leaves in a direction is P² and S².

        Args:
            sine, weight: (m,) turned by, and share of the lens, of sum 1.
        """
        powers = np.stack([self.sine, self.sine**2], 1).astype(complex)
        coefficients = np.linalg.lstsq(powers, self.by_polarization.T - 1, rcond=None)[0]
        factor = 1 + np.stack([sine, sine**2], 1) @ coefficients
        cosine = np.sqrt(np.maximum(1 - (sine / cover) ** 2, 0.0))
        along, across = factor[:, 0] / np.sqrt(np.maximum(cosine, 1e-9)), factor[:, 1] * np.sqrt(cosine)
        return float(abs(weight @ (along + across) / 2) ** 2)


def neighbours(lens: Lens, *, counts: tuple[int, ...] = (6, 5), harmonics: int = 3) -> Neighbours:
    """How far unlike neighbours change the pillars of this lens: blazed rows of its own pillars, both polarisations.

    A row of N pillars whose phases rise by 2 pi / N turns light by s = wavelength / (N pitch), as the lens does where
    its phase has that slope. Of short rows several are solved, whose phases begin elsewhere, and their mean is taken.

    Raises:
        CellError: the cell has films or tilted walls, or is no round pillar on a square lattice.
    """
    sines, factors, scatter = [], [], []
    for count in counts:
        begins = max(1, round(LONG / count))
        found = []
        for begin in range(begins):
            wanted = 2 * np.pi * (np.arange(count) + 0.25 + begin / begins) / count
            diameters = lens.proxy.diameter_um(wanted, lens.wavelength_um, within_um=printed(lens), gap="nearest")
            found.append(_blazed(lens, np.asarray(diameters), harmonics))
        sines.append(lens.wavelength_um / (count * lens.cell.pitch_um))
        factors.append(np.mean([ratio for ratio, _ in found], axis=0))
        scatter.append(float(np.mean([lost for _, lost in found])))
    s, both = np.array(sines), np.array(factors).T
    a, b = np.linalg.lstsq(np.stack([s, s**2], 1).astype(complex), both.mean(axis=0) - 1, rcond=None)[0]
    return Neighbours(complex(a), complex(b), s, both.mean(axis=0), np.array(scatter), lens.wavelength_um, both)


def _blazed(lens: Lens, diameters_um: Array, harmonics: int) -> tuple[Array, float]:
    """Amplitude in the wanted order against pillars one by one, of light along and across the row, and power that went
    elsewhere, the mean of both."""
    count = len(diameters_um)
    place = np.arange(count) - (count - 1) / 2
    ratios, lost = [], []
    for polarization in ("x", "y"):
        whole = solve_row(lens.cell, diameters_um, lens.wavelength_um, polarization=polarization, harmonics=harmonics)
        alone = np.array(
            [
                solve_row(lens.cell, [d], lens.wavelength_um, polarization=polarization, harmonics=harmonics).order(0)
                for d in diameters_um
            ]
        )
        want = (alone * np.exp(-2j * np.pi * place / count)).mean()
        got = whole.order(1)
        ratios.append(got / want)
        travels = np.abs(whole.orders) * lens.wavelength_um < count * lens.cell.pitch_um
        total = float((np.abs(whole.t[travels]) ** 2).sum())
        lost.append(1 - abs(got) ** 2 / total - (1 - abs(want) ** 2 / float((np.abs(alone) ** 2).mean())))
    return np.array(ratios), float(np.mean(lost))


def printed(lens: Lens) -> tuple[float, float]:
    """(least, largest) diameter of the lens's pillars, within its proxy's domain."""
    built = lens.diameters.diameter_um[lens.diameters.diameter_um > 0]
    low, high = lens.proxy.domain_um
    return max(float(built.min()), low), min(float(built.max()), high)
