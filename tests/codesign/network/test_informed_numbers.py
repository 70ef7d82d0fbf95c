"""Numbers of the blur branch and of the means over a training that its learned weights
belong to, by hand.
"""

import math

import numpy as np
import pytest
import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from codesign.network import architecture as arch
from codesign.network import blur, windows
from codesign.network.running import RunningNorm
from codesign.network.supernet import SlicedConv, SlicedNorm, Supernet

CHANNELS = 5


def test_means_reach_back_over_a_hundred_batches():
    """300 batches of 3.7 are held at a share of 1/100, whatever came first; 37 of -1.1
    leave 0.99^37 of the step.
    """
    norm = RunningNorm(1)
    for value, count in ((3.7, 300), (-1.1, 37)):
        for _ in range(count):
            norm(torch.full((2, 1, 3, 1), value))
    left = 0.99**37
    assert float(norm.mean) == pytest.approx(
        -1.1 + 4.8 * left, rel=1e-6
    )  # 3.7 and 1.1 in single
    assert float(norm.square) == pytest.approx(
        1.21 + (3.7**2 - 1.21) * left, rel=1e-6
    )  # 3.7 and 1.1 in single


def test_a_wave_that_no_frame_held_is_blown_up_ten_times_at_most():
    """Of variance 0 a step of 0.3 gives 0.3 / sqrt(0.01)."""
    norm = RunningNorm(1)
    for _ in range(3):
        norm(torch.full((2, 1, 3, 1), -0.7))
    seen = norm.eval()(torch.full((1, 1, 1, 1), -0.4))
    assert float(seen) == pytest.approx(3.0, rel=1e-5)


def test_filters_are_waves_of_the_frame_under_a_hann_weight_of_power_one():
    """90 pixels: windows of 22, waves by 90 / 4 = 22.5 pixels, from the middle of the
    window on.
    """
    cosine, sine = windows.hann_filters(90)
    place = np.arange(22) + 0.5
    weight = np.sin(np.pi * place / 22) ** 2
    weight /= math.sqrt((weight**2).sum())
    turn = 2 * np.pi * (place - 11) / 22.5
    assert (cosine.shape, sine.shape) == ((11, 9), (11, 8))
    for f in (0, 3, 8):
        assert cosine[:, f].numpy() == pytest.approx(
            (weight * np.cos(f * turn))[11:], abs=1e-6
        )
    for f in (1, 4, 8):
        assert sine[:, f - 1].numpy() == pytest.approx(
            (weight * np.sin(f * turn))[11:], abs=1e-6
        )


def test_a_window_without_light_has_the_power_of_the_floor():
    """A hundredth of the frame's variance: its logarithm is what the norm is given."""
    given = []

    class Told(nn.Module):
        def forward(self, x):
            given.append(x)
            return x

    blur.BlurBranch(Told())(torch.zeros(1, 1, 64, 64))
    power, mean, (level, spread, steepest) = (
        given[0][0, :144],
        given[0][0, 144],
        given[0][0, 145:].reshape(3, 14, 7, 7),
    )
    assert power.detach().numpy() == pytest.approx(math.log(0.01), rel=1e-6)
    assert not mean.any()
    assert not level.any()
    assert spread.numpy() == pytest.approx(
        0.01, rel=1e-5
    )  # what is added under the root
    assert not steepest.any()


def test_the_place_of_a_window_is_told_along_x_first():
    place = blur.BlurBranch(SlicedNorm(blur.FEATURES)).place[0]
    x, y = 2 / 3, -1 / 3  # sixth column and third row of seven
    assert place[:, 2, 5].numpy() == pytest.approx(
        [x, y, x * x, y * y, x * y], rel=1e-6
    )


@pytest.mark.parametrize("size", [16, 63])
def test_what_the_content_adds_is_counted_as_a_pass_counts_it(size):
    branch = blur.InformedBranch(SlicedNorm(blur.FEATURES), CHANNELS).eval()
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        branch(
            torch.zeros(1, 1, size, size),
            torch.zeros(1, CHANNELS, size // 4, size // 4),
        )
    assert counter.get_total_flops() // 2 == blur.blur_branch_macs(
        size
    ) - windows.STEP_MACS + blur.content_macs(CHANNELS)


def test_windows_of_maps_that_are_not_square_lie_over_both_sides_evenly():
    """Ramps over 16 rows and 40 columns: their middles at 1/8 … 7/8 of either side."""
    down, across = ((torch.arange(n) + 0.5) / n for n in (16, 40))
    maps = torch.stack([down[:, None].expand(16, 40), across.expand(16, 40)])[None]
    got = windows.window_content(maps)[0].numpy()
    middle = np.arange(1, 8) / 8
    assert got[0] == pytest.approx(np.tile(middle[:, None], (1, 7)), rel=1e-5)
    assert got[1] == pytest.approx(np.tile(middle, (7, 1)), rel=1e-5)


def test_the_vote_of_the_windows_is_added_to_the_axial_slippage_alone():
    """All windows claim alike; estimates larger by 0.7 move z by 0.7, x and y not at
    all.
    """
    torch.manual_seed(3)
    net = Supernet(arch.SearchSpace()).eval()
    frames = torch.randn(2, 1, 64, 64)
    least = arch.smallest_architecture(net.space)
    with torch.no_grad():
        before = net(frames, least).slip
        net.blur.vote.bias += torch.tensor([0.7, 0.0])
        after = net(frames, least).slip
    assert (after - before).numpy() == pytest.approx(
        np.tile([0.0, 0.0, 0.7], (2, 1)), abs=1e-5
    )


@pytest.mark.parametrize(("depthwise", "fan"), [(False, 200 * 9), (True, 9)])
def test_weights_begin_so_that_gradients_keep_their_size(depthwise, fan):
    """Variance 2 / fan out (He and others 2015, eq. 14); 1800 weights or more: 1.7 % of
    a standard deviation.
    """
    torch.manual_seed(4)
    weight = SlicedConv(50, 200, 3, depthwise=depthwise).weight.detach()
    assert float(weight.std()) == pytest.approx(math.sqrt(2 / fan), rel=0.07)
