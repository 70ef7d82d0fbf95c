"""Which cure is named for pillars that cover less than a turn: by what ends them, the
process or the library.
"""

import numpy as np
import pytest

from metalens.cell import Cell, Index
from metalens.design import of_phase
from metalens.design.of_phase import Limits
from metalens.pillars import Proxy

CELL = Cell(pitch_um=0.40, height_um=0.6, pillar=Index(3.1))
LIMITS = Limits(min_diameter_nm=90.0, min_gap_nm=60.0)  # prints 0.09 to 0.34 um


@pytest.mark.parametrize(
    ("low", "high", "ended"),
    [
        (
            0.0915,
            0.3385,
            "process",
        ),  # 1.5 nm are no end of their own: a curve ends at its last entries
        (0.0880, 0.3500, "process"),
        (0.0930, 0.3385, "library"),
        (0.0915, 0.3370, "library"),
    ],
)
def test_a_curve_that_reaches_what_is_printed_to_two_nanometres_is_ended_by_the_process(
    low, high, ended
):
    proxy = Proxy(
        np.array([[6.0, 2.0]]),
        np.array([[0.9, -0.03]]),
        (low, high),
        (0.85, 0.85),
        1e-6,
        1e-6,
    )
    told = of_phase.phase_coverage_hint(proxy, CELL, LIMITS, 0.8)
    assert ("the process prints 0.0900-0.3400 um" in told) is (ended == "library")
    assert ("0.75" in told) is (ended == "process")  # um: 0.6 of 0.8 of a turn
