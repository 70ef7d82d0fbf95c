"""The layer's equation with its diagonal blocks diagonalised: what finding few modes,
and a root, start from.
"""

from dataclasses import dataclass

import numpy as np

from metalens.modal.dense import (
    add_diagonal,
    cholesky_factor,
    definite_inverse,
    gram_matrix,
    solve_lower,
    symmetric_eigenvectors,
    whitened_levels,
)
from metalens.modal.homogeneous import HomogeneousBasis
from metalens.modal.layer import LayerMedium

# levels up to this many times the most that permittivities add to a diagonal are
# diagonalised
LOW = 32.0


@dataclass(frozen=True, eq=False, slots=True)
class CoordinateTurn:
    """Fields of y in the homogeneous basis, square: of the first alone ``low`` (m, m),
    of each other ``beyond`` times
    itself; size: of all."""

    low: np.ndarray
    size: int
    beyond: float = 1.0

    def down(self, matrix: np.ndarray) -> np.ndarray:
        """turnᵀ matrix."""
        m = len(self.low)
        if m == self.size:
            return np.asarray(self.low.T @ matrix)
        out = matrix * self.beyond
        out[:m] = self.low.T @ matrix[:m]
        return out

    def onto(self, block: np.ndarray, diagonal: np.ndarray) -> None:
        """Add turnᵀ diag turn to a block, in place."""
        m = len(self.low)
        block[:m, :m] += self.low.T @ (diagonal[:m, None] * self.low)
        beyond = np.arange(m, self.size)
        block[beyond, beyond] += self.beyond**2 * diagonal[m:]

    def rows(self, places: np.ndarray) -> np.ndarray:
        """Some of its rows."""
        m = len(self.low)
        out = np.zeros((len(places), self.size))
        for row, place in zip(out, places.tolist(), strict=True):
            if place < m:
                row[:m] = self.low[place]
            else:
                row[place] = self.beyond
        return out


@dataclass(frozen=True, eq=False, slots=True)
class LayerPencil:
    """Real and symmetric; see the module.

    te (a,), tm (b,): levels. te_sign, tm_sign: of growth. coupling: (a, b).
    te_turn, tm_turn: fields of the y in the homogeneous basis. dual: the unknown is the
    partner.
    te_rest (a, a) or tm_rest (b, b): of growth⁻¹ stiffness beside the levels, zero
    among the low ones; the other None.
    """

    te: np.ndarray
    tm: np.ndarray
    te_sign: np.ndarray
    tm_sign: np.ndarray
    coupling: np.ndarray
    te_turn: CoordinateTurn
    tm_turn: CoordinateTurn
    te_rest: np.ndarray | None
    tm_rest: np.ndarray | None
    dual: bool


def is_lossless(medium: LayerMedium) -> bool:
    """Whether a ``medium`` has positive real permittivities, as the definite blocks need."""
    return all(
        e.imag == 0 and e.real > 0 for e in map(complex, (medium.disc, medium.around))
    )


def low_levels(
    matrix: np.ndarray, square: np.ndarray, most: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Levels (n,), vectors (m, m) of the low ones, and what is left, of diag(square)
    and as much as ``most`` beside it.

    square: rising. Of the matrix the lower triangle counts.
    """
    m, n = max(1, int(np.searchsorted(square, LOW * most))), len(square)
    low, vectors = symmetric_eigenvectors(matrix[:m, :m])
    level = np.concatenate([low, matrix.diagonal()[m:]])
    rest = np.zeros((n, n))
    rest[m:, :m] = matrix[m:, :m] @ vectors
    rest[m:, m:] = np.tril(matrix[m:, m:], -1)
    return level, vectors, rest + rest.T


def electric_pencil(basis: HomogeneousBasis, medium: LayerMedium) -> LayerPencil:
    """Block-diagonalised equation of the layer for u = E_t: growth = diag(1, (scalar_eps^-1
    tm / k0^2 - 1)^-1 negative), stiffness = curl - k0^2 mass_eps.

    Args:
        basis: homogeneous modes. medium: wavenumber and permittivities, lossless.
    """
    around = float(medium.around.real)
    a, b, k2, step = (
        len(basis.te),
        len(basis.tm),
        medium.k0**2,
        float((medium.disc - medium.around).real),
    )
    first = add_diagonal(-k2 * step * basis.disc_mass[:a, :a], basis.te - k2 * around)
    te, te_low, rest = low_levels(first, basis.te, k2 * abs(step))
    second = add_diagonal(k2 * step * basis.disc_mass[a:, a:], k2 * around)
    scalar = cholesky_factor(add_diagonal(step * basis.disc_scalar, around))
    rise = solve_lower(scalar, np.diag(np.sqrt(basis.tm / k2)))
    tm, tm_turn = whitened_levels(second, add_diagonal(gram_matrix(rise), -1.0))
    turn = CoordinateTurn(te_low, a)
    coupling = turn.down(-k2 * step * basis.disc_mass[:a, a:] @ tm_turn)
    return LayerPencil(
        te,
        tm,
        np.ones(a),
        -np.sign(tm),
        coupling,
        turn,
        CoordinateTurn(tm_turn, b),
        rest,
        None,
        dual=False,
    )


def magnetic_pencil(basis: HomogeneousBasis, medium: LayerMedium) -> LayerPencil:
    """Block-diagonalised equation of the layer for the dual unknown of u = H_t: growth =
    stiffness^-1, stiffness = mass_(1/eps)^-1 - diag(0, tm / k0^2).

    Args:
        basis: homogeneous modes. medium: wavenumber and permittivities, lossless.
    """
    disc, around = (1 / float(e.real) for e in (medium.disc, medium.around))
    a, b, k2 = len(basis.te), len(basis.tm), medium.k0**2
    weighted = definite_inverse(add_diagonal((disc - around) * basis.disc_mass, around))
    curl = add_diagonal((disc - around) * basis.disc_curl, around * basis.te - k2)
    te, te_turn = whitened_levels(weighted[:a, :a], curl)
    second = add_diagonal(-k2 * weighted[a:, a:], basis.tm)
    tm, tm_low, rest = low_levels(second, basis.tm, k2 * abs(1 / disc - 1 / around))
    turn = CoordinateTurn(tm_low * medium.k0, b, medium.k0)
    coupling = turn.down(weighted[a:, :a] @ te_turn).T
    return LayerPencil(
        te,
        tm,
        np.sign(te),
        -np.ones(b),
        coupling,
        CoordinateTurn(te_turn, a),
        turn,
        None,
        rest,
        dual=True,
    )
