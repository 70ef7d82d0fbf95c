"""A phase that turns about a place beside the edge of its map, of which no sample to
spare is known.
"""

import numpy as np
import pytest

from metalens.design import phase_map


@pytest.mark.parametrize(("charge", "at"), [(1, (1.4, 1.7)), (-1, (1.6, 1.2))])
@pytest.mark.parametrize("beyond", [(0, 0), (3, 0), (0, 2)])
def test_the_ring_about_a_vortex_may_be_the_edge_of_the_map(charge, at, beyond):
    """Four by four samples hold it in their middle; farther ones on one side change
    nothing.
    """
    y, x = np.mgrid[: 4 + beyond[0], : 4 + beyond[1]]
    phase = np.angle(
        np.exp(1j * (charge * np.arctan2(y - at[0], x - at[1]) + 0.3 * x - 0.2))
    )
    found = phase_map._vortex(phase, *at)
    assert found == phase[round(at[0]), round(at[1])]
    mirrored = phase_map._vortex(phase[:, ::-1], at[0], phase.shape[1] - 1 - at[1])
    assert mirrored == found
    assert (
        phase_map._vortex(phase[:, 1:], at[0], at[1] - 1) is None
    )  # three columns are no ring
    assert phase_map._vortex(phase[1:], at[0] - 1, at[1]) is None
    assert phase_map._vortex(phase[:, :3], *at) is None
    assert phase_map._vortex(phase[:3], *at) is None
    smooth = np.angle(np.exp(1j * (0.3 * x + 0.4 * y)))
    assert phase_map._vortex(smooth, *at) is None
