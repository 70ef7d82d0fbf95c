"""What scenes are drawn from: units, widened looks, scales that hide the depth, views
from elsewhere.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from codesign.batches import scenes
from codesign.batches.scenes import EyeScenes, SceneConfig
from codesign.eye import POPULATION, MotionRanges

OWN = SceneConfig(
    pixels=50,
    margin=7,
    slip_mm=(1.9, 1.1, 3.2),
    gaze_deg=(17.0, 11.0),
    depth_sd_mm=0.6,
    variety=1.7,
    scale=0.15,
)


def test_ranges_of_motion_carry_micrometres_and_radians():
    motion = OWN.motion
    assert (motion.gaze_x_rad, motion.gaze_y_rad) == pytest.approx(
        (math.radians(17), math.radians(11))
    )
    assert motion.slip_um == pytest.approx((1900.0, 1100.0, 3200.0))
    assert motion.population["depth_um"].sd == pytest.approx(600.0)
    assert motion.population["depth_um"].mean == POPULATION["depth_um"].mean


def test_depths_are_those_of_the_rig_and_its_slippage_and_frames_have_their_margin():
    made = EyeScenes(OWN, 11.0, 1800.0, 3)
    distance = made.rig.distance_um
    assert made.depths_um == pytest.approx((distance - 3200, distance + 3200))
    assert (made.camera.pixels, made.camera.pitch_um, made.rig.sensor_distance_um) == (
        64,
        11.0,
        1800.0,
    )


LIMITS = {name: (0.0, 0.95) for name in ("sclera", "skin", "pupil", "exposure")}
LIMITS |= {"iris": (0.05, 0.95), "pupil_radius_um": (700.0, 4300.0)}


@pytest.mark.parametrize("variety", [0.5, 1.0, 2.5])
def test_looks_spread_about_their_mean_and_stay_above_nothing(variety):
    made = scenes.widen_traits(variety)
    for name, trait in made.items():
        usual = POPULATION[name]
        assert trait.mean == usual.mean
        assert trait.sd == pytest.approx(usual.sd * variety)
        low = usual.mean - (usual.mean - usual.low) * variety
        least, most = LIMITS.get(name, (0.0, math.inf))
        assert trait.low == pytest.approx(max(low, least))
        assert trait.high == pytest.approx(
            min(usual.mean + (usual.high - usual.mean) * variety, most)
        )
    low, high = MotionRanges().aperture
    assert scenes.widen_motion(variety).aperture == pytest.approx(
        (max(1 - (1 - low) * variety, 0.1), high)
    )


def test_scales_bring_every_depth_to_one_that_knows_nothing_of_it():
    """A wanted depth over the own one, within 15 % of 1: below and above, the factor
    ends there.
    """
    depth = torch.tensor([15e3, 20e3, 26e3, 31e3], dtype=torch.float64)
    got = scenes.draw_depth_scales(depth, (18e3, 27e3), 0.15, np.random.default_rng(9))
    wanted = np.random.default_rng(9).uniform(18e3, 27e3, 4)
    assert got.numpy() == pytest.approx(np.clip(wanted / depth.numpy(), 0.85, 1.15))


def test_a_batch_has_the_mask_without_its_margin_and_slippage_in_millimetres():
    frames = SimpleNamespace(
        radiance=torch.rand(2, 2, 9, 9),
        coverage=torch.rand(2, 2, 9, 9),
        depth_um=torch.rand(2, 2, 9, 9),
    )
    labels = SimpleNamespace(
        slip_um=torch.tensor([[100.0, -250.0, 1900.0], [7.0, 0.0, -30.0]]),
        shift_um=torch.tensor([[400.0, -150.0, 1800.0], [8.0, 1.0, -40.0]]),
        optic_axis=torch.tensor([[0.6, 0.0, -0.8], [0.0, 0.28, -0.96]]),
        landmarks_px=torch.tensor(
            [[[4.0, 4.0], [6.5, 1.0]], [[-1.0, 5.0], [9.0, 4.0]]]
        ),
        pupil_px=torch.tensor([[5.0, 3.0], [4.0, 6.0]]),
    )
    pupil = torch.rand(2, 9, 9)
    made = scenes.as_batch(
        SimpleNamespace(frames=frames, pupil=pupil, labels=labels), 2
    )
    assert torch.equal(made.mask, pupil[:, 2:7, 2:7])
    assert made.slip_mm.numpy() == pytest.approx(
        np.array([[0.1, -0.25, 1.9], [0.007, 0.0, -0.03]])
    )
    assert made.frames.depth_um is frames.depth_um
    assert made.pose.shift_mm.numpy() == pytest.approx(
        np.array([[0.4, -0.15, 1.8], [0.008, 0.001, -0.04]])
    )
    assert torch.equal(made.pose.axis, labels.optic_axis)
    # of the five pixels inside the margin, from the middle of pixel 4
    assert made.pose.points[0].numpy() == pytest.approx(
        np.array([[0.0, 0.0], [0.5, -0.6], [0.2, -0.2]]), abs=1e-7
    )
    assert made.pose.points[1].numpy() == pytest.approx(
        np.array([[-1.0, 0.2], [1.0, 0.0], [0.0, 0.4]]), abs=1e-7
    )
