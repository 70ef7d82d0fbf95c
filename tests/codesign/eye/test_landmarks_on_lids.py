"""Landmarks of the lids lie on the ball that the lids are, at the face coordinates of corners and margins."""

import numpy as np
import pytest
import torch

from codesign.eye import model
from codesign.eye.landmarks import landmark_points


def test_corners_and_margins_of_the_lids_are_where_their_ball_is_met():
    """Centre + x right + y down + sqrt(R² - x² - y²) out, as tangents x / z and y / z; a face turned three ways."""
    turn = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0]
    turn[:, 2] *= -np.sign(turn[2, 2])  # out of the face: towards the camera
    p = torch.zeros(1, model.COUNT, dtype=torch.float64)
    centre = np.array([1300.0, -800.0, 41_000.0])
    places = {model.CENTRE: centre, model.FACE_X: turn[:, 0], model.FACE_Y: turn[:, 1], model.FACE_Z: turn[:, 2]}
    for at, vector in places.items():
        p[0, at : at + 3] = torch.tensor(vector)
    radius, middle, half, upper, lower = 13_100.0, 450.0, 11_800.0, 4900.0, 5600.0
    numbers = {model.LID_R: radius, model.MIDDLE: middle, model.HALF: half, model.UPPER: upper, model.LOWER: lower}
    for at, number in numbers.items():
        p[0, at] = number
    p[0, model.AXIS : model.AXIS + 3] = torch.tensor([0.0, 0.0, -1.0])
    found = landmark_points(p)[0, :4].numpy()
    corners = [(middle - 0.98 * half, 0.0), (middle + 0.98 * half, 0.0), (middle, -upper), (middle, lower)]
    for got, (x, y) in zip(found, corners, strict=True):
        there = centre + turn @ [x, y, np.sqrt(radius**2 - x**2 - y**2)]
        assert got == pytest.approx(there[:2] / there[2], rel=1e-9)
