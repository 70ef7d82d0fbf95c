"""Where the orders do not resolve a pillar the bar is no less than all that the pillar
does.
"""

import cmath
import math

import pytest

from metalens import rcwa
from metalens.cell import Cell, Index


@pytest.mark.parametrize("diameter_um", [0.02, 0.03])
def test_the_bar_of_an_unresolved_pillar_is_its_whole_effect(diameter_um):
    """Three orders on 0.4 um see nothing below 0.13 um. Without a pillar: Fresnel and
    the phase of 0.5 um of air.
    """
    cell = Cell(0.4, height_um=0.5, pillar=Index(3.5), substrate=Index(1.45))
    got = rcwa.solve(cell, diameter_um, 0.85, harmonics=3)
    bare = 2 * math.sqrt(1.45) / 2.45 * cmath.exp(2j * math.pi * 0.5 / 0.85)
    effect = abs(got.t - bare)
    assert 1e-4 < effect < 0.3
    assert effect * (1 - 1e-9) <= got.t_error < 2 * effect + 0.1
