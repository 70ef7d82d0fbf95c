"""What a subnet keeps of its supernet: the first channels, the middle of the kernels,
nothing else.
"""

import numpy as np
import pytest
import torch

from codesign.network import architecture as arch
from codesign.network.subnet import Subnet
from codesign.network.supernet import Supernet, modules_of, recalibrate_batch_norm

SPACE = arch.SearchSpace()


@pytest.fixture(scope="module")
def net():
    torch.manual_seed(3)
    made = Supernet(SPACE)
    frames = torch.randn(2, 1, 64, 64, generator=torch.Generator().manual_seed(1))
    recalibrate_batch_norm(made, arch.smallest_architecture(SPACE), [frames])
    return made


def kept(conv, cut, outputs, inputs, kernel):
    """Whether a trimmed convolution holds just these of the whole one."""
    whole = conv.weight.shape[-1]
    first = (whole - kernel) // 2
    want = conv.weight[
        :outputs, :inputs, first : first + kernel, first : first + kernel
    ]
    assert cut.weight.shape == (outputs, inputs, kernel, kernel)
    assert torch.equal(cut.weight, want)
    for name in ("weight", "bias", "mean", "variance"):
        mine, its = getattr(conv.norm, name), getattr(cut.norm, name)
        assert its.shape == (outputs,)
        assert torch.equal(its, mine[:outputs])


@pytest.mark.parametrize("seed", [3, 7, None])
def test_first_channels_and_the_middle_of_kernels_stay(net, seed):
    chosen = (
        arch.smallest_architecture(SPACE)
        if seed is None
        else arch.sample_architecture(SPACE, np.random.default_rng(seed))
    )
    cut = Subnet(net, chosen)
    assert not cut.training
    assert cut.architecture == chosen
    kept(net.stem, cut.net.stem, arch.stem_channels(SPACE, chosen), 1, 3)
    rows = arch.active_blocks(SPACE, chosen)
    for stage, trimmed, row in zip(net.stages, cut.net.stages, rows, strict=True):
        assert len(list(modules_of(trimmed))) == len(row)
        for module, its, block in zip(
            modules_of(stage), modules_of(trimmed), row, strict=False
        ):
            kept(module.expand, its.expand, block.hidden, block.inputs, 1)
            kept(module.depthwise, its.depthwise, block.hidden, 1, block.kernel)
            kept(module.project, its.project, block.outputs, block.hidden, 1)
            if its.squeeze is not None:
                down, up = its.squeeze.down, its.squeeze.up
                assert torch.equal(
                    down.weight,
                    module.squeeze.down.weight[: block.squeeze, : block.hidden],
                )
                assert torch.equal(down.bias, module.squeeze.down.bias[: block.squeeze])
                assert torch.equal(
                    up.weight, module.squeeze.up.weight[: block.hidden, : block.squeeze]
                )
                assert torch.equal(up.bias, module.squeeze.up.bias[: block.hidden])
    last = rows[-1][-1].outputs
    assert cut.net.calibration.reduce.weight.shape[1] == last
    assert torch.equal(
        cut.net.calibration.reduce.weight, net.calibration.reduce.weight[:, :last]
    )
    for lateral, whole in zip(
        cut.net.perception.laterals, net.perception.laterals, strict=True
    ):
        inputs = lateral.weight.shape[1]
        assert inputs in {row[-1].outputs for row in rows}
        assert torch.equal(lateral.weight, whole.weight[:, :inputs])


def test_answers_are_those_of_the_whole_and_the_whole_stays_as_it_was(net):
    chosen = arch.smallest_architecture(SPACE)
    before = {name: value.clone() for name, value in net.state_dict().items()}
    cut = Subnet(net, chosen)
    frames = torch.randn(3, 1, 64, 64, generator=torch.Generator().manual_seed(8))
    with torch.no_grad():
        whole, (mask, centre, slip) = net.eval()(frames, chosen), cut(frames)
    for got, want in (
        (mask, whole.mask_logits),
        (centre, whole.centre),
        (slip, whole.slip),
    ):
        torch.testing.assert_close(
            got, want, rtol=1e-4, atol=1e-5
        )  # single precision, laid out otherwise in memory
    assert all(
        torch.equal(value, before[name]) for name, value in net.state_dict().items()
    )
