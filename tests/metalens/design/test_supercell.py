"""Rows of unlike pillars: one pillar repeated is the periodic cell, energy holds,
mirrors mirror, slopes cost light.
"""

import dataclasses

import numpy as np
import pytest
import torch

from metalens import design, modal
from metalens.cell.record import Cell, Film, Index
from metalens.cell.shapes import Square
from metalens.core.errors import CellError
from metalens.design import neighbours as supercell
from metalens.design.profiles import Focus
from metalens.library.proxy import Proxy
from metalens.psf import neighbour_coupling

CELL = Cell(pitch_um=0.30, height_um=0.7, pillar=Index(3.6), substrate="SiO2")
GLASS = dataclasses.replace(CELL, pillar=Index(1.05))
WAVE = 0.85
HELD_OUT = 0.5  # of the change by neighbours


def test_a_single_pillar_is_the_periodic_cell_of_the_modal_method():
    want = modal.solve(CELL, 0.12, WAVE, tolerance=1e-3).t
    for polarization in ("x", "y"):
        errors = [
            abs(
                supercell.solve_row(
                    CELL, [0.12], WAVE, polarization=polarization, harmonics=h
                ).order(0)
                - want
            )
            for h in (3, 5)
        ]
        assert errors[1] < 0.01  # truncation of RCWA at 5 orders
        assert errors[1] < errors[0]


@pytest.mark.parametrize("polarization", ["x", "y"])
def test_equal_pillars_in_a_row_are_one_pillar(polarization):
    one = supercell.solve_row(
        CELL, [0.14], WAVE, polarization=polarization, harmonics=2
    )
    four = supercell.solve_row(
        CELL, [0.14] * 4, WAVE, polarization=polarization, harmonics=2
    )
    assert four.order(0) == pytest.approx(one.order(0), abs=1e-9)
    assert np.abs(four.t[np.abs(four.orders) % 4 != 0]).max() < 1e-9


@pytest.mark.parametrize("polarization", ["x", "y"])
def test_energy_holds_and_a_mirrored_row_mirrors_its_orders(polarization):
    row = [0.1, 0.12, 0.17, 0.2]
    there = supercell.solve_row(CELL, row, WAVE, polarization=polarization, harmonics=2)
    back = supercell.solve_row(
        CELL, row[::-1], WAVE, polarization=polarization, harmonics=2
    )
    assert there.energy == pytest.approx(1, abs=1e-9)
    assert back.t[::-1] == pytest.approx(there.t, abs=1e-9)
    # the row is not its own mirror image
    assert abs(there.order(1) - there.order(-1)) > 0.05


@pytest.mark.parametrize("polarization", ["x", "y"])
def test_rows_along_the_diagonal_hold_energy_mirror_and_know_one_pillar_from_another(
    polarization,
):
    """Equal pillars have the orders of their own lattice alone, every other one of a
    square of two (|m + n| even), and
    light along both axes is alike; truncated to another set of waves than along the
    lattice, 1e-2 of t."""
    about = dict(polarization=polarization, harmonics=2, diagonal=True)
    four = supercell.solve_row(CELL, [0.14] * 4, WAVE, **about)
    assert np.abs(four.t[np.abs(four.orders) % 4 != 0]).max() < 2e-4
    two = [
        supercell.solve_row(
            CELL, [0.14] * 2, WAVE, **about | dict(polarization=p)
        ).order(0)
        for p in ("x", "y")
    ]
    assert two == pytest.approx([four.order(0)] * 2, abs=2e-4)
    fine = supercell.solve_row(
        CELL, [0.14], WAVE, polarization=polarization, harmonics=5
    ).order(0)
    assert (
        abs(
            supercell.solve_row(
                CELL, [0.14] * 2, WAVE, **about | dict(harmonics=4)
            ).order(0)
            - fine
        )
        < 0.02
    )
    there = supercell.solve_row(CELL, [0.1, 0.12, 0.17, 0.2], WAVE, **about)
    back = supercell.solve_row(CELL, [0.2, 0.17, 0.12, 0.1], WAVE, **about)
    assert there.energy == pytest.approx(1, abs=1e-9)
    assert back.t[::-1] == pytest.approx(there.t, abs=1e-9)
    with pytest.raises(CellError, match="diagonal: need an even number"):
        supercell.solve_row(CELL, [0.14] * 3, WAVE, **about)


def test_absorbing_pillars_lose_energy():
    lossy = dataclasses.replace(CELL, pillar=Index(3.6, 0.1))
    assert (
        supercell.solve_row(
            lossy, [0.1, 0.2], WAVE, polarization="x", harmonics=2
        ).energy
        < 0.98
    )


def test_weak_pillars_do_not_feel_their_neighbours():
    """Where scattering is weak the local periodic approximation is first-order exact:
    pillars add one by one.
    """
    row = np.array([0.08, 0.14, 0.2, 0.25])
    whole = supercell.solve_row(GLASS, row, WAVE, polarization="y", harmonics=2)
    alone = [
        supercell.solve_row(GLASS, [d], WAVE, polarization="y", harmonics=2).order(0)
        for d in row
    ]
    # second order: (0.2 rad)² / 20
    assert whole.order(0) == pytest.approx(np.mean(alone), abs=2e-3)
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
    found = supercell.estimate_neighbour_coupling(
        _lens(), counts=(6, 5, 4), harmonics=2
    )
    assert found.sine[~found.diagonal] == pytest.approx(
        WAVE / 0.3 / np.array([6, 5, 4])
    )
    assert found.sine[found.diagonal] == pytest.approx(
        WAVE * 2**0.5 / 0.3 / np.array([6, 8])
    )  # √2 of those, even
    cosine = np.sqrt(1 - found.sine**2)
    power = found.factor * np.stack([cosine**-0.5, cosine**0.5])
    change = abs(power - 1)
    assert (change > 0.01).all()
    assert (change < 0.6).all()
    model = found.at(found.sine, np.where(found.diagonal, np.pi / 4, 0.0))
    assert abs(model - power).max() < 0.5 * change.max()  # two terms for three rows
    # nothing turned, nothing changed
    assert found.at(np.array(0.0)) == pytest.approx(1.0)
    assert abs(found.coarse - found.factor).max() > 0


@pytest.mark.parametrize(
    ("cell", "row"),
    [
        (dataclasses.replace(CELL, sidewall_rad=0.02), [0.1]),
        (dataclasses.replace(CELL, over=(Film("SiO2", 0.1),)), [0.1]),
        (CELL, []),
        (CELL, [0.1, 0.3]),
        (CELL, [0.0]),
        (dataclasses.replace(CELL, shape=Square()), [0.1]),
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
    alone = [
        supercell.solve_row(TITANIA, [d], GREEN, polarization="x", harmonics=4).order(0)
        for d in sizes
    ]
    phase = np.polynomial.Chebyshev.fit(
        sizes, np.unwrap(np.angle(alone)), 8, domain=[NARROW, WIDE]
    )
    proxy = Proxy(
        phase.coef[None], np.array([[0.95]]), (NARROW, WIDE), (GREEN, GREEN), 0.0, 0.0
    )
    focus = Focus(GREEN, 7.5)
    wanted = design.phase_of(None, focus, radius_um=10.0)
    limits = design.Limits(1e3 * NARROW, 10.0)
    return design.make(
        wanted, focus, aperture_um=20.0, cell=TITANIA, proxy=proxy, limits=limits
    )[0]


def _solved_whole(lens, polarization, *, count=12, aperture=0.8, harmonics=2):
    """Amplitude in the focus of a cylinder lens of ``count`` unlike pillars over what
    they give one by one, and the
    sines by which it turns light."""
    cell = lens.cell
    wave = lens.wavelength_um
    place = np.arange(count) - (count - 1) / 2
    width = count * cell.pitch_um
    focal = width / 2 / np.tan(np.arcsin(aperture))
    x = place * cell.pitch_um
    phase = 0.4 - 2 * np.pi / wave * (np.hypot(x, focal) - focal)
    sizes = np.asarray(
        lens.proxy.diameter_um(
            phase, wave, within_um=supercell.drawn_diameter_range(lens), gap="nearest"
        )
    )
    settings = {"polarization": polarization, "harmonics": harmonics}
    row = supercell.solve_row(cell, sizes, wave, **settings)
    alone = np.array(
        [supercell.solve_row(cell, [d], wave, **settings).order(0) for d in sizes]
    )
    to_orders = np.exp(-2j * np.pi * np.outer(row.orders, place) / count) / count
    ideal = np.where(
        np.abs(row.orders) * wave / width < aperture,
        np.conj(to_orders @ np.exp(1j * phase)),
        0,
    )
    return (ideal @ row.t) / (ideal @ (to_orders @ alone)), np.abs(x) / np.hypot(
        x, focal
    )


def test_the_factor_of_rows_is_that_of_a_lens_of_unlike_pillars_solved_whole(steep):
    """Sign and size; what is left are the ends of twelve pillars and how fast their
    zones change.
    """
    found = supercell.estimate_neighbour_coupling(steep, counts=(2, 3, 4), harmonics=2)
    solved = [_solved_whole(steep, polarization) for polarization in ("x", "y")]
    cosine = np.sqrt(1 - solved[0][1] ** 2)
    fields = found.at(solved[0][1]) * np.stack([cosine**0.5, cosine**-0.5])
    whole = np.mean([ratio for ratio, _ in solved])
    predicted = fields.mean()
    assert np.angle(predicted) < -0.3  # late, not early
    assert np.angle(whole) == pytest.approx(np.angle(predicted), abs=0.06)
    assert abs(whole) == pytest.approx(abs(predicted), abs=0.12)
    # light along the row loses more
    assert abs(solved[0][0]) < abs(solved[1][0]) - 0.05
    assert (np.abs(found.factor[0]) < np.abs(found.factor[1]) - 0.05)[:2].all()


@pytest.mark.parametrize(
    ("count", "diagonal"), [(5, False), pytest.param(8, True, marks=pytest.mark.slow)]
)
def test_the_factor_on_a_lens_s_maps_is_that_of_rows_it_has_not_seen(
    steep, count, diagonal
):
    """A grating of the lens's pillars, as the maps of PSFs take it, against all its
    pillars solved as one cell.

    Rows of 2, 3 and 4 pillars (2, 4 and 6 along the diagonal) are known. Apart: rows
    whose phases begin elsewhere.
    """
    rows = supercell.estimate_neighbour_coupling(steep, counts=(2, 3, 4), harmonics=3)
    block = supercell.block_of(TITANIA.pitch_um, diagonal)
    solved = supercell._mean(steep, count, diagonal, 3)[0]
    sine = GREEN / (count * block.spacing_um)
    want = solved * np.array([(1 - sine**2) ** -0.25, (1 - sine**2) ** 0.25])
    along, down = np.indices((24, 24))[::-1]
    turns = 2 * np.pi / count * (along + down if diagonal else along)
    got = neighbour_coupling.apply_jones_coupling(
        torch.tensor(np.angle(np.exp(1j * turns))),
        torch.ones(24, 24).double(),
        rows,
        TITANIA.pitch_um,
    )
    middle = [complex(part[12, 12]) for part in got]
    fields = [middle[0] + middle[2], middle[0] - middle[2]] if diagonal else middle[:2]
    change = abs(want - 1).max()
    assert change > 0.1
    assert abs(np.array(fields) - want).max() < HELD_OUT * change
