"""Likeness of frames that hold single lit pixels, and what is left of them above their
rim, by hand.
"""

import math

import numpy as np
import pytest

from characterize.captures.alike import (
    FrameSpectra,
    above_rim,
    normalized_cross_correlation,
)

SHAPE = 9, 11


def pixels(**lit):
    """A frame of 9 x 11 pixels, of which r2c3=5 lights that at row 2, column 3."""
    frame = np.zeros(SHAPE)
    for place, value in lit.items():
        row, column = place[1:].split("c")
        frame[int(row), int(column)] = value
    return frame


ONE = pixels(r4c4=2.0)
TWO = pixels(
    r2c3=3.0, r6c8=4.0
)  # of norm 5; its brighter pixel is 2 rows and 4 columns off


@pytest.mark.parametrize(
    ("noise", "norm"), [(0.0, 5.0), (2.0, math.sqrt(21)), (3.0, 4.0)]
)
def test_likeness_is_the_largest_product_over_norms_freed_of_noise(noise, norm):
    score, shift = normalized_cross_correlation(TWO, ONE, noise)
    assert score == pytest.approx(4 * 2 / (norm * 2))
    assert shift == (2.0, 4.0)
    assert normalized_cross_correlation(ONE, TWO, 0.0)[1] == (-2.0, -4.0)
    assert normalized_cross_correlation(ONE, TWO, 0.0)[0] == pytest.approx(0.8)


def test_of_a_frame_of_noise_a_tenth_of_the_power_is_left():
    """Twelve pixels of 1, whose noise is nearly all: √1.2 in place of √0.5. Nothing is
    more alike than 1.
    """
    many = np.zeros(SHAPE)
    many.flat[[0, 5, 13, 22, 30, 41, 47, 58, 66, 75, 83, 98]] = 1.0
    assert normalized_cross_correlation(many, ONE, math.sqrt(11.5))[0] == pytest.approx(
        1 / math.sqrt(1.2)
    )
    assert normalized_cross_correlation(many, ONE, math.sqrt(6.0))[0] == pytest.approx(
        1 / math.sqrt(6.0)
    )
    assert normalized_cross_correlation(TWO, ONE, 4.9)[0] == 1.0
    assert normalized_cross_correlation(0 * TWO, ONE, 0.0) == (0.0, (0.0, 0.0))
    assert normalized_cross_correlation(TWO, 0 * ONE, 0.0) == (0.0, (0.0, 0.0))


@pytest.mark.parametrize(("row", "column"), [(8, 10), (8, 0), (0, 10), (0, 0), (4, 5)])
def test_shifts_reach_from_rim_to_rim(row, column):
    a = pixels(**{f"r{row}c{column}": 1.5})
    for b, at in (
        (pixels(r0c0=1.0), (0, 0)),
        (pixels(r8c10=1.0), (8, 10)),
        (pixels(r8c0=1.0), (8, 0)),
    ):
        assert normalized_cross_correlation(a, b, 0.0) == (
            pytest.approx(1.0),
            (row - at[0], column - at[1]),
        )


def test_stacks_are_as_alike_as_their_frames_on_the_mean():
    rng = np.random.default_rng(2)
    light, expected = rng.normal(0, 1, (4, *SHAPE)), rng.normal(0, 1, (3, *SHAPE))
    noise = np.array([1.0, 3.0, 0.5, 20.0])
    seen, told = FrameSpectra.of(light, noise), FrameSpectra.of(expected, np.zeros(3))
    for order in ([0, 1, 2], [3, 0, 1], [2, 2, 3]):
        want = np.mean(
            [
                normalized_cross_correlation(light[i], expected[k], noise[i])[0]
                for k, i in enumerate(order)
            ]
        )
        assert seen.alike(told, np.array(order)) == pytest.approx(want, rel=1e-9)
    strong, one = (
        FrameSpectra.of(each[None], np.array([noise]))
        for each, noise in ((TWO, 4.9), (ONE, 0.0))
    )
    assert strong.alike(one, np.array([0])) == 1.0
    dark = FrameSpectra.of(np.zeros((1, *SHAPE)), np.zeros(1))
    assert dark.alike(FrameSpectra.of(expected[:1], np.zeros(1)), np.array([0])) == 0.0


def test_frames_do_not_reach_round_their_rims():
    """Of two pixels each, apart by unlike steps, one at a time meets another: half as
    alike, however the frame ends.
    """
    for a, b in (
        (pixels(r0c0=1, r0c10=1), pixels(r0c0=1, r0c8=1)),
        (pixels(r0c0=1, r0c10=1), pixels(r0c0=1, r0c1=1)),
        (pixels(r0c0=1, r8c0=1), pixels(r0c0=1, r1c0=1)),
        (pixels(r0c0=1, r8c0=1), pixels(r0c0=1, r3c0=1)),
    ):
        seen, told = (FrameSpectra.of(each[None], np.zeros(1)) for each in (a, b))
        assert seen.alike(told, np.array([0])) == pytest.approx(0.5)
        assert normalized_cross_correlation(a, b, 0.0)[0] == pytest.approx(0.5)


def test_a_plane_through_the_two_outermost_pixels_is_taken_off_and_holes_are_filled():
    """Light further in than two pixels is left as it is; a hole has the median of its
    frame, above the same plane.
    """
    y, x = np.mgrid[-1 : 1 : SHAPE[0] * 1j, -1 : 1 : SHAPE[1] * 1j]
    planes = np.stack([40 + 3.0 * x - 7.0 * y, 5 - 1.5 * x + 0.5 * y])
    inner = np.zeros(SHAPE)
    inner[2, 2], inner[6, 8], inner[4, 5] = 11.0, 6.0, 3.0
    assert above_rim(planes + inner) == pytest.approx(
        np.stack([inner, inner]), abs=1e-9
    )
    holed = planes + inner
    holed[0, 4, 4] = np.nan
    median = np.nanmedian(holed[0])
    want = inner.copy()
    want[4, 4] = median - planes[0, 4, 4]
    assert above_rim(holed)[0] == pytest.approx(want, abs=1e-9)


def test_the_plane_is_that_of_least_squares_of_the_rim():
    """Of two pixels on every side, in rows and columns."""
    frame = np.random.default_rng(6).normal(50, 4, SHAPE)
    row, column = np.indices(SHAPE)
    rim = (row < 2) | (row > 6) | (column < 2) | (column > 8)
    design = np.stack([np.ones(SHAPE), row, column], -1)
    plane = design @ np.linalg.lstsq(design[rim], frame[rim], rcond=None)[0]
    assert above_rim(frame[None])[0] == pytest.approx(frame - plane, abs=1e-9)
