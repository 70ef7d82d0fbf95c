"""Dense symmetric linear algebra without the cost of general-purpose checks: matrices here have a hundred rows.

Solves with triangles and eigenproblems of this size take a fraction of a millisecond, less than what the front ends
of some libraries spend on their arguments.
"""

import numpy as np
from scipy.linalg import lapack


def below(lower: np.ndarray, right: np.ndarray, *, transposed: bool = False) -> np.ndarray:
    """lower⁻¹ right, or lower⁻ᵀ right if ``transposed``; real, lower triangular with zeros above."""
    solved: np.ndarray = lapack.dtrtrs(lower.T, right, lower=0, trans=0 if transposed else 1)[0]
    return solved


def definite_inverse(matrix: np.ndarray) -> np.ndarray:
    """Inverse of a symmetric positive definite matrix, symmetric to the last digit.

    Raises:
        LinAlgError: it is not definite.
    """
    upper: np.ndarray = lapack.dtrtri(np.linalg.cholesky(matrix).T, lower=0)[0]
    inverse: np.ndarray = upper @ upper.T
    return inverse


def eigen_pairs(matrix: np.ndarray, definite: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values, rising, and vectors of matrix x = value definite x, with xᵀ definite x = 1.

    Raises:
        LinAlgError: ``definite`` is not positive definite.
    """
    lower = np.linalg.cholesky(definite)
    value, vectors = np.linalg.eigh(below(lower, below(lower, matrix).T))
    return value, below(lower, vectors, transposed=True)
