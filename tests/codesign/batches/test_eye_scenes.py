"""Training frames: the same step gives the same frames, streams never share one, labels are those of the renderer."""

from dataclasses import replace

import pytest
import torch

from codesign.batches.scenes import TEST, TRAINING, EyeScenes, SceneConfig
from metalens.ground.errors import ConfigError

SMALL = SceneConfig(pixels=48, margin=8)


def _scenes(stream=TRAINING, seed=0):
    return EyeScenes(SMALL, 18.0, 2000.0, seed, stream)


def test_same_step_same_frames_other_step_others():
    one, again, other = _scenes().batch(3, 2), _scenes().batch(3, 2), _scenes().batch(4, 2)
    assert torch.equal(one.frames.radiance, again.frames.radiance)
    assert torch.equal(one.slip_mm, again.slip_mm)
    assert not torch.equal(one.frames.radiance, other.frames.radiance)


def test_streams_and_seeds_never_share_a_state():
    drawn = [_scenes(stream, seed).states(0, 4).slip_um for stream in (TRAINING, TEST) for seed in (0, 1)]
    for i, a in enumerate(drawn):
        assert all(not torch.equal(a, b) for b in drawn[i + 1 :])


def test_mask_lies_on_the_frame_without_its_margin():
    scenes = _scenes()
    made, batch = scenes.rendered(0, 3), scenes.batch(0, 3)
    assert batch.frames.radiance.shape[-1] == 48 + 16
    assert torch.equal(batch.mask, made.pupil[:, 8:-8, 8:-8])
    torch.testing.assert_close(batch.slip_mm.double(), made.labels.slip_um * 1e-3, rtol=1e-6, atol=1e-6)


def test_scale_ambiguity_moves_depth_but_not_the_pinhole_image():
    from dataclasses import replace

    scenes = _scenes()
    states = scenes.states(0, 2)
    one, two = (replace(states, scale=torch.full((2,), s, dtype=torch.float64)) for s in (1.0, 1.15))
    from codesign.eye.renderer import render

    a, b = (render(s, rig=scenes.rig, camera=scenes.camera) for s in (one, two))
    assert torch.equal(a.pinhole(), b.pinhole())
    torch.testing.assert_close(b.frames.depth_um, a.frames.depth_um * 1.15, rtol=1e-6, atol=0.0)


def test_impossible_settings_are_refused():
    with pytest.raises(ConfigError, match="scale"):
        SceneConfig(scale=0.6)


def test_variety_widens_looks_and_nothing_else():
    """Twice the spread of a trait whose limits are far; geometry and the subject's size stay."""
    plain, wide = (
        EyeScenes(replace(SceneConfig(), variety=v), 9.0, 2000.0, seed=3).states(0, 4000) for v in (1.0, 2.0)
    )
    for name, most in (("skin", 0.95), ("iris", 0.95), ("lashes", 9.0), ("pupil_radius_um", 4300.0)):
        ratio = float(wide.trait(name).std() / plain.trait(name).std())
        assert 1.6 < ratio < 2.05  # 2, less what the limits cut off: 12 % of the pupils at twice the spread
        assert 0 <= float(wide.trait(name).min()) <= float(wide.trait(name).max()) <= most
    for name in ("size", "cornea_radius_um", "limbus_radius_um"):
        assert torch.equal(wide.trait(name), plain.trait(name))
    assert float(wide.aperture.min()) < 0.52 < 0.74 < float(plain.aperture.min())
    with pytest.raises(ConfigError, match="variety = 5"):
        SceneConfig(variety=5.0)
