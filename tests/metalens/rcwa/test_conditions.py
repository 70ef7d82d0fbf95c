"""What coupled waves refuse before they solve: pillars whose leaning walls meet or
close.
"""

import math

import pytest

from metalens import rcwa
from metalens.cell import Cell, Index
from metalens.core.errors import CellError


@pytest.mark.parametrize(
    ("tilt", "wide", "narrow"), [(0.1, "foot", "top"), (-0.1, "top", "foot")]
)
def test_walls_that_meet_or_close_are_refused_by_where_they_do(tilt, wide, narrow):
    """Wider by height times tangent at the foot, or at the top where the wall leans
    out; thinner at the other end.
    """
    slant = 0.6 * math.tan(0.1)
    cell = Cell(0.4, 0.6, Index(3.5), Index(1.45), sidewall_rad=tilt)
    with pytest.raises(CellError, match=f"overlap, the {wide} of a section, "):
        rcwa.solve(cell, 0.38, 0.85)
    with pytest.raises(
        CellError,
        match=f"closes the pillar below its {narrow}; need at least {slant:.6g} um",
    ):
        rcwa.solve(cell, 0.05, 0.85)
    touching = rcwa.solve(cell, 0.4 - slant, 0.85, harmonics=1)
    assert abs(touching.energy - 1) < 1e-9
