"""Power series through solved amounts, and the bending energy of plates, on polynomials."""

import numpy as np
import pytest

from characterize.model import solving, thinplate
from metalens import modal
from metalens.cell import Cell, Index
from metalens.made import Answers, Bends, maps, named, of_kind

RNG = np.random.default_rng(29)


def test_amounts_reach_beyond_the_bounds_of_a_fit():
    changes = solving._changes(0.85)
    rows = [row for _, row in of_kind(Answers)]
    assert [row.name for _, row, _ in changes] == ["height_nm", "index"]
    assert [n for n, _, _ in changes] == [rows.index(row) for _, row, _ in changes]
    assert changes[0][2] == pytest.approx(np.array([-1, -0.5, 0, 0.5, 1]) * 0.02996)  # 28 nm and 7 %, in um
    assert changes[1][2] == pytest.approx(np.array([-1, 0, 1]) * 0.08025)


def test_series_go_through_what_was_solved():
    """Quartics in the height and parabolas in the index come back; a cause that is not solved has t alone."""
    changes = solving._changes(0.85)
    t = RNG.normal(size=7) + 1j * RNG.normal(size=7)
    tall = RNG.normal(size=(4, 7)) * np.array([3.0, 40.0, 500.0, 9e3])[:, None]
    dense = RNG.normal(size=(2, 7)) * 1j
    columns = [t + sum(tall[p] * a ** (p + 1) for p in range(4)) for a in changes[0][2]]
    columns += [t + dense[0] * a + dense[1] * a**2 for a in changes[1][2]]
    out = solving._powers(np.array(columns).T, changes)
    assert out.shape == (len(named(Answers)), 5, 7)
    assert out[:, 0] == pytest.approx(np.tile(t, (len(out), 1)), rel=1e-9)
    assert out[0, 1:] == pytest.approx(tall, rel=1e-6)
    assert out[1, 1:3] == pytest.approx(dense, rel=1e-9)
    assert not out[1, 3:].any()
    assert not out[2:, 1:].any()


def test_bending_energy_is_the_mean_of_squared_second_derivatives():
    """f = u² + 3 u v - 2 v²: 2², 3² twice, 4²; g = u²: its product with f is 2 x 2."""
    t = np.linspace(-1, 1, 21)
    u, v = np.meshgrid(t, t)
    inside = np.hypot(u, v) < 0.75
    shapes = np.stack([u**2 + 3 * u * v - 2 * v**2, u**2, u * v])
    want = np.array([[4 + 18 + 16, 4, 6], [4, 4, 0], [6, 0, 2]])
    assert thinplate._bending(shapes, inside, t[1] - t[0]) == pytest.approx(want, rel=1e-9, abs=1e-9)


def test_modes_leave_out_what_parameters_already_do():
    """On the places where they are made they are at right angles to piston, tilts, defocus and every aberration."""
    t = np.linspace(-1, 1, thinplate._GRID)
    u, v = np.meshgrid(t, t)
    inside = np.hypot(u, v) <= 1
    modes = thinplate.basis(u, v)[:, inside]
    u, v = u[inside], v[inside]
    for shape in (np.ones_like(u), u, v, u**2 + v**2, *maps(Bends, u, v)):
        assert np.abs(modes @ shape).max() < 1e-6 * len(u)
    assert (modes @ modes.T) / len(u) == pytest.approx(np.eye(len(modes)), abs=1e-6)


def test_a_curve_along_the_diameters_is_what_single_solves_have():
    """t, and not r; the fit's share of 3e-3 and twice the solver's half."""
    cell = Cell(0.3, 0.55, Index(2.4), substrate=Index(1.45))
    diameters = np.linspace(0.17, 0.19, 9)
    got = solving._along(cell, 0.85, diameters)
    for at in (1, 6):
        assert abs(got[at] - modal.solve(cell, float(diameters[at]), 0.85, tolerance=1e-3).t) < 3e-3
    assert np.abs(got).min() > 0.5
