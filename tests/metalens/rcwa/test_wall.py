"""Collocation of walls that change with height: closed forms, invariants, and no growth
with the harmonics.
"""

import math

import numpy as np
import pytest

from metalens import rcwa
from metalens.cell import Cell, Incidence, Index, Layer
from metalens.cell.shapes import Rectangle
from metalens.rcwa import wall
from metalens.rcwa.conditions import disc_case
from metalens.rcwa.solver import solve_truncated, wall_stages
from metalens.rcwa.wall import EDGES, TiltedWall, collocate_panel, gauss_collocation

TILTED = Cell(0.31, 0.63, Index(3.5), Index(1.47), Index(1.03), sidewall_rad=0.034)


def of(cell):
    return disc_case(cell, Incidence(0.87))


def test_gauss_integrals_are_those_of_polynomials():
    c, b, a = gauss_collocation(4)
    for power in range(4):
        assert np.abs(a @ c**power - c ** (power + 1) / (power + 1)).max() < 1e-14
    assert abs(b @ c**7 - 1 / 8) < 1e-14  # exact to degree 2 m - 1, and rounding


def test_uniform_wall_is_an_exponential():
    """P = 1, Q = q²: u'' = -q² u, over a panel of 0.4 rad; five stages leave 1e-13."""
    q, height = 1.7, 2.3
    this = TiltedWall(lambda share: (np.eye(1), q**2 * np.eye(1)), height)
    got = collocate_panel(this, 0.4, 0.5, 5).downwards
    phase = q * height * 0.1
    want = np.array(
        [
            [math.cos(phase), -1j * math.sin(phase) / q],
            [-1j * q * math.sin(phase), math.cos(phase)],
        ]
    )
    assert np.abs(got - want).max() < 1e-12


def test_panels_cover_the_wall():
    assert EDGES[0] == 0
    assert EDGES[-1] == 1
    assert np.allclose(np.diff(EDGES), np.diff(EDGES)[::-1])


@pytest.mark.parametrize("reach", [3, 6])
def test_error_of_the_wall_does_not_grow_with_the_harmonics(reach):
    """The staircase and the commutator-free method that stood here before lost an order
    with every few harmonics.
    """
    t = {
        stages: solve_truncated(of(TILTED), np.array([0.17]), reach, stages).t[0]
        for stages in (4, 5, 6)
    }
    assert abs(t[5] - t[6]) < 1e-4
    assert abs(t[4] - t[5]) < 5e-3


def test_power_and_the_error_that_is_told():
    this = of(TILTED)
    stages, left = wall_stages(this, np.array([0.17]), 1e-3)
    assert left <= 1e-4
    found = solve_truncated(this, np.array([0.17]), 5, stages)
    assert (
        abs(found.energy[0] - 1) < 1e-10
    )  # Gauss collocation keeps quadratic invariants
    assert abs(found.t[0] - solve_truncated(this, np.array([0.17]), 5, 8).t[0]) <= left


def test_upright_limit_is_the_upright_pillar():
    flat = Cell(0.31, 0.63, Index(3.5), Index(1.47), Index(1.03))
    want = solve_truncated(of(flat), np.array([0.17]), 4)
    got = solve_truncated(of(flat), np.array([0.17]), 4, 6)
    assert abs(got.t[0] - want.t[0]) < 1e-8
    assert abs(got.r[0] - want.r[0]) < 1e-8


def test_both_solvers_of_a_round_tilted_pillar_meet():
    """Other orders, other normals, one limit: RCWA of the disc by the fast way, and of
    any shape.
    """
    fast, any_shape = (
        rcwa.solve(TILTED, 0.17, 0.87, harmonics=8),
        rcwa.jones(TILTED, 0.17, 0.87, harmonics=6),
    )
    assert (
        abs(fast.t - any_shape.t[0, 0]) < 2e-2
    )  # of truncation; the tilt itself is worth 5e-2


def test_layers_tilt_on_their_own_and_keep_power():
    cell = Cell(
        0.36,
        0.6,
        Index(3.3),
        Index(1.47),
        sidewall_rad=-0.02,
        shape=Rectangle(0.6, 0.3),
        layers=(Layer(0.1), Layer(0.5)),
    )
    whole = Cell(
        0.36,
        0.6,
        Index(3.3),
        Index(1.47),
        sidewall_rad=-0.02,
        shape=Rectangle(0.6, 0.3),
    )
    cut, one = (
        rcwa.jones(c, 0.2, 0.9, angle_rad=0.1, azimuth_rad=0.3, harmonics=2)
        for c in (cell, whole)
    )
    assert np.abs(cut.energy - 1).max() < 1e-9
    assert (
        np.abs(cut.t - one.t).max() < 2e-4
    )  # the same pillar in one piece: what interpolation and stages leave


def test_stages_stop_at_the_most():
    stages, left = wall.choose_stage_count(lambda count: np.array([1.0 / count]), 1e-9)
    assert stages == wall.MOST
    assert left > 1e-9
