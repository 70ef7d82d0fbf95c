"""Which axis of a stack is that of its frames, shape by shape at the bounds of every
rule.
"""

from pathlib import Path

import numpy as np
import pytest

from characterize.captures import axes
from metalens.core.errors import CaptureError

PATH = Path("s.tif")


def lying(shape):
    """Counts of which no two are alike."""
    return np.arange(np.prod(shape)).reshape(shape)


def moved(shape):
    """Frames of a stack that lies as (y, x, n), one by one."""
    whole = lying(shape)
    return np.stack([whole[:, :, k] for k in range(shape[2])])


def test_frames_along_the_last_axis_keep_their_colours_behind_and_lie_close():
    found, note = axes.frames_first(lying((7, 5, 4, 3)), PATH, "yxn")
    assert np.array_equal(found, moved((7, 5, 4, 3)))
    assert found.flags["C_CONTIGUOUS"]
    assert note == "s.tif taken as (y, x, n), 4 frames of 7 x 5 pixels, as stated"


@pytest.mark.parametrize(
    ("shape", "order"),
    [((7, 5), None), ((7, 5), "yxn"), ((1, 7, 2), None), ((7, 5, 2), "nyx")],
)
def test_single_frames_and_what_is_stated_are_left_alone(shape, order):
    whole = lying(shape)
    found, note = axes.frames_first(whole, PATH, order)
    assert (found is whole, note) == (True, "")


@pytest.mark.parametrize(
    ("shape", "known", "why"),
    [
        ((9, 7, 5), {"count": 5}, "since 5 frames of it are listed"),
        ((2, 7, 5), {"count": 5}, "since 5 frames of it are listed"),
        ((5, 7, 5), {"count": 5}, ""),
        ((9, 7, 5), {"count": 9}, ""),
        ((9, 7, 5), {"count": 7}, ""),
        (
            (9, 7, 2),
            {"count": 4},
            "",
        ),  # a number that is none of them is left to the caller, however narrow
        ((9, 7, 5), {"pages": 5}, "since its pages 0 to 4 are listed"),
        ((9, 7, 5), {"pages": 9}, ""),
        ((2, 7, 2), {"pages": 2}, ""),
        ((9, 7, 5), {"count": 9, "pages": 5}, ""),  # a count says more
    ],
)
def test_numbers_of_frames_that_are_known_decide(shape, known, why):
    found, note = axes.frames_first(lying(shape), PATH, None, **known)
    first, second, last = shape
    if why:
        assert np.array_equal(found, moved(shape))
        assert (
            note
            == f"s.tif taken as (y, x, n), {last} frames of {first} x {second} pixels, {why}"
        )
    else:
        assert np.array_equal(found, lying(shape))
        assert note == "" or "taken as (n, y, x)" in note


@pytest.mark.parametrize(
    ("shape", "taken"),
    [
        ((12, 11, 5), "refused"),  # below half of both others
        ((11, 12, 5), "refused"),
        ((12, 10, 5), "told"),  # just half of one
        ((10, 12, 5), "told"),
        ((9, 9, 8), "refused"),  # below both, and these alike
        ((9, 9, 9), "told"),
        ((9, 9, 10), "told"),
        ((9, 8, 7), "told"),
        ((9, 8, 8), "plain"),  # below the first alone
        ((8, 9, 8), "plain"),
        ((3, 9, 8), "plain"),
    ],
)
def test_a_stack_of_which_nothing_is_known_is_taken_told_or_refused_by_its_shape(
    shape, taken
):
    first, second, last = shape
    if taken == "refused":
        with pytest.raises(
            CaptureError, match=f"is {first} frames of {second} x {last} pixels as"
        ):
            axes.frames_first(lying(shape), PATH, None)
        return
    found, note = axes.frames_first(lying(shape), PATH, None)
    assert np.array_equal(found, lying(shape))
    words = f"s.tif taken as (n, y, x), {first} frames of {second} x {last} pixels; if it is {last} frames of {first} x"
    assert note == (f'{words} {second}, say axes = "yxn"' if taken == "told" else "")


@pytest.mark.parametrize(
    ("shape", "size", "pitch", "lies"),
    [
        ((4, 7, 5), (7, 5), 1, False),
        ((7, 5, 4), (7, 5), 1, True),
        ((7, 5, 5), (7, 5), 1, True),
        ((7, 7, 5), (7, 7), 1, True),
        ((7, 5), (7, 5), 1, False),
        ((7, 6, 4), (7, 5), 1, False),  # of another size: left to who reads it
        ((14, 10, 4), (7, 5), 2, True),
        ((15, 9, 4), (7, 5), 2, True),  # one pixel more or less than twice
        ((16, 10, 4), (7, 5), 2, False),
        ((14, 8, 4), (7, 5), 2, False),
        ((7, 5, 4, 3), (7, 5), 1, True),
        ((4, 7, 5, 3), (7, 5), 1, False),
        ((7, 7, 7), (7, 7), 1, False),  # either way: as it lies
    ],
)
def test_a_dark_frame_is_known_by_the_size_of_the_frames(shape, size, pitch, lies):
    found, note = axes.as_large(lying(shape), PATH, size, pitch=pitch)
    assert np.array_equal(found, moved(shape) if lies else lying(shape))
    assert bool(note) is lies
    assert note.endswith("since frames are as large") is lies


def test_by_default_every_pixel_of_a_dark_frame_is_one_of_the_frames():
    assert axes.as_large(lying((7, 5, 4)), PATH, (7, 5))[0].shape == (4, 7, 5)
    assert axes.as_large(lying((8, 5, 4)), PATH, (7, 5))[0].shape == (8, 5, 4)
