"""Steps of brightness in a window against pixels by hand, white frames, and edges that
blur has or has not spread.
"""

import itertools
import math

import numpy as np
import pytest
import torch

from codesign.network import windows

KINDS = (
    (1, 0),
    (0, 1),
    (1, 1),
    (-1, 1),
)  # from a sample back to its neighbour: along x, along y, both diagonals


def _by_hand(frame, row, column):
    """(3, 14) of one window of 64 x 64 pixels in double precision; the frame goes on
    beyond its edge.
    """

    def clip(n):
        return min(max(n, 0), 63)

    def fine(y, x):
        return frame[clip(y), clip(x)]

    def coarse(y, x):
        y, x = clip(y), clip(x)
        return (fine(y, x) + fine(y, x + 1) + fine(y + 1, x) + fine(y + 1, x + 1)) / 4

    squares = [[] for _ in range(14)]
    for y in range(8 * row, 8 * row + 16):
        for x in range(8 * column, 8 * column + 16):
            for scale, (at, r) in enumerate(((fine, 1), (coarse, 2))):
                here = at(y, x)
                first = [
                    (here - at(y - r * dy, x - r * dx)) / math.sqrt(2)
                    for dx, dy in KINDS
                ]
                across, down = at(y, x - r) + at(y, x + r), at(y - r, x) + at(y + r, x)
                second = [
                    (across - 2 * here) / math.sqrt(6),
                    (down - 2 * here) / math.sqrt(6),
                ]
                both = (across + down - 4 * here) / math.sqrt(20)
                for kind, step in enumerate([*first, *second, both]):
                    squares[7 * scale + kind].append(step**2)
    squares = np.array(squares)
    told = np.log(1 + squares / 0.0025)
    return np.stack(
        [told.mean(1), told.std(1), np.log(1 + ((squares / 0.0025) ** 4).mean(1)) / 4]
    )


@pytest.mark.parametrize(("row", "column"), [(0, 6), (3, 1)])
def test_steps_of_a_window_are_those_between_its_pixels(row, column):
    frame = np.random.default_rng(7).normal(size=(64, 64)) + 0.03 * np.arange(64)
    got = windows.gradient_statistics(torch.from_numpy(frame)[None, None])
    assert got.shape == (1, windows.STEP_FEATURES, 7, 7)
    found = got[0, :, row, column].numpy().reshape(3, 14)
    assert found == pytest.approx(
        _by_hand(frame, row, column), rel=3e-5, abs=3e-5
    )  # 1e-4 under the root of the spread


def test_steps_of_white_frames_have_the_variance_of_a_pixel():
    """The logarithm of a squared normal number and the floor; away from the edge,
    beyond which frames go on.
    """
    frames = torch.randn(6, 1, 64, 64, generator=torch.Generator().manual_seed(3))
    mean, spread, _ = (
        windows.gradient_statistics(frames)
        .reshape(6, 3, 14, 7, 7)[..., 1:6, 1:6]
        .mean((0, 3, 4))
    )
    sample = np.random.default_rng(1).normal(size=400_000) ** 2
    want = np.log(1 + sample / 0.0025)
    of_means = np.log(
        1 + sample / 4 / 0.0025
    )  # means of two by two pixels have a quarter of the variance
    for i in range(7):
        assert float(mean[i]) == pytest.approx(
            want.mean(), abs=0.05
        )  # 14 000 pixels of deviation 2
        assert float(spread[i]) == pytest.approx(want.std(), rel=0.03)
        assert float(mean[7 + i]) == pytest.approx(
            of_means.mean(), abs=0.1
        )  # and these overlap


def test_blur_takes_the_steepest_step_of_an_edge_and_leaves_the_mean_power_nearly():
    """An edge of height 2 spread over 1, 2 and 4 pixels: steps of 2 / width over as
    many.
    """
    place = torch.arange(64.0) - 30
    steepest = []
    for width in (1, 2, 4):
        edge = (2 * (place / width).clamp(0, 1)).expand(64, 64)[None, None]
        told = windows.gradient_statistics(edge)[0].reshape(3, 14, 7, 7)
        steepest.append(float(told[2, 0, 3, 3]))
    for narrow, wide in itertools.pairwise(
        steepest
    ):  # (w (1 / w²)^4)^(1/4): less 7 / 4 ln 2 a doubling
        assert wide - narrow == pytest.approx(-1.75 * math.log(2), abs=0.01)


@pytest.mark.parametrize("size", [16, 63, 128, 192])
def test_a_slope_has_the_same_steps_on_any_pixels(size):
    """Brightness 5 across the frame: 5 / 64 a sample; half of its square for a step
    along x, none along y.
    """
    line = 5 * (torch.arange(size, dtype=torch.float64) + 0.5) / size
    told = windows.gradient_statistics(line.expand(1, 1, size, size))[0].reshape(
        3, 14, 7, 7
    )[0, :, 3, 3]
    slope = 5 / 64
    assert float(told[0]) == pytest.approx(
        math.log(1 + slope**2 / 2 / 0.0025), abs=2e-3
    )  # interpolated samples are even
    assert float(told[7]) == pytest.approx(
        math.log(1 + (2 * slope) ** 2 / 2 / 0.0025), abs=2e-3
    )
    assert float(told[1]) == pytest.approx(0.0, abs=1e-6)


def test_steps_move_with_the_frame_as_finite_differences_say():
    frame = torch.randn(
        1, 1, 24, 24, dtype=torch.float64, generator=torch.Generator().manual_seed(5)
    )
    assert torch.autograd.gradcheck(
        lambda x: windows.gradient_statistics(x)[..., 2:4, 2:4],
        frame.requires_grad_(),
        fast_mode=True,
    )


def test_a_blank_frame_has_slopes():
    frame = torch.zeros(1, 1, 64, 64, requires_grad=True)
    windows.gradient_statistics(frame).sum().backward()
    assert bool(torch.isfinite(frame.grad).all())


def test_the_count_of_steps_is_one_a_tap():
    """Four steps of two samples, two of three and one of five, twice; a mean of four
    samples before the second time.
    """
    assert windows.STEP_MACS == 64 * 64 * (2 * (4 * 2 + 2 * 3 + 5) + 4)


def test_steps_that_are_alike_all_over_are_not_spread():
    """A ramp along x: in windows that do not meet the rim a kind of step has one size:
    no spread but a floor.
    """
    ramp = (torch.linspace(-2.3, 1.9, 128)[None] + torch.zeros(128, 1))[None, None]
    found = windows.gradient_statistics(ramp)
    kinds = found.shape[1] // windows.TOLD
    mean, spread = found[0, :kinds, 2:-2, 2:-2], found[0, kinds : 2 * kinds, 2:-2, 2:-2]
    assert float(mean.max()) > 0.05
    assert (
        float((spread - 0.01).abs().max()) < 2e-3
    )  # the root of 1e-4, and of rounding of squares
