"""What holds when nobody says: the documented defaults, and the steps of a tilted wall."""

import inspect

import pytest

from metalens import rcwa
from metalens.cell.light import Light
from metalens.cell.record import Cell, Index
from metalens.rcwa.conditions import case
from metalens.rcwa.derivative import differentiate


def test_a_solve_is_to_a_thousandth_at_normal_incidence_unless_said_otherwise():
    told = inspect.signature(rcwa.solve).parameters
    found = {
        name: told[name].default for name in ("tolerance", "angle_rad", "azimuth_rad")
    }
    assert found == {"tolerance": 1e-3, "angle_rad": 0.0, "azimuth_rad": 0.0}


@pytest.mark.parametrize(("tilt", "steps"), [(0.03, 8), (0.0, 0)])
def test_a_tilted_wall_is_taken_in_eight_steps(tilt, steps):
    cell = Cell(0.43, 0.7, pillar=Index(3.1), substrate=Index(1.45), sidewall_rad=tilt)
    want = differentiate(
        case(cell, Light(0.81)), 0.22, harmonics=3, steps=steps, angle_rad=0.0
    )
    assert rcwa.derivatives(cell, 0.22, 0.81, harmonics=3) == want
