"""Fields of rays beyond plane faces: Fresnel's shares in sines, the ray's own frame,
and the ray along the axis.
"""

import itertools
import math

import numpy as np
import pytest
import torch

from metalens.psf.vector import beyond_faces

MEDIA = (1.52, 1.0, 1.33)


def fresnel(angles_rad):
    """Shares of the power of s and p light through the faces between rays of these
    angles (sin 2a sin 2b / sin²(a + b),
    for p over cos²(a - b))."""
    s = p = 1.0
    for a, b in itertools.pairwise(angles_rad):
        passed = math.sin(2 * a) * math.sin(2 * b) / math.sin(a + b) ** 2
        s, p = s * passed, p * passed / math.cos(a - b) ** 2
    return s, p


def ray(azimuth_rad, angle_rad):
    """(direction, s, p): right-handed, p in the plane of the ray, outwards."""
    u = np.array([math.cos(azimuth_rad), math.sin(azimuth_rad), 0.0])
    z = np.array([0.0, 0.0, 1.0])
    across = np.array([-u[1], u[0], 0.0])
    return (
        math.sin(angle_rad) * u + math.cos(angle_rad) * z,
        across,
        math.cos(angle_rad) * u - math.sin(angle_rad) * z,
    )


@pytest.mark.parametrize(
    ("azimuth_deg", "angle_deg"), [(25.0, 33.0), (-128.0, 11.0), (90.0, 38.0)]
)
def test_s_and_p_pass_with_the_roots_of_their_shares(azimuth_deg, angle_deg):
    """Over the mean of both shares, and over the root of the cosines; either stays in
    its own frame.
    """
    turn, first = math.radians(azimuth_deg), math.radians(angle_deg)
    angles = [math.asin(MEDIA[0] / n * math.sin(first)) for n in MEDIA]
    (k, s, p), (beyond, s_beyond, p_beyond) = (
        ray(turn, angles[0]),
        ray(turn, angles[-1]),
    )
    given = [(0.7, -0.4), (0.2, 0.9)]  # s and p of two polarisations
    electric = np.concatenate([a * s + b * p for a, b in given])
    got = beyond_faces(
        torch.from_numpy(electric)[:, None], torch.from_numpy(k)[:, None], MEDIA
    )[:, 0].numpy()
    of_s, of_p = fresnel(angles)
    of_s, of_p = 2 * of_s / (of_s + of_p), 2 * of_p / (of_s + of_p)
    kept = math.cos(angles[0]) / math.cos(angles[-1])
    for (a, b), found in zip(given, got.reshape(2, 3), strict=True):
        want = math.sqrt(kept) * (
            math.sqrt(of_s) * a * s_beyond + math.sqrt(of_p) * b * p_beyond
        )
        assert found == pytest.approx(want, rel=1e-12)
        assert found @ beyond == pytest.approx(0, abs=1e-12)


def test_the_ray_along_the_axis_keeps_its_field():
    """It has no plane of its own, and s and p pass alike."""
    electric = torch.tensor([0.8, -0.3, 0.0, 0.1, 0.6, 0.0], dtype=torch.float64)[
        :, None
    ]
    axis = torch.tensor([[0.0], [0.0], [1.0]], dtype=torch.float64)
    assert beyond_faces(electric, axis, MEDIA)[:, 0].tolist() == pytest.approx(
        electric[:, 0].tolist(), rel=1e-12
    )


def test_without_a_face_nothing_changes():
    electric = torch.arange(12, dtype=torch.float64).reshape(6, 2)
    assert beyond_faces(electric, electric[:3], (1.4, 1.4)) is electric
