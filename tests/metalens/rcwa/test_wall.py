"""Walls that change with height: invariants and limits."""

from dataclasses import replace

from metalens import rcwa
from metalens.cell import Cell, Index, Layer
from metalens.cell.shapes import Rectangle

TILTED = Cell(0.31, 0.63, Index(3.5), Index(1.47), Index(1.03), sidewall_rad=0.034)


def test_power_is_kept_and_the_bar_covers_many_thin_steps():
    """Thirty-two and sixty-four steps, extrapolated: 1e-6 left."""
    found = rcwa.solve(TILTED, 0.17, 0.87, harmonics=5, tolerance=1e-3)
    coarse, fine = (
        rcwa.solve_truncation(
            replace(
                TILTED,
                sidewall_rad=0.0,
                layers=tuple(rcwa.staircase_layers(TILTED, steps)),
            ),
            0.17,
            0.87,
            harmonics=5,
        ).t[0, 0]
        for steps in (32, 64)
    )
    assert abs(found.energy - 1) < 1e-10
    assert abs(found.t - (4 * fine - coarse) / 3) < 1e-4


def test_upright_limit_is_the_upright_pillar():
    upright = Cell(0.31, 0.63, Index(3.5), Index(1.47), Index(1.03))
    tilted = Cell(0.31, 0.63, Index(3.5), Index(1.47), Index(1.03), sidewall_rad=1e-12)
    want = rcwa.solve_truncation(upright, 0.17, 0.87, harmonics=4)
    got = rcwa.solve_truncation(tilted, 0.17, 0.87, harmonics=4)
    assert abs(got.t - want.t).max() < 1e-8
    assert abs(got.r - want.r).max() < 1e-8


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
    assert abs(cut.energy - 1).max() < 1e-9
    # the same pillar in one piece: what the staircases leave
    assert abs(cut.t - one.t).max() < 2e-4
