"""Fourier orders of a square cell, reduced by the mirror symmetries of the case.

A field that a mirror plane leaves unchanged (or turns into its negative) has one
amplitude for all the orders that the
mirrors carry into each other. Four scalar sets belong to a case: Ex, Ey, and the
parities of Ez and Hz, from which the
transverse waves of a homogeneous medium are made (p from Ez, s from Hz).
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from scipy.special import j0, j1, jv

from metalens.core.arrays import Array

Symmetry = Literal[
    "x", "p", "s", "none"
]  # E along x at normal incidence; E in, or across, the mirror plane y = 0
_PARITY: dict[
    str, tuple[tuple[int, int], ...]
] = {  # of Ex, Ey, Ez, Hz under x -> -x and y -> -y; 0: no such mirror
    "x": ((1, 1), (-1, -1), (-1, 1), (1, -1)),
    "p": ((0, 1), (0, -1), (0, 1), (0, -1)),
    "s": ((0, -1), (0, 1), (0, -1), (0, 1)),
    "none": ((0, 0), (0, 0), (0, 0), (0, 0)),
}


@dataclass(frozen=True, eq=False, slots=True)
class DiscOrders:
    """Amplitudes of one scalar field: one representative order for each set of mirror
    images.

    m, n: (k,) representative orders along x and y.
    size: (k,) number of orders in each set.
    parity: under x -> -x and y -> -y, 0 where the case has no such mirror.
    """

    m: Array
    n: Array
    size: Array
    parity: tuple[int, int]


@dataclass(frozen=True, eq=False, slots=True)
class DiscBasis:
    """Orders within a circle of radius ``harmonics``, for one symmetry.

    ex, ey, ez, hz: the scalar sets.
    shells: (q,) distinct squared distances between orders; disc coefficients depend on
    nothing else.
    links: for the products (ex, ex), (ey, ey), (ez, ez), (ex, ey).
    normal: matrices of nx nx (ex, ex), ny ny (ey, ey), nx ny (ex, ey) for the radial
    unit field n.
    """

    harmonics: int
    symmetry: Symmetry
    ex: DiscOrders
    ey: DiscOrders
    ez: DiscOrders
    hz: DiscOrders
    shells: Array
    links: tuple["DiscLink", ...]
    normal: tuple[Array, Array, Array]


@dataclass(frozen=True, eq=False, slots=True)
class DiscLink:
    """How a function of the cell couples two scalar sets: a sum over the mirror images
    of the column's order.

    shell: (k, l, images) place in ``Basis.shells`` of the difference of orders.
    weight, cos2, sin2: (k, l, images) sign and norm of each image; the same times cos
    2f and sin 2f, where f is
        the direction of the difference.
    """

    shell: Array
    weight: Array
    cos2: Array
    sin2: Array


@lru_cache(maxsize=24)
def disc_basis(harmonics: int, symmetry: Symmetry) -> DiscBasis:
    """The basis of all orders with m² + n² <= harmonics², reduced by the symmetry."""
    ex, ey, ez, hz = (_orders(harmonics, parity) for parity in _PARITY[symmetry])
    pairs = ((ex, ex), (ey, ey), (ez, ez), (ex, ey))
    reach = np.arange(2 * harmonics + 1) ** 2
    shells = np.unique(reach[:, None] + reach)
    links = tuple(_link(rows, columns, shells) for rows, columns in pairs)
    return DiscBasis(
        harmonics,
        symmetry,
        ex,
        ey,
        ez,
        hz,
        shells,
        links,
        _normal(ex, ey, 2 * harmonics),
    )


def _orders(harmonics: int, parity: tuple[int, int]) -> DiscOrders:
    reach = np.arange(-harmonics, harmonics + 1)
    m, n = (a.ravel() for a in np.meshgrid(reach, reach, indexing="ij"))
    keep = m * m + n * n <= harmonics**2
    for order, sign in zip((m, n), parity, strict=True):
        if sign:
            keep &= order >= (0 if sign > 0 else 1)
    m, n = m[keep], n[keep]
    size = np.where(m != 0, 2, 1) ** (parity[0] != 0) * np.where(n != 0, 2, 1) ** (
        parity[1] != 0
    )
    return DiscOrders(m, n, size, parity)


def _images(rows: DiscOrders, columns: DiscOrders) -> tuple[Array, Array, Array]:
    """Differences between the rows and every mirror image of the columns, with the
    weight of each.
    """
    signs = [
        (
            sx,
            sy,
            (columns.parity[0] if sx < 0 else 1) * (columns.parity[1] if sy < 0 else 1),
        )
        for sx in ((1, -1) if columns.parity[0] else (1,))
        for sy in ((1, -1) if columns.parity[1] else (1,))
    ]
    dm = np.stack([rows.m[:, None] - sx * columns.m for sx, _, _ in signs], axis=-1)
    dn = np.stack([rows.n[:, None] - sy * columns.n for _, sy, _ in signs], axis=-1)
    share = np.sqrt(rows.size[:, None] * columns.size) / len(signs)
    return dm, dn, share[..., None] * np.array([float(sign) for *_, sign in signs])


def _link(rows: DiscOrders, columns: DiscOrders, shells: Array) -> DiscLink:
    dm, dn, weight = _images(rows, columns)
    square = dm * dm + dn * dn
    round_part = np.where(square == 0, 1, square)
    cos2, sin2 = (dm * dm - dn * dn) / round_part, 2 * dm * dn / round_part
    return DiscLink(
        np.searchsorted(shells, square), weight, weight * cos2, weight * sin2
    )


EX, EY, EZ, MIXED = range(4)  # places in Basis.links


def toeplitz_matrix(space: DiscBasis, coefficients: Array, link: int) -> Array:
    """Matrix of the product with a round function: (*batch, shells) Fourier
    coefficients -> (*batch, k, k).
    """
    pair = space.links[link]
    return np.asarray(
        np.einsum("...ijg,ijg->...ij", coefficients[..., pair.shell], pair.weight)
    )


def disc_coefficients(space: DiscBasis, diameter_um: Array, pitch_um: float) -> Array:
    """Fourier coefficients of the indicator of a disc: f 2 J1(x)/x, x = pi D |G| /
    pitch, f its share of the cell.

    diameter_um: (*batch,), real or complex. Returns (*batch, shells).
    """
    radius = np.pi * np.asarray(diameter_um)[..., None] / pitch_um
    x = np.sqrt(space.shells) * radius
    share = radius**2 / (4 * np.pi)
    safe = np.where(x == 0, 1.0, x)
    return np.asarray(share * np.where(x == 0, 1.0, 2 * _bessel(1, safe) / safe))


def _bessel(order: int, x: Array) -> Array:
    if np.iscomplexobj(x) or order > 1:
        return np.asarray(jv(order, x))
    return np.asarray(j1(x) if order else j0(x))


def disc_normal_matrices(
    space: DiscBasis, diameter_um: Array, pitch_um: float
) -> tuple[Array, Array, Array]:
    """Matrices (xx, yy, xy) of a field N that is n n^T of the radial unit field at the
    rim and outside the disc.

    Inside it is (r/R)² n n^T = (r r^T)/R², smooth at the centre: what is taken off n
    n^T there, (1 - r²/R²) n n^T,
    has the Fourier coefficients pi R² (a + b cos 2f, b sin 2f, a - b cos 2f) with
    Bessel functions a, b of x = |G| R.
    (Half the worst truncation error of n n^T, whose centre is singular.)
    """
    radius = np.pi * np.asarray(diameter_um)[..., None] / pitch_um
    x, y, small = _argument(space, radius)
    j0, j2 = _bessel(0, y), _bessel(2, y)
    share = radius**2 / (4 * np.pi)
    a = share * np.where(small, 0.25 - x**2 / 48, 2 * j2 / y**2)
    b = -share * np.where(small, x**2 / 96, (2 - 2 * j0 - 4 * j2) / y**2)
    xx, yy, xy = (
        whole - part
        for whole, part in zip(space.normal, _directed(space, a, b), strict=True)
    )
    return xx, yy, xy


def _argument(space: DiscBasis, radius: Array) -> tuple[Array, Array, Array]:
    x = np.sqrt(space.shells) * radius
    small = np.abs(x) < 0.01
    return x, np.where(small, 1.0, x), small


def _directed(space: DiscBasis, a: Array, b: Array) -> tuple[Array, Array, Array]:
    """Matrices of the functions with coefficients a + b cos 2f, a - b cos 2f and b sin
    2f: (xx, yy, xy).
    """
    taken = []
    for link, sign in ((EX, 1), (EY, -1)):
        pair = space.links[link]
        isotropic = toeplitz_matrix(space, a, link)
        directed = np.einsum("...ijg,ijg->...ij", b[..., pair.shell], pair.cos2)
        taken.append(isotropic + sign * directed)
    pair = space.links[MIXED]
    return (
        taken[0],
        taken[1],
        np.einsum("...ijg,ijg->...ij", b[..., pair.shell], pair.sin2),
    )


def _normal(ex: DiscOrders, ey: DiscOrders, reach: int) -> tuple[Array, Array, Array]:
    even, odd = _radial_field(reach)

    def matrix(
        rows: DiscOrders, columns: DiscOrders, table: Array, odd_in_both: bool
    ) -> Array:
        dm, dn, weight = _images(rows, columns)
        sign = np.sign(dm) * np.sign(dn) if odd_in_both else 1.0
        return np.asarray((table[np.abs(dm), np.abs(dn)] * sign * weight).sum(axis=-1))

    return (
        matrix(ex, ex, even, odd_in_both=False),
        matrix(ey, ey, even.T, odd_in_both=False),
        matrix(ex, ey, odd, odd_in_both=True),
    )


def _radial_field(reach: int) -> tuple[Array, Array]:
    """Fourier coefficients of x²/r² and x y/r² over the unit cell, orders 0..reach on
    both axes.

    Each eighth of the cell is mapped to a square (x = s, y = s v), where the field
    depends on v alone and the
    integrand is smooth: Gauss-Legendre is exact to rounding.
    """
    nodes, weights = np.polynomial.legendre.leggauss(3 * reach // 2 + 30)
    s, ws = (nodes + 1) / 4, weights / 4
    v, wv = (nodes + 1) / 2, weights / 2
    angle = 2 * np.pi * np.arange(reach + 1)
    along = angle[:, None] * s
    across = angle[:, None, None] * (s[:, None] * v)
    area = 4 * ws * s
    near, far = (
        wv / (1 + v * v),
        wv * v * v / (1 + v * v),
    )  # x² / r² where x > y, and where y > x
    even = (np.cos(along) * area) @ (np.cos(across) @ near).T + (
        np.cos(across) @ far
    ) @ (np.cos(along) * area).T
    mixed = (np.sin(along) * area) @ (np.sin(across) @ (wv * v / (1 + v * v))).T
    return even, -(mixed + mixed.T)
