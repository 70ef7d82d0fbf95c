"""A row of unlike pillars solved rigorously as one cell: what the local periodic
approximation leaves out.

A lens is designed as if every pillar stood among its like. Here N different pillars in
a row repeat with period N
times the pitch, so every one feels its real neighbours; light leaves in the orders of
that grating, and the wanted one
is compared with what the pillars would give one by one. RCWA with normal vectors
(Schuster et al. 2007), mirror
symmetric in y, both solved at the same truncation so that truncation all but cancels.

Rows run along the lattice, or along its diagonal, where every other pillar stands half
a period aside:

    straight    o o o o    period N p, p across          diagonal    o   o       period N p / √2, √2 p across
                                                                       o   o
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy import linalg
from scipy.special import j1

from metalens.cell import Cell, materials
from metalens.ground.arrays import Array
from metalens.ground.errors import CellError
from metalens.lens import Lens, Neighbours

LONG = 6  # pillars: of shorter rows several are solved
# sine in the cover of the light of a row; that of steeper ones runs along the lens, or
# nowhere
STEEPEST = 0.95
# points across a cell for the normal field; its coefficients are needed to twice the
# harmonics
GRID = 48
Polarization = Literal["x", "y"]


@dataclass(frozen=True, eq=False, slots=True)
class Row:
    """What a row of pillars does to light at normal incidence from the substrate.

    orders: (n,) diffraction orders along the row. t: (n,) transverse amplitude of each
    in the cover, for unit power
    in; the phase runs from foot to top, as for
    :class:`metalens.cell.response.Response`.
    energy: transmitted plus reflected power, 1 where nothing absorbs.
    """

    orders: Array
    t: Array
    energy: float

    def order(self, m: int) -> complex:
        """Amplitude of one order."""
        return complex(self.t[int(np.flatnonzero(self.orders == m)[0])])


@dataclass(frozen=True, slots=True)
class _Block:
    """What repeats along a row: a square with one pillar, or along the diagonal with
    two. width_um: of the square.
    """

    width_um: float
    pillars: int

    @property
    def spacing_um(self) -> float:
        """From pillar to pillar along the row."""
        return self.width_um / self.pillars

    def places_um(self, count: int) -> Array:
        """(2, count) x and y of the pillars of a row about its middle; mirrored in y."""
        order = np.arange(count)
        across = (
            (order % 2) * self.width_um / 2 if self.pillars > 1 else np.zeros(count)
        )
        return np.stack([(order - (count - 1) / 2) * self.spacing_um, across])

    def normals(self) -> tuple[Array, Array, Array]:
        """nx nx, ny ny, nx ny of the radial field about the nearest pillar at points of
        the square; ties: the mean.
        """
        u = (np.arange(GRID) + 0.5) / GRID - 0.5
        x, y = np.meshgrid(u, u, indexing="ij")
        places = self.places_um(self.pillars) / self.width_um
        dx, dy = (
            np.stack([v - one for one in axis])
            for v, axis in zip((x, y), places, strict=True)
        )
        dx, dy = dx - np.rint(dx), dy - np.rint(dy)
        r2 = dx**2 + dy**2
        near = r2 <= r2.min(0) + 1e-9
        xx, yy, xy = (
            (v / r2 * near).sum(0) / near.sum(0) for v in (dx * dx, dy * dy, dx * dy)
        )
        return xx, yy, xy


def block_of(pitch_um: float, diagonal: bool) -> _Block:
    """The square that repeats along a row of a square lattice."""
    return _Block(math.sqrt(2) * pitch_um, 2) if diagonal else _Block(pitch_um, 1)


def solve_row(
    cell: Cell,
    diameters_um: Sequence[float] | Array,
    wavelength_um: float,
    *,
    polarization: Polarization,
    harmonics: int = 4,
    diagonal: bool = False,
) -> Row:
    """Orders of a row of pillars of these diameters, one pitch apart, repeated without
    end.

    Args:
        harmonics: orders to each side along y, and along x per pillar.
        diagonal: along the diagonal of the lattice, pitch / √2 apart along it; an even
            number of pillars. As many
            orders per wave vector.

    Accuracy: that of RCWA at this truncation, a few 1e-2 of t for silicon; differences
    between rows at one truncation
        are better by an order of magnitude. Energy holds to rounding.

    Raises:
        CellError: films or tilted walls, no round pillars on a square lattice, no
            pillar, an odd number along the
            diagonal, or pillars that touch.
    """
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
            f"row of {len(diameters_um)} pillars: need diameters above 0 and below {cell.pitch_um} um"
        )
    block = block_of(cell.pitch_um, diagonal)
    if len(diameters_um) % block.pillars:
        raise CellError(
            f"row of {len(diameters_um)} pillars along the diagonal: need an even number"
        )
    blocks = len(diameters_um) // block.pillars
    across = math.ceil(harmonics * block.width_um / cell.pitch_um - 1e-9)
    reach = across * blocks
    m, n = (
        a.ravel()
        for a in np.meshgrid(
            np.arange(-reach, reach + 1), np.arange(-across, across + 1), indexing="ij"
        )
    )
    kx, ky = (
        m * wavelength_um / (blocks * block.width_um),
        n * wavelength_um / block.width_um,
    )
    p, q = _layer(cell, diameters_um, wavelength_um, block, (m, n, kx, ky))
    electric, magnetic = _mirror(n, polarization)
    p, q = electric.T @ p @ magnetic, magnetic.T @ q @ electric
    return _matched(
        cell, wavelength_um, (p, q), (m, n, kx, ky), (electric, magnetic, polarization)
    )


Grid = tuple[
    Array, Array, Array, Array
]  # orders m, n and the wave vector kx, ky in units of k0


def _layer(
    cell: Cell,
    diameters_um: Sequence[float] | Array,
    wavelength_um: float,
    block: _Block,
    grid: Grid,
) -> tuple[Array, Array]:
    """Matrices of dE/dz = P H and dH/dz = Q E in the pillar layer, lengths in units of
    1 / k0.
    """
    m, n, kx, ky = grid
    inside, around = (
        materials.index(name, wavelength_um) ** 2 for name in (cell.pillar, cell.fill)
    )
    dm, dn = m[:, None] - m, n[:, None] - n
    disc = _discs(dm, dn, np.asarray(diameters_um), block)
    one = np.eye(len(m))
    eps = around * one + (inside - around) * disc
    harmonic = np.linalg.inv(one / around + (1 / inside - 1 / around) * disc)
    gap = eps - harmonic
    xx, yy, xy = (
        _product(gap, field[dm, dn])
        for field in _normal_fields(len(diameters_um), m, n, block)
    )
    inverse = np.linalg.inv(eps)
    x, y = np.diag(kx), np.diag(ky)
    p = np.block(
        [
            [x @ inverse @ y, one - x @ inverse @ x],
            [y @ inverse @ y - one, -y @ inverse @ x],
        ]
    )
    q = np.block([[x @ y - xy, eps - yy - x @ x], [y @ y - (eps - xx), -y @ x + xy]])
    return p, q


def _product(gap: Array, normal: Array) -> Array:
    """The two orders of the product averaged, so that energy holds at any truncation."""
    return np.asarray((gap @ normal + normal @ gap) / 2)


def _discs(dm: Array, dn: Array, diameters_um: Array, block: _Block) -> Array:
    """Fourier coefficients of the indicator of all discs: sum of f 2 J1(x) / x
    exp(-iGx).
    """
    blocks = len(diameters_um) // block.pillars
    size = np.hypot(dm / blocks, dn) / block.width_um
    total = np.zeros(dm.shape, complex)
    for (x_um, y_um), diameter in zip(
        block.places_um(len(diameters_um)).T, diameters_um, strict=True
    ):
        x = np.pi * diameter * size
        share = np.pi * diameter**2 / (4 * blocks * block.width_um**2)
        shape = np.where(x > 0, 2 * j1(x) / np.where(x > 0, x, 1), 1.0)
        turns = (dm * x_um / blocks + dn * y_um) / block.width_um
        total += share * shape * np.exp(-2j * np.pi * turns)
    return total


def _normal_fields(
    count: int, m: Array, n: Array, block: _Block
) -> tuple[Array, Array, Array]:
    """Tables over differences of orders of nx nx, ny ny, nx ny of the radial field
    about the nearest pillar.
    """
    u = (np.arange(GRID) + 0.5) / GRID - 0.5
    blocks = count // block.pillars
    reach_x, reach_y = 2 * int(m.max()), 2 * int(n.max())
    orders = np.arange(-reach_x, reach_x + 1)[:, None]
    along = np.exp(-2j * np.pi * orders * u / blocks) / GRID
    across = np.exp(-2j * np.pi * np.arange(-reach_y, reach_y + 1)[:, None] * u) / GRID
    comb = np.exp(
        -2j * np.pi * orders * (np.arange(blocks) - (blocks - 1) / 2) / blocks
    ).mean(1)
    tables = []
    for field in block.normals():
        table = (along @ field @ across.T) * comb[:, None]
        tables.append(
            np.roll(table, (-reach_x, -reach_y), (0, 1))
        )  # so that negative differences index from the end
    return tables[0], tables[1], tables[2]


def _mirror(n: Array, polarization: Polarization) -> tuple[Array, Array]:
    """Bases of (Ex, Ey) and (Hx, Hy) that hold for light along one axis: even or odd
    under y -> -y.
    """
    even, odd = _parity(n, 1), _parity(n, -1)
    first, second = (even, odd) if polarization == "x" else (odd, even)
    return linalg.block_diag(first, second), linalg.block_diag(second, first)


def _parity(n: Array, sign: int) -> Array:
    """(orders, combinations) orthonormal: orders come with all n of one m beside each
    other, from -N to N.
    """
    reach = int(n.max())
    one = np.zeros((2 * reach + 1, reach + (sign > 0)))
    for k in range(reach):
        one[reach - 1 - k, k], one[reach + 1 + k, k] = (
            sign * math.sqrt(0.5),
            math.sqrt(0.5),
        )
    if sign > 0:
        one[reach, reach] = 1.0
    return np.asarray(np.kron(np.eye(len(n) // (2 * reach + 1)), one))


def _matched(
    cell: Cell,
    wavelength_um: float,
    layer: tuple[Array, Array],
    grid: Grid,
    basis: tuple[Array, Array, Polarization],
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
    wave[
        np.flatnonzero((m == 0) & (n == 0))[0] + (half if polarization == "y" else 0)
    ] = 1.0
    incident = electric.T @ wave
    foot, top = below @ modes, above @ modes
    system = np.block(
        [[foot + fields, (foot - fields) * fall], [(top - fields) * fall, top + fields]]
    )
    right = np.concatenate([2 * below @ incident, np.zeros(len(incident))])
    up, down = np.split(np.linalg.solve(system, right), 2)
    out, back = modes @ (fall * up + down), modes @ (up + fall * down) - incident
    powers = [float(np.real(np.vdot(e, 1j * (_cross(electric, magnetic) @ (medium @ e))))) for e, medium in
              ((incident, below), (out, above), (back, below))]  # fmt: skip
    whole = electric @ out
    component = whole[half:] if polarization == "y" else whole[:half]
    kept = n == 0
    indices = [
        materials.index(name, wavelength_um).real
        for name in (cell.substrate, cell.cover)
    ]
    amplitude = component[kept] * math.sqrt(indices[1] / indices[0])
    return Row(m[kept], amplitude, (powers[1] + powers[2]) / powers[0])


def _cross(electric: Array, magnetic: Array) -> Array:
    """z part of E* x H in the reduced bases: Ex* Hy - Ey* Hx."""
    half = len(electric) // 2
    turn = np.block(
        [
            [np.zeros((half, half)), np.eye(half)],
            [-np.eye(half), np.zeros((half, half))],
        ]
    )
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


def neighbours(
    lens: Lens,
    *,
    counts: tuple[int, ...] = (6, 5),
    harmonics: int = 3,
    diagonal: bool = True,
) -> Neighbours:
    """How far unlike neighbours change the pillars of this lens: blazed rows of its own
    pillars, both polarisations.

    A row of N pillars whose phases rise by 2 pi / N turns light by s = wavelength / (N
    pitch), as the lens does where
    its phase has that slope. Of short rows several are solved, whose phases begin
    elsewhere, and their mean is taken.

    Args:
        counts: pillars of the rows along the lattice. harmonics: of :func:`solve_row`;
            one less for ``coarse``.
        diagonal: also solve rows along the diagonal, of the even numbers next to √2 of
            those.

    Raises:
        CellError: the cell has films or tilted walls, or is no round pillar on a square
            lattice.
    """
    cover = materials.index(lens.cell.cover, lens.wavelength_um).real
    aside = (
        sorted({2 * max(1, round(count / math.sqrt(2))) for count in counts})
        if diagonal
        else []
    )
    rows = [(count, False) for count in counts] + [(count, True) for count in aside]
    sines = [
        lens.wavelength_um / (n * block_of(lens.cell.pitch_um, turned).spacing_um)
        for n, turned in rows
    ]
    told = [
        (row, sine)
        for row, sine in zip(rows, sines, strict=True)
        if sine < STEEPEST * cover
    ]
    found = [
        [_mean(lens, *row, reach) for row, _ in told]
        for reach in (harmonics, harmonics - 1)
    ]
    fine, coarse = ([factor for factor, _ in one] for one in found)
    return Neighbours(
        np.array([sine for _, sine in told]),
        np.array([turned for (_, turned), _ in told], bool),
        np.array(fine).reshape(-1, 2).T,
        np.array(coarse).reshape(-1, 2).T,
        np.array([lost for _, lost in found[0]]),
        lens.wavelength_um,
        cover,
    )


def _mean(
    lens: Lens, count: int, diagonal: bool, harmonics: int
) -> tuple[Array, float]:
    """(2,) factor and the power that went elsewhere, mean over rows of ``count`` whose
    phases begin elsewhere.
    """
    begins = max(1, round(LONG / count))
    found = []
    for begin in range(begins):
        wanted = 2 * np.pi * (np.arange(count) + 0.25 + begin / begins) / count
        diameters = lens.proxy.diameter_um(
            wanted, lens.wavelength_um, within_um=printed(lens), gap="nearest"
        )
        found.append(_blazed(lens, np.asarray(diameters), harmonics, diagonal))
    return np.mean([ratio for ratio, _ in found], axis=0), float(
        np.mean([lost for _, lost in found])
    )


def _blazed(
    lens: Lens, diameters_um: Array, harmonics: int, diagonal: bool
) -> tuple[Array, float]:
    """Amplitude in the wanted order against pillars one by one, of light along and
    across the row, and power that went
    elsewhere, the mean of both."""
    count, block = len(diameters_um), block_of(lens.cell.pitch_um, diagonal)
    place = np.arange(count) - (count - 1) / 2
    about: dict[str, Any] = {"harmonics": harmonics, "diagonal": diagonal}
    ratios, lost = [], []
    for polarization in ("x", "y"):
        whole = solve_row(
            lens.cell,
            diameters_um,
            lens.wavelength_um,
            polarization=polarization,
            **about,
        )
        alone = np.array(
            [
                solve_row(
                    lens.cell,
                    [d] * block.pillars,
                    lens.wavelength_um,
                    polarization=polarization,
                    **about,
                ).order(0)
                for d in diameters_um
            ]
        )
        want = (alone * np.exp(-2j * np.pi * place / count)).mean()
        got = whole.order(1)
        ratios.append(got / want)
        travels = np.abs(whole.orders) * lens.wavelength_um < count * block.spacing_um
        total = float((np.abs(whole.t[travels]) ** 2).sum())
        lost.append(
            1
            - abs(got) ** 2 / total
            - (1 - abs(want) ** 2 / float((np.abs(alone) ** 2).mean()))
        )
    return np.array(ratios), float(np.mean(lost))


def printed(lens: Lens) -> tuple[float, float]:
    """(least, largest) diameter of the lens's pillars, within its proxy's domain."""
    built = lens.diameters.diameter_um[lens.diameters.diameter_um > 0]
    low, high = lens.proxy.domain_um
    return max(float(built.min()), low), min(float(built.max()), high)
