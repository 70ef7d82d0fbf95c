"""The diagonalised layer against its own equation written out densely, for matrices
drawn at will.
"""

import numpy as np
import pytest

from metalens.modal import pencil
from metalens.modal.homogeneous import HomogeneousBasis
from metalens.modal.layer import LayerMedium
from metalens.modal.pencil import CoordinateTurn
from tests.metalens.modal.unordered import apart

A, B = 6, 5
MEDIUM = LayerMedium(1.7, 5.3 + 0j, 1.6 + 0j)
K2, STEP = 1.7**2, 3.7


def part(rng, size, most):
    """A symmetric matrix of levels between 0 and ``most``, as the share of modes inside
    a disc is.
    """
    turn = np.linalg.qr(rng.normal(size=(size, size)))[0]
    return (turn * rng.uniform(0.02 * most, most, size)) @ turn.T


def basis():
    """Levels to both sides of 32 times what permittivities add: 32 K2 STEP = 342."""
    rng = np.random.default_rng(8)
    te, tm = (
        np.array([0.0, 4.1, 9.3, 330.0, 377.0, 512.0]),
        np.array([3.7, 8.2, 330.0, 350.0, 611.0]),
    )
    return HomogeneousBasis(te, tm, te, tm, lambda: np.eye(A + B), np.eye(B), part(rng, A + B, 0.9), part(rng, A, 40.0),
                 part(rng, B, 0.9))  # fmt: skip


def written_out(found):
    """(a + b, a + b) growth⁻¹ stiffness of a pencil: levels, coupling by the signs, and
    the rest.
    """
    sign = np.concatenate([found.te_sign, found.tm_sign])
    out = np.diag(np.concatenate([found.te, found.tm]))
    out[:A, A:] += sign[:A, None] * found.coupling
    out[A:, :A] += sign[A:, None] * found.coupling.T
    out[:A, :A] += 0 if found.te_rest is None else found.te_rest
    out[A:, A:] += 0 if found.tm_rest is None else found.tm_rest
    return out


def values(matrix):
    return np.linalg.eigvals(matrix)


def equation():
    """The electric form: inverse growth and stiffness from the docstring of the layer,
    nothing folded.
    """
    b = basis()
    shares = 1.6 * np.eye(B) + STEP * b.disc_scalar
    root = np.sqrt(b.tm / K2)
    growth = np.zeros((A + B, A + B))
    growth[:A, :A] = np.eye(A)
    growth[A:, A:] = np.eye(B) - root[:, None] * np.linalg.inv(shares) * root
    return growth, np.diag(np.concatenate([b.te, np.zeros(B)])) - K2 * (
        1.6 * np.eye(A + B) + STEP * b.disc_mass
    )


def test_the_electric_form_has_the_values_of_its_equation():
    growth, stiffness = equation()
    found = pencil.electric_pencil(basis(), MEDIUM)
    assert not found.dual
    assert (np.abs(found.te_sign) == 1).all()
    assert found.te_sign.tolist() == [1.0] * A
    assert np.array_equal(found.tm_sign, -np.sign(found.tm))
    assert found.tm_rest is None
    want = values(growth @ stiffness)
    assert (
        apart(values(written_out(found)), want).max() < 1e-9
    )  # of values up to 2e3, in float64


def test_the_magnetic_form_has_the_values_of_its_equation():
    """Partner: stiffness⁻¹ in place of growth, growth⁻¹ = mass_(1/eps)⁻¹ - diag(0, tm /
    k0²) in place of stiffness.
    """
    b = basis()
    disc, around = 1 / 5.3, 1 / 1.6
    mass = around * np.eye(A + B) + (disc - around) * b.disc_mass
    curl = np.zeros((A + B, A + B))
    curl[:A, :A] = np.diag(around * b.te) + (disc - around) * b.disc_curl
    inverse_growth = np.linalg.inv(mass) - np.diag(
        np.concatenate([np.zeros(A), b.tm / K2])
    )
    found = pencil.magnetic_pencil(b, MEDIUM)
    assert found.dual
    assert np.array_equal(found.te_sign, np.sign(found.te))
    assert found.tm_sign.tolist() == [-1.0] * B
    assert found.te_rest is None
    want = values(inverse_growth @ (curl - K2 * np.eye(A + B)))
    assert apart(values(written_out(found)), want).max() < 1e-9


@pytest.mark.parametrize("medium", [MEDIUM, LayerMedium(1.7, 1.6 + 0j, 5.3 + 0j)])
def test_levels_that_are_diagonalised_end_where_permittivities_weigh_little(medium):
    """Four of the six and three of the five lie below 342, whichever side is the
    denser.
    """
    assert len(pencil.electric_pencil(basis(), medium).te_turn.low) == 4
    assert len(pencil.magnetic_pencil(basis(), medium).tm_turn.low) == 3


def whole(turn):
    """The fields of a turn as a dense square."""
    out = turn.beyond * np.eye(turn.size)
    out[: len(turn.low), : len(turn.low)] = turn.low
    return out


@pytest.mark.parametrize("form", ["electric", "magnetic"])
def test_turns_carry_the_blocks_into_the_levels(form):
    """turnᵀ stiffness turn = diag(sign level), coupling and rest; turnᵀ growth turn =
    diag(sign).
    """
    b = basis()
    if form == "electric":
        found = pencil.electric_pencil(b, MEDIUM)
        growth, stiffness = equation()
        growth = np.linalg.inv(growth)
    else:
        found = pencil.magnetic_pencil(b, MEDIUM)
        disc, around = 1 / 5.3, 1 / 1.6
        curl = np.diag(np.concatenate([around * b.te, np.zeros(B)])) - K2 * np.eye(
            A + B
        )
        curl[:A, :A] += (disc - around) * b.disc_curl
        growth = np.linalg.inv(curl)
        stiffness = np.linalg.inv(
            around * np.eye(A + B) + (disc - around) * b.disc_mass
        )
        stiffness[A:, A:] -= np.diag(b.tm / K2)
    turn = np.zeros((A + B, A + B))
    turn[:A, :A], turn[A:, A:] = whole(found.te_turn), whole(found.tm_turn)
    sign = np.concatenate([found.te_sign, found.tm_sign])
    assert turn.T @ growth @ turn == pytest.approx(np.diag(sign), abs=1e-8)
    assert turn.T @ stiffness @ turn == pytest.approx(
        sign[:, None] * written_out(found), abs=1e-6
    )  # of up to 2e3


@pytest.mark.parametrize(
    ("square", "count"), [([1.0, 63.9, 64.0, 70.0], 2), ([65.0, 66.0, 67.0, 99.0], 1)]
)
def test_levels_below_32_times_the_most_are_diagonalised_and_the_rest_is_told(
    square, count
):
    matrix = np.diag(square) + part(np.random.default_rng(5), 4, 2.0)
    spoilt = np.where(np.tri(4), matrix, 99.0)
    level, vectors, rest = pencil.low_levels(spoilt, np.array(square), 2.0)
    assert vectors.shape == (count, count)
    want = np.linalg.eigvalsh(matrix[:count, :count])
    assert level == pytest.approx(
        np.concatenate([want, matrix.diagonal()[count:]]), rel=1e-12
    )
    turn = whole(CoordinateTurn(vectors, 4))
    assert np.diag(level) + rest == pytest.approx(turn.T @ matrix @ turn, abs=1e-12)


def test_a_turn_is_the_dense_matrix_that_it_stands_for():
    low = np.array([[0.6, -0.3], [0.2, 0.9]])
    rng = np.random.default_rng(2)
    for turn in (CoordinateTurn(low, 5, 1.7), CoordinateTurn(low, 2, 1.7)):
        dense, matrix = whole(turn), rng.normal(size=(turn.size, 3))
        assert turn.down(matrix) == pytest.approx(dense.T @ matrix)
        block, diagonal = (
            rng.normal(size=(turn.size, turn.size)),
            rng.normal(size=turn.size),
        )
        want = block + dense.T @ np.diag(diagonal) @ dense
        turn.onto(block, diagonal)
        assert block == pytest.approx(want)
    places = np.array([4, 0, 1, 2])
    assert CoordinateTurn(low, 5, 1.7).rows(places) == pytest.approx(
        whole(CoordinateTurn(low, 5, 1.7))[places]
    )


@pytest.mark.parametrize(
    ("disc", "around", "same"),
    [
        (5.3, 1.6, True),
        (0.9, 0.4, True),
        (5.3 + 0.1j, 1.6, False),
        (5.3, 1.6 - 0.1j, False),
        (-5.3, 1.6, False),
        (5.3, 0, False),
    ],
)
def test_a_layer_is_lossless_where_both_permittivities_are_positive(disc, around, same):
    assert pencil.is_lossless(LayerMedium(1.7, disc, around)) is same
