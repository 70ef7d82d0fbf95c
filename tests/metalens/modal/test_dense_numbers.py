"""Dense symmetric algebra on matrices of a few rows, whose factors and eigenvalues are
known by hand.
"""

import numpy as np
import pytest

from metalens.modal import dense

EXACT = {"rel": 1e-13, "abs": 1e-13}  # some tens of roundings of float64
L = np.array([[2.0, 0, 0], [1, 3, 0], [-4, 0.5, 5]])
DEFINITE = np.array(
    [[4.0, 99, 99], [2, 10, 99], [-8, -2.5, 41.25]]
)  # L Lᵀ; what stands above counts for nothing
SPIN = np.array(
    [[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1.0]]
)  # a turn: columns of unit length
LEVELS = np.array([-3.0, 2.0, 7.0])


def symmetric(levels, vectors):
    """The matrix of these eigenvalues, its upper half spoilt."""
    whole = (vectors * levels) @ vectors.T
    return np.where(np.tri(3), whole, 99.0)


def alike(found, want):
    """Whether columns are the same up to their signs."""
    return np.abs(found * np.sign((found * want).sum(0))) == pytest.approx(
        np.abs(want), **EXACT
    ) and np.abs(
        np.abs((found * want).sum(0)) - (want**2).sum(0)
    ).max() == pytest.approx(0, abs=1e-12)


def test_a_diagonal_is_added_in_place():
    matrix = np.arange(9.0).reshape(3, 3)
    assert dense.add_diagonal(matrix, np.array([0.5, -7, 3])) is matrix
    assert matrix.tolist() == [[0.5, 1, 2], [3, -3, 5], [6, 7, 11]]


def test_the_factor_is_lower_and_what_solves_with_it_inverts_it():
    assert dense.cholesky_factor(DEFINITE.copy()) == pytest.approx(L, **EXACT)
    right = np.array([[1.0, 2], [-3, 4], [5, 0.5]])
    assert dense.solve_lower(L, L @ right) == pytest.approx(right, **EXACT)
    assert dense.solve_lower(L, L.T @ right, transposed=True) == pytest.approx(
        right, **EXACT
    )
    with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
        dense.cholesky_factor(np.diag([2.0, -1.0, 3.0]))


def test_inverse_and_gram_are_lower_halves():
    whole = np.linalg.inv(L @ L.T)
    assert dense.definite_inverse(DEFINITE.copy()) == pytest.approx(
        np.tril(whole), **EXACT
    )
    wide = np.array([[1.0, 2, -3], [0.5, 4, 7]])
    assert dense.gram_matrix(wide) == pytest.approx(
        np.array([[1.25, 0, 0], [4, 20, 0], [0.5, 22, 58]]), **EXACT
    )


def test_a_congruence_leaves_out_rows_without_a_diagonal_alone():
    """Of rank two in a 4 x 4: the second row and column are zero."""
    inner = np.array([[2.0, 0, 1, 0], [0, 0, 0, 0], [1, 0, 3, 0.5], [0, 0, 0.5, 1]])
    outer = np.array([[1.0, -2], [50, 60], [0.5, 4], [3, -1]])
    want = [
        [14.25, 7.75],
        [7.75, 37.0],
    ]  # by hand: inner outer is (2.5, 4, 3.25) and (0, 9.5, 1) on the rows that count
    assert dense.congruence_product(inner, outer) == pytest.approx(
        np.array(want), **EXACT
    )


def test_eigenvalues_rise_and_their_vectors_are_columns():
    value, vectors = dense.symmetric_eigenvectors(symmetric(LEVELS, SPIN))
    assert value == pytest.approx(LEVELS, **EXACT)
    assert alike(vectors, SPIN)


def test_pairs_are_those_of_the_two_matrices():
    """matrix = L (turn levels turnᵀ) Lᵀ with definite = L Lᵀ has x = L⁻ᵀ turn."""
    whole = L @ ((SPIN * LEVELS) @ SPIN.T) @ L.T
    value, vectors = dense.eigen_pairs(
        np.where(np.tri(3), whole, 99.0), DEFINITE.copy()
    )
    assert value == pytest.approx(LEVELS, **EXACT)
    assert alike(vectors, np.linalg.inv(L.T) @ SPIN)


def test_whitened_levels_come_with_the_roots_of_their_sizes():
    """Lᵀ inner L = turn levels turnᵀ; vectors L⁻ᵀ turn √|level|."""
    back = np.linalg.inv(L)
    whole = back.T @ ((SPIN * LEVELS) @ SPIN.T) @ back
    level, vectors = dense.whitened_levels(
        DEFINITE.copy(), np.where(np.tri(3), whole, 99.0)
    )
    assert level == pytest.approx(LEVELS, **EXACT)
    assert alike(vectors, back.T @ SPIN * np.sqrt([3.0, 2.0, 7.0]))
