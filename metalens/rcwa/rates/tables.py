"""From the weights of P and Q to those of the Fourier coefficients of eps and 1/eps, of outlines and permittivities.

With [.] a matrix of coefficients, E = [eps] - (Delta N + N Delta) / 2, Delta = [eps] - [1/eps]^-1 and the normal field N
held (see :mod:`metalens.rcwa.pattern`),

    dE = [d eps] - (dDelta N + N dDelta) / 2,    dDelta = [d eps] + [1/eps]^-1 [d(1/eps)] [1/eps]^-1,
    dP = K [eps]^-1 [d eps] [eps]^-1 K.

N is held because it may be any field: t has the same limit, and its rate has. Rows and columns may be of two symmetry
classes: a change of less symmetry than the section couples them.
"""

from dataclasses import dataclass

import numpy as np

from metalens.cell import Cell
from metalens.cell.shapes import motion
from metalens.ground.arrays import Array
from metalens.rcwa import pattern
from metalens.rcwa.orders import mirrors
from metalens.rcwa.orders.mirrors import Operation, Orders
from metalens.rcwa.orders.waves import Waves
from metalens.rcwa.rates.kernels import Weight, times


@dataclass(frozen=True, eq=False, slots=True)
class Section:
    """Matrices of a cross-section in one symmetry class.

    stiff: [1/eps]^-1 in the orders of Ex, Ey; normals: of N, by rows and columns; upright: [eps]^-1 of Ez.
    """

    space: Orders
    ways: Waves
    operations: tuple[Operation, ...]
    stiff: tuple[Array, Array]
    normals: tuple[tuple[Array, Array], tuple[Array, Array]]
    upright: Array


def section(
    space: Orders, ways: Waves, operations: tuple[Operation, ...], this: pattern.Slab, cell: Cell
) -> Section:
    """Of a slab."""
    direct, inverse = pattern.tables(this, cell, space.reach)
    xx, yy, xy = pattern.normal_tables(this.outlines, cell, space.reach)
    first, second = (np.linalg.inv(mirrors.product(space, inverse, link)) for link in (0, 1))
    nx, ny, mixed = mirrors.product(space, xx, 0), mirrors.product(space, yy, 1), mirrors.product(space, xy, 3)
    upright = np.linalg.inv(mirrors.product(space, direct, 2))
    return Section(space, ways, operations, (first, second), ((nx, mixed), (mixed.conj().T, ny)), upright)


def pulled(rows: Section, columns: Section, weight: Weight) -> tuple[Array, Array]:
    """Weights of the coefficients of eps and of 1/eps, over m, n from -2 reach to 2 reach."""
    from scipy.sparse import csr_array

    ex = len(rows.space.ex.m), len(columns.space.ex.m)
    left, right = (csr_array(part.ways.fold) for part in (rows, columns))
    whole = (right @ (left @ weight.of_Q).T).T
    halves = ((whole[: ex[0], : ex[1]], whole[: ex[0], ex[1] :]), (whole[ex[0] :, : ex[1]], whole[ex[0] :, ex[1] :]))
    direct, inverse = [], []
    for k in (0, 1):
        # dDelta_k stands in E_kj before N_kj and in E_jk behind N_jk
        delta = -0.5 * sum(
            times(halves[k][j], columns.normals[k][j].T) + times(rows.normals[j][k].T, halves[j][k]) for j in (0, 1)
        )
        direct.append(halves[k][k] + delta)
        inverse.append(times(times(rows.stiff[k].T, delta), columns.stiff[k].T))
    down, across = (slice(ways.bare, ways.p_count) for ways in (rows.ways, columns.ways))
    scaled = rows.ways.kappa[down, None] * weight.of_P[down, across] * columns.ways.kappa[across]
    direct.append(times(times(rows.upright.T, scaled), columns.upright.T))
    return _tabled(rows, columns, direct), _tabled(rows, columns, inverse)


def _tabled(rows: Section, columns: Section, parts: list[Array]) -> Array:
    """The transpose of ``mirrors.product`` of both Ex, both Ey and both Ez, for functions that couple the classes."""
    reach = rows.space.reach
    shape = (4 * reach[0] + 1, 4 * reach[1] + 1)
    table = np.zeros(shape[0] * shape[1], complex)
    for field, part in enumerate(parts):
        pair = [(space.ex, space.ey, space.ez)[field] for space in (rows.space, columns.space)]
        link = mirrors.link(pair[0], pair[1], columns.operations, reach)
        values = part[..., None] * link.weight
        place = link.place.ravel()
        table += np.bincount(place, values.real.ravel(), len(table))
        table += 1j * np.bincount(place, values.imag.ravel(), len(table))
    whole, images = table.reshape(shape), []
    for (sx, sy, sign), (_, _, other) in zip(rows.operations, columns.operations, strict=True):
        images.append(sign[0] * other[0] * whole[::sx, ::sy])
    return np.asarray(np.mean(images, axis=0))


def numbers(this: pattern.Slab) -> Array:
    """(k,) numbers of all outlines, then the permittivities from the inside out."""
    return np.concatenate([*(motion.numbers(outline) for outline in this.outlines), this.inside, [this.outside]])


def gradient(this: pattern.Slab, cell: Cell, weights: tuple[Array, Array]) -> Array:
    """(k,) derivatives of sum(weight * coefficient) by :func:`numbers`."""
    direct, inverse = (table.ravel() for table in weights)
    m, n = ((len(weights[0]) - 1) // 2, (weights[0].shape[1] - 1) // 2)
    x, y = cell.lattice.periods_um(cell.pitch_um)
    gx, gy = np.meshgrid(2 * np.pi / x * np.arange(-m, m + 1), 2 * np.pi / y * np.arange(-n, n + 1), indexing="ij")
    gx, gy, area = gx.ravel(), gy.ravel(), cell.lattice.area_um2(cell.pitch_um)
    by_rim, shares = [], []
    beyond = (*this.inside[1:], this.outside)
    for outline, inner, outer in zip(this.outlines, this.inside, beyond, strict=True):
        weight = ((inner - outer) * direct + (1 / inner - 1 / outer) * inverse) / area
        by_rim.append(motion.pulled(outline, gx, gy, weight))
        shares.append(outline.fourier(gx, gy) / area)
    shares.append(np.asarray((gx == 0) & (gy == 0), complex))
    filled = [shares[0], *(high - low for low, high in zip(shares[:-1], shares[1:], strict=True))]
    by_eps = [
        (share * (direct - inverse / eps**2)).sum()
        for share, eps in zip(filled, (*this.inside, this.outside), strict=True)
    ]
    return np.concatenate([*by_rim, by_eps])
