"""Frames of ambiguous pairs: which of them stand in a step, and at which depth."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from codesign.batches import EyeScenes, SceneConfig
from codesign.eye import ambiguity_pairs, render
from codesign.train.ambiguity import ambiguous
from metalens.ground.errors import TrainingError

SCENES = EyeScenes(SceneConfig(pixels=32, margin=5, scale=0.15), 31.0, 2100.0, 3, 6)


@pytest.fixture(scope="module")
def made():
    return ambiguous(SCENES, 3, 11)


def test_the_two_states_of_a_pair_follow_each_other(made):
    found = ambiguity_pairs(
        3, 11, rig=SCENES.rig, camera=SCENES.camera, motion=SCENES.settings.motion
    )
    assert len(made) == 6
    assert (made.margin, made.stream) == (5, 6)
    for name in ("slip_um", "traits", "gaze_rad", "mount_rad"):
        mine = getattr(made.states, name)
        assert torch.equal(mine[0::2], getattr(found.first, name))
        assert torch.equal(mine[1::2], getattr(found.second, name))


def test_scaled_depths_are_those_drawn_from_the_range_of_the_scenes(made):
    """From 21 mm -+ 3.5 mm, once more by the second stream of the seed, as far as a
    factor of 1 -+ 0.15 reaches.
    """
    depth = SCENES.rig.distance_um + made.states.slip_um[:, 2]
    low, high = SCENES.depths_um
    wanted = low + (high - low) * np.random.default_rng((11, 8)).random(6)
    scaled = (depth * made.states.scale).numpy()
    reach = np.clip(wanted, 0.85 * depth.numpy(), 1.15 * depth.numpy())
    assert scaled == pytest.approx(reach, rel=1e-12)


def test_frames_of_a_step_are_rows_of_their_own_and_the_last_ones_are_held(made):
    assert [made.rows(k, 2) for k in range(3)] == [
        slice(0, 2),
        slice(2, 4),
        slice(4, 6),
    ]
    with pytest.raises(TrainingError, match="6 ambiguous frames hold no batch 3 of 2"):
        made.rows(3, 2)
    with pytest.raises(TrainingError, match="6 ambiguous frames hold no batch 1 of 4"):
        made.rows(1, 4)
    assert made.rows(0, 6) == slice(0, 6)
    want = render(made.states[2:4], rig=SCENES.rig, camera=SCENES.camera)
    got = made.batch(1, 2)
    assert torch.equal(got.frames.radiance, want.frames.radiance)
    at = SCENES.rig.distance_um
    far = (at + made.states.slip_um[2:4, 2]) * made.states.scale[2:4] - at
    assert got.slip_mm[:, 2].numpy() == pytest.approx(
        far.numpy() * 1e-3, rel=1e-5
    )  # float32, of 0.4 of 20 mm
    assert got.mask.shape[-1] == 32
    assert torch.equal(made.labels(1, 2).pupil_px, want.labels.pupil_px)


def test_the_scale_comes_back_to_one_where_none_is_asked_for():
    plain = ambiguous(
        replace(SCENES, settings=replace(SCENES.settings, scale=0.0)), 2, 11
    )
    assert plain.states.scale.tolist() == [1.0] * 4
