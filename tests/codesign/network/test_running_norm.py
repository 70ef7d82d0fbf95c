"""Means over the batches of a training, that a batch's own depth survives."""

import numpy as np
import pytest
import torch

from codesign.network import architecture as arch
from codesign.network.running import EPSILON, REACH, RunningNorm
from codesign.network.supernet import Supernet, recalibrate_batch_norm


def test_a_batch_is_normalised_by_the_means_of_all_so_far():
    """By numpy: means of x and x^2 over three batches of equal weight, whatever their
    size.
    """
    norm, draw = RunningNorm(3), np.random.default_rng(4)
    level, width = (
        np.array([2.3, -4.6, 0.7])[:, None, None],
        np.array([1.7, 0.02, 3.1])[:, None, None],
    )
    batches = [
        level + width * draw.normal(0.4 * i, 1.0, (n, 3, 2, 5))
        for i, n in enumerate((1, 4, 2))
    ]
    for one in batches:
        out = norm(torch.tensor(one, dtype=torch.float32))
    mean = np.mean([one.mean((0, 2, 3)) for one in batches], axis=0)
    square = np.mean([(one**2).mean((0, 2, 3)) for one in batches], axis=0)
    want = (batches[-1] - mean[:, None, None]) / np.sqrt(square - mean**2 + EPSILON)[
        :, None, None
    ]
    assert out.detach().numpy() == pytest.approx(
        want, abs=1e-5
    )  # of 30 spreads, in single precision: 2e-6


def test_old_batches_fade_by_a_hundredth_a_batch():
    norm = RunningNorm(1)
    for value, count in ((3.7, REACH), (-1.1, 37)):
        for _ in range(count):
            norm(torch.full((2, 1, 3, 1), value))
    assert float(norm.mean) == pytest.approx(
        -1.1 + 4.8 * (1 - 1 / REACH) ** 37, rel=1e-5
    )


def test_what_all_frames_of_a_batch_have_in_common_is_kept():
    """Batch normalisation would give the same for both: how deep a batch lies as a
    whole would be lost.
    """
    norm, draw = RunningNorm(2), torch.Generator().manual_seed(5)
    for _ in range(60):
        norm(torch.randn(4, 2, 3, 3, generator=draw))
    batch = torch.randn(4, 2, 3, 3, generator=draw)
    there = norm(batch + 0.8).mean() - norm(batch).mean()
    assert float(there) == pytest.approx(
        0.8, abs=0.05
    )  # 1/61 of it is taken off; 2160 samples of the variance: 2 %


def test_neither_evaluation_nor_frames_that_are_not_finite_move_the_means():
    norm = RunningNorm(2)
    norm(torch.randn(3, 2, 4, 4, generator=torch.Generator().manual_seed(6)))
    before = {k: v.clone() for k, v in norm.state_dict().items()}
    broken = torch.ones(3, 2, 4, 4)
    broken[1, 1, 2, 0] = torch.nan
    norm(broken)
    norm.eval()(torch.full((3, 2, 4, 4), 7.0))
    assert all(torch.equal(before[k], v) for k, v in norm.state_dict().items())


def test_means_over_the_training_stay_when_the_statistics_of_an_architecture_are_measured():
    torch.manual_seed(0)
    net = Supernet(arch.SearchSpace()).train()
    frames = torch.randn(2, 1, 64, 64, generator=torch.Generator().manual_seed(1))
    net(frames, arch.smallest_architecture(net.space))
    before = {k: v.clone() for k, v in net.blur.norm.state_dict().items()}
    stem = net.stem.norm.mean.clone()
    recalibrate_batch_norm(
        net, arch.smallest_architecture(net.space), [2 * frames, frames]
    )
    assert int(before["batches"]) == 1
    assert all(torch.equal(before[k], v) for k, v in net.blur.norm.state_dict().items())
    assert not torch.equal(stem, net.stem.norm.mean)
