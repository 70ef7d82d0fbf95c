"""Rows of unlike pillars: one pillar repeated is the periodic cell, energy holds, mirrors mirror, slopes cost light."""

import dataclasses

import numpy as np
import pytest

from metalens import design, modal
from metalens.cell.record import Cell, Film, Index
from metalens.cell.shapes import Square
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
    assert (change < 0.6).all()
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


TITANIA = Cell(pitch_um=0.32, height_um=0.8, pillar=Index(2.35), substrate="SiO2")
GREEN, NARROW, WIDE = 0.532, 0.084, 0.24


@pytest.fixture(scope="module")
def steep():
    """A lens of NA 0.8 of pillars as the rows' own solver has them, one by one."""
    sizes = np.linspace(NARROW, WIDE, 25)
    alone = [supercell.solve_row(TITANIA, [d], GREEN, polarization="x", harmonics=2).order(0) for d in sizes]
    phase = np.polynomial.Chebyshev.fit(sizes, np.unwrap(np.angle(alone)), 8, domain=[NARROW, WIDE])
    proxy = Proxy(phase.coef[None], np.array([[0.95]]), (NARROW, WIDE), (GREEN, GREEN), 0.0, 0.0)
    focus = Focus(GREEN, 7.5)
    wanted, limits = design.phase_of(None, focus, radius_um=10.0), design.Limits(1e3 * NARROW, 10.0)
    return design.make(wanted, focus, aperture_um=20.0, cell=TITANIA, proxy=proxy, limits=limits)[0]


def _solved_whole(lens, polarization, *, count=12, aperture=0.8, harmonics=2):
    """Amplitude in the focus of a cylinder lens of ``count`` unlike pillars over what they give one by one, and the
    sines by which it turns light."""
    cell, wave, place = lens.cell, lens.wavelength_um, np.arange(count) - (count - 1) / 2
    width = count * cell.pitch_um
    focal = width / 2 / np.tan(np.arcsin(aperture))
    x = place * cell.pitch_um
    phase = 0.4 - 2 * np.pi / wave * (np.hypot(x, focal) - focal)
    sizes = np.asarray(lens.proxy.diameter_um(phase, wave, within_um=supercell.printed(lens), gap="nearest"))
    settings = {"polarization": polarization, "harmonics": harmonics}
    row = supercell.solve_row(cell, sizes, wave, **settings)
    alone = np.array([supercell.solve_row(cell, [d], wave, **settings).order(0) for d in sizes])
    to_orders = np.exp(-2j * np.pi * np.outer(row.orders, place) / count) / count
    ideal = np.where(np.abs(row.orders) * wave / width < aperture, np.conj(to_orders @ np.exp(1j * phase)), 0)
    return (ideal @ row.t) / (ideal @ (to_orders @ alone)), np.abs(x) / np.hypot(x, focal)


def test_the_factor_of_rows_is_that_of_a_lens_of_unlike_pillars_solved_whole(steep):
    """Sign and size; what is left are the ends of twelve pillars and how fast their zones change."""
    found = supercell.neighbours(steep, counts=(2, 3, 4), harmonics=2)
    solved = [_solved_whole(steep, polarization) for polarization in ("x", "y")]
    whole, predicted = np.mean([ratio for ratio, _ in solved]), found.at(solved[0][1]).mean()
    assert np.angle(predicted) < -0.3  # late, not early
    assert np.angle(whole) == pytest.approx(np.angle(predicted), abs=0.06)
    assert abs(whole) == pytest.approx(abs(predicted), abs=0.12)
    assert abs(solved[0][0]) < abs(solved[1][0]) - 0.05  # light along the row loses more
    assert (np.abs(found.by_polarization[0]) < np.abs(found.by_polarization[1]) - 0.05)[:2].all()


def test_the_share_left_in_the_focus_counts_both_polarisations_by_power():
    """One ring that turns light by 0.6: tangential amplitudes c, powers c² / 0.8 along the slope and 0.8 c² across."""
    sine = np.array([0.5, 0.25])
    along, across = 1 + (0.2 - 0.3j) * sine - 0.4 * sine**2, 1 + 0.1j * sine + 0.3 * sine**2
    none = np.zeros(2)
    found = supercell.Neighbours(0j, 0j, sine, none, none, GREEN, np.array([along, across]))
    want = (1 + (0.2 - 0.3j) * 0.6 - 0.4 * 0.36) / 0.8**0.5 + (1 + 0.06j + 0.3 * 0.36) * 0.8**0.5
    assert found.share(np.array([0.6]), np.array([1.0]), 1.0) == pytest.approx(abs(want / 2) ** 2, rel=1e-12)
    assert found.without(1).sine == pytest.approx([0.5])
    assert found.without(1).by_polarization[:, 0] == pytest.approx([along[0], across[0]])


def test_what_unlike_neighbours_leave_of_a_steep_lens_and_of_a_flat_one(steep, monkeypatch):
    solved = {}

    def kept(lens, *, counts, harmonics):
        solved[harmonics] = supercell.neighbours(lens, counts=counts, harmonics=harmonics - 1)  # a third of the time
        return solved[harmonics]

    monkeypatch.setattr("metalens.design.own_cell.neighbours", kept)
    found = design.unlike(steep, radius_um=10.0)
    assert found.pillars == (2, 3, 4)  # 0.532 / (0.32 · 0.8) = 2.1 pillars in a zone of the rim
    r = 10.0 * np.sqrt((np.arange(4000) + 0.5) / 4000)
    shares = {h: rows.share(r / np.hypot(r, 7.5), np.full(4000, 1 / 4000), 1.0) for h, rows in solved.items()}
    assert found.share == pytest.approx(shares[3], rel=1e-3)
    assert found.error > abs(shares[3] - shares[2]) + 0.2 * (1 - shares[3])
    assert found.error < 0.3
    rough = design.rough_unlike(steep, radius_um=10.0)
    assert abs(rough.share - found.share) < rough.error  # what is said without a solve covers it
    flat = design.rough_unlike(dataclasses.replace(steep, sensor_distance_um=75.0), radius_um=10.0)
    assert flat.share > 0.98


def test_rows_of_other_cells_are_refused_by_name():
    with pytest.raises(CellError, match="square on a square lattice"):
        supercell.solve_row(dataclasses.replace(CELL, shape=Square()), [0.1], WAVE, polarization="x")
