"""Rows of unlike pillars: one pillar repeated is the periodic cell, energy holds, mirrors mirror, slopes cost light."""

import dataclasses

import numpy as np
import pytest

from metalens import design, modal
from metalens.cell.record import Cell, Film, Index
from metalens.design import neighbours as supercell
from metalens.design.profiles import Focus
from metalens.ground.errors import CellError
from metalens.pillars.proxy import Proxy

CELL = Cell(pitch_um=0.30, height_um=0.7, pillar=Index(3.6), substrate="SiO2")
GLASS = dataclasses.replace(CELL, pillar=Index(1.05))
WAVE = 0.85


def test_a_single_pillar_is_the_periodic_cell_of_the_modal_method():
    want = modal.solve(CELL, 0.12, WAVE, tolerance=1e-3).t
    for polarization in ("x", "y"):
        errors = [
            abs(supercell.solve_row(CELL, [0.12], WAVE, polarization=polarization, harmonics=h).order(0) - want)
            for h in (3, 5)
        ]
        assert errors[1] < 0.01  # truncation of RCWA at 5 orders
        assert errors[1] < errors[0]


@pytest.mark.parametrize("polarization", ["x", "y"])
def test_equal_pillars_in_a_row_are_one_pillar(polarization):
    one = supercell.solve_row(CELL, [0.14], WAVE, polarization=polarization, harmonics=2)
    four = supercell.solve_row(CELL, [0.14] * 4, WAVE, polarization=polarization, harmonics=2)
    assert four.order(0) == pytest.approx(one.order(0), abs=1e-9)
    assert np.abs(four.t[np.abs(four.orders) % 4 != 0]).max() < 1e-9


@pytest.mark.parametrize("polarization", ["x", "y"])
def test_energy_holds_and_a_mirrored_row_mirrors_its_orders(polarization):
    row = [0.1, 0.12, 0.17, 0.2]
    there = supercell.solve_row(CELL, row, WAVE, polarization=polarization, harmonics=2)
    back = supercell.solve_row(CELL, row[::-1], WAVE, polarization=polarization, harmonics=2)
    assert there.energy == pytest.approx(1, abs=1e-9)
    assert back.t[::-1] == pytest.approx(there.t, abs=1e-9)
    assert abs(there.order(1) - there.order(-1)) > 0.05  # the row is not its own mirror image


def test_absorbing_pillars_lose_energy():
    lossy = dataclasses.replace(CELL, pillar=Index(3.6, 0.1))
    assert supercell.solve_row(lossy, [0.1, 0.2], WAVE, polarization="x", harmonics=2).energy < 0.98


def test_weak_pillars_do_not_feel_their_neighbours():
    """Where scattering is weak the local periodic approximation is first-order exact: pillars add one by one."""
    row = np.array([0.08, 0.14, 0.2, 0.25])
    whole = supercell.solve_row(GLASS, row, WAVE, polarization="y", harmonics=2)
    alone = [supercell.solve_row(GLASS, [d], WAVE, polarization="y", harmonics=2).order(0) for d in row]
    assert whole.order(0) == pytest.approx(np.mean(alone), abs=2e-3)  # second order: (0.2 rad)² / 20
    assert np.abs(np.diff(alone)).max() > 0.03


def _lens():
    phase = np.polynomial.Polynomial([0.0, 52.0])  # 2 pi over 0.12 um
    proxy = Proxy(
        np.polynomial.Chebyshev.interpolate(phase, 3, domain=[0.08, 0.21]).coef[None],
        np.array([[0.95]]),
        (0.08, 0.21),
        (WAVE, WAVE),
        0.0,
        0.0,
    )
    focus = Focus(WAVE, 100.0, 1000.0)
    wanted = design.phase_of(None, focus, radius_um=10.0)
    return design.make(wanted, focus, aperture_um=20.0, cell=CELL, proxy=proxy)[0]


def test_steeper_slopes_change_more_and_the_model_follows_the_rows():
    found = supercell.neighbours(_lens(), counts=(6, 5, 4), harmonics=2)
    assert found.sine == pytest.approx(WAVE / 0.3 / np.array([6, 5, 4]))
    change = np.abs(found.factor - 1)
    assert (change > 0.01).all()
    assert (change < 0.5).all()
    assert np.abs(found.at(found.sine) - found.factor).max() < 0.5 * change.max()  # two terms for three rows
    assert found.at(0.0) == pytest.approx(1.0)  # nothing turned, nothing changed


def test_the_terms_of_the_lens_s_own_cell_are_those_of_an_independent_solver(monkeypatch):
    """Angle: by the modal method, which shares no code with RCWA; both to 1e-2 of t. Neighbours: through their rows."""
    monkeypatch.setattr("metalens.design.own_cell.DIAMETERS", 2)
    lens, tilt = _lens(), 0.3
    found = design.left_out(lens, aperture=0.5, incidence_rad=tilt)
    rows = supercell.neighbours(lens, counts=(6, 4))  # 0.85 / (0.3 · 0.5) = 5.7 pillars in a zone of the rim, and 3.8
    at = rows.sine[0]
    assert 1 + found.neighbours[0] * at + found.neighbours[1] * at**2 == pytest.approx(rows.factor[0], abs=1e-9)
    changes = []
    for side in ("s", "p"):
        flat, tilted = (
            np.array(
                [
                    modal.solve(CELL, d, WAVE, angle_rad=angle, polarization=side, tolerance=5e-3).t
                    for d in supercell.printed(lens)
                ]
            )
            for angle in (0.0, tilt)
        )
        common = (flat.conj() @ tilted) / (flat.conj() @ flat)
        changes.append((np.abs(tilted - common * flat) ** 2).sum() / (np.abs(tilted) ** 2).sum())
    assert found.angle * np.sin(tilt) ** 2 == pytest.approx(np.sqrt(np.mean(changes)), abs=1.5e-2)
    assert found.angle > 0.1


@pytest.mark.parametrize(
    ("cell", "row"),
    [
        (dataclasses.replace(CELL, sidewall_rad=0.02), [0.1]),
        (dataclasses.replace(CELL, over=(Film("SiO2", 0.1),)), [0.1]),
        (CELL, []),
        (CELL, [0.1, 0.3]),
        (CELL, [0.0]),
    ],
)
def test_what_cannot_be_a_row_is_refused(cell, row):
    with pytest.raises(CellError):
        supercell.solve_row(cell, row, WAVE, polarization="x")
