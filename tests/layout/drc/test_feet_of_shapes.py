"""Gaps between the feet of pillars that are not round: every pair is counted."""

import numpy as np
import pytest

import layout
from layout.mask.plan import MaskPlan, PillarArray, PillarClass
from layout.process.process import DesignRules

WIDE, LONG, PITCH, ROWS, COLUMNS = 324, 210, 400, 5, 7


@pytest.mark.parametrize(("lean_nm", "least"), [(37.0, 39.0), (20.0, 56.0)])
def test_every_pair_of_feet_that_is_too_near_is_counted(lean_nm, least):
    """Rectangles of 324 nm on 400 nm leave 76 nm along x; both walls lean out by half
    of ``lean_nm``. Pairs along x: 5 x 6, one pillar is missing in the middle of a row.
    """
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    half = np.array([WIDE // 2, LONG // 2])
    made = PillarClass(
        "D000324", float(WIDE), WIDE, (1, 0), corners * half, round=False
    )
    sites = np.ones((ROWS, COLUMNS), np.uint8)
    sites[2, 3] = 0
    lens = PillarArray.of("LENS", sites, pitch=PITCH, x0=0, y0=0)
    plan = MaskPlan("TOP", (made,), (lens,))
    rules = DesignRules(minimum_foot_gap_nm=50)
    found = layout.check_plan(plan, rules, foot_nm=np.array([WIDE + lean_nm]))
    assert found.minimum_foot_space_nm == pytest.approx(least)
    assert found.counts["foot"] == (ROWS * (COLUMNS - 1) - 2 if least < 50 else 0)
