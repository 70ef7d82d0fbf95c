"""Fourier orders of any lattice, reduced by whatever mirrors and half turns shape,
lattice and light share.

The fields of a case are carried by its operations g into themselves with a sign for
each of Ex, Ey, Ez, Hz; one
amplitude stands for an orbit of orders. The rectangle of a hexagonal lattice holds two
sites: orders with m + n even.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from metalens.core.arrays import Array

Sign = tuple[int, int, int, int]  # of Ex, Ey, Ez, Hz
Operation = tuple[int, int, Sign]  # (x, y) -> (sx x, sy y)
IDENTITY: Operation = (1, 1, (1, 1, 1, 1))
# An electric field along x (or y) that a mirror leaves as it is has Ex (or Ey) even;
# see basis._PARITY.
FLIP_X = {"x": (-1, 1, (1, -1, -1, 1)), "y": (-1, 1, (-1, 1, 1, -1))}
FLIP_Y = {"x": (1, -1, (1, -1, 1, -1)), "y": (1, -1, (-1, 1, -1, 1))}
HALF_TURN: Operation = (-1, -1, (1, 1, -1, -1))


@dataclass(frozen=True, slots=True)
class LatticeFrame:
    """What the orders depend on: edges of the rectangle that repeats over the pitch,
    centred or not, operations.
    """

    along: float
    across: float
    centred: bool
    operations: tuple[Operation, ...]


@dataclass(frozen=True, eq=False, slots=True)
class OrderSet:
    """Amplitudes of one scalar field: (k,) orders m, n, sizes of their orbits, sign of
    each operation.
    """

    m: Array
    n: Array
    size: Array
    signs: tuple[int, ...]


@dataclass(frozen=True, eq=False, slots=True)
class OrderLink:
    """How a function couples two sets: (k, l, operations) places in its table of
    coefficients, and weights.
    """

    place: Array
    weight: Array


@dataclass(frozen=True, eq=False, slots=True)
class ReducedOrders:
    """The reduced sets of one truncation; coefficients are tabled over m, n from -2
    reach to 2 reach.
    """

    ex: OrderSet
    ey: OrderSet
    ez: OrderSet
    hz: OrderSet
    reach: tuple[int, int]
    links: tuple[
        OrderLink, OrderLink, OrderLink, OrderLink
    ]  # (ex, ex), (ey, ey), (ez, ez), (ex, ey)


@lru_cache(maxsize=24)
def reduced_orders(harmonics: float, frame: LatticeFrame) -> ReducedOrders:
    """All orders within the circle of radius ``harmonics`` orders of a square lattice
    of this cell's area.
    """
    radius = harmonics / np.sqrt(
        frame.along * frame.across / (2 if frame.centred else 1)
    )
    most = radius * (1 + 1e-9)
    reach = (int(most * frame.along), int(most * frame.across))
    m, n = (
        a.ravel()
        for a in np.meshgrid(*(np.arange(-r, r + 1) for r in reach), indexing="ij")
    )
    keep = (m / frame.along) ** 2 + (n / frame.across) ** 2 <= radius**2 * (1 + 1e-9)
    if frame.centred:
        keep &= (m + n) % 2 == 0
    m, n = m[keep], n[keep]
    ex, ey, ez, hz = (_reduced(m, n, frame.operations, field) for field in range(4))
    pairs = ((ex, ex), (ey, ey), (ez, ez), (ex, ey))
    first, second, third, fourth = (
        link_sets(rows, columns, frame.operations, reach) for rows, columns in pairs
    )
    return ReducedOrders(ex, ey, ez, hz, reach, (first, second, third, fourth))


def _reduced(
    m: Array, n: Array, operations: tuple[Operation, ...], field: int
) -> OrderSet:
    """One order of each orbit; those that an operation keeps but whose field it turns
    into its negative vanish.
    """
    images = np.stack([(sx * m) * 4096 + sy * n for sx, sy, _ in operations])
    own, signs = images[0], tuple(sign[field] for _, _, sign in operations)
    first = own == images.max(axis=0)
    dead = ((images == own) & (np.array(signs)[:, None] < 0)).any(axis=0)
    keep = first & ~dead
    size = np.array([len(set(column)) for column in images[:, keep].T], int)
    return OrderSet(m[keep], n[keep], size, signs)


def link_sets(
    rows: OrderSet,
    columns: OrderSet,
    operations: tuple[Operation, ...],
    reach: tuple[int, int],
) -> OrderLink:
    """How a function couples two sets; it must turn the fields of the columns into
    those of the rows.

    Rows and columns of one class take functions that all operations leave as they are.
    Of classes that differ by the
    sign s(g) of each operation, functions with f(g r) = s(g) f(r).
    """
    dm = np.stack(
        [rows.m[:, None] - sx * columns.m for sx, _, _ in operations], axis=-1
    )
    dn = np.stack(
        [rows.n[:, None] - sy * columns.n for _, sy, _ in operations], axis=-1
    )
    share = np.sqrt(rows.size[:, None] * columns.size) / len(operations)
    place = (dm + 2 * reach[0]) * (4 * reach[1] + 1) + dn + 2 * reach[1]
    return OrderLink(place, share[..., None] * np.array(columns.signs, float))


def toeplitz_product(space: ReducedOrders, table: Array, pair: int) -> Array:
    """(k, l) matrix of the product with a function of these coefficients ((2 m reach) x
    (2 n reach) table).
    """
    return product_by(space.links[pair], table)


def product_by(pair: OrderLink, table: Array) -> Array:
    """The same for any two sets."""
    return np.asarray(np.einsum("ijg,ijg->ij", table.ravel()[pair.place], pair.weight))
