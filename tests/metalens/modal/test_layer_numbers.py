"""Modes of a layer against its own equation written out densely: matrices drawn at
will, absorbing media and others.
"""

import numpy as np
import pytest

from metalens.modal import layer
from metalens.modal.homogeneous import HomogeneousBasis
from metalens.modal.layer import LayerMedium
from tests.metalens.modal.unordered import apart

A, B, K0 = 4, 3, 1.7
N = A + B


def part(rng, size, most):
    """A symmetric matrix of levels up to ``most``, as the share of modes inside a disc
    is.
    """
    turn = np.linalg.qr(rng.normal(size=(size, size)))[0]
    return (turn * rng.uniform(0.05 * most, most, size)) @ turn.T


def basis():
    rng = np.random.default_rng(8)
    te, tm = np.array([0.0, 4.1, 9.3, 33.0]), np.array([3.7, 8.2, 45.0])
    return HomogeneousBasis(te, tm, te + 9, tm + 9, lambda: np.eye(N), np.eye(B), part(rng, N, 0.9), part(rng, A, 20.0),
                 part(rng, B, 0.9))  # fmt: skip


def electric(disc, around):
    """Stiffness curl - k0² mass_eps; 1/growth = 1/mass - grad (k0² scalar_eps)⁻¹ gradᵀ,
    where grad is √tm.
    """
    b = basis()
    stiffness = np.diag(np.concatenate([b.te, np.zeros(B)])).astype(complex)
    stiffness -= K0**2 * (around * np.eye(N) + (disc - around) * b.disc_mass)
    inverse = np.eye(N, dtype=complex)
    grad = np.diag(np.sqrt(b.tm))
    inverse[A:, A:] -= (
        grad
        @ np.linalg.inv(K0**2 * (around * np.eye(B) + (disc - around) * b.disc_scalar))
        @ grad
    )
    return stiffness, inverse


def magnetic(disc, around):
    """Stiffness curl_(1/eps) - k0² mass; 1/growth = 1/mass_(1/eps) - grad (k0²
    scalar)⁻¹ gradᵀ.
    """
    b, step = basis(), 1 / disc - 1 / around
    stiffness = -(K0**2) * np.eye(N, dtype=complex)
    stiffness[:A, :A] += np.diag(b.te) / around + step * b.disc_curl
    inverse = np.linalg.inv(np.eye(N) / around + step * b.disc_mass.astype(complex))
    inverse[A:, A:] -= np.diag(b.tm / K0**2)
    return stiffness, inverse


@pytest.mark.parametrize(
    ("disc", "around"),
    [(5.3 + 0j, 1.6 + 0j), (5.3 + 0.4j, 1.6 + 0j), (1.3 + 0j, 3.1 + 0.2j)],
)
@pytest.mark.parametrize("form", ["electric", "magnetic"])
def test_modes_solve_the_equation_of_their_form(form, disc, around):
    """-q² growth w = stiffness w with p = growth w; growth and stiffness symmetric, q
    all of them, once each.
    """
    medium = LayerMedium(K0, disc, around)
    found = {"electric": layer.electric_modes, "magnetic": layer.magnetic_modes}[form](
        basis(), medium
    )
    stiffness, inverse = {"electric": electric, "magnetic": magnetic}[form](
        disc, around
    )
    if disc.imag == around.imag == 0:
        assert (
            np.isrealobj(found.field) or np.abs(found.q.imag * found.q.real).max() > 0
        )
    scale = np.linalg.norm(found.field, axis=0)
    assert found.partner / scale == pytest.approx(
        np.linalg.solve(inverse, found.field) / scale, abs=1e-9
    )
    left, right = stiffness @ found.field, -(found.q**2) * found.partner
    assert (
        np.abs(left - right).max() < 1e-9 * np.abs(left).max()
    )  # rounding of eigenvectors
    assert apart(found.q**2, -np.linalg.eigvals(inverse @ stiffness)).max() < 1e-9
    assert (found.q.imag >= -1e-9 * np.abs(found.q)).all()
    assert np.linalg.matrix_rank(found.field / scale) == N


def test_waves_decay_or_go_up():
    """Of each pair of roots the one above the real axis, and to its right where they
    lie on it.
    """
    square = np.array([4.0, -9.0, 2j, -2j, 4 + 1e-10j, 4 - 1e-8j, -9 + 1e-12j])
    found = layer.axial_wavenumber(square)
    assert found**2 == pytest.approx(square)
    assert found[:4] == pytest.approx(np.array([2, 3j, 1 + 1j, -1 + 1j]))
    assert found[4] == pytest.approx(2, abs=1e-9)
    assert found[5] == pytest.approx(
        -2, abs=1e-7
    )  # that gains, by more than rounding, decays the other way
    assert found[5].imag > 0
    assert layer.axial_wavenumber(np.array([0.0]))[0] == 0


def test_permittivities_are_real_where_neither_absorbs():
    assert LayerMedium(1.0, 3.0 + 0j, 2.0 + 0j).permittivities() == (3.0, 2.0)
    assert [type(e) for e in LayerMedium(1.0, 3.0 + 0j, 2.0 + 0j).permittivities()] == [
        float,
        float,
    ]
    for medium in (
        LayerMedium(1.0, 3.0 + 1j, 2.0 + 0j),
        LayerMedium(1.0, 3.0 + 0j, 2.0 + 1j),
    ):
        assert medium.permittivities() == (medium.disc, medium.around)
