"""Weights of the windows of local blur pixel by pixel, and what becomes of a depth and
its spread.
"""

import math

import numpy as np
import pytest
import torch
from torch import nn

from codesign.network import blur
from tests.codesign.network.told import Told


@pytest.mark.parametrize("size", [64, 61, 83])
def test_windows_weigh_by_the_square_of_a_hann_power(size):
    """sin⁴ over two steps, sum 1, half overlapping, the margin that none covers even to
    a pixel.
    """
    step = size // 8
    margin = (size - 8 * step) // 2
    rows = blur.window_weights(size).double().numpy()
    assert rows.shape == (7, size)
    for i, row in enumerate(rows):
        want = np.zeros(size)
        for j in range(2 * step):
            want[margin + i * step + j] = (
                math.sin(math.pi * (j + 0.5) / (2 * step)) ** 4
            )
        assert row == pytest.approx(want / want.sum(), abs=1e-7)  # float32
    assert rows.sum(1) == pytest.approx(np.ones(7), rel=1e-6)


def test_the_vergence_of_a_window_is_that_of_its_middle_where_it_is_straight():
    """1 / z = 45 + 8 (u + v) per metre, straight along both axes: u and v are told at
    the middles of the windows.
    """
    size, step = 61, 7
    along, down = 0.03 * (np.arange(size) - 30.0), -0.05 * (np.arange(size) - 30.0)
    vergence = 45 + 8 * (along[None, :] + down[:, None])
    depth = torch.from_numpy(1e6 / vergence)[None]
    middle = (61 - 56) // 2 + step * (np.arange(7) + 1) - 0.5
    want = -0.05 * (middle - 30)[:, None] + 0.03 * (middle - 30)[None, :]
    assert blur.window_vergence(depth)[0].numpy() == pytest.approx(
        want, abs=1e-5
    )  # float32 weights
    told = torch.tensor([-9.0, 0.5, 0.0, 99.0])
    assert blur.depth_mm(told).tolist() == pytest.approx(
        [1000.0, 1e3 / 49, 1e3 / 45, 5.0]
    )


def test_spreads_are_kept_from_e_to_minus_3_to_e_squared_and_windows_count_by_their_variance():
    random = torch.Generator().manual_seed(3)
    answer = torch.randn(2, 2 + blur.BESIDE, 7, 7, generator=random)
    answer[:, 1, 0, :3] = torch.tensor([-3.4, 2.6, 1.9])
    branch = blur.BlurBranch(nn.Identity())
    branch.depth = Told(answer)
    frames = torch.randn(2, 1, 64, 64, generator=random)
    depth, features = branch(frames)
    assert depth[:, 1, 0, :3].tolist() == [pytest.approx([-3.0, 2.0, 1.9])] * 2
    spread = np.clip(answer[:, 1].numpy().astype(float), -3, 2)
    assert depth[:, 1].numpy() == pytest.approx(spread)
    assert torch.equal(depth[:, 0], answer[:, 0])
    trust = np.exp(-2 * spread)
    mean = (trust * answer[:, 0].numpy()).sum((1, 2)) / trust.sum((1, 2))
    assert features.shape == (2, blur.SLIP_FEATURES)
    assert features[:, 3 * 49].numpy() == pytest.approx(mean, rel=1e-5)
    assert features[:, 3 * 49 + 1].numpy() == pytest.approx(
        spread.mean((1, 2)), rel=1e-5
    )
    assert torch.equal(features[:, 3 * 49 + 2 :], answer[:, 2:].flatten(1))
    assert features[:, : 2 * 49].numpy() == pytest.approx(depth.flatten(1).numpy())
