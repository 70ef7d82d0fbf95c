"""Matrices of the quarter cell with every wall natural: what a geometry costs once, for
all wavelengths.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from metalens.core.errors import CellError
from metalens.modal.mesh import DiscMesh, MeshPatch, MeshPlan, build_mesh


@dataclass(frozen=True, eq=False, slots=True)
class CellMatrices:
    """Mass, curl-curl and scalar mass matrices of a part of the cell."""

    mass: np.ndarray
    curl: np.ndarray
    scalar: np.ndarray


@dataclass(frozen=True, eq=False, slots=True)
class AssembledDisc:
    """One disc in its cell, assembled: reused for every wavelength, height, index,
    angle and polarisation.

    rho: diameter over pitch. cell, disc: matrices of the whole quarter cell and of its
    part inside the disc, in
    half pitches. gradient: (vectors, scalars).
    """

    rho: float
    mesh: DiscMesh
    cell: CellMatrices
    disc: CellMatrices
    gradient: np.ndarray


@dataclass(frozen=True, eq=False, slots=True)
class JacobianMetric:
    """Products of the Jacobian at the points of a patch: contravariant metric times
    area, 1 / area, area.
    """

    xi_xi: np.ndarray
    eta_eta: np.ndarray
    xi_eta: np.ndarray
    inverse_area: np.ndarray
    area: np.ndarray


def jacobian_metric(patch: MeshPatch, rho: float) -> JacobianMetric:
    """Metric of the map from the reference element, at the points of a patch.

    N_i N_j dA = xi_xi a_i a_j + xi_eta (a_i b_j + b_i a_j) + eta_eta b_i b_j.

    Args:
        patch: elements with one reference basis. rho: diameter over pitch.

    Returns:
        Products of the Jacobian, (elements, points) each.
    """
    xi = rho * patch.rho_xi + patch.rest_xi
    eta = rho * patch.rho_eta + patch.rest_eta
    g11 = (xi * xi).sum(-1)
    g22 = (eta * eta).sum(-1)
    g12 = (xi * eta).sum(-1)
    area = np.abs(xi[..., 0] * eta[..., 1] - xi[..., 1] * eta[..., 0])
    inverse = 1 / area
    return JacobianMetric(g22 * inverse, g11 * inverse, -g12 * inverse, inverse, area)


def element_matrices(
    patch: MeshPatch, m: JacobianMetric
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Finite-element matrices of each element of a patch.

    Args:
        patch: elements with one reference basis. m: its metric.

    Returns:
        Mass, curl-curl and scalar mass, (elements, functions, functions) each.
    """
    basis = patch.basis
    weight = basis.weight

    def gram(left: np.ndarray, field: np.ndarray, right: np.ndarray) -> np.ndarray:
        product: np.ndarray = (left * (field * weight)[:, None, :]) @ right.T
        return product

    cross = gram(basis.along_xi, m.xi_eta, basis.along_eta)
    mass = np.concatenate(
        [
            np.concatenate([gram(basis.along_xi, m.xi_xi, basis.along_xi), cross], 2),
            np.concatenate(
                [
                    cross.transpose(0, 2, 1),
                    gram(basis.along_eta, m.eta_eta, basis.along_eta),
                ],
                2,
            ),
        ],
        1,
    )
    curl = basis.curl.T @ gram(basis.turn, m.inverse_area, basis.turn) @ basis.curl
    return mass, curl, gram(basis.scalar, m.area, basis.scalar)


def sum_blocks(numbers: np.ndarray, blocks: np.ndarray, n: int) -> np.ndarray:
    """Sum element blocks into an (n, n) matrix; numbers is (copies, elements,
    functions), blocks shared by copies.
    """
    index = (numbers[..., :, None] * n + numbers[..., None, :]).ravel()
    weights = np.broadcast_to(blocks, (len(numbers), *blocks.shape)).ravel()
    return np.bincount(index, weights, n * n).reshape(n, n)


@lru_cache(maxsize=32)
def gradient_matrix(plan: MeshPlan) -> np.ndarray:
    """Discrete gradient (vectors, scalars): coefficients of the gradients of the scalar
    functions in the vector functions, exact and by topology alone.

    plan: of the mesh.
    """
    mesh = build_mesh(plan)
    gradient = np.zeros((len(mesh.vector_wall), len(mesh.scalar_wall)))
    for patch in mesh.patches:
        rows, columns = np.nonzero(patch.basis.gradient)
        gradient[patch.vector[..., rows], patch.scalar[..., columns]] = (
            patch.basis.gradient[rows, columns]
        )
    return gradient


def integrate_matrices(mesh: DiscMesh, rho: float) -> tuple[CellMatrices, CellMatrices]:
    """Assembled matrices of the quarter cell and of its part inside the disc.

    Args:
        mesh: patches and numbering. rho: diameter over pitch.
    """
    nv, ns = len(mesh.vector_wall), len(mesh.scalar_wall)
    sums = {
        inside: [np.zeros((nv, nv)), np.zeros((nv, nv)), np.zeros((ns, ns))]
        for inside in (True, False)
    }
    for patch in mesh.patches:
        mass, curl, scalar = element_matrices(patch, jacobian_metric(patch, rho))
        total = sums[patch.inside]
        total[0] += sum_blocks(patch.vector, mass, nv)
        total[1] += sum_blocks(patch.vector, curl, nv)
        total[2] += sum_blocks(patch.scalar, scalar, ns)
    disc = CellMatrices(*sums[True])
    outside = sums[False]
    whole = CellMatrices(
        disc.mass + outside[0], disc.curl + outside[1], disc.scalar + outside[2]
    )
    return whole, disc


def assemble_disc(rho: float, plan: MeshPlan) -> AssembledDisc:
    """Finite-element matrices of a disc of radius ``rho`` half pitches on the mesh of a
    ``plan``.

    Raises:
        CellError: the disc is not strictly inside the cell: elements between it and the
            wall would vanish.
    """
    if not (math.isfinite(rho) and 0 < rho < 1):
        raise CellError(
            f"diameter = {rho:.6g} pitches: the elements that follow the disc need one above 0 and below 1; "
            "touching pillars are solved by metalens.rcwa"
        )
    mesh = build_mesh(plan)
    return AssembledDisc(
        rho, mesh, *integrate_matrices(mesh, rho), gradient_matrix(plan)
    )
