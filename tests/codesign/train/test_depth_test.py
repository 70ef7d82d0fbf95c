"""Tests on blur alone: ambiguous frames hold no other cue, and a network that ignores
its PSF is found out.
"""

import numpy as np
import pytest
import torch

from codesign.batches.flat import flatten_layers
from codesign.batches.scenes import TEST, EyeScenes, SceneConfig
from codesign.network.architecture import smallest_architecture
from codesign.network.supernet import Prediction, Supernet
from codesign.optics.stack import OpticsConfig
from codesign.train import ambiguity, assess, inner
from codesign.train.depth_test import DisplacedFrames, depth_response, displace_frames
from codesign.train.inner import InnerConfig, Trainer
from metalens.core.errors import TrainingError
from metalens.image.sensor import Sensor

SCENES = EyeScenes(SceneConfig(pixels=64, margin=8), 18.0, 2000.0, 0, TEST)
OPTICS = OpticsConfig(
    depth_count=12,
    sample_um=18.0,
    window_samples=17,
    polynomials=0,
    focus_mm=33.0,
    image="uniform",
)


@pytest.fixture(scope="module")
def pairs():
    return ambiguity.ambiguous_pairs(SCENES, 8, seed=4)


@pytest.fixture(scope="module")
def trainer():
    config = InnerConfig(steps=1, batch=8)
    made = inner.make_model(OPTICS, pitch_um=18.0, seed=0)
    return Trainer(
        config, OPTICS, Sensor(18.0, 18.0, 1e5, 0.0, 2e5, 0.0, 16), SCENES, made
    )


class Blurmeter(Supernet):
    """Predicts the axial slippage from the contrast of fine detail: it sees nothing but
    blur.
    """

    def forward(self, frames, architecture):
        fine = (frames[..., 1:] - frames[..., :-1]).square().mean((1, 2, 3))
        slip = torch.stack([0 * fine, 0 * fine, fine], 1)
        return Prediction(frames[:, 0], torch.zeros(len(fine), 2), slip)


class Ruler(Supernet):
    """Predicts from where things are: the blur hardly moves it."""

    def forward(self, frames, architecture):
        x = torch.arange(frames.shape[-1], dtype=frames.dtype)
        place = (frames.square() * x).sum((1, 2, 3)) / frames.square().sum((1, 2, 3))
        return Prediction(
            frames[:, 0],
            torch.zeros(len(place), 2),
            torch.stack([0 * place, 0 * place, place / 10], 1),
        )


def test_batches_of_pairs_end_with_the_pairs(pairs):
    assert torch.equal(pairs.batch(1, 8).slip_mm, pairs.batch(0, 16).slip_mm[8:])
    with pytest.raises(TrainingError, match="16 ambiguous frames hold no batch 2"):
        pairs.batch(2, 8)


def test_displaced_frames_differ_in_depth_alone(pairs):
    plain, moved = pairs.batch(0, 4), DisplacedFrames(pairs, 1000.0).batch(0, 4)
    assert torch.equal(plain.frames.radiance, moved.frames.radiance)
    assert torch.equal(plain.slip_mm, moved.slip_mm)
    torch.testing.assert_close(
        moved.frames.depth_um - plain.frames.depth_um,
        torch.full((4, 2, 80, 80), 1000.0),
    )
    scale = pairs.states.scale[:4]
    flat = flatten_layers(plain.frames, scale)
    far = displace_frames(flat, 1000.0)
    change = (far.depth_um.astype(float) - flat.depth_um) * flat.scale[:, None, None]
    assert (
        np.abs(change - 1000.0).max() < 1.3
    )  # a um of rounding before and after, times the scale


def test_the_response_to_psf_depth_tells_a_blurmeter_from_a_ruler(pairs, trainer):
    """Beyond its focus, a hyperbolic lens blurs more as things come nearer: the
    blurmeter follows, the ruler not.
    """
    found = {}
    for kind in (Blurmeter, Ruler):
        found[kind] = depth_response(
            trainer, pairs, kind(), smallest_architecture(Supernet().space), batches=2
        )
    assert found[Blurmeter].frames == 16
    assert found[Blurmeter].mean > 5 * found[Blurmeter].standard_error > 0
    per_blur = found[Blurmeter].mean / _spread(trainer, pairs, Blurmeter())
    per_place = abs(found[Ruler].mean) / _spread(trainer, pairs, Ruler())
    assert per_place < 0.1 * per_blur


def _spread(trainer, pairs, net):
    seen = assess.sensor_frames(trainer, pairs, 2)
    return float(
        assess.predict_frames(
            net, smallest_architecture(net.space), seen, trainer.inner
        )
        .slip_mm[:, 2]
        .std()
    )
