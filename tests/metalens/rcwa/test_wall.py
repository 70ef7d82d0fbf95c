"""Collocation of walls that change with height: closed forms, invariants, and no growth
with the harmonics.
"""

import math

import numpy as np
import pytest

from metalens import rcwa
from metalens.cell import Cell, Index, Layer
from metalens.cell.shapes import Rectangle
from metalens.rcwa.sidewall import WallSection, panel_transfer

TILTED = Cell(0.31, 0.63, Index(3.5), Index(1.47), Index(1.03), sidewall_rad=0.034)


def test_uniform_wall_is_an_exponential():
    """P = 1, Q = q²: u'' = -q² u, over a panel of 0.4 rad; five stages leave 1e-13."""
    q, height = 1.7, 2.3
    this = WallSection(lambda share: (np.eye(1), q**2 * np.eye(1)), height)
    got = panel_transfer(this, 0.4, 0.5, 5)
    phase = q * height * 0.1
    want = np.array(
        [
            [math.cos(phase), -1j * math.sin(phase) / q],
            [-1j * q * math.sin(phase), math.cos(phase)],
        ]
    )
    assert np.abs(got - want).max() < 1e-12


@pytest.mark.parametrize("reach", [3, 6])
def test_error_of_the_wall_does_not_grow_with_the_harmonics(reach):
    t = {
        stages: rcwa.solve_truncation(
            TILTED, 0.17, 0.87, harmonics=reach, stages=stages
        ).t[0, 0]
        for stages in (4, 5, 6)
    }
    assert abs(t[5] - t[6]) < 1e-4
    assert abs(t[4] - t[5]) < 5e-3


def test_power_is_kept_and_the_bar_covers_more_stages():
    """Gauss collocation keeps quadratic invariants."""
    found = rcwa.solve(TILTED, 0.17, 0.87, harmonics=5, tolerance=1e-3)
    finer = rcwa.solve_truncation(TILTED, 0.17, 0.87, harmonics=5, stages=8)
    assert abs(found.energy - 1) < 1e-10
    assert abs(found.t - finer.t[0, 0]) < 1e-4


def test_upright_limit_is_the_upright_pillar():
    upright = Cell(0.31, 0.63, Index(3.5), Index(1.47), Index(1.03))
    tilted = Cell(0.31, 0.63, Index(3.5), Index(1.47), Index(1.03), sidewall_rad=1e-12)
    want = rcwa.solve_truncation(upright, 0.17, 0.87, harmonics=4)
    got = rcwa.solve_truncation(tilted, 0.17, 0.87, harmonics=4, stages=6)
    assert np.abs(got.t - want.t).max() < 1e-8
    assert np.abs(got.r - want.r).max() < 1e-8


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
