"""The layer's equation with its diagonal blocks diagonalised: what finding few modes, and a root, start from.

In the homogeneous basis the layer without absorption couples TE and TM unknowns by one block only, and each diagonal
block is a symmetric definite problem of half the size. In their eigenvectors y,

    growth = diag(sign),   stiffness = diag(sign * level) + [[0, coupling], [couplingᵀ, 0]],   sign = +-1,

so that growth⁻¹ stiffness (whose eigenvalues are -q²) is diagonal but for the coupling, which is weak beside all
levels but the lowest. The magnetic form is taken in its dual unknown, the partner p (tangential E): there
stiffness⁻¹ plays the part of growth and growth⁻¹ that of stiffness, half-space admittances are inverted, and the
reflection changes its sign. It needs no inverse of an indefinite matrix.
"""

from dataclasses import dataclass

import numpy as np

from metalens.modal.homogeneous import Basis, below, definite_inverse
from metalens.modal.layer import Medium


@dataclass(frozen=True, eq=False, slots=True)
class Pencil:
    """Real and symmetric; see the module.

    te (a,), tm (b,): levels. te_sign, tm_sign: of growth. coupling: (a, b).
    te_turn (a, a), tm_turn (b, b): fields of the y in the homogeneous basis. dual: the unknown is the partner.
    """

    te: np.ndarray
    tm: np.ndarray
    te_sign: np.ndarray
    tm_sign: np.ndarray
    coupling: np.ndarray
    te_turn: np.ndarray
    tm_turn: np.ndarray
    dual: bool


def lossless(medium: Medium) -> bool:
    """Whether the layer is one of positive real permittivities, as the definite blocks need."""
    return all(e.imag == 0 and e.real > 0 for e in map(complex, (medium.disc, medium.around)))


def added(matrix: np.ndarray, diagonal: np.ndarray | float) -> np.ndarray:
    """The matrix with a diagonal added in place."""
    matrix.ravel()[:: len(matrix) + 1] += diagonal
    return matrix


def whitened(definite: np.ndarray, inner: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Levels of lowerᵀ inner lower with lower lowerᵀ = definite, and lower⁻ᵀ vectors sqrt(|level|)."""
    lower = np.linalg.cholesky(definite)
    level, vectors = np.linalg.eigh(lower.T @ inner @ lower)
    return level, below(lower, vectors, transposed=True) * np.sqrt(np.abs(level))


def electric_pencil(basis: Basis, medium: Medium) -> Pencil:
    """u = E_t: growth = diag(1, (scalar_eps⁻¹ tm / k0² - 1)⁻¹ negative), stiffness = curl - k0² mass_eps."""
    around = float(medium.around.real)
    a, k2, step = len(basis.te), medium.k0**2, float((medium.disc - medium.around).real)
    first = added(-k2 * step * basis.disc_mass[:a, :a], basis.te - k2 * around)
    te, te_turn = np.linalg.eigh(first)
    second = added(k2 * step * basis.disc_mass[a:, a:], k2 * around)
    scalar = np.linalg.cholesky(added(step * basis.disc_scalar, around))
    rise = below(scalar, np.diag(np.sqrt(basis.tm / k2)))
    tm, tm_turn = whitened(second, added(rise.T @ rise, -1.0))
    coupling = te_turn.T @ (-k2 * step * basis.disc_mass[:a, a:]) @ tm_turn
    return Pencil(te, tm, np.ones(a), -np.sign(tm), coupling, te_turn, tm_turn, dual=False)


def magnetic_pencil(basis: Basis, medium: Medium) -> Pencil:
    """The dual unknown of u = H_t: growth = stiffness⁻¹, stiffness = mass_(1/eps)⁻¹ - diag(0, tm / k0²)."""
    disc, around = (1 / float(e.real) for e in (medium.disc, medium.around))
    a, k2 = len(basis.te), medium.k0**2
    weighted = definite_inverse(added((disc - around) * basis.disc_mass, around))
    curl = added((disc - around) * basis.disc_curl, around * basis.te - k2)
    te, te_turn = whitened(weighted[:a, :a], curl)
    second = added(-k2 * weighted[a:, a:], basis.tm)
    tm, tm_turn = np.linalg.eigh(second)
    tm_turn = tm_turn * medium.k0
    coupling = te_turn.T @ weighted[:a, a:] @ tm_turn
    return Pencil(te, tm, np.sign(te), -np.ones(len(tm)), coupling, te_turn, tm_turn, dual=True)
