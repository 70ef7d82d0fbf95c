"""Side walls that lean: pillars as stacks of thin ones, against the two points that the
model takes for them.
"""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.model.pillars import PillarChange, PillarResponse

LEAN_UM = 0.019


@pytest.mark.parametrize("bias_um", [0.004, -0.007])
def test_two_heights_stand_for_the_whole_wall(bias_um):
    """41 slices of ln t: the effect is 0.013 of t; a tenth of it is the basis, which
    was not made for walls.
    """
    pillars = PillarResponse(b.lens(), b.RESPONSE)
    upright, leaning = (
        pillars.basis.conj().T
        @ (
            pillars.weights(np.array(bias_um))
            @ pillars.coefficients(PillarChange(), lean)
        )
        for lean in (0.0, LEAN_UM)
    )
    heights = (np.arange(41) + 0.5) / 41 - 0.5
    slices = np.array(
        [pillars.exact(bias_um + 2 * LEAN_UM * h, PillarChange()) for h in heights]
    )
    turned = np.unwrap(np.angle(slices), axis=0).mean(0)
    want = np.exp(np.log(np.abs(slices)).mean(0) + 1j * turned)
    assert abs(leaning - want).max() < 1.5e-3
    assert abs(upright - want).max() > 0.012
