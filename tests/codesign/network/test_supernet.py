"""Weight sharing by slices, calibration of batch statistics, and subnets that equal
their supernet.
"""

import itertools

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from codesign.network import architecture as arch
from codesign.network.supernet import Supernet, recalibrate_batch_norm, soft_argmax
from metalens.core.errors import TrainingError

SPACE = arch.SearchSpace()


@pytest.fixture(scope="module")
def net():
    torch.manual_seed(0)
    return Supernet(SPACE)


def _frames(count=2, size=64):
    return torch.randn(count, 1, size, size, generator=torch.Generator().manual_seed(1))


def test_every_sampled_architecture_runs_and_gives_all_outputs(net):
    generator = np.random.default_rng(0)
    for _ in range(6):
        found = net.train()(_frames(), arch.sample_architecture(SPACE, generator))
        assert found.slip.shape == (2, 3)
        assert found.centre.shape == (2, 2)
        for value in (found.mask_logits, found.centre, found.slip):
            assert torch.isfinite(value).all()


def test_recalibration_gives_the_mean_of_the_batches_whatever_came_before(net):
    chosen = arch.largest_architecture(SPACE)
    batches = [_frames(4), 2 * _frames(4) + 1]
    recalibrate_batch_norm(net, chosen, batches)
    first = net.stem.norm.mean.clone()
    recalibrate_batch_norm(net, arch.smallest_architecture(SPACE), [_frames()])
    recalibrate_batch_norm(net, chosen, batches[::-1])
    assert torch.allclose(net.stem.norm.mean, first, atol=1e-6)


def test_recalibration_without_frames_is_refused(net):
    with pytest.raises(TrainingError, match="at least one batch"):
        recalibrate_batch_norm(net, arch.smallest_architecture(SPACE), [])


def test_training_one_slice_leaves_the_rest_without_gradient(net):
    net.zero_grad()
    net.train()(_frames(), arch.smallest_architecture(SPACE)).slip.sum().backward()
    block = net.stages[0][0]
    hidden = arch.active_blocks(SPACE, arch.smallest_architecture(SPACE))[0][0].hidden
    assert float(block.expand.weight.grad[hidden:].abs().max()) == 0
    assert float(block.expand.weight.grad[:hidden].abs().max()) > 0
    rim = block.depthwise.weight.grad.clone()
    rim[..., 2:5, 2:5] = 0
    assert float(rim.abs().max()) == 0


def test_soft_argmax_finds_the_centre_of_a_disc_and_survives_an_empty_mask():
    y, x = torch.meshgrid(torch.arange(40.0), torch.arange(60.0), indexing="ij")
    logits = (5 - torch.hypot(x - 44.5, y - 9.5)).mul(4)[None].requires_grad_()
    centre = soft_argmax(logits)
    assert centre[0].tolist() == pytest.approx([45 / 60 - 0.5, 10 / 40 - 0.5], abs=2e-3)
    empty = torch.full((1, 8, 8), -50.0, requires_grad=True)
    soft_argmax(empty).sum().backward()
    assert soft_argmax(empty).abs().max() == 0
    assert torch.isfinite(empty.grad).all()


@settings(max_examples=40)
@given(st.integers(0, 10_000))
def test_mutation_stays_in_the_space_and_changes_the_network(seed):
    generator = np.random.default_rng(seed)
    parent = arch.sample_architecture(SPACE, generator)
    child = arch.mutate_architecture(SPACE, parent, generator)
    for name in ("depths", "kernels", "expansions"):
        assert len(getattr(child, name)) == len(getattr(parent, name))
        assert set(getattr(child, name)) <= set(getattr(SPACE, name))
    assert child.width in SPACE.widths
    assert SPACE.resolution[0] <= child.resolution <= SPACE.resolution[1]
    assert arch.canonical_architecture(SPACE, child) != arch.canonical_architecture(
        SPACE, parent
    )
    chain = itertools.chain.from_iterable(arch.active_blocks(SPACE, child))
    assert all(a.outputs == b.inputs for a, b in itertools.pairwise(chain))
