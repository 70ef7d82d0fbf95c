"""Legendre polynomials, interpolation and the count of nodes, against closed forms."""

import itertools

import numpy as np

from metalens.core import legendre


def test_polynomials_are_orthonormal_to_high_order():
    t, w = legendre.gauss_legendre_nodes(200)
    p = legendre.legendre_values(180, t)
    assert np.abs((p.T * w) @ p - np.eye(180)).max() < 1e-12


def test_interpolation_is_exact_for_polynomials_and_fast_for_waves():
    t = np.linspace(-1, 1, 77)
    x, _ = legendre.gauss_legendre_nodes(9)
    assert np.abs(legendre.interpolation_matrix(9, t) @ x**8 - t**8).max() < 1e-13
    errors = []
    for n in (10, 14, 18, 22):
        x, _ = legendre.gauss_legendre_nodes(n)
        errors.append(
            np.abs(
                legendre.interpolation_matrix(n, t) @ np.exp(6j * x) - np.exp(6j * t)
            ).max()
        )
    assert all(
        b < 0.1 * a for a, b in itertools.pairwise(errors)
    )  # faster than geometric
    assert errors[-1] < 1e-9


def test_needed_finds_the_least_count_and_says_when_it_cannot_tell():
    t, _ = legendre.gauss_legendre_nodes(64)
    cubic = np.array([1 + t**3])
    assert legendre.needed_node_count(cubic, 1e-12) == 4
    wave = np.exp(20j * t)[None]
    for tolerance in (1e-2, 1e-6):
        n = legendre.needed_node_count(wave, tolerance)
        x, _ = legendre.gauss_legendre_nodes(n)
        fine, w = legendre.gauss_legendre_nodes(100)
        rest = legendre.interpolation_matrix(n, fine) @ np.exp(20j * x) - np.exp(
            20j * fine
        )
        assert (
            np.sqrt((np.abs(rest) ** 2 * w).sum() / 2) < 3 * tolerance
        )  # interpolation: tail and its alias
    assert legendre.needed_node_count(np.exp(80j * t)[None], 1e-3) == 65
