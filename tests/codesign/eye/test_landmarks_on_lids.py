"""Landmarks of the lids lie on the ball that the lids are; what no ray shows of the
iris is projected straight.
"""

import numpy as np
import pytest
import torch

from codesign.eye import model
from codesign.eye.landmarks import iris_to_camera, landmark_points
from codesign.eye.population import (
    POPULATION,
    CameraRig,
    EyeStates,
    draw_states,
    model_parameters,
)


def test_corners_and_margins_of_the_lids_are_where_their_ball_is_met():
    """Centre + x right + y down + sqrt(R² - x² - y²) out, as tangents x / z and y / z;
    a face turned three ways.
    """
    turn = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0]
    turn[:, 2] *= -np.sign(turn[2, 2])  # out of the face: towards the camera
    p = torch.zeros(1, model.COUNT, dtype=torch.float64)
    centre = np.array([1300.0, -800.0, 41_000.0])
    places = {
        model.CENTRE: centre,
        model.FACE_X: turn[:, 0],
        model.FACE_Y: turn[:, 1],
        model.FACE_Z: turn[:, 2],
    }
    for at, vector in places.items():
        p[0, at : at + 3] = torch.tensor(vector)
    radius, middle, half, upper, lower = 13_100.0, 450.0, 11_800.0, 4900.0, 5600.0
    numbers = {
        model.LID_R: radius,
        model.MIDDLE: middle,
        model.HALF: half,
        model.UPPER: upper,
        model.LOWER: lower,
    }
    for at, number in numbers.items():
        p[0, at] = number
    p[0, model.AXIS : model.AXIS + 3] = torch.tensor([0.0, 0.0, -1.0])
    found = landmark_points(p)[0, :4].numpy()
    corners = [
        (middle - 0.98 * half, 0.0),
        (middle + 0.98 * half, 0.0),
        (middle, -upper),
        (middle, lower),
    ]
    for got, (x, y) in zip(found, corners, strict=True):
        there = centre + turn @ [x, y, np.sqrt(radius**2 - x**2 - y**2)]
        assert got == pytest.approx(there[:2] / there[2], rel=1e-9)


def test_a_point_that_no_ray_shows_is_projected_straight_and_leaves_the_others_as_they_are():
    """60 mm aside, with the pupil 0.55 mm nearer and 13 % larger; the points beside it
    are found as if it were not.
    """
    traits = torch.tensor(
        [[t.mean for t in POPULATION.values()]] * 2, dtype=torch.float64
    )
    gaze, none, slip = (
        torch.tensor([[0.1, -0.2], [-0.3, 0.05]]).double(),
        torch.zeros(2).double(),
        torch.zeros(2, 3),
    )
    still = draw_states(2, 0)
    states = EyeStates(
        traits, still.textures, gaze, none, slip.double(), 0 * gaze, none + 1, none + 1
    )
    p = model_parameters(states, CameraRig(), pixel_rad=0.0045)
    near = torch.tensor(
        [[900.0, -400.0], [0.0, 1300.0], [-700.0, -250.0]], dtype=torch.float64
    ).expand(2, 3, 2)
    far = torch.tensor([[-60_000.0, 31_000.0]], dtype=torch.float64).expand(2, 1, 2)
    alone = iris_to_camera(p, near)
    found = iris_to_camera(p, torch.cat([near[:, :2], far, near[:, 2:]], 1))
    assert found[:, [0, 1, 3]].numpy() == pytest.approx(alone.numpy(), abs=1e-9)
    for eye, got in zip(p.numpy(), found[:, 2].numpy(), strict=True):
        centre, axis, across, below = (
            eye[at : at + 3]
            for at in (model.CENTRE, model.AXIS, model.IRIS_X, model.IRIS_Y)
        )
        there = (
            centre
            + (eye[model.PUPIL_D] + 550) * axis
            + 1.13 * (-60_000 * across + 31_000 * below)
        )
        assert got == pytest.approx(there[:2] / max(there[2], 500.0), rel=1e-12)
