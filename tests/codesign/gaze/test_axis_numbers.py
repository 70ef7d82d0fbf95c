"""The axis of a spherical eye from points that are put on it, on either side of the
camera's axis.
"""

import math

import numpy as np
import pytest
import torch

from codesign.gaze import axis
from codesign.gaze.axis import EyeGeometry
from metalens.core.errors import SceneError

EYE = EyeGeometry((1.5, -2.0, 40.0), radius_mm=9.0, sensor_distance_mm=3.0)
SLIP = np.array([[0.0, 0.0, 0.0], [2.0, -1.0, 3.0], [-1.5, 0.5, -2.0]])
DIRECTION = np.array([[0.1, -0.2, -1.0], [-0.3, 0.25, -0.9], [0.4, 0.1, -1.0]])
DIRECTION /= np.linalg.norm(DIRECTION, axis=1, keepdims=True)


def test_a_pupil_on_the_sphere_comes_back_from_its_image():
    """The camera moves by the slip, so the eye moves the other way; its image is 3 mm
    behind the lens, upright.
    """
    pupil = np.array(EYE.centre_mm) - SLIP + 9.0 * DIRECTION
    image = 3.0 * pupil[:, :2] / pupil[:, 2:]
    found = axis.optical_axis(torch.tensor(image), torch.tensor(SLIP), EYE)
    assert found.hit.all()
    assert found.direction.numpy() == pytest.approx(DIRECTION, abs=1e-12)
    rows = (
        torch.tensor(np.stack([image, image[::-1]])),
        torch.tensor(np.stack([SLIP, SLIP[::-1]])),
    )
    many = axis.optical_axis(*rows, EYE)  # of a batch of batches, each by itself
    assert many.hit.shape == (2, 3)
    assert many.direction.numpy() == pytest.approx(
        np.stack([DIRECTION, DIRECTION[::-1]]), abs=1e-12
    )
    apart = axis.angle_rad(many.direction, many.direction[:1])
    want = np.arccos(np.clip((DIRECTION[::-1] * DIRECTION).sum(1), -1, 1))
    assert apart.numpy() == pytest.approx(
        np.stack([np.zeros(3), want]), abs=1e-7
    )  # arccos near 1


@pytest.mark.parametrize(("beside", "hit"), [(8.98, True), (9.02, False)])
def test_a_ray_meets_the_eye_up_to_its_radius(beside, hit):
    """Past the middle at 8.98 and 9.02 mm of 9: 0.6 mm before it the sphere is met, or
    nowhere.
    """
    eye = EyeGeometry((0.0, 0.0, 40.0), radius_mm=9.0, sensor_distance_mm=3.0)
    sine = beside / 40.0
    image = torch.tensor(
        [[0.0, 3.0 * sine / math.sqrt(1 - sine**2)]], dtype=torch.float64
    )
    found = axis.optical_axis(image, torch.zeros(1, 3, dtype=torch.float64), eye)
    assert bool(found.hit) is hit
    before = math.sqrt(max(81 - beside**2, 0.0))
    across, along = (
        np.array([math.sqrt(1 - sine**2), -sine]),
        np.array([sine, math.sqrt(1 - sine**2)]),
    )
    place = beside * across - before * along  # of y and z, from the middle of the eye
    assert found.direction[0, 1:].tolist() == pytest.approx(
        (place / np.linalg.norm(place)).tolist(), abs=1e-12
    )


def test_a_ray_beside_the_eye_names_the_nearest_place_on_it():
    """From the centre to the foot of the perpendicular on the ray, at whichever side;
    gradients stay finite.
    """
    image = torch.tensor(
        [[2.0, 0.5], [-1.5, -2.5]], dtype=torch.float64, requires_grad=True
    )
    found = axis.optical_axis(image, torch.zeros(2, 3, dtype=torch.float64), EYE)
    assert not found.hit.any()
    for one, direction in zip(
        image.detach().numpy(), found.direction.detach().numpy(), strict=True
    ):
        ray = np.array([*one, 3.0])
        centre = np.array(EYE.centre_mm)
        foot = ray * (ray @ centre) / (ray @ ray)
        assert np.linalg.norm(foot - centre) > 9.0
        assert direction == pytest.approx(
            (foot - centre) / np.linalg.norm(foot - centre), abs=1e-12
        )
    found.direction.sum().backward()
    assert torch.isfinite(image.grad).all()


def test_angles_keep_their_digits_near_none_and_at_half_a_turn():
    one = torch.tensor(
        [[0.0, 0.0, 2.0], [0.0, 3.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0]],
        dtype=torch.float64,
    )
    other = torch.tensor(
        [[1e-9, 0, 1], [0, -1.0, 0], [0, 0, 4.0], [1.0, 1.0, 0.0]], dtype=torch.float64
    )
    assert axis.angle_rad(one, other).tolist() == pytest.approx(
        [1e-9, math.pi, math.pi / 2, 0.0], rel=1e-9
    )
    apart = torch.tensor([[0.3, -0.2, 0.9]], dtype=torch.float64)
    near = torch.tensor([[0.1, 0.7, -0.5]], dtype=torch.float64)
    cosine = (0.03 - 0.14 - 0.45) / math.sqrt(0.94 * 0.75)
    assert axis.angle_rad(apart, near).item() == pytest.approx(math.acos(cosine))


@pytest.mark.parametrize("wrong", [{"radius_mm": 0.0}, {"sensor_distance_mm": -1.0}])
def test_lengths_of_nothing_are_refused(wrong):
    with pytest.raises(SceneError, match="need both above 0"):
        EyeGeometry((0.0, 0.0, 30.0), **wrong)
