"""Frames that nobody else uses: streams of calibration, selection and test; a mask that
would be worse; a network and loss of one's own.
"""

import itertools
import runpy
from dataclasses import replace
from pathlib import Path

import torch

from codesign.batches import CALIBRATION, EXPERIMENT, TEST, VALIDATION
from codesign.batches.scenes import TRAINING, EyeScenes, SceneConfig
from codesign.train.trainer import compute_ahead

ROOT = Path(__file__).parents[3]


def test_no_two_streams_show_the_same_eye():
    """Intervals are calibrated on a stream that neither training, nor the search's
    selection, nor the test, nor batch statistics (of training) draw from.
    """
    scenes = EyeScenes(SceneConfig(), 9.0, 2000.0, seed=3)
    streams = (TRAINING, VALIDATION, TEST, CALIBRATION, EXPERIMENT)
    assert len(set(streams)) == len(streams)
    seen = [
        torch.cat([replace(scenes, stream=s).states(step, 6).traits for step in (0, 1)])
        for s in streams
    ]
    for one, other in itertools.combinations(seen, 2):
        distance = torch.cdist(one, other)
        assert float(distance.min()) > 1e-6


def test_a_lens_is_trained_behind_a_network_and_a_loss_of_ones_own():
    example = runpy.run_path(str(ROOT / "examples" / "own_network.py"))
    torch.manual_seed(0)
    layers = torch.nn.Conv2d(1, 8, 5, stride=4), torch.nn.ReLU(), torch.nn.Flatten()
    network = torch.nn.Sequential(*layers, torch.nn.LazyLinear(3))
    phase_rad, losses = example["train"](network, steps=12)
    assert losses[-1] < 0.9 * losses[0]  # one batch of 16 frames, learned by heart
    assert int((phase_rad.abs() > 1e-3).sum()) == len(phase_rad)


def test_frames_rendered_ahead_are_those_of_their_steps():
    scenes = EyeScenes(SceneConfig(pixels=32, margin=0), 36.0, 2000.0, seed=2)
    steps = range(3, 8)
    made = list(compute_ahead(lambda n: scenes.batch(n, 2), steps))
    assert len(made) == len(steps)
    for step, batch in zip(steps, made, strict=True):
        assert torch.equal(batch.slip_mm, scenes.batch(step, 2).slip_mm)
        want = scenes.batch(step, 2).frames.radiance
        assert torch.equal(batch.frames.radiance, want)
