"""Who asks for no tolerance gets 1e-3, as the pages say: the same bits as asked for,
and less error than with 1.
"""

import pytest

from metalens import modal, rcwa
from metalens.cell import Cell, Index

CELL = Cell(0.32, 0.55, Index(3.1), Index(1.47))
LIGHT = {"angle_rad": 0.11, "polarization": "s"}


@pytest.mark.parametrize("engine", [rcwa, modal])
def test_one_pillar(engine):
    asked = engine.solve(CELL, 0.17, 0.83, **LIGHT, tolerance=1e-3)
    assert engine.solve(CELL, 0.17, 0.83, **LIGHT) == asked
    assert (
        asked.t_error < engine.solve(CELL, 0.17, 0.83, **LIGHT, tolerance=1.0).t_error
    )


def test_many_pillars():
    asked = rcwa.solve_many(CELL, [0.12, 0.19], 0.83, **LIGHT, tolerance=1e-3)
    assert rcwa.solve_many(CELL, [0.12, 0.19], 0.83, **LIGHT) == asked
