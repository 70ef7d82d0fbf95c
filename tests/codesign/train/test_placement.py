"""Where the network computes."""

import math

import pytest
import torch

from codesign.network import largest_architecture
from codesign.train import run, trainer
from metalens.core import config
from metalens.core.errors import ConfigError
from tests.elsewhere import AWAY, elsewhere

GPU = torch.cuda.is_available()
SMALL = {
    "scenes": {"pixels": 64, "margin": 8, "pool": 16},
    "inner": {"steps": 4, "batch": 8},
    "sensor": {"bits": 16},
}
# few nodes of the true image over the field
TRUE = {"optics": {"image_tolerance": 0.4}, "scenes": {"pixels": 32}}


def _going(change=None, frozen=()):
    small = config.merge_tables(run.preset_table("smoke"), SMALL)
    table = config.merge_tables(
        config.merge_tables(small, {"run": {"frozen": list(frozen)}}), change or {}
    )
    return run.start_run(config.from_table(table, run.RunConfig, where="a test"))


def test_without_a_gpu_the_processor_is_taken():
    assert trainer.device_of("cpu") == torch.device("cpu")
    assert (trainer.device_of("auto").type == "cuda") == GPU


@pytest.mark.skipif(GPU, reason="there is a GPU")
def test_a_gpu_that_is_not_there_is_refused_with_what_to_do():
    with pytest.raises(ConfigError, match="--device cpu"):
        trainer.device_of("cuda")


def test_a_network_computes_where_its_parameters_are():
    """A device without numbers stands for a GPU: nothing of an answer may be formed on
    the processor.
    """
    net = _going().trainer.model.net.eval().to("meta")
    answer = net(
        torch.empty(2, 1, 64, 64, device="meta"), largest_architecture(net.space)
    )
    parts = [getattr(answer, name) for name in answer.__slots__]
    assert {part.device.type for part in parts if part is not None} == {"meta"}


@pytest.mark.parametrize(
    ("change", "frozen"),
    [
        (
            {"optics": {"image": "uniform"}},
            ("optics", "pitch"),
        )  # flat frames of a pool, a step ahead
    ],
)
def test_a_step_elsewhere_is_that_of_the_processor(change, frozen):
    """Images, pixels, network, losses and the way back to lens and pitch: nothing of it
    is for the processor alone.
    """
    plain = _going(change, frozen).trainer
    moved = _going(change, frozen).trainer
    (want,) = plain.run(until=1)
    with elsewhere() as done:
        trainer.place_on_device(moved, AWAY)
        (found,) = moved.run(until=1)
        there = {name: p.cpu() for name, p in moved.model.net.named_parameters()}
    assert {"convolution", "convolution_backward", "_fft_r2c"} <= done
    for name in ("loss", "task", "optics", "pitch_um", "mmacs"):
        assert getattr(found, name) == pytest.approx(getattr(want, name), rel=1e-5), (
            name
        )
    names = {"optics": "coefficients_rad", "pitch": "log_pitch"}
    for part in names.keys() - set(frozen):
        one, other = (
            getattr(trainer.model, names[part]).grad for trainer in (plain, moved)
        )
        # a count that falls the other way: 1e-2
        assert float((one - other).norm()) <= 5e-2 * float(one.norm()), part
    for name, p in plain.model.net.named_parameters():
        assert there[name].shape == p.shape


@pytest.mark.skipif(not GPU, reason="needs a GPU")
def test_a_gpu_trains_to_the_same_losses_and_resumes():
    plain, moved = _going().trainer, _going().trainer
    trainer.place_on_device(moved, trainer.device_of("cuda"))
    losses = [
        (a.loss, b.loss)
        for a, b in zip(plain.run(until=2), moved.run(until=2), strict=True)
    ]
    again = _going().trainer
    again.restore(moved.state())
    trainer.place_on_device(again, trainer.device_of("cuda"))
    losses += [(a.loss, b.loss) for a, b in zip(moved.run(), again.run(), strict=True)]
    assert all(math.isclose(a, b, rel_tol=1e-2) for a, b in losses)
