"""The eight ways a camera may lie: its frames turned by quarters, mirrored or not."""

import numpy as np

from metalens.core.arrays import Array

TURNS = ("as they are", "turned by 90°", "turned by 180°", "turned by 270°")
MIRRORED = ("mirrored", *(f"mirrored and {words}" for words in TURNS[1:]))


def orient_frames(frames: Array, orientation: int) -> Array:
    """(n, y, x) frames mirrored left-right for 4 to 7, then turned by 90° (orientation
    mod 4) times.
    """
    turned = frames[..., ::-1] if orientation >= 4 else frames
    return np.rot90(turned, orientation % 4, axes=(-2, -1))


def relative_orientation(first: int, second: int) -> int:
    """The orientation that makes of frames turned by the first those turned by the
    second.

    >>> between(3, 1), between(4, 6), between(5, 0)
    (2, 2, 5)
    """
    frame = np.arange(4).reshape(1, 2, 2)
    return next(
        k
        for k in range(8)
        if np.array_equal(
            orient_frames(orient_frames(frame, first), k), orient_frames(frame, second)
        )
    )
