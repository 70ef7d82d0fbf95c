"""The cost model equals counted forward passes, published counts, and its own finite
differences.
"""

import numpy as np
import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.peers import mobilenet_v3
from codesign.network import cost, windows
from codesign.network.architecture import (
    SearchSpace,
    largest_architecture,
    sample_architecture,
    smallest_architecture,
)
from codesign.network.supernet import Supernet
from metalens.core.errors import ConfigError


def _counted(net, architecture, size):
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        net(torch.zeros(1, 1, size, size), architecture)
    # steps are sums of slices, which it does not count
    return counter.get_total_flops() // 2 + windows.STEP_MACS


def test_count_equals_a_counted_forward_pass_for_24_subnets():
    net, generator = Supernet(), np.random.default_rng(0)
    net.eval()
    for _ in range(24):  # of some fifteen blocks, each drawn
        architecture = sample_architecture(net.space, generator)
        size = int(generator.integers(54, 120))
        scaled = round(size * architecture.resolution)
        assert int(cost.network_cost(net.space, architecture).at(scaled)) == _counted(
            net, architecture, size
        )


def test_published_counts_of_mobilenet_v3():
    assert mobilenet_v3.counted("large") / 1e6 == pytest.approx(216.6, abs=0.05)
    assert mobilenet_v3.counted("small") / 1e6 == pytest.approx(56.5, abs=0.05)
    # the last row of Table 1: 1280 channels to 1000 classes
    without = mobilenet_v3.counted("large", classes=0)
    assert mobilenet_v3.counted("large") - without == 1280 * 1000


@pytest.mark.parametrize("size", [16.0, 63.5, 64.0, 127.25, 400.0])
def test_continuous_count_has_the_gradient_of_its_finite_difference(size):
    space = SearchSpace()
    at = torch.tensor(size, dtype=torch.float64, requires_grad=True)
    value = cost.macs_of_size(space, largest_architecture(space), at)
    value.backward()
    step = 1e-6
    ahead, behind = (
        float(cost.macs_of_size(space, largest_architecture(space), size + s))
        for s in (step, -step)
    )
    # at an integer the curvature jumps: the difference is off by that times the step,
    # 1e-4 of the mean slope
    mean_slope = 2 * float(value.detach()) / size
    assert float(at.grad) == pytest.approx(
        (ahead - behind) / (2 * step), rel=1e-4, abs=1e-4 * mean_slope
    )
    if size == round(size):
        assert float(value.detach()) == float(
            cost.network_cost(space, largest_architecture(space)).at(int(size))
        )


def test_the_gradient_in_the_pitch_is_that_of_its_finite_difference():
    pitch = torch.tensor(5.31, dtype=torch.float64, requires_grad=True)
    cost.macs(largest_architecture(SearchSpace()), pitch, window_um=1152.0).backward()
    ahead, behind = (
        float(
            cost.macs(largest_architecture(SearchSpace()), 5.31 + s, window_um=1152.0)
        )
        for s in (1e-6, -1e-6)
    )
    assert float(pitch.grad) == pytest.approx((ahead - behind) / 2e-6, rel=1e-4)


@pytest.mark.parametrize("low", [64, 100, 217])
def test_more_pixels_never_cost_less(low):
    sizes = np.linspace(low, low + 3, 61)
    counts = np.array(
        [
            float(
                cost.macs_of_size(
                    SearchSpace(), smallest_architecture(SearchSpace()), s
                )
            )
            for s in sizes
        ]
    )
    assert (np.diff(counts) >= -1e-6 * counts[0]).all()


def test_cost_falls_with_pitch_and_impossible_pitch_is_refused():
    space = SearchSpace()
    sizes = [cost.input_size(1200.0, pitch, 1.0) for pitch in (3.0, 6.0, 12.0)]
    counts = [
        float(cost.macs_of_size(space, smallest_architecture(space), s)) for s in sizes
    ]
    # heads and windows of the blur are no pixels
    assert counts[0] > 3.5 * counts[1] > 3.5**2 * counts[2] * 0.85
    with pytest.raises(ConfigError, match=r"leaves 12\.0 pixels"):
        cost.input_size(1200.0, 100.0, 1.0)
