"""Slopes of the pillars by process: against differences of an independent solver, and
where they come from.
"""

import dataclasses
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.model import pillar_slopes
from characterize.model.pillar_slopes import log_response_slopes
from metalens import rcwa
from metalens.cell.record import Cell, Film, Index
from metalens.fabrication import sensitivity

CELL = Cell(pitch_um=0.3, height_um=0.7, pillar=Index(3.6), substrate="SiO2")


def lens_of(cell):
    return dataclasses.replace(b.lens(), cell=cell)


def coupled(cell, diameter_um):
    """t by RCWA, another solver than the table's: 9 harmonics err by 2 to 3 % of a
    slope."""
    return rcwa.solve(cell, diameter_um, 0.85, harmonics=9).t


def thin_lens(cell):
    lens = lens_of(cell)
    thin = dataclasses.replace(
        lens.diameters, diameter_um=lens.diameters.diameter_um * 0.6
    )
    return dataclasses.replace(lens, diameters=thin)


def slope_by(changed, diameter_um, step=1e-3):
    """Central difference of ln t."""
    high, low = (coupled(changed(side * step), diameter_um) for side in (1, -1))
    return np.log(high / low) / (2 * step)


def test_slopes_are_those_of_an_independent_solver():
    found = log_response_slopes(thin_lens(CELL))
    assert found.error < 0.1
    for d in (0.07, 0.15):
        height, index, wall = found.at(np.array(d))[:3]
        want = slope_by(lambda x: dataclasses.replace(CELL, height_um=0.7 + x), d)
        assert abs(height - want) < 0.05 * abs(want)
        want = slope_by(lambda x: dataclasses.replace(CELL, pillar=Index(3.6 + x)), d)
        assert abs(index - want) < 0.1 * abs(want) + 0.03
        assert wall != 0


def test_a_film_on_the_pillars_is_part_of_their_slopes():
    film = dataclasses.replace(CELL, over=(Film(Index(1.5), 0.05),))
    found = log_response_slopes(thin_lens(film))
    want = slope_by(lambda x: dataclasses.replace(film, height_um=0.7 + x), 0.13)
    assert abs(found.at(np.array(0.13))[0] - want) < (0.05 + found.error) * abs(want)


def test_cells_that_no_solver_takes_fall_back_to_the_effective_index():
    absorbing = dataclasses.replace(CELL, substrate=Index(1.5, 0.1))
    assert np.array_equal(
        log_response_slopes(lens_of(absorbing)).coefficients,
        sensitivity(lens_of(absorbing)).coefficients,
    )


def test_slopes_that_are_kept_are_known_by_the_least_and_the_largest_diameter():
    whole = b.lens().diameters.diameter_um
    lit = whole[whole > 0]
    told = set()
    for low, high in (
        (lit.min(), lit.max()),
        (lit.min() + 0.011, lit.max()),
        (lit.min(), lit.max() - 0.013),
    ):
        d = np.where(whole > 0, np.clip(whole, low, high), 0.0)
        lens = dataclasses.replace(
            b.lens(), diameters=dataclasses.replace(b.lens().diameters, diameter_um=d)
        )
        told.add(pillar_slopes._about(lens, 1e-3, ["height_nm"]))
    assert len(told) == 3
