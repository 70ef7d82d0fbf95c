"""Slopes of the pillars by process: against differences of an independent solver, and
where they come from.
"""

import dataclasses
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.model import pillar_slopes
from characterize.model.pillar_slopes import slopes
from metalens import rcwa
from metalens.cell.record import Cell, Film, Index
from metalens.made import Answers, named, sensitivity

CELL = Cell(pitch_um=0.3, height_um=0.7, pillar=Index(3.6), substrate="SiO2")


def lens_of(cell):
    return dataclasses.replace(b.lens(), cell=cell)


def test_slopes_are_those_of_an_independent_solver():
    thin = dataclasses.replace(
        b.lens().diameters, diameter_um=b.lens().diameters.diameter_um * 0.6
    )
    found = slopes(dataclasses.replace(lens_of(CELL), diameters=thin))
    assert found.error < 0.02
    for d in (0.07, 0.12, 0.15):
        height, index, wall = found.at(np.array(d))[:3]
        step = 1e-3
        taller, lower = (
            dataclasses.replace(CELL, height_um=0.7 + s) for s in (step, -step)
        )
        want = np.log(
            rcwa.derivatives(taller, d, 0.85).t / rcwa.derivatives(lower, d, 0.85).t
        ) / (2 * step)
        assert abs(height - want) < 0.05 * abs(
            want
        )  # 9 harmonics of the referee: 2 to 3 % of the slope
        exact = rcwa.derivatives(CELL, d, 0.85)
        assert abs(index - exact.n / exact.t) < 0.1 * abs(exact.n / exact.t) + 0.03
        assert wall == 0


def test_cells_with_films_are_solved_too_and_impossible_ones_fall_back():
    film = dataclasses.replace(CELL, over=(Film(Index(1.5), 0.05),))
    thin = dataclasses.replace(
        b.lens().diameters, diameter_um=b.lens().diameters.diameter_um * 0.6
    )
    assert slopes(dataclasses.replace(lens_of(film), diameters=thin)).error < 0.1
    absorbing = dataclasses.replace(CELL, substrate=Index(1.5, 0.1))
    assert np.array_equal(
        slopes(lens_of(absorbing)).coefficients,
        sensitivity(lens_of(absorbing)).coefficients,
    )


def test_a_slope_that_no_solver_knows_is_a_difference_where_it_is_wanted(monkeypatch):
    """Of a t whose logarithm follows the wall by 0.03 - 0.7i a degree, and by as much
    of its cube; told a radian.
    """
    rate = 0.03 - 0.7j

    def solved(cell, diameter_um, wavelength_um):
        lean = np.degrees(cell.sidewall_rad)
        return SimpleNamespace(t=np.exp(0.2 + rate * (lean + lean**3)))

    monkeypatch.setattr(pillar_slopes.rcwa, "derivatives", solved)
    found = pillar_slopes._exact(CELL, 0.11, 0.85, {"sidewall_deg"}, None)
    assert found[2] == pytest.approx(
        rate * 1.25 * 180 / np.pi, rel=1e-9
    )  # (0.5 + 0.125) / 0.5
    assert pillar_slopes._exact(CELL, 0.11, 0.85, (), None) == [
        *found[:2],
        *[0] * (len(named(Answers)) - 2),
    ]


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
