"""Baseline networks: counted cost, geometry of the drawn pupil, attention that looks
where it says, training.
"""

import math

import numpy as np
import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from codesign.batches.scenes import EyeScenes, SceneConfig
from codesign.network import baselines, losses
from codesign.network.baselines import NOMINAL_MM, TANGENT, make
from codesign.optics.stack import OpticsConfig
from codesign.train import inner
from codesign.train.inner import InnerConfig, Model, Trainer
from metalens.ground.errors import ConfigError
from metalens.image.sensor import Sensor

NAMES = ("nvgaze", "popovic", "de2gaze")


@pytest.mark.parametrize("name", NAMES)
def test_counted_cost_is_that_of_a_pass(name):
    torch.manual_seed(0)
    net = make(name)
    with FlopCounterMode(display=False) as counter:
        net(torch.zeros(1, 1, 72, 72))
    assert net.counts(None, np.array([72]))[
        0
    ] == counter.get_total_flops() // 2 + net.sampling_macs(72)
    assert (
        net.counts(None, np.array([64, 128]))[1]
        > 3 * net.counts(None, np.array([64, 128]))[0]
    )


def test_nvgaze_is_the_stack_of_its_paper():
    widths = [
        m.out_channels
        for m in make("nvgaze").modules()
        if isinstance(m, torch.nn.Conv2d)
    ]
    assert widths == [16, 24, 36, 54, 81, 122]


def test_the_nominal_eye_of_the_eyeball_regressor_is_that_of_the_renderer():
    scenes = EyeScenes(SceneConfig(pixels=32, margin=0, scale=0.0), 36.0, 2000.0, 0)
    labels = scenes.rendered(0, 128).labels
    centre = ((labels.centre_um - labels.slip_um) * 1e-3).mean(0)
    torch.testing.assert_close(
        centre, torch.tensor(NOMINAL_MM, dtype=torch.float64), rtol=0, atol=0.15
    )  # 5 sigma


def test_the_drawn_pupil_is_the_ellipse_of_a_disc_in_space():
    """A disc of radius 2 mm at 20 mm, turned by 60 degrees about the vertical: half as
    wide as high.
    """
    axis = torch.tensor(
        [[math.sin(math.radians(60)), 0.0, -math.cos(math.radians(60))]]
    )
    logits = baselines._disc(
        torch.tensor([[0.0, 0.0, 20.0]]), axis, torch.tensor([2.0]), 400
    )[0]
    inside = logits > 0
    step = 2 * TANGENT / 400 * 20
    area = float(inside.sum()) * step**2
    # on the near side the disc is 1.7 mm closer: the ellipse grows by about 1 %
    assert area == pytest.approx(math.pi * 4 * 0.5, rel=0.03)
    rows, columns = inside.any(1).sum() * step, inside.any(0).sum() * step
    assert float(columns / rows) == pytest.approx(0.5, rel=0.03)


def test_an_eyeball_at_its_nominal_place_points_its_axis_at_the_camera_below():
    axis = baselines.Eyeball._axis(torch.zeros(1, 2))
    torch.testing.assert_close(
        axis, torch.tensor([[0.0, -math.sqrt(0.5), -math.sqrt(0.5)]])
    )


def test_deformable_attention_looks_where_its_offsets_say():
    """One head, one point, identity weights, an offset of exactly one position to the
    right: the features shift.
    """
    layer = baselines._Attention(4, 1, 1)
    with torch.no_grad():
        for linear in (layer.value, layer.out):
            linear.weight.copy_(torch.eye(4))
            linear.bias.zero_()
        layer.offset.bias.copy_(torch.tensor([1.0, 0.0]))
        for linear in (layer.feed[0], layer.feed[2]):
            linear.weight.zero_(), linear.bias.zero_()
    features = torch.randn(2, 4, 5, 6, generator=torch.Generator().manual_seed(0))
    place = torch.nn.Linear(2, 4)
    found = layer(features, place) - features
    torch.testing.assert_close(found[..., :-1], features[..., 1:], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_baselines_train_in_the_same_loop(name):
    torch.manual_seed(0)
    scenes = EyeScenes(
        SceneConfig(pixels=64, margin=8, slip_mm=(2.0, 1.5, 3.0)), 18.0, 2000.0, 3
    )
    optics = OpticsConfig(
        depth_count=4, sample_um=18.0, window_samples=17, polynomials=3, image="uniform"
    )
    config = InnerConfig(
        steps=3, batch=4, patience=1, optics=inner.Schedule(0.02, 0.0, 1.0)
    )
    plain = inner.model(optics, pitch_um=18.0, seed=0)
    net = make(name)
    before = [p.detach().clone() for p in net.parameters()]
    trainer = Trainer(
        config,
        optics,
        Sensor(18.0),
        scenes,
        Model(net, plain.coefficients_rad, plain.log_pitch),
    )
    records = list(trainer.run())
    assert records[-1].skipped == 0
    assert records[0].mmacs == pytest.approx(
        float(net.counts(None, np.array([64]))[0]) / 1e6
    )
    moved = [
        not torch.equal(a, b) for a, b in zip(before, net.parameters(), strict=True)
    ]
    assert sum(moved) > 0.9 * len(moved)
    assert (
        float(plain.coefficients_rad.detach().abs().max()) > 0
    )  # gradients reach the optics


def test_centres_are_held_to_the_centroid_and_empty_masks_count_nothing():
    mask = torch.zeros(2, 8, 8)
    mask[0, 2, 6] = 1.0
    centre = torch.tensor(
        [[6.5 / 8 - 0.5, 2.5 / 8 - 0.5], [0.3, 0.3]], requires_grad=True
    )
    loss = losses.place(centre, mask)
    loss.backward()
    assert float(loss.detach()) == 0.0
    assert torch.equal(centre.grad, torch.zeros(2, 2))
    assert float(losses.place(centre.detach() + 0.1, mask)) > 1
    assert float(losses.place(centre.detach(), torch.zeros(2, 8, 8))) == 0.0


def test_unknown_baselines_are_refused():
    with pytest.raises(ConfigError, match="no baseline network 'resnet'"):
        make("resnet")
