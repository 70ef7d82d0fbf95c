"""Spherical-eye solver: inverse of the projection, safe when the ray misses, exact
gradients.
"""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from codesign.gaze import axis as gaze
from tests.referees.seen_pupil import pupil_of

GEOMETRY = gaze.EyeGeometry(centre_mm=(1.0, -14.0, 27.0))
angle = st.floats(-0.5, 0.5)
slip = st.floats(-3.0, 3.0)


def _direction(yaw, pitch):
    return torch.tensor(
        [
            [
                math.sin(yaw) * math.cos(pitch),
                math.sin(pitch),
                -math.cos(yaw) * math.cos(pitch),
            ]
        ],
        dtype=torch.float64,
    )


@given(angle, angle, slip, slip, slip)
def test_solver_inverts_the_projection(yaw, pitch, dx, dy, dz):
    direction = _direction(yaw, pitch)
    moved = torch.tensor([[dx, dy, dz]], dtype=torch.float64)
    pupil = pupil_of(direction, moved, GEOMETRY)
    found = gaze.optical_axis(pupil, moved, GEOMETRY)
    # the near intersection is the pupil wherever the pupil faces the camera
    centre = torch.tensor(GEOMETRY.centre_mm, dtype=torch.float64) - moved
    facing = (direction * (centre + GEOMETRY.radius_mm * direction)).sum() < 0
    if facing:
        assert float(gaze.angle_rad(found, direction)) < 1e-6


def test_gradients_agree_with_finite_differences():
    pupil = torch.tensor(
        [[0.1, -1.2], [0.3, -0.9]], dtype=torch.float64, requires_grad=True
    )
    moved = torch.tensor(
        [[0.5, -0.2, 1.0], [0.0, 0.3, -1.0]], dtype=torch.float64, requires_grad=True
    )
    assert torch.autograd.gradcheck(
        lambda p, s: gaze.optical_axis(p, s, GEOMETRY), (pupil, moved)
    )


def test_angle_is_exact_and_differentiable_at_zero():
    a = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64, requires_grad=True)
    b = torch.tensor([[math.sin(1e-9), 0.0, -math.cos(1e-9)]], dtype=torch.float64)
    assert float(gaze.angle_rad(a.detach(), b)) == pytest.approx(1e-9, rel=1e-6)
    gaze.angle_rad(a, a.detach()).sum().backward()
    assert torch.isfinite(a.grad).all()


def test_pupil_on_the_sensor_by_similar_triangles():
    """Eye at (1, -14, 27) mm, camera slipped by (0.7, -1.1, 2.3): the pupil's place in
    the world through the lens.
    """
    geometry = gaze.EyeGeometry(
        (1.0, -14.0, 27.0), radius_mm=9.3, sensor_distance_mm=1.7
    )
    look = torch.tensor([[0.48, 0.6, -0.64]], dtype=torch.float64)
    moved = torch.tensor([[0.7, -1.1, 2.3]], dtype=torch.float64)
    x = 1.0 - 0.7 + 9.3 * 0.48
    y = -14.0 + 1.1 + 9.3 * 0.6
    z = 27.0 - 2.3 - 9.3 * 0.64
    assert pupil_of(look, moved, geometry)[0].tolist() == pytest.approx(
        [1.7 * x / z, 1.7 * y / z]
    )
    found = gaze.optical_axis(
        torch.tensor([[1.7 * x / z, 1.7 * y / z]], dtype=torch.float64), moved, geometry
    )
    # faces the camera: the near side
    assert found[0].tolist() == pytest.approx([0.48, 0.6, -0.64])


def test_a_missing_ray_points_to_the_place_on_the_sphere_nearest_to_it():
    pupil = torch.tensor([[9.0, -3.0]], dtype=torch.float64, requires_grad=True)
    found = gaze.optical_axis(pupil, torch.zeros(1, 3, dtype=torch.float64), GEOMETRY)
    found.sum().backward()
    assert torch.isfinite(pupil.grad).all()
    ray = torch.tensor([9.0, -3.0, 2.0], dtype=torch.float64)
    along = (
        torch.linspace(0, 60, 600_001, dtype=torch.float64)[:, None] * ray / ray.norm()
    )
    gap = along - torch.tensor(GEOMETRY.centre_mm, dtype=torch.float64)
    nearest = gap[gap.norm(dim=1).argmin()]
    assert found[0].tolist() == pytest.approx(
        (nearest / nearest.norm()).tolist(), abs=1e-4
    )


@pytest.mark.parametrize("wide", [0.02, 1.1, 2.9])
def test_angle_between_directions_of_any_length(wide):
    one = torch.tensor([[0.3, -0.4, 1.2]], dtype=torch.float64)
    across = torch.linalg.cross(
        one, torch.tensor([[1.0, 2.0, 0.5]], dtype=torch.float64)
    )
    other = 2.7 * (
        math.cos(wide) * one / one.norm() + math.sin(wide) * across / across.norm()
    )
    assert float(gaze.angle_rad(one, other)) == pytest.approx(wide, rel=1e-12)
