"""Symmetry classes of the cell, and their homogeneous modes: the field of the whole
cell from the real matrices of its quarter.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.linalg as sl
from scipy.sparse import csr_array

from metalens.modal.mesh import (
    X0,
    X1,
    Y0,
    Y1,
    CellMatrices,
    MeshPlan,
    assemble_disc,
    build_mesh,
    gradient_matrix,
)

Unknowns = tuple[np.ndarray, np.ndarray]  # places of the functions, complex weights


def select_functions(
    wall: np.ndarray, *, electric: bool, half_phase_rad: float | None
) -> Unknowns:
    """Unknowns of a Bloch wave with phase ``2 half_phase_rad`` over a pitch, or with
    electric x walls for None.

    The field is the sum over the real unknowns of u times a weight times a function:
    real parts inside and at x = 0, imaginary parts inside, and the moduli at x = pitch
    / 2, where the field has half the phase.

    Args:
        wall: bits of each quarter-cell function. electric: whether the y walls are
            electric.
        half_phase_rad: phase over half a pitch.

    Returns:
        Place of the function and weight of each unknown, (n,) each.
    """
    free = (wall & (Y0 | Y1)) == 0 if electric else np.ones(len(wall), bool)
    at_start, at_end = (wall & X0) != 0, (wall & X1) != 0
    inside, start, end = (
        np.flatnonzero(free & part) for part in (~at_start & ~at_end, at_start, at_end)
    )
    if half_phase_rad is None:
        return inside, np.ones(len(inside))
    groups = (inside, 1), (start, 1), (inside, 1j), (end, np.exp(1j * half_phase_rad))
    return (
        np.concatenate([places for places, _ in groups]),
        np.concatenate([np.full(len(places), weight) for places, weight in groups]),
    )


def restrict_matrix(
    matrix: np.ndarray, rows: Unknowns, columns: Unknowns
) -> np.ndarray:
    """Quarter-cell ``matrix``, acting on the unknowns ``rows`` and ``columns``."""
    restricted = matrix.take(rows[0], 0).take(columns[0], 1)
    if np.isrealobj(rows[1]):
        return restricted
    weight = np.outer(rows[1].real, columns[1].real)
    weight += np.outer(rows[1].imag, columns[1].imag)
    return np.asarray(restricted * weight)


@dataclass(frozen=True, eq=False, slots=True)
class SymmetryClass:
    """Part of a symmetry class that holds for all diameters.

    vectors, scalars: unknowns, see :func:`select_functions`. gradient: sparse.
    cotree: unknowns that with all gradients make a well-conditioned basis (those of the
        edges off a spanning tree).
    """

    vectors: Unknowns
    scalars: Unknowns
    gradient: csr_array
    cotree: np.ndarray


@lru_cache(maxsize=32)
def symmetry_class(
    plan: MeshPlan,
    electric: bool,
    half_phase_rad: float | None,
    typical_rho: float = 0.5,
) -> SymmetryClass:
    """Unknowns, gradient and cotree of a symmetry class; cached.

    The cotree follows from QR with pivoting of the gradients, weighted by the mass of a
    typical disc.

    Args:
        plan: of the mesh. electric: whether the y walls are electric, else natural.
        half_phase_rad: Bloch phase over half a pitch, or None.
        typical_rho: diameter of that disc, in pitches.
    """
    mesh = build_mesh(plan)
    vectors, scalars = (
        select_functions(wall, electric=electric, half_phase_rad=half_phase_rad)
        for wall in (mesh.vector_wall, mesh.scalar_wall)
    )
    gradient = restrict_matrix(gradient_matrix(plan), vectors, scalars)
    mass = restrict_matrix(assemble_disc(typical_rho, plan)[0].mass, vectors, vectors)
    weighted = np.sqrt(mass.diagonal()) * gradient.T
    pivots = sl.qr(weighted, mode="r", pivoting=True)[1]
    cotree = np.sort(pivots[gradient.shape[1] :])
    return SymmetryClass(vectors, scalars, csr_array(gradient), cotree)


@dataclass(frozen=True, eq=False, slots=True)
class HomogeneousBasis:
    """Mass-orthonormal modes of the empty cell, lengths in half pitches: the basis of
    everything else.

    te: (a,) transverse wavenumbers squared, rising. tm: (b,) likewise.
    te_exact, tm_exact: the same with that of the zero order exact.
    disc_mass: (a + b, a + b) mass inside the disc, TE first. disc_curl: (a, a).
    disc_scalar: (b, b) of the longitudinal fields of the TM modes.
    """

    te: np.ndarray
    tm: np.ndarray
    te_exact: np.ndarray
    tm_exact: np.ndarray
    disc_mass: np.ndarray
    disc_curl: np.ndarray
    disc_scalar: np.ndarray

    @property
    def size(self) -> int:
        """Count of the modes."""
        return len(self.te) + len(self.tm)


def exact_zero_order(discrete: np.ndarray, half_phase_rad: float | None) -> np.ndarray:
    """Transverse wavenumbers squared with that of the zero order, where this family has
    it, set to its exact value.

    Args:
        discrete: (n,) of the mesh, rising. half_phase_rad: half the Bloch phase, or
            None.
    """
    exact = (half_phase_rad or 0.0) ** 2
    squares: np.ndarray = np.maximum(discrete, 0.0)
    if abs(squares[0] - exact) <= 0.05 * exact + 1e-9:
        squares[0] = exact
    return squares


def congruence_product(inner: np.ndarray, outer: np.ndarray) -> np.ndarray:
    """outerᵀ inner outer of a semidefinite matrix: rows and columns with zero diagonal
    are zero, and are left out.
    """
    rows = np.flatnonzero(inner.diagonal())
    reduced = outer[rows]
    product: np.ndarray = reduced.T @ (inner[np.ix_(rows, rows)] @ reduced)
    return product


def homogeneous_modes(
    geometry: tuple[CellMatrices, CellMatrices],
    plan: MeshPlan,
    *,
    electric: bool,
    half_phase_rad: float | None,
    small_phase_rad: float = 0.05,
) -> HomogeneousBasis:
    """Eigenmodes of the empty cell in the basis of cotree unknowns and gradients.

    The curl acts on the cotree unknowns alone. With G the gradients, K = G^T mass G,
    the TM modes solve K f = tm scalar f, and the TE modes are x on the cotree less its
    projection on the gradients: curl_cc x = te (mass_cc - mass_cG K^-1 mass_Gc) x.

    Args:
        geometry: matrices of the quarter cell and of its part inside the disc.
        plan: of their mesh. electric: whether the y walls are electric, else natural.
        half_phase_rad: Bloch phase over half a pitch, or None.
        small_phase_rad: phases below it lose digits in the squared problem of the
            gradients.

    Accuracy: the difference loses digits, 1e-8 of t at worst.
    """
    space = symmetry_class(plan, electric, half_phase_rad)
    vectors, scalars, cotree = space.vectors, space.scalars, space.cotree
    whole, disc = geometry
    scalar_mass = restrict_matrix(whole.scalar, scalars, scalars)
    mass = restrict_matrix(whole.mass, vectors, vectors)
    mass_gradient = (space.gradient.T @ mass).T
    if 0 < (half_phase_rad or 0.0) < small_phase_rad:
        # singular values keep all digits of a nearly uniform field
        lower = np.linalg.cholesky(scalar_mass)
        field = np.linalg.cholesky(mass).T @ space.gradient.toarray()
        whitened = sl.solve_triangular(lower, field.T, lower=True)
        left, value, _ = np.linalg.svd(whitened, full_matrices=False)
        tm = value[::-1] ** 2
        scalar = sl.solve_triangular(lower.T, left[:, ::-1])
    else:
        tm, scalar = sl.eigh(space.gradient.T @ mass_gradient, scalar_mass, lower=False)
    normalized = scalar / np.sqrt(tm)
    coupling = normalized.T @ mass_gradient[cotree].T
    corner = np.ix_(cotree, cotree)
    curl, disc_curl = (
        restrict_matrix(part.curl, vectors, vectors)[corner] for part in (whole, disc)
    )
    te, x = sl.eigh(curl, mass[corner] - coupling.T @ coupling, lower=False)
    tm_fields = space.gradient @ normalized
    te_fields = -tm_fields @ (coupling @ x)
    te_fields[cotree] += x
    fields = np.concatenate([te_fields, tm_fields], 1)
    disc_mass = restrict_matrix(disc.mass, vectors, vectors)
    disc_scalar = restrict_matrix(disc.scalar, scalars, scalars)
    return HomogeneousBasis(
        te=np.maximum(te, 0.0),
        tm=tm,
        te_exact=exact_zero_order(te, half_phase_rad),
        tm_exact=exact_zero_order(tm, half_phase_rad),
        disc_mass=congruence_product(disc_mass, fields),
        disc_curl=congruence_product(disc_curl, x),
        disc_scalar=congruence_product(disc_scalar, scalar),
    )
