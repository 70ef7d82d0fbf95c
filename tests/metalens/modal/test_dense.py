"""Dense symmetric algebra, blocks diagonalised in part, elimination by halves: against
plain products and solves.
"""

import numpy as np
import pytest

from metalens.cell.light import Incidence
from metalens.cell.record import Cell, Index
from metalens.modal import dense
from metalens.modal.assembly import assemble_disc
from metalens.modal.case import case_of
from metalens.modal.homogeneous import homogeneous_modes
from metalens.modal.ladder import RUNGS
from metalens.modal.layer import LayerMedium
from metalens.modal.match import solve_symmetric
from metalens.modal.pencil import (
    CoordinateTurn,
    electric_pencil,
    low_levels,
    magnetic_pencil,
)
from metalens.modal.spaces import build_symmetry_class

# of products of 20 rows of numbers up to some tens, and of inverses whose condition is
# below 1e3
ROUNDING = 1e-11


def drawn(seed=1):
    """A definite and a symmetric matrix, and a square one."""
    left, right = np.random.default_rng(seed).normal(size=(2, 20, 20))
    return left @ left.T + np.eye(20), right + right.T, right


def lower_alone(matrix):
    """The matrix with other numbers above its diagonal."""
    return np.tril(matrix) + np.triu(np.full(matrix.shape, 7.3), 1)


def test_factors_inverses_and_products():
    definite, _, right = drawn()
    lower = dense.cholesky_factor(lower_alone(definite))
    assert np.abs(lower @ lower.T - definite).max() < ROUNDING
    assert (lower == np.tril(lower)).all()
    assert np.abs(lower @ dense.solve_lower(lower, right) - right).max() < ROUNDING
    assert (
        np.abs(lower.T @ dense.solve_lower(lower, right, transposed=True) - right).max()
        < ROUNDING
    )
    assert (
        np.abs(
            dense.definite_inverse(lower_alone(definite))
            - np.tril(np.linalg.inv(definite))
        ).max()
        < ROUNDING
    )
    assert (
        np.abs(dense.gram_matrix(right[:7]) - np.tril(right[:7].T @ right[:7])).max()
        < ROUNDING
    )
    assert (
        np.abs(
            dense.add_diagonal(definite.copy(), 0.3) - definite - 0.3 * np.eye(20)
        ).max()
        < ROUNDING
    )


def test_rows_of_zeros_count_for_nothing_between_vectors():
    _, _, right = drawn()
    inner = np.zeros((20, 20))
    inner[3:17:2, 3:17:2] = (
        right[:7, :9] @ right[:7, :9].T
    )  # semidefinite, and 13 rows of zeros
    assert (
        np.abs(
            dense.congruence_product(inner, right[:, :8])
            - right[:, :8].T @ inner @ right[:, :8]
        ).max()
        < ROUNDING
    )


def test_eigenvectors_of_one_matrix_and_of_two():
    definite, symmetric, _ = drawn()
    level, vectors = dense.symmetric_eigenvectors(lower_alone(symmetric))
    assert np.abs(symmetric @ vectors - vectors * level).max() < ROUNDING
    value, pairs = dense.eigen_pairs(lower_alone(symmetric), lower_alone(definite))
    assert (np.diff(value) > 0).all()
    assert np.abs(symmetric @ pairs - definite @ pairs * value).max() < ROUNDING
    assert np.abs(pairs.T @ definite @ pairs - np.eye(20)).max() < ROUNDING
    white, turn = dense.whitened_levels(lower_alone(definite), lower_alone(symmetric))
    assert np.abs(turn.T @ definite @ turn - np.diag(np.abs(white))).max() < ROUNDING
    want = np.linalg.inv(symmetric)
    assert (
        np.abs(turn.T @ want @ turn - np.diag(np.sign(white))).max() < 100 * ROUNDING
    )  # its condition is 1e2 more


@pytest.mark.parametrize(
    "call",
    [
        dense.cholesky_factor,
        dense.definite_inverse,
        lambda m: dense.eigen_pairs(np.eye(20), m),
    ],
)
def test_what_is_not_definite_is_refused(call):
    with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
        call(drawn()[1])


@pytest.mark.parametrize("m", [0, 3, 8])
def test_a_turn_of_the_first_alone_is_a_matrix(m):
    random = np.random.default_rng(m)
    turn = CoordinateTurn(random.normal(size=(m, m)), 8, 1.3)
    whole = 1.3 * np.eye(8)
    whole[:m, :m] = turn.low
    matrix, diagonal, block = (
        random.normal(size=(8, 5)),
        random.normal(size=8),
        random.normal(size=(8, 8)),
    )
    assert np.abs(turn.down(matrix) - whole.T @ matrix).max() < ROUNDING
    want = block + whole.T @ np.diag(diagonal) @ whole
    turn.onto(block, diagonal)
    assert np.abs(block - want).max() < ROUNDING
    assert (turn.rows(np.array([6, 1])) == whole[[6, 1]]).all()


@pytest.mark.parametrize(("most", "m"), [(3.0, 4), (0.0, 1), (9.0, 6)])
def test_low_levels_are_diagonal_among_themselves_and_the_rest_is_what_is_left(most, m):
    """To 32 times as much as is added; one at least, of pillars of the stuff around
    them.
    """
    square = np.array([1.0, 3.0, 8.0, 90.0, 160.0, 170.0])
    random = np.random.default_rng(4).normal(size=(6, 6))
    matrix = np.diag(square) + (random + random.T) / 2
    level, low, rest = low_levels(lower_alone(matrix), square, most)
    assert low.shape == (m, m)
    whole = np.eye(6)
    whole[:m, :m] = low
    assert np.abs(whole.T @ matrix @ whole - np.diag(level) - rest).max() < ROUNDING
    assert (rest[:m, :m] == 0).all()
    assert (rest.diagonal() == 0).all()


@pytest.mark.parametrize("contrast", [3.6, 0.7])
def test_blocks_diagonalised_in_part_are_those_of_the_layer(contrast):
    """The pencil in the basis of the homogeneous modes, with its turns undone:
    stiffness of curl less k0² mass.
    """
    symmetry_class = build_symmetry_class(
        assemble_disc(0.5, RUNGS[1].choice(0.5).plan),
        electric=False,
        half_phase_rad=None,
    )
    case = case_of(
        Cell(0.4, 0.7, Index(contrast), Index(1.6), Index(1.1)), 0.2, Incidence(0.85)
    )
    b, medium = (
        homogeneous_modes(symmetry_class),
        LayerMedium(case.k0, case.disc, case.around),
    )
    a, k2, step = len(b.te), case.k0**2, case.disc.real - case.around.real
    electric, magnetic = electric_pencil(b, medium), magnetic_pencil(b, medium)
    assert len(electric.te_turn.low) < a
    assert len(magnetic.tm_turn.low) < len(b.tm)
    turn = electric.te_turn.rows(np.arange(a))
    mass = step * b.disc_mass + case.around.real * np.eye(b.size)
    want = turn.T @ (np.diag(b.te) - k2 * mass[:a, :a]) @ turn
    assert (
        np.abs(np.diag(electric.te) + electric.te_rest - want).max()
        < 1e-12 * b.te.max()
    )
    across = -k2 * turn.T @ mass[:a, a:] @ electric.tm_turn.rows(np.arange(len(b.tm)))
    assert np.abs(electric.coupling - across).max() < 1e-9 * np.abs(across).max()
    inverse = np.linalg.inv(
        (1 / case.disc.real - 1 / case.around.real) * b.disc_mass
        + np.eye(b.size) / case.around.real
    )
    turn = magnetic.tm_turn.rows(np.arange(len(b.tm)))
    want = turn.T @ (np.diag(b.tm) / k2 - inverse[a:, a:]) @ turn
    assert (
        np.abs(np.diag(magnetic.tm) + magnetic.tm_rest - want).max()
        < 1e-12 * b.tm.max()
    )
    across = magnetic.te_turn.rows(np.arange(a)).T @ inverse[:a, a:] @ turn
    assert np.abs(magnetic.coupling - across).max() < 1e-9 * np.abs(across).max()


@pytest.mark.parametrize(
    ("lift", "first"),
    [((-9, 0), True), ((0, 20), False), ((0, 0), True), ((0, 0), False)],
)
def test_elimination_by_halves_is_a_solve(lift, first):
    """A definite block first or last, or, in the last two, none where one is told: the
    plain way.
    """
    random = np.random.default_rng(2)
    matrix = random.normal(size=(9, 9))
    matrix = matrix + matrix.T + np.diag([lift[0]] * 4 + [lift[1]] * 5)
    columns = random.normal(size=(9, 2))
    assert (
        np.abs(
            matrix @ solve_symmetric(matrix, 4, columns, first=first) - columns
        ).max()
        < ROUNDING
    )
