"""What a fit says of how the frames lie."""

import numpy as np

from characterize.inference import arrange
from characterize.inference.arrange import FrameArrangement


def told(**how):
    about = {
        "reordered": False,
        "order_seen": True,
        "orientation": 0,
        "clearly": False,
        "alike": (),
    }
    return arrange.laid_words(
        FrameArrangement(
            0.0, 110.0, (0.0, 0.0), 0.9, np.array([2, 0, 1]), **about | how
        )
    )


def test_each_finding_about_the_frames_has_its_words():
    assert told() == []
    (words,) = told(orientation=6, clearly=True)
    assert "only mirrored and turned by 180°" in words
    (words,) = told(reordered=True)
    assert "order [2, 0, 1]" in words
    (words,) = told(alike=(2, 4, 7))
    assert (
        "looks the same turned by 180°, mirrored, mirrored and turned by 270°: the orientation"
        in words
    )
    (words,) = told(order_seen=False)
    assert "the order of the frames cannot be seen" in words
