"""Power series through solved amounts, and the bending energy of plates, on
polynomials.
"""

import numpy as np
import pytest

from characterize.model import solving, thinplate
from metalens import modal
from metalens.cell import Cell, Index
from metalens.fabrication import ResponseError, WavefrontError, maps, named, of_kind

RNG = np.random.default_rng(29)


def test_amounts_reach_beyond_the_bounds_of_a_fit():
    changes = solving._changes(0.85)
    rows = [row for _, row in of_kind(ResponseError)]
    assert [row.name for _, row, _ in changes] == ["height_nm", "index"]
    assert [n for n, _, _ in changes] == [rows.index(row) for _, row, _ in changes]
    assert changes[0][2] == pytest.approx(
        np.array([-1, -0.5, 0, 0.5, 1]) * 0.02996
    )  # 28 nm and 7 %, in um
    assert changes[1][2] == pytest.approx(
        np.array([-1, -0.67, -0.33, 0, 0.33, 0.67, 1]) * 0.08025
    )


def test_series_go_through_what_was_solved():
    """Quartics in height and sixth powers in the index come back; a cause that is not
    solved has t alone.
    """
    changes = solving._changes(0.85)
    t = RNG.normal(size=7) + 1j * RNG.normal(size=7)
    tall = RNG.normal(size=(4, 7)) * np.array([3.0, 40.0, 500.0, 9e3])[:, None]
    dense = RNG.normal(size=(6, 7)) * np.array([1j, 4j, 60.0, 900j, 1e4, 1e5j])[:, None]
    columns = [t + sum(tall[p] * a ** (p + 1) for p in range(4)) for a in changes[0][2]]
    columns += [
        t + sum(dense[p] * a ** (p + 1) for p in range(6)) for a in changes[1][2]
    ]
    out = solving._powers(np.array(columns).T, changes)
    assert out.shape == (len(named(ResponseError)), 7, 7)
    assert out[:, 0] == pytest.approx(np.tile(t, (len(out), 1)), rel=1e-9)
    assert out[0, 1:5] == pytest.approx(tall, rel=1e-6)
    assert not out[0, 5:].any()
    assert out[1, 1:] == pytest.approx(dense, rel=1e-6)
    assert not out[2:, 1:].any()


def test_series_follow_a_resonance_that_moves_with_the_index(monkeypatch):
    """Pillars near 0.23 um of the default cell, where t turns by a radian as n falls by
    a twentieth: by the solver.

    The index alone is solved, between the first diameter and the last: a kept answer of
    all causes is not touched.
    """
    cell, wave = Cell(0.3, 0.7, Index(3.6)), 0.85
    index = [change for change in solving._changes(wave) if change[1].name == "index"]
    monkeypatch.setattr(solving, "_changes", lambda wavelength_um: index)
    table, off = solving._solved.__wrapped__(cell, wave, 0.2295, 0.2315), []
    for d, amount in (
        (0.23060831, -0.04401585),
        (0.23126282, -0.06865947),
        (0.2297, 0.031),
    ):
        want = modal.solve(
            Cell(0.3, 0.7, Index(3.6 + amount)), d, wave, tolerance=1e-3
        ).t
        got = np.polynomial.polynomial.polyval(amount, table.series(np.array(d))[1])
        off.append(abs(got - want))
    assert (
        max(off) < 0.04
    )  # 0.03 of the polynomials, 4e-3 of two solves; 0.29 through three indices, 0.07 through five


def test_bending_energy_is_the_mean_of_squared_second_derivatives():
    """f = u² + 3 u v - 2 v²: 2², 3² twice, 4²; g = u²: its product with f is 2 x 2."""
    t = np.linspace(-1, 1, 21)
    u, v = np.meshgrid(t, t)
    inside = np.hypot(u, v) < 0.75
    shapes = np.stack([u**2 + 3 * u * v - 2 * v**2, u**2, u * v])
    want = np.array([[4 + 18 + 16, 4, 6], [4, 4, 0], [6, 0, 2]])
    assert thinplate._bending(shapes, inside, t[1] - t[0]) == pytest.approx(
        want, rel=1e-9, abs=1e-9
    )


def test_modes_leave_out_what_parameters_already_do():
    """On the places where they are made they are at right angles to piston, tilts,
    defocus and every aberration.
    """
    t = np.linspace(-1, 1, thinplate._GRID)
    u, v = np.meshgrid(t, t)
    inside = np.hypot(u, v) <= 1
    modes = thinplate.thin_plate_basis(u, v)[:, inside]
    u, v = u[inside], v[inside]
    for shape in (np.ones_like(u), u, v, u**2 + v**2, *maps(WavefrontError, u, v)):
        assert np.abs(modes @ shape).max() < 1e-6 * len(u)
    assert (modes @ modes.T) / len(u) == pytest.approx(np.eye(len(modes)), abs=1e-6)


def test_a_curve_along_the_diameters_is_what_single_solves_have():
    """t, and not r; the fit's share of 3e-3 and twice the solver's half."""
    cell = Cell(0.3, 0.55, Index(2.4), substrate=Index(1.45))
    diameters = np.linspace(0.17, 0.19, 9)
    got = solving._along(cell, 0.85, diameters)
    for at in (1, 6):
        assert (
            abs(
                got[at]
                - modal.solve(cell, float(diameters[at]), 0.85, tolerance=1e-3).t
            )
            < 3e-3
        )
    assert np.abs(got).min() > 0.5
