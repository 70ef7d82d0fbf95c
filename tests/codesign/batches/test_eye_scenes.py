"""Training frames: the same step gives the same frames, streams never share one, labels
are those of the renderer.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch

from codesign.batches import pool
from codesign.batches.scenes import TEST, TRAINING, EyeScenes, SceneConfig
from codesign.network.cost import POINTS
from metalens.core.errors import ConfigError

SMALL = SceneConfig(pixels=48, margin=8)


def _scenes(stream=TRAINING, seed=0):
    return EyeScenes(SMALL, 18.0, 2000.0, seed, stream)


def test_same_step_same_frames_other_step_others():
    one, again, other = (
        _scenes().batch(3, 2),
        _scenes().batch(3, 2),
        _scenes().batch(4, 2),
    )
    assert torch.equal(one.frames.radiance, again.frames.radiance)
    assert torch.equal(one.slip_mm, again.slip_mm)
    assert not torch.equal(one.frames.radiance, other.frames.radiance)


def test_streams_and_seeds_never_share_a_state():
    drawn = [
        _scenes(stream, seed).states(0, 4).slip_um
        for stream in (TRAINING, TEST)
        for seed in (0, 1)
    ]
    for i, a in enumerate(drawn):
        assert all(not torch.equal(a, b) for b in drawn[i + 1 :])


def test_mask_lies_on_the_frame_without_its_margin():
    scenes = _scenes()
    made, batch = scenes.rendered(0, 3), scenes.batch(0, 3)
    assert batch.frames.radiance.shape[-1] == 48 + 16
    assert torch.equal(batch.mask, made.pupil[:, 8:-8, 8:-8])
    torch.testing.assert_close(
        batch.slip_mm.double(), made.labels.slip_um * 1e-3, rtol=1e-6, atol=1e-6
    )


def test_scale_ambiguity_moves_depth_but_not_the_pinhole_image():
    from dataclasses import replace

    scenes = _scenes()
    states = scenes.states(0, 2)
    one, two = (
        replace(states, scale=torch.full((2,), s, dtype=torch.float64))
        for s in (1.0, 1.15)
    )
    from codesign.eye.renderer import render

    a, b = (render(s, rig=scenes.rig, camera=scenes.camera) for s in (one, two))
    assert torch.equal(a.pinhole(), b.pinhole())
    torch.testing.assert_close(
        b.frames.depth_um, a.frames.depth_um * 1.15, rtol=1e-6, atol=0.0
    )


def test_impossible_settings_are_refused():
    with pytest.raises(ConfigError, match="scale"):
        SceneConfig(scale=0.6)
    for slip_mm in ((-2.0, 1.5, 3.5), (2.0, 1.5, 21.0)):
        with pytest.raises(
            ConfigError,
            match=r"slip_mm = .* the 21 mm that the eye stands before the lens",
        ):
            SceneConfig(slip_mm=slip_mm)
    with pytest.raises(ConfigError, match=r"gaze_deg = \(18.0, 60.0\)"):
        SceneConfig(gaze_deg=(18.0, 60.0))


def test_variety_widens_looks_and_nothing_else():
    """Twice the spread of a trait whose limits are far; geometry and the subject's size
    stay.
    """
    plain, wide = (
        EyeScenes(replace(SceneConfig(), variety=v), 9.0, 2000.0, seed=3).states(
            0, 4000
        )
        for v in (1.0, 2.0)
    )
    for name, most in (
        ("skin", 0.95),
        ("iris", 0.95),
        ("lashes", 9.0),
        ("pupil_radius_um", 4300.0),
    ):
        ratio = float(wide.trait(name).std() / plain.trait(name).std())
        assert (
            1.6 < ratio < 2.05
        )  # 2, less what the limits cut off: 12 % of the pupils at twice the spread
        assert (
            0 <= float(wide.trait(name).min()) <= float(wide.trait(name).max()) <= most
        )
    for name in ("size", "cornea_radius_um", "limbus_radius_um"):
        assert torch.equal(wide.trait(name), plain.trait(name))
    assert float(wide.aperture.min()) < 0.52 < 0.74 < float(plain.aperture.min())
    with pytest.raises(ConfigError, match="variety = 5"):
        SceneConfig(variety=5.0)


def test_the_shift_is_where_the_pupil_of_an_eye_that_looks_straight_ahead_stands():
    """Turn of the mount, depth of the person, slippage and scale at once; the pupil is
    the renderer's own label.
    """
    scenes = replace(_scenes(), settings=replace(SMALL, depth_sd_mm=1.3))
    states = scenes.states(2, 6)
    ahead = replace(
        states,
        gaze_rad=0 * states.gaze_rad,
        scale=1 + 0.1 * torch.arange(6, dtype=torch.float64),
    )
    from codesign.eye.renderer import render

    labels = render(ahead, rig=scenes.rig, camera=scenes.camera).labels
    here = torch.tensor(
        [*scenes.rig.aim_um, scenes.rig.distance_um], dtype=torch.float64
    )
    torch.testing.assert_close(
        labels.shift_um, labels.pupil_um - here, rtol=1e-9, atol=1e-5
    )
    apart = (labels.shift_um - labels.slip_um).abs().mean(0)
    assert (
        float(apart[:2].min()) > 90
    )  # a degree of mounting at 21 mm, spread evenly: 180 um in the mean of many
    assert float(apart[2]) > 300  # depth of the person


def test_poses_of_a_pool_are_those_of_the_renderer_whatever_the_view():
    """Other cameras see wider fields: landmarks and places shrink across, the axis
    turns with the face.
    """
    wide = EyeScenes(replace(SMALL, variety=3.0), 18.0, 2000.0, 4)
    direct, made = wide.batch(0, 24), pool.render_pool(wide, 24)
    states = wide.states(0, 24)
    drawn = pool.PoolScenes(made, wide.margin, 0.0, seed=1).rows(
        np.arange(24), np.random.default_rng(0)
    )
    here = (
        torch.tensor([*wide.rig.aim_um, wide.rig.distance_um], dtype=torch.float64)
        * 1e-3
    )
    for ours, theirs in (
        (drawn.slip_mm, direct.slip_mm),
        (drawn.pose.shift_mm, direct.pose.shift_mm),
    ):
        scaled = states.scale[:, None] * (ours.double() + here) - here
        torch.testing.assert_close(scaled, theirs.double(), rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(drawn.pose.axis, direct.pose.axis)
    torch.testing.assert_close(drawn.pose.points, direct.pose.points)
    assert direct.pose.points.shape == (24, POINTS, 2)  # as many as networks seek
    labels = wide.rendered(0, 24).labels
    side = wide.camera.pixels
    x = (
        labels.pupil_px[:, 0] + 0.5
    ) * 18.0 - 18.0 * side / 2  # um on the sensor, from the axis
    torch.testing.assert_close(
        direct.pose.points[:, -1, 0].double(), x / (48 * 18.0), rtol=1e-5, atol=1e-6
    )
