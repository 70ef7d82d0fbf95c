"""A square of K by K unlike pillars, repeated without end, solved as one cell of
coupled waves.

A referee of lenses: no code in common with :mod:`metalens.rcwa` and
:mod:`metalens.design.neighbours`. Diameters that
are mirrored in x and y share these mirrors with light along x, so that a field is even
or odd along each axis and a
quarter of the orders is enough:

    Ex, Hy  even in x, even in y        Ez  odd in x, even in y
    Ey, Hx  odd in x,  odd in y         Hz  even in x, odd in y

In these bases permittivity is real where nothing absorbs. The product of ε and E
follows normal vectors about the
nearest pillar (Schuster et al. 2007), both orders of it averaged, so that energy holds
at any truncation.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from scipy import linalg
from scipy.special import j1

from metalens.cell import Cell, materials
from metalens.ground.arrays import Array

GRID = 48  # points across a cell for the normal field
Parity = Literal["even", "odd"]


@dataclass(frozen=True, eq=False, slots=True)
class Light:
    """Transmitted orders of light along x of unit power: (n,) sines along x and y that
    travel, (n,) complex transverse
    amplitudes ``ex``, ``ey``; energy: transmitted plus reflected power."""

    sx: Array
    sy: Array
    ex: Array
    ey: Array
    energy: float


@dataclass(frozen=True, eq=False, slots=True)
class _Sector:
    """Orders m, n >= 0 of fields of one parity along x and y. size: of one of the
    orders in a combination.
    """

    reach: int
    along: Parity
    across: Parity
    m: Array = field(init=False)
    n: Array = field(init=False)
    size: Array = field(init=False)

    def __post_init__(self) -> None:
        first = [0 if parity == "even" else 1 for parity in (self.along, self.across)]
        m, n = (
            a.ravel()
            for a in np.meshgrid(
                *(np.arange(f, self.reach + 1) for f in first), indexing="ij"
            )
        )
        object.__setattr__(self, "m", m)
        object.__setattr__(self, "n", n)
        object.__setattr__(
            self,
            "size",
            np.where(m > 0, math.sqrt(0.5), 0.5) * np.where(n > 0, math.sqrt(0.5), 0.5),
        )

    @property
    def signs(self) -> tuple[int, int]:
        return (1 if self.along == "even" else -1), (1 if self.across == "even" else -1)

    def mirrors(self) -> Iterator[tuple[int, int, int]]:
        """(±1, ±1) of m and n, with the sign of a field there."""
        for x in (1, -1):
            for y in (1, -1):
                yield (
                    x,
                    y,
                    (self.signs[0] if x < 0 else 1) * (self.signs[1] if y < 0 else 1),
                )


def solve(
    cell: Cell, diameters_um: Array, wavelength_um: float, *, harmonics: int = 2
) -> Light:
    """Light along x at normal incidence from the substrate through (K, K) upright round
    pillars without films.

    Args:
        diameters_um: mirrored in both axes. harmonics: orders to each side along each
            axis, per pillar.

    Accuracy: of coupled waves at this truncation. Matrices have 2 (harmonics K)² rows:
    K = 21 takes some 5 min.
    """
    count = len(diameters_um)
    if diameters_um.shape != (count, count) or not all(
        np.array_equal(diameters_um, np.flip(diameters_um, a)) for a in (0, 1)
    ):
        raise ValueError("need a square of diameters mirrored in x and y")
    reach = harmonics * count
    width = count * cell.pitch_um
    ee, oo, oe = (
        _Sector(reach, "even", "even"),
        _Sector(reach, "odd", "odd"),
        _Sector(reach, "odd", "even"),
    )
    p, q = _layer(cell, diameters_um, wavelength_um, (ee, oo, oe))
    below, above = (
        _homogeneous(
            materials.index(name, wavelength_um), wavelength_um / width, ee, oo
        )
        for name in (cell.substrate, cell.cover)
    )
    thickness = 2 * np.pi / wavelength_um * cell.height_um
    incident = np.zeros(len(p))
    incident[0] = 1.0
    out, back = _matched(p, q, (below, above), thickness, incident)
    power = [
        _power(fields, medium, len(ee.m))
        for fields, medium in ((incident, below), (out, above), (back, below))
    ]
    return _orders(
        out,
        (ee, oo),
        wavelength_um / width,
        cell,
        wavelength_um,
        (power[1] + power[2]) / power[0],
    )


def _layer(
    cell: Cell, diameters_um: Array, wavelength_um: float, sectors: tuple[_Sector, ...]
) -> tuple[Array, Array]:
    """P and Q of dE/dz = P H, dH/dz = Q E for E = (Ex, Ey), H = (Hx, Hy), lengths in 1
    / k0.
    """
    ee, oo, oe = sectors
    inside, around = (
        _plain(materials.index(name, wavelength_um) ** 2)
        for name in (cell.pillar, cell.fill)
    )
    step = wavelength_um / (len(diameters_um) * cell.pitch_um)
    disc = _discs(diameters_um, cell.pitch_um, ee.reach)
    xx, yy, xy = _normals(len(diameters_um), ee.reach)
    eps, gap = {}, {}
    for sector in sectors:
        one, area = np.eye(len(sector.m)), _product(disc, sector, sector)
        eps[sector.signs] = around * one + (inside - around) * area
        gap[sector.signs] = eps[sector.signs] - np.linalg.inv(
            one / around + (1 / inside - 1 / around) * area
        )
    inverse = np.linalg.inv(eps[oe.signs])

    def kx(to: _Sector, of: _Sector) -> Array:
        return _same(to, of, of.m * step)

    def ky(to: _Sector, of: _Sector) -> Array:
        return _same(to, of, of.n * step)

    def normal(table: Array, to: _Sector, of: _Sector) -> Array:
        one = _product(table, to, of)
        return np.asarray((gap[to.signs] @ one + one @ gap[of.signs]) / 2)

    p = np.block(
        [
            [
                kx(ee, oe) @ inverse @ ky(oe, oo),
                np.eye(len(ee.m)) - kx(ee, oe) @ inverse @ kx(oe, ee),
            ],
            [
                ky(oo, oe) @ inverse @ ky(oe, oo) - np.eye(len(oo.m)),
                -ky(oo, oe) @ inverse @ kx(oe, ee),
            ],
        ]
    )
    turned = _same(oo, ee, ee.m * ee.n * step**2)
    q = np.block(
        [
            [
                turned - normal(xy, oo, ee),
                eps[oo.signs] - normal(yy, oo, oo) - np.diag((oo.m * step) ** 2),
            ],
            [
                np.diag((ee.n * step) ** 2) - eps[ee.signs] + normal(xx, ee, ee),
                normal(xy, ee, oo) - turned.T,
            ],
        ]
    )
    return p, q


def _plain(value: complex) -> complex | float:
    """Real where next to nothing absorbs (less than 1e-5 of a layer of pillars): a
    quarter of the time.
    """
    return value.real if abs(value.imag) < 1e-6 else value


def _same(to: _Sector, of: _Sector, value: Array) -> Array:
    """(to, of) of what keeps m and n."""
    return np.where((to.m[:, None] == of.m) & (to.n[:, None] == of.n), value, 0.0)


def _product(table: Array, to: _Sector, of: _Sector) -> Array:
    """(to, of) of the product with a function of these real coefficients over m, n from
    -2 reach to 2 reach.
    """
    middle, total = len(table) // 2, 0.0
    for x, y, sign in of.mirrors():
        total = (
            total
            + sign
            * table[
                to.m[:, None] - x * of.m + middle, to.n[:, None] - y * of.n + middle
            ]
        )
    return np.asarray(4 * to.size[:, None] * of.size * total)


def _discs(diameters_um: Array, pitch_um: float, reach: int) -> Array:
    """Coefficients of the indicator of all discs, real by the mirrors."""
    count = len(diameters_um)
    order = np.arange(-2 * reach, 2 * reach + 1)
    size = np.hypot(order[:, None], order) / (count * pitch_um)
    turn = np.exp(
        -2j * np.pi * np.outer(order, np.arange(count) - (count - 1) / 2) / count
    )
    total = np.zeros(size.shape)
    for diameter in np.unique(diameters_um):
        x = np.pi * diameter * size
        shape = (
            np.where(x > 0, 2 * j1(x) / np.where(x > 0, x, 1), 1.0)
            * (np.pi / 4)
            * (diameter / (count * pitch_um)) ** 2
        )
        total += shape * (turn @ (diameters_um == diameter) @ turn.T).real
    return total


def _normals(count: int, reach: int) -> tuple[Array, Array, Array]:
    """Coefficients of nx nx, ny ny, nx ny of the radial field of every cell: those of
    one cell at every K-th order.
    """
    u = (np.arange(GRID) + 0.5) / GRID - 0.5
    x, y = np.meshgrid(u, u, indexing="ij")
    own = np.arange(-2 * reach // count, 2 * reach // count + 1)
    wave = np.exp(-2j * np.pi * np.outer(own, u)) / GRID
    phase = (-1.0) ** (
        (count - 1) * np.add.outer(own, own)
    )  # the middle of the square is between cells where K is even
    found = []
    for values in (x * x, y * y, x * y):
        table = np.zeros((4 * reach + 1, 4 * reach + 1))
        table[np.ix_(own * count + 2 * reach, own * count + 2 * reach)] = (
            wave @ (values / (x * x + y * y)) @ wave.T
        ).real * phase
        found.append(table)
    return found[0], found[1], found[2]


def _homogeneous(index: complex, step: float, ee: _Sector, oo: _Sector) -> Array:
    """H of waves that travel upwards, from their E."""
    x, y = (np.concatenate([a, b]) * step for a, b in ((oo.m, ee.m), (oo.n, ee.n)))
    kz = -1j * _forward(np.sqrt(index**2 - x**2 - y**2 + 0j))  # of rows
    turned = _same(oo, ee, ee.m * ee.n * step**2)
    eps = index**2
    q = np.block(
        [
            [turned, np.diag(eps - (oo.m * step) ** 2)],
            [np.diag((ee.n * step) ** 2 - eps), -turned.T],
        ]
    )
    return np.asarray(-q / kz[:, None])


def _forward(kz: Array) -> Array:
    """The root that travels or decays upwards."""
    return np.asarray(np.where(kz.real + kz.imag < 0, -kz, kz))


def _matched(
    p: Array, q: Array, media: tuple[Array, Array], thickness: float, incident: Array
) -> tuple[Array, Array]:
    """E above, and reflected E below, of the incident E."""
    below, above = media
    square, modes = linalg.eig(p @ q, overwrite_a=True, check_finite=False)
    decay = -1j * _forward(np.sqrt(-square.astype(complex)))
    fields, fall = -(q @ modes) / decay, np.exp(-decay * thickness)
    foot, top = below @ modes, above @ modes
    system = np.block(
        [[foot + fields, (foot - fields) * fall], [(top - fields) * fall, top + fields]]
    )
    right = np.concatenate([2 * below @ incident, np.zeros(len(incident))])
    up, down = np.split(np.linalg.solve(system, right), 2)
    return modes @ (fall * up + down), modes @ (up + fall * down) - incident


def _power(electric: Array, medium: Array, half: int) -> float:
    """Power along z: E = (Ex, Ey), H = (Hx, Hy) with Ex beside Hy."""
    magnetic = medium @ electric
    other = len(electric) - half
    flow = (
        electric[:half].conj() @ magnetic[other:]
        - electric[half:].conj() @ magnetic[:other]
    )
    return float(np.real(1j * flow))


def _orders(
    out: Array,
    sectors: tuple[_Sector, _Sector],
    step: float,
    cell: Cell,
    wavelength_um: float,
    energy: float,
) -> Light:
    """All orders that travel, from the combinations."""
    ee, oo = sectors
    index, front = (
        materials.index(name, wavelength_um).real
        for name in (cell.cover, cell.substrate)
    )
    reach = ee.reach
    full = []
    for sector, part in ((ee, out[: len(ee.m)]), (oo, out[len(ee.m) :])):
        square = np.zeros((2 * reach + 1, 2 * reach + 1), complex)
        for x, y, sign in sector.mirrors():
            np.add.at(
                square,
                (x * sector.m + reach, y * sector.n + reach),
                sign * sector.size * part,
            )
        full.append(square)
    m, n = np.meshgrid(
        np.arange(-reach, reach + 1), np.arange(-reach, reach + 1), indexing="ij"
    )
    travels = np.hypot(m, n) * step < index
    level = math.sqrt(index / front)
    return Light(
        m[travels] * step,
        n[travels] * step,
        full[0][travels] * level,
        full[1][travels] * level,
        energy,
    )
