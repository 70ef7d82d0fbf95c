"""Dense symmetric linear algebra for matrices of a hundred rows.

Rows are contiguous; of symmetric matrices the lower triangle counts.
"""

import numpy as np
from scipy.linalg import blas, lapack

UPPER, TRANSPOSED = 0, 1  # of LAPACK


def add_diagonal(matrix: np.ndarray, diagonal: np.ndarray | float) -> np.ndarray:
    """The matrix with a diagonal added in place."""
    matrix.ravel()[:: len(matrix) + 1] += diagonal
    return matrix


def cholesky_factor(definite: np.ndarray) -> np.ndarray:
    """Lower triangular factor, with zeros above.

    Raises:
        LinAlgError: the matrix is not positive definite.
    """
    upper, failed = lapack.dpotrf(definite.T, lower=UPPER)
    if failed:
        raise np.linalg.LinAlgError("a matrix is not positive definite")
    lower: np.ndarray = upper.T
    return lower


def solve_lower(
    lower: np.ndarray, right: np.ndarray, *, transposed: bool = False
) -> np.ndarray:
    """lower⁻¹ right, or lower⁻ᵀ right if ``transposed``; lower triangular with zeros
    above.
    """
    solved: np.ndarray = lapack.dtrtrs(
        lower.T, right, lower=UPPER, trans=0 if transposed else TRANSPOSED
    )[0]
    return solved


def definite_inverse(definite: np.ndarray) -> np.ndarray:
    """Lower triangle of the inverse of a positive definite matrix, with zeros above.

    Raises:
        LinAlgError: it is not definite.
    """
    inverse: np.ndarray = lapack.dpotri(
        cholesky_factor(definite).T, lower=UPPER, overwrite_c=1
    )[0].T
    return inverse


def gram_matrix(matrix: np.ndarray) -> np.ndarray:
    """Lower triangle of matrixᵀ matrix, with zeros above."""
    product: np.ndarray = blas.dsyrk(1.0, matrix.T, lower=UPPER).T
    return product


def congruence_product(inner: np.ndarray, outer: np.ndarray) -> np.ndarray:
    """outerᵀ inner outer of a semidefinite matrix.

    Rows and columns with zero diagonal are zero, and are left out.
    """
    rows = np.flatnonzero(inner.diagonal())
    reduced = outer[rows]
    product: np.ndarray = reduced.T @ (inner.take(rows, 0).take(rows, 1) @ reduced)
    return product


def symmetric_eigenvectors(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values, rising, and vectors of a symmetric matrix.

    Raises:
        LinAlgError: they are not found.
    """
    value, vectors, failed = lapack.dsyevd(matrix.T, lower=UPPER)
    if failed:
        raise np.linalg.LinAlgError("eigenvalues of a symmetric matrix do not converge")
    return value, vectors


def eigen_pairs(
    matrix: np.ndarray, definite: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Values, rising, and vectors of matrix x = value definite x, with xᵀ definite x =
    1.

    Raises:
        LinAlgError: ``definite`` is not positive definite.
    """
    lower = cholesky_factor(definite)
    value, vectors = symmetric_eigenvectors(
        lapack.dsygst(matrix.T, lower.T, itype=1, lower=UPPER)[0].T
    )
    return value, solve_lower(lower, vectors, transposed=True)


def whitened_levels(
    definite: np.ndarray, inner: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Levels of lowerᵀ inner lower with lower lowerᵀ = definite, and lower⁻ᵀ vectors
    sqrt(|level|).

    Raises:
        LinAlgError: ``definite`` is not positive definite.
    """
    lower = cholesky_factor(definite)
    level, vectors = symmetric_eigenvectors(
        lapack.dsygst(inner.T, lower.T, itype=2, lower=UPPER)[0].T
    )
    return level, solve_lower(lower, vectors, transposed=True) * np.sqrt(np.abs(level))
