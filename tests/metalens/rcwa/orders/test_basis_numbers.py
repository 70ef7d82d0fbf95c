"""Fourier orders of a disc's cell: coefficients and normals by sums over a fine grid,
mirrors against all orders.
"""

import numpy as np
import pytest

from metalens.rcwa.orders import basis

PITCH, DIAMETER, N = 0.4, 0.23, 1000
LINE = (np.arange(N) + 0.5) / N - 0.5
X, Y = np.meshgrid(LINE, LINE, indexing="ij")  # in pitches
RADIUS = DIAMETER / 2 / PITCH
WHOLE = basis.basis(2, "none")


def coefficients(values):
    """(m, n) from -4 to 4: the mean of values times exp(-2πi (m x + n y))."""
    turns = np.exp(-2j * np.pi * np.arange(-4, 5)[:, None] * LINE)
    return turns @ values @ turns.T / N**2


def matrix(table, rows, columns):
    """Of the product with a function, between orders (m, n)."""
    return table[rows.m[:, None] - columns.m + 4, rows.n[:, None] - columns.n + 4]


def test_orders_lie_in_a_circle_and_are_one_of_every_mirror_image():
    assert len(WHOLE.ex.m) == 13  # m² + n² <= 4
    assert set(zip(WHOLE.ex.m.tolist(), WHOLE.ex.n.tolist(), strict=True)) == {
        (m, n) for m in range(-2, 3) for n in range(-2, 3) if m * m + n * n <= 4
    }
    assert set(WHOLE.ex.size.tolist()) == {1}
    one = basis.basis(2, "x")
    assert list(zip(one.ex.m.tolist(), one.ex.n.tolist(), one.ex.size.tolist(), strict=True)) == [
        (0, 0, 1), (0, 1, 2), (0, 2, 2), (1, 0, 2), (1, 1, 4), (2, 0, 2),
    ]  # fmt: skip
    assert list(zip(one.ey.m.tolist(), one.ey.n.tolist(), strict=True)) == [
        (1, 1)
    ]  # odd under both
    half = basis.basis(2, "p")
    assert set(zip(half.ey.n.tolist(), half.ey.size.tolist(), strict=True)) == {
        (1, 2),
        (2, 2),
    }


def test_a_disc_s_coefficients_are_its_mean_over_the_cell():
    """A staircase of a thousand steps across: some 5e-5 of the cell."""
    got = basis.products(WHOLE, basis.disc(WHOLE, np.array(DIAMETER), PITCH), basis.EX)
    want = matrix(coefficients((np.hypot(X, Y) < RADIUS) * 1.0), WHOLE.ex, WHOLE.ex)
    assert np.abs(got - want).max() < 1e-4
    assert got[0, 0] == pytest.approx(np.pi * RADIUS**2)


@pytest.mark.parametrize("diameter", [DIAMETER, 0.002])
def test_normals_are_the_radial_field_softened_inside_the_disc(diameter):
    """(xx, yy, xy) of r r / max(r, R)²: continuous, so that a grid of 1e-3 errs by its
    corner at the rim alone.
    """
    radius = diameter / 2 / PITCH
    scale = np.maximum(np.hypot(X, Y), radius) ** 2
    got = basis.normals(WHOLE, np.array(diameter), PITCH)
    for one, part in zip(got, (X * X, Y * Y, X * Y), strict=True):
        want = matrix(coefficients(part / scale), WHOLE.ex, WHOLE.ex)
        assert np.abs(one - want).max() < 2e-5
    assert np.abs(got[2]).max() > 0.01


@pytest.mark.parametrize(
    ("diameter", "share", "near"), [(DIAMETER, 1e-3, 1e-5), (0.0009, 0.01, 1e-3)]
)
def test_rates_are_differences(diameter, share, near):
    """The thin one lies below x = 0.01, where series stand for Bessel functions; its
    differences are rounding.
    """
    step = share * diameter
    up, down = (
        basis.normals(WHOLE, np.array(diameter + s), PITCH) for s in (step, -step)
    )
    for one, a, b in zip(
        basis.normals_rate(WHOLE, np.array(diameter), PITCH), up, down, strict=True
    ):
        want = (a - b) / (2 * step)
        assert np.abs(one - want).max() < near * np.abs(want).max()
    up, down = (basis.disc(WHOLE, np.array(diameter + s), PITCH) for s in (step, -step))
    want = (up - down) / (2 * step)
    assert (
        np.abs(basis.disc_rate(WHOLE, np.array(diameter), PITCH) - want).max()
        < near * np.abs(want).max()
    )


def test_squares_of_the_radial_field_add_to_one_at_every_truncation():
    """x² / r² + y² / r² = 1, whatever the order: its coefficients are 1 at (0, 0) and 0
    elsewhere. Cosines of 60 turns
    across the cell on a rule that is exact to rounding."""
    even, odd = basis._radial_field(60)
    whole = even + even.T
    whole[0, 0] -= 1
    assert np.abs(whole).max() < 1e-11
    few = basis._radial_field(7)
    assert np.abs(few[0] - even[:8, :8]).max() < 1e-12
    assert np.abs(few[1] - odd[:8, :8]).max() < 1e-12


def test_series_and_bessel_functions_meet():
    """On both sides of x = 0.01 for every shell: no jump but that of the next term, x⁴
    / 3000.
    """
    for shell in (1, 5, 8):
        edge = 0.01 / np.sqrt(shell) * PITCH / np.pi
        a, b = (
            np.stack(basis.normals(WHOLE, np.array(edge * s), PITCH))
            for s in (1 - 1e-9, 1 + 1e-9)
        )
        assert np.abs(a - b).max() < 1e-12
        a, b = (
            np.stack(basis.normals_rate(WHOLE, np.array(edge * s), PITCH))
            for s in (1 - 1e-9, 1 + 1e-9)
        )
        assert np.abs(a - b).max() < 1e-9


def spread(some):
    """(orders of the circle, k): every representative as its mirror images, of norm 1."""
    out = np.zeros((len(WHOLE.ex.m), len(some.m)))
    for k, (m, n) in enumerate(zip(some.m, some.n, strict=True)):
        for sx in (1, -1) if some.parity[0] else (1,):
            for sy in (1, -1) if some.parity[1] else (1,):
                at = np.flatnonzero((WHOLE.ex.m == sx * m) & (WHOLE.ex.n == sy * n))
                sign = (some.parity[0] if sx < 0 else 1) * (
                    some.parity[1] if sy < 0 else 1
                )
                out[at, k] = sign
    return out / np.linalg.norm(out, axis=0)


@pytest.mark.parametrize("symmetry", ["x", "p", "s"])
def test_mirrors_reduce_the_matrices_of_all_orders(symmetry):
    some = basis.basis(2, symmetry)
    table = basis.disc(WHOLE, np.array(DIAMETER), PITCH)
    every = [
        basis.products(WHOLE, table, basis.EX),
        *basis.normals(WHOLE, np.array(DIAMETER), PITCH),
    ]
    few = basis.disc(some, np.array(DIAMETER), PITCH)
    for link, one in ((basis.EX, some.ex), (basis.EY, some.ey), (basis.EZ, some.ez)):
        way = spread(one)
        assert basis.products(some, few, link) == pytest.approx(
            way.T @ every[0] @ way, abs=1e-12
        )
    x, y = spread(some.ex), spread(some.ey)
    xx, yy, xy = basis.normals(some, np.array(DIAMETER), PITCH)
    assert xx == pytest.approx(x.T @ every[1] @ x, abs=1e-12)
    assert yy == pytest.approx(y.T @ every[2] @ y, abs=1e-12)
    assert xy == pytest.approx(x.T @ every[3] @ y, abs=1e-12)
