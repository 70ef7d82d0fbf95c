"""Modes of a homogeneous layer in the element space: the basis of everything else."""

from dataclasses import dataclass

import numpy as np

from metalens.modal.dense import (
    cholesky_factor,
    congruence_product,
    eigen_pairs,
    gram_matrix,
    solve_lower,
)
from metalens.modal.spaces import SymmetryClass

# half Bloch phases below it lose digits in the squared problem of the gradients
SMALL_PHASE_RAD = 0.05


@dataclass(frozen=True, eq=False, slots=True)
class HomogeneousBasis:
    """Mass-orthonormal modes of the empty cell, lengths in half pitches.

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


def gradient_modes(space: SymmetryClass) -> tuple[np.ndarray, np.ndarray]:
    """Transverse wavenumbers squared (b,) and scalar fields (n, b) of the TM modes.

    From singular values, which keep all digits of a nearly uniform field.

    Args:
        space: the symmetry class.
    """
    lower = cholesky_factor(space.cell.scalar)
    field = cholesky_factor(space.cell.mass).T @ space.gradient
    _, value, right = np.linalg.svd(solve_lower(lower, field.T).T, full_matrices=False)
    return value[::-1] ** 2, solve_lower(lower, right[::-1].T, transposed=True)


def homogeneous_modes(space: SymmetryClass) -> HomogeneousBasis:
    """Eigenmodes of the empty cell in the basis of cotree unknowns and gradients.

    The curl acts on the cotree unknowns alone. With G the gradients, K = G^T mass G,
    the TM modes solve K f = tm scalar f, and the TE modes are x on the cotree less its
    projection on the gradients: curl_cc x = te (mass_cc - mass_cG K^-1 mass_Gc) x.

    Args:
        space: the symmetry class.

    Accuracy: the difference loses digits, 1e-8 of t at worst.
    """
    cotree, gradient_transposed = space.cotree, space.transposed
    corner = cotree[:, None], cotree
    mass = (gradient_transposed @ space.cell.mass).T
    if 0 < (space.half_phase_rad or 0.0) < SMALL_PHASE_RAD:
        tm, scalar = gradient_modes(space)
    else:
        tm, scalar = eigen_pairs(gradient_transposed @ mass, space.cell.scalar)
    normalized = scalar / np.sqrt(tm)
    coupling = normalized.T @ mass[cotree].T
    te, x = eigen_pairs(
        space.cell.curl[corner], space.cell.mass[corner] - gram_matrix(coupling)
    )
    tm_fields = gradient_transposed.T @ normalized
    te_fields = -tm_fields @ (coupling @ x)
    te_fields[cotree] += x
    return HomogeneousBasis(
        te=np.maximum(te, 0.0),
        tm=tm,
        te_exact=exact_zero_order(te, space.half_phase_rad),
        tm_exact=exact_zero_order(tm, space.half_phase_rad),
        disc_mass=congruence_product(
            space.disc.mass, np.concatenate([te_fields, tm_fields], 1)
        ),
        disc_curl=congruence_product(space.disc.curl[corner], x),
        disc_scalar=congruence_product(space.disc.scalar, scalar),
    )
