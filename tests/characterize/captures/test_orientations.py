"""Ways that a camera may lie, put after one another."""

import numpy as np
import pytest

from characterize.captures import orient_frames, relative_orientation

FRAME = np.arange(16.0).reshape(1, 4, 4) ** 2


@pytest.mark.parametrize("first", range(8))
def test_what_lies_between_two_orientations_leads_from_one_to_the_other(first):
    """64 pairs of a frame without symmetry; a quarter of a mirrored one turns the other
    way.
    """
    for second in range(8):
        assert np.array_equal(
            orient_frames(
                orient_frames(FRAME, first), relative_orientation(first, second)
            ),
            orient_frames(FRAME, second),
        )
    assert relative_orientation(first, first) == 0
