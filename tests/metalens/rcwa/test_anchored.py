"""Coupled waves put right by the modal method: exact where nothing is left to put
right, and honest elsewhere.
"""

import cmath
import math
from dataclasses import replace

import numpy as np
import pytest

from metalens import modal, rcwa
from metalens.cell import Cell, Film, Incidence, Index
from metalens.core.errors import CellError
from metalens.rcwa import anchored
from metalens.rcwa.anchored import node_diameters, solve_anchored, upright_cell

UPRIGHT = Cell(0.33, 0.61, Index(2.6), Index(1.46), Index(1.04), Index(1.0))
TILTED = replace(UPRIGHT, sidewall_rad=0.027)
WAVELENGTH, DIAMETER = 0.87, 0.162
LIGHT = Incidence(WAVELENGTH)


def test_upright_limit_is_the_modal_answer():
    want = modal.solve(UPRIGHT, DIAMETER, WAVELENGTH, tolerance=2e-4)
    got = solve_anchored(
        UPRIGHT, DIAMETER, LIGHT, [want], tolerance=1e-3, reaches=(3, 4, 5, 6)
    )
    assert abs(got.t - want.t) <= got.t_error
    assert got.t_error < 1e-3


@pytest.mark.parametrize("polarization", ["s", "p"])
def test_films_like_the_half_spaces_only_turn_the_phase(polarization):
    """A film of the cover's index on top and one of the substrate's below: t exp(i (kz1
    d1 + kz2 d2)).
    """
    angle, under, over = 0.13, 0.07, 0.11
    light = {"angle_rad": angle, "polarization": polarization, "tolerance": 1e-3}
    bare = modal.solve(UPRIGHT, DIAMETER, WAVELENGTH, **light)
    cell = replace(
        UPRIGHT, under=(Film(Index(1.46), under),), over=(Film(Index(1.04), over),)
    )
    got = modal.solve(cell, DIAMETER, WAVELENGTH, **light)
    kx = math.sin(angle)
    turn = (
        2
        * math.pi
        / WAVELENGTH
        * (under * math.sqrt(1.46**2 - kx**2) + over * math.sqrt(1.04**2 - kx**2))
    )
    assert got.engine == "anchored"
    assert abs(got.t - bare.t * cmath.exp(1j * turn)) <= got.t_error + bare.t_error


def test_tilted_wall_meets_a_thousandth_and_agrees_with_more_harmonics():
    got = modal.solve(TILTED, DIAMETER, WAVELENGTH, tolerance=1e-3)
    assert got.converged
    assert abs(got.energy - 1) < 1e-3
    alone = rcwa.solve(TILTED, DIAMETER, WAVELENGTH, harmonics=7)
    assert (
        abs(got.t - alone.t) < 6e-3
    )  # what seven orders leave of an upright pillar of this index


def test_a_tilt_to_either_side_differs():
    """Foot and top are not alike: light comes from the substrate."""
    found = [
        modal.solve(
            replace(UPRIGHT, sidewall_rad=s), DIAMETER, WAVELENGTH, tolerance=2e-3
        )
        for s in (-0.05, 0.05)
    ]
    assert abs(found[0].t - found[1].t) > 5 * max(one.t_error for one in found)


def test_nodes_lie_between_foot_and_top():
    nodes = np.array(node_diameters(TILTED, DIAMETER))
    half = 0.61 * math.tan(0.027)
    assert len(nodes) == anchored.NODES
    assert np.abs(nodes - DIAMETER).max() < half
    assert np.ptp(nodes) > 1.8 * half
    assert node_diameters(UPRIGHT, DIAMETER) == (DIAMETER,)
    assert upright_cell(replace(TILTED, over=(Film("SiO2", 0.1),))) == UPRIGHT


def test_walls_that_close_are_refused():
    with pytest.raises(CellError, match="closes the pillar"):
        modal.solve(replace(UPRIGHT, sidewall_rad=0.3), 0.1, WAVELENGTH)


def test_a_bar_that_knows_nothing_is_two():
    """|t| is 1 at most, so no two answers are farther apart; an anchor whose own error
    is 5 leaves that.
    """
    upright = modal.solve(UPRIGHT, DIAMETER, WAVELENGTH, tolerance=1e-2)
    unsure = replace(upright, t_error=5.0)
    got = solve_anchored(
        UPRIGHT, DIAMETER, LIGHT, [unsure], tolerance=1e-2, reaches=(3, 4, 5, 6)
    )
    assert got.t_error == 2.0
    assert not got.converged
