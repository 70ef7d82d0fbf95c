"""Where the network computes."""

import math

import pytest
import torch

from codesign.network import largest
from codesign.train import placement, run
from metalens.ground import config
from metalens.ground.errors import ConfigError

GPU = torch.cuda.is_available()
SMALL = {"scenes": {"pixels": 64, "margin": 8, "pool": 16}, "inner": {"steps": 4, "batch": 8}}


def _going():
    table = config.merged(run.preset_table("smoke"), SMALL)
    return run.start(config.from_table(table, run.RunConfig, where="a test"))


def test_without_a_gpu_the_processor_is_taken():
    assert placement.device_of("cpu") == torch.device("cpu")
    assert (placement.device_of("auto").type == "cuda") == GPU


@pytest.mark.skipif(GPU, reason="there is a GPU")
def test_a_gpu_that_is_not_there_is_refused_with_what_to_do():
    with pytest.raises(ConfigError, match="--device cpu"):
        placement.device_of("cuda")


def test_a_network_computes_where_its_parameters_are():
    """A device without numbers stands for a GPU: nothing of an answer may be formed on the processor."""
    net = _going().trainer.model.net.eval().to("meta")
    answer = net(torch.empty(2, 1, 64, 64, device="meta"), largest(net.space))
    parts = [getattr(answer, name) for name in answer.__slots__]
    assert {part.device.type for part in parts if part is not None} == {"meta"}


def test_frames_and_gradients_pass_through_an_attended_network():
    """On the processor nothing is moved, and every number stays."""
    plain, attended = _going().trainer, _going().trainer
    placement.attend(attended.model.net, torch.device("cpu"))
    for one, other in zip(plain.run(), attended.run(), strict=True):
        assert one == other


@pytest.mark.skipif(not GPU, reason="needs a GPU")
def test_a_gpu_trains_to_the_same_losses_and_resumes():
    plain, moved = _going().trainer, _going().trainer
    placement.place(moved, placement.device_of("cuda"))
    losses = [(a.loss, b.loss) for a, b in zip(plain.run(until=2), moved.run(until=2), strict=True)]
    again = _going().trainer
    again.restore(moved.state())
    placement.place(again, placement.device_of("cuda"))
    losses += [(a.loss, b.loss) for a, b in zip(moved.run(), again.run(), strict=True)]
    assert all(math.isclose(a, b, rel_tol=1e-2) for a, b in losses)
