"""The arrays of a windowed propagation: plane waves, the low-rank correction, and the
fields that span all depths.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from metalens.core import legendre
from metalens.core.arrays import Array
from metalens.propagate.geometry import PropagationCase
from metalens.propagate.nodes import NodeCounts
from metalens.propagate.paths import (
    chief_path,
    cosine_y,
    direction_range,
    from_source,
    kernel_derivatives,
    plane_wave_residual,
    ray_cosines,
    reference_depth,
)


@dataclass(frozen=True, eq=False, slots=True)
class DepthBasis:
    """Fields on the lens nodes that span the curvatures of all depths.

    basis: (b, e, x); coefficients: (depth, b); strength: (b,).
    """

    basis: Array
    coefficients: Array
    strength: Array


@dataclass(frozen=True, eq=False, slots=True)
class TileOperators:
    """Arrays of one tile, complex128 and float64; e = lens row nodes, x = lens column
    nodes, p = directions.

    to_directions: (e, x, p); along_y: (p, Y, e); along_x: (X, p).
    lens_terms: (p, e, r), window_terms: (X, Y, r) of the correction; strength: (r,).
    """

    to_directions: Array
    along_y: Array
    along_x: Array
    lens_terms: Array
    window_terms: Array
    strength: Array


def depth_factors(
    case: PropagationCase, e: Any, x: Any, tangents: Any, inverse: Any
) -> Any:
    """k(s_z - s_ref) on the lens nodes (depth, e, x), rad; numpy or torch operands.

    Args:
        case: geometry of the propagation.
        tangents: (x, y) of the field angle, in air.
        inverse: 1 / depth of the source, 1/um.
    """
    reference = from_source(case, x, e, case.tangents, reference_depth(case))
    return case.wavenumber * (from_source(case, x, e, tangents, inverse) - reference)


def depth_basis(
    case: PropagationCase,
    nodes_um: tuple[Array, Array],
    tolerance: float,
    *,
    moving: bool = False,
) -> DepthBasis:
    """Few fields that span the curvatures of all depths.

    With ``moving`` they also span the derivatives in inverse depth and tangents.
    Orthonormal under the quadrature of
    the nodes; truncated at ``tolerance`` root mean square.

    Args:
        case: geometry of the propagation.
        nodes_um: (e,) and (x,) positions on the lens.
    """
    e, x = nodes_um[0][:, None], nodes_um[1]
    weight = np.sqrt(
        np.outer(
            legendre.gauss_legendre_nodes(len(e))[1],
            legendre.gauss_legendre_nodes(len(x))[1],
        )
    )
    inverse = np.array(case.inverse_depths_per_um)
    count = 48
    # until the rank says that no depth lies between the nodes: they need pi a period,
    # the fields two
    while True:
        few = len(inverse) > count
        training = (
            np.clip(legendre.mapped_nodes(count, inverse.min(), inverse.max()), 0, None)
            if few
            else inverse
        )
        fields = (
            np.exp(
                1j * depth_factors(case, e, x, case.tangents, training[:, None, None])
            )
            * weight
        )
        if moving:
            fields = np.concatenate(
                [fields, *_tangents(case, e, x, training[:, None, None], fields)]
            )
        _, size, v = np.linalg.svd(fields.reshape(len(fields), -1), full_matrices=False)
        tail = np.sqrt(np.cumsum(size[::-1] ** 2)[::-1] / (size**2).sum())
        rank = int(max(1, (tail > tolerance).sum()))
        if not few or rank <= 2 / np.pi * count:
            break
        count *= 2
    basis = v[:rank].reshape(rank, len(e), len(x))
    coefficients = np.empty((len(inverse), rank), complex)
    for start in range(0, len(inverse), 16):
        part = inverse[start : start + 16, None, None]
        fields = np.exp(1j * depth_factors(case, e, x, case.tangents, part)) * weight
        coefficients[start : start + 16] = (
            fields.reshape(len(part), -1) @ basis.reshape(rank, -1).conj().T
        )
    return DepthBasis(
        np.asarray(basis / weight), coefficients, np.asarray(size[:rank] / size[0])
    )


def _tangents(
    case: PropagationCase, e: Array, x: Array, inverse: Array, fields: Array
) -> list[Array]:
    """Derivatives of the depth fields in inverse depth and the tangents, each of the
    fields' own norm; complex step.
    """
    out = []
    h = 1e-30
    for step in ((0, 0, 1j * h), (1j * h, 0, 0), (0, 1j * h, 0)):
        tangents = case.tangents[0] + step[0], case.tangents[1] + step[1]
        slope = (
            case.wavenumber
            * from_source(case, x, e, tangents, inverse + step[2]).imag
            / h
        )
        slope = np.broadcast_to(slope, fields.shape)
        scale = np.sqrt(
            (np.abs(slope * fields) ** 2).sum() / (np.abs(fields) ** 2).sum()
        )
        if scale > 0:
            out.append(1j * slope / scale * fields)
    return out


def significant_pairs(strength: Array, size: Array, tolerance: float) -> Array:
    """(2, n) pairs (correction term, depth field) whose joint strength matters; the
    rest sums below tolerance.

    Args:
        size: strengths of the depth fields.
    """
    joint = (np.outer(strength, size) ** 2).ravel()
    order = np.argsort(joint)
    least = np.cumsum(joint[order]) <= tolerance**2 * joint.sum()
    kept = np.sort(order[~least])
    return np.stack(np.unravel_index(kept, (len(strength), len(size))))


def build_operators(
    case: PropagationCase,
    chosen: NodeCounts,
    tolerance: float,
    *,
    slope: int | None = None,
) -> TileOperators:
    """All arrays of a tile; ``slope`` 0, 1, 2 gives the derivative in sensor distance,
    window centre x, y instead.

    Args:
        case: geometry of the propagation.
        chosen: counts of nodes and directions.
        tolerance: relative error of the field.
    """
    (ny, nx), m = chosen.nodes, chosen.directions
    high_y, high_x = case.half_size_um
    e, x = (
        legendre.mapped_nodes(ny, -high_y, high_y),
        legendre.mapped_nodes(nx, -high_x, high_x),
    )
    low, high = direction_range(case, e)
    p = legendre.mapped_nodes(m, low, high)
    far = (e - case.centre_um[1])[:, None]
    towards = ray_cosines(case, x - case.centre_um[0], far)
    y_um, x_um = case.window_um
    k = case.wavenumber
    q = cosine_y(case, p[:, None], e[None, :])
    lens_terms, window_terms, strength = _low_rank(
        case, chosen, tolerance / 2, (low, high), slope
    )
    return TileOperators(
        to_directions=legendre.interpolation_matrix(
            m, (2 * towards - low - high) / (high - low)
        ),
        along_y=np.exp(-1j * k * y_um[:, None] * q[:, None, :]),
        along_x=np.exp(-1j * k * x_um[:, None] * p),
        lens_terms=lens_terms,
        window_terms=window_terms * np.exp(1j * k * chief_path(case)),
        strength=strength,
    )


def _low_rank(
    case: PropagationCase,
    chosen: NodeCounts,
    tolerance: float,
    span: tuple[float, float],
    slope: int | None,
) -> tuple[Array, Array, Array]:
    """Correction as Σ_r lens_terms[p, e, r] window_terms[X, Y, r], pillar area
    included; and strengths (r,).
    """
    (wy, wx), (hy, _) = case.half_window_um, case.half_size_um
    (my, mx), (me, mp) = chosen.window, chosen.lens
    Y, X = legendre.mapped_nodes(my, -wy, wy), legendre.mapped_nodes(mx, -wx, wx)
    e, p = legendre.mapped_nodes(me, -hy, hy), legendre.mapped_nodes(mp, *span)
    at = (p[:, None], e[None, :], X[:, None, None], Y[:, None, None, None])
    table = plane_wave_residual(case, *at)
    if slope is not None:
        table = table * kernel_derivatives(case, *at)[slope]
    left, right = _factors(table.reshape(my * mx, mp * me) * case.area_um2, tolerance)
    y_um, x_um = case.window_um
    Iy, Ix = (
        legendre.interpolation_matrix(my, y_um / wy),
        legendre.interpolation_matrix(mx, x_um / wx),
    )
    window_terms = np.einsum(
        "Yj,jir,Xi->XYr", Iy, left.reshape(my, mx, -1), Ix, optimize=True
    )
    e_um = legendre.gauss_legendre_nodes(chosen.nodes[0])[0]
    p_um = legendre.gauss_legendre_nodes(chosen.directions)[0]
    Ie, Ip = (
        legendre.interpolation_matrix(me, e_um),
        legendre.interpolation_matrix(mp, p_um),
    )
    lens_terms = np.einsum(
        "Pp,rpe,Ee->PEr", Ip, right.reshape(-1, mp, me), Ie, optimize=True
    )
    return lens_terms, window_terms, np.linalg.norm(left, axis=0)


def _factors(table: Array, tolerance: float) -> tuple[Array, Array]:
    """table ≈ left (row, r) @ right (r, column) within ``tolerance`` in the Frobenius
    norm; randomised range finder.
    """
    random = np.random.default_rng(0)
    total = np.linalg.norm(table)
    rank = min(16, *table.shape)
    while True:
        left = np.linalg.qr(table @ random.standard_normal((table.shape[1], rank)))[0]
        right = left.conj().T @ table
        if (
            rank == min(table.shape)
            or np.linalg.norm(table - left @ right) <= tolerance * total / 4
        ):
            break
        rank = min(2 * rank, *table.shape)
    u, size, v = np.linalg.svd(right, full_matrices=False)
    tail = np.sqrt(np.cumsum(size[::-1] ** 2)[::-1]) / total
    keep = int(max(1, (tail > tolerance).sum()))
    return left @ u[:, :keep] * size[:keep], v[:keep]
