"""What a library and its proxy are asked for where nothing is said: as the pages say
it.
"""

import dataclasses

import pytest

from metalens.cell import Cell, Index
from metalens.cell.shapes import Square
from metalens.pillars.fit import Wanted
from metalens.pillars.record import Sweep

ROUND = Cell(0.3, 0.7, Index(2.1))


@pytest.mark.parametrize(
    ("cell", "sizes", "tolerance"),
    [
        (ROUND, {}, 1e-3),
        (dataclasses.replace(ROUND, shape=Square()), {}, 0.02),
        (
            dataclasses.replace(ROUND, shape=Square()),
            {"diameters_um": (0.1, 0.2), "lengths_um": (0.12, 0.23)},
            0.05,
        ),
    ],
)
def test_a_tolerance_left_out_is_what_the_solver_of_such_pillars_reaches(
    cell, sizes, tolerance
):
    assert Sweep(**sizes).settled(cell).tolerance == tolerance
    assert Sweep(tolerance=0.003, **sizes).settled(cell).tolerance == 0.003


def test_a_proxy_follows_its_entries_to_half_of_what_they_are_known_to():
    """A thousandth at the least, and what is asked where it is asked."""
    loose = Wanted().settled(0.034)
    assert (loose.phase_tolerance_rad, loose.transmission_tolerance) == (0.017, 0.017)
    close = Wanted(transmission_tolerance=0.004).settled(0.0013)
    assert (close.phase_tolerance_rad, close.transmission_tolerance) == (1e-3, 0.004)
