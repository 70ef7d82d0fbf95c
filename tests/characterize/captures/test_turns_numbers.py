"""The eight ways of a camera on a frame of two rows and three columns, drawn by hand."""

import numpy as np
import pytest

from characterize.captures.turns import (
    MIRRORED,
    TURNS,
    orient_frames,
    relative_orientation,
)

FRAMES = np.array([[[1, 2, 3], [4, 5, 6]], [[11, 12, 13], [14, 15, 16]]])
# of the first frame: turned against the clock as it is drawn, rows from the top
LYING = {
    0: [[1, 2, 3], [4, 5, 6]],
    1: [[3, 6], [2, 5], [1, 4]],
    2: [[6, 5, 4], [3, 2, 1]],
    3: [[4, 1], [5, 2], [6, 3]],
    4: [[3, 2, 1], [6, 5, 4]],
    5: [[1, 4], [2, 5], [3, 6]],
    6: [[4, 5, 6], [1, 2, 3]],
    7: [[6, 3], [5, 2], [4, 1]],
}


@pytest.mark.parametrize("orientation", LYING)
def test_every_frame_of_a_stack_is_turned_alike(orientation):
    want = np.array(LYING[orientation])
    assert orient_frames(FRAMES, orientation).tolist() == [
        want.tolist(),
        (want + 10).tolist(),
    ]


def test_what_lies_between_is_the_one_that_leads_there():
    """Quarters add up; behind a mirror they count the other way, as two mirrors about
    axes 45° apart turn by 90°.
    """
    assert [relative_orientation(0, k) for k in range(8)] == list(range(8))
    assert [relative_orientation(1, k) for k in range(8)] == [3, 0, 1, 2, 5, 6, 7, 4]
    assert [relative_orientation(6, k) for k in range(8)] == [6, 7, 4, 5, 2, 3, 0, 1]


def test_every_way_has_its_words():
    assert TURNS == ("as they are", "turned by 90°", "turned by 180°", "turned by 270°")
    assert " | ".join(MIRRORED) == (
        "mirrored | mirrored and turned by 90° | mirrored and turned by 180° | mirrored and turned by 270°"
    )
