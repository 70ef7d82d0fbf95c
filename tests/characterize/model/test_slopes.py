"""Slopes of the pillars by process: against differences of an independent solver, and where they come from."""

import dataclasses
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.model.pillar_slopes import slopes
from metalens import rcwa
from metalens.cell.record import Cell, Film, Index
from metalens.made import sensitivity

CELL = Cell(pitch_um=0.3, height_um=0.7, pillar=Index(3.6), substrate="SiO2")


def lens_of(cell):
    return dataclasses.replace(b.lens(), cell=cell)


def test_slopes_are_those_of_an_independent_solver():
    thin = dataclasses.replace(b.lens().diameters, diameter_um=b.lens().diameters.diameter_um * 0.6)
    found = slopes(dataclasses.replace(lens_of(CELL), diameters=thin))
    assert found.error < 0.02
    for d in (0.07, 0.12, 0.15):
        height, index, wall = found.at(np.array(d))
        step = 1e-3
        taller, lower = (dataclasses.replace(CELL, height_um=0.7 + s) for s in (step, -step))
        want = np.log(rcwa.derivatives(taller, d, 0.85).t / rcwa.derivatives(lower, d, 0.85).t) / (2 * step)
        assert abs(height - want) < 0.05 * abs(want)  # 9 harmonics of the referee: 2 to 3 % of the slope
        exact = rcwa.derivatives(CELL, d, 0.85)
        assert abs(index - exact.n / exact.t) < 0.1 * abs(exact.n / exact.t) + 0.03
        assert wall == 0


def test_cells_with_films_are_solved_too_and_impossible_ones_fall_back():
    film = dataclasses.replace(CELL, over=(Film(Index(1.5), 0.05),))
    thin = dataclasses.replace(b.lens().diameters, diameter_um=b.lens().diameters.diameter_um * 0.6)
    assert slopes(dataclasses.replace(lens_of(film), diameters=thin)).error < 0.1
    absorbing = dataclasses.replace(CELL, substrate=Index(1.5, 0.1))
    assert np.array_equal(slopes(lens_of(absorbing)).coefficients, sensitivity(lens_of(absorbing)).coefficients)
