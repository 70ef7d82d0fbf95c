"""Changes of P and Q for changes of rims and permittivities.

With [.] a matrix of coefficients, E = [eps] - (Delta N + N Delta) / 2, Delta = [eps] -
[1/eps]^-1 and the field N of
normals held (see :mod:`metalens.rcwa.pattern`),

    dE = [d eps] - (dDelta N + N dDelta) / 2,    dDelta = [d eps] + [1/eps]^-1 [d(1/eps)] [1/eps]^-1,
    dP = K [eps]^-1 [d eps] [eps]^-1 K.

N is held because it may be any field: t has the same limit, and its rate has. Rows and
columns may be of two symmetry
classes: a change of less symmetry than the section couples them.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from metalens.cell import Cell
from metalens.cell.shapes import motion
from metalens.core.arrays import Array
from metalens.rcwa import pattern
from metalens.rcwa.orders import mirrors
from metalens.rcwa.orders.mirrors import Operation, ReducedOrders
from metalens.rcwa.orders.waves import PlaneWaves

Tables = tuple[
    Array, Array
]  # derivatives of the coefficients of eps and 1/eps, over m, n from -2 reach to 2 reach
Change = tuple[Array, Array]  # dP between the Ez waves, where alone it is not 0; dQ
_NONE = 1e-13  # of a table: rounding


@dataclass(frozen=True, eq=False, slots=True)
class SectionMatrices:
    """Matrices of a cross-section in one symmetry class.

    stiff: [1/eps]^-1 in the orders of Ex, Ey; normals: of N, by rows and columns;
    upright: [eps]^-1 of Ez.
    """

    space: ReducedOrders
    ways: PlaneWaves
    operations: tuple[Operation, ...]
    stiff: tuple[Array, Array]
    normals: tuple[tuple[Array, Array], tuple[Array, Array]]
    upright: Array


def section_matrices(
    space: ReducedOrders,
    ways: PlaneWaves,
    operations: tuple[Operation, ...],
    this: pattern.PillarSection,
    cell: Cell,
) -> SectionMatrices:
    """Of a slab."""
    direct, inverse = pattern.permittivity_coefficients(this, cell, space.reach)
    xx, yy, xy = pattern.normal_tables(this.outlines, cell, space.reach)
    first, second = (
        np.linalg.inv(mirrors.toeplitz_product(space, inverse, link)) for link in (0, 1)
    )
    nx, ny, mixed = (
        mirrors.toeplitz_product(space, xx, 0),
        mirrors.toeplitz_product(space, yy, 1),
        mirrors.toeplitz_product(space, xy, 3),
    )
    upright = np.linalg.inv(mirrors.toeplitz_product(space, direct, 2))
    return SectionMatrices(
        space,
        ways,
        operations,
        (first, second),
        ((nx, mixed), (mixed.conj().T, ny)),
        upright,
    )


def section_parameters(this: pattern.PillarSection) -> Array:
    """(k,) numbers of all outlines, then the permittivities from the inside out."""
    return np.concatenate(
        [
            *(motion.shape_parameters(outline) for outline in this.outlines),
            this.inside,
            [this.outside],
        ]
    )


def coefficient_rates(
    this: pattern.PillarSection, cell: Cell, reach: tuple[int, int], rates: Array
) -> Tables:
    """Derivatives of the coefficients of eps and 1/eps, as :func:`section_parameters`
    change at
    these rates.
    """
    x, y = cell.lattice.periods_um(cell.pitch_um)
    m, n = (np.arange(-2 * r, 2 * r + 1) for r in reach)
    gx, gy = (
        g.ravel()
        for g in np.meshgrid(2 * np.pi / x * m, 2 * np.pi / y * n, indexing="ij")
    )
    area = cell.lattice.area_um2(cell.pitch_um)
    eps, by_eps = np.array([*this.inside, this.outside]), rates[-1 - len(this.inside) :]
    filled = [
        np.zeros(len(gx)),
        *(outline.fourier(gx, gy) / area for outline in this.outlines),
        (gx == 0) & (gy == 0),
    ]
    shares = np.diff(np.array(filled, complex), axis=0)
    direct, inverse = by_eps @ shares, -(by_eps / eps**2) @ shares
    start = 0
    for outline, inner, outer in zip(this.outlines, eps[:-1], eps[1:], strict=True):
        count = len(motion.shape_parameters(outline))
        rim = (
            motion.fourier_shape_derivative(
                outline, gx, gy, rates[start : start + count]
            )
            / area
        )
        direct, inverse = (
            direct + (inner - outer) * rim,
            inverse + (1 / inner - 1 / outer) * rim,
        )
        start += count
    return direct.reshape(len(m), len(n)), inverse.reshape(len(m), len(n))


def operator_rates(
    rows: SectionMatrices, columns: SectionMatrices, tables: Tables
) -> Change | None:
    """dP and dQ for these derivatives of the coefficients; None where they do not
    couple the classes.
    """
    direct, inverse = (_coupling(rows, columns, table) for table in tables)
    if max(np.abs(direct).max(), np.abs(inverse).max()) <= _NONE * max(
        np.abs(table).max() for table in tables
    ):
        return None
    pairs = [
        [getattr(part.space, name) for part in (rows, columns)]
        for name in ("ex", "ey", "ez")
    ]
    links = [
        mirrors.link_sets(row, column, columns.operations, rows.space.reach)
        for row, column in pairs
    ]
    plain = [mirrors.product_by(link, direct) for link in links]
    bend = [mirrors.product_by(link, inverse) for link in links[:2]]
    delta = [plain[k] + rows.stiff[k] @ bend[k] @ columns.stiff[k] for k in (0, 1)]
    blocks = [
        [
            -0.5 * (delta[k] @ columns.normals[k][j] + rows.normals[k][j] @ delta[j])
            for j in (0, 1)
        ]
        for k in (0, 1)
    ]
    whole = np.block(
        [
            [blocks[0][0] + plain[0], blocks[0][1]],
            [blocks[1][0], blocks[1][1] + plain[1]],
        ]
    )
    left, right = (csr_array(part.ways.fold.T) for part in (rows, columns))
    down, across = (
        part.ways.kappa[part.ways.bare : part.ways.p_count] for part in (rows, columns)
    )
    dP = down[:, None] * (rows.upright @ plain[2] @ columns.upright) * across
    return dP, (right @ (left @ whole).T).T


def _coupling(rows: SectionMatrices, columns: SectionMatrices, table: Array) -> Array:
    """The part of a function that turns the fields of one class into those of the
    other.
    """
    images = [
        sign[0] * other[0] * table[::sx, ::sy]
        for (sx, sy, sign), (_, _, other) in zip(
            rows.operations, columns.operations, strict=True
        )
    ]
    return pattern.without_rounding(np.mean(images, axis=0))
