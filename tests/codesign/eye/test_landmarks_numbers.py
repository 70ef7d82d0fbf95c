"""Landmarks of a face and an eye that are turned every way, by vectors; the pupil by
Snell's law, traced forwards.
"""

import numpy as np
import pytest
import torch

from codesign.eye import landmarks, model

CENTRE = np.array([1300.0, -800.0, 33_000.0])
NUMBERS = {
    model.LID_R: 13_100.0, model.MIDDLE: 450.0, model.HALF: 11_800.0, model.UPPER: 4900.0, model.LOWER: 5600.0,
    model.LIMBUS_D: 9_900.0, model.LIMBUS_R: 5_800.0, model.CORNEA_D: 5_100.0, model.CORNEA_R: 7_700.0,
    model.PUPIL_D: 9_300.0, model.INDEX: 1.376, model.SCLERA_R: 12_000.0,
}  # fmt: skip


def turned(seed, tilt):
    """Right-handed axes whose third one points to the camera, tilted."""
    draw = np.random.default_rng(seed)
    out = np.array([tilt * draw.normal(), tilt * draw.normal(), -1.0])
    out /= np.linalg.norm(out)
    right = np.cross(draw.normal(size=3), out)
    right /= np.linalg.norm(right)
    return right, np.cross(out, right), out


FACE, EYE = turned(3, 0.2), turned(5, 0.15)


def parameters(**numbers):
    p = torch.zeros(1, model.COUNT, dtype=torch.float64)
    places = (
        model.FACE_X,
        model.FACE_Y,
        model.FACE_Z,
        model.IRIS_X,
        model.IRIS_Y,
        model.AXIS,
        model.CENTRE,
    )
    for at, vector in zip(places, (*FACE, *EYE, CENTRE), strict=True):
        p[0, at : at + 3] = torch.tensor(vector)
    for at, number in (
        NUMBERS | {getattr(model, name): v for name, v in numbers.items()}
    ).items():
        p[0, at] = number
    return p


def test_nine_points_are_where_their_vectors_end():
    """Corners at 0.98 of half the opening, margins above and below its middle; the
    limbus right, down, left and up of
    the eye's axis; the apex a corneal radius before its centre."""
    right, down, out = FACE
    across, below, axis = EYE

    def on_lid(x, y):
        return (
            CENTRE + x * right + y * down + np.sqrt(13_100.0**2 - x * x - y * y) * out
        )

    ring = CENTRE + 9_900 * axis
    points = [on_lid(450 - 11_564, 0), on_lid(450 + 11_564, 0), on_lid(450, -4900), on_lid(450, 5600),
              ring + 5800 * across, ring + 5800 * below, ring - 5800 * across, ring - 5800 * below,
              CENTRE + 12_800 * axis]  # fmt: skip
    want = [(point[0] / point[2], point[1] / point[2]) for point in points]
    assert landmarks.landmark_points(parameters())[0].numpy() == pytest.approx(
        np.array(want), rel=1e-9
    )
    assert len(landmarks.NAMES) == 9


def test_a_corner_beyond_the_ball_of_the_lids_stands_a_tenth_of_a_millimetre_out():
    """sqrt(1e4) = 100 um, where the root would be of nothing."""
    got = landmarks.landmark_points(parameters(HALF=14_000.0))[0, 1].numpy()
    there = CENTRE + (450 + 0.98 * 14_000) * FACE[0] + 100 * FACE[2]
    assert got == pytest.approx(there[:2] / there[2], rel=1e-9)


def test_what_is_nearer_than_half_a_millimetre_is_projected_from_there():
    points = torch.tensor(
        [[30.0, -20.0, 499.0], [30.0, -20.0, -7000.0], [30.0, -20.0, 800.0]],
        dtype=torch.float64,
    )
    want = [[0.06, -0.04], [0.06, -0.04], [0.0375, -0.025]]
    assert landmarks.project_points(points).numpy() == pytest.approx(
        np.array(want), rel=1e-12
    )


def landed(tangents):
    """Where a ray through the pinhole meets the plane of the iris: first hit of the
    cornea's sphere, Snell there.
    """
    across, below, axis = EYE
    d = np.array([*tangents, 1.0])
    d /= np.linalg.norm(d)
    middle = CENTRE + 5_100 * axis
    along = d @ middle
    hit = (along - np.sqrt(7_700.0**2 - middle @ middle + along**2)) * d
    normal = (hit - middle) / 7_700.0
    cosine, ratio = -d @ normal, 1 / 1.376
    bent = (
        ratio * d + (ratio * cosine - np.sqrt(1 - ratio**2 * (1 - cosine**2))) * normal
    )
    plane = CENTRE + 9_300 * axis
    there = hit + ((plane - hit) @ axis) / (bent @ axis) * bent - plane
    return there @ across, there @ below


def test_rays_to_the_iris_land_where_they_were_wanted():
    """To 1e-5 um where twelve steps are usual, and the plane is met by vectors of
    double precision.
    """
    wanted = np.array([[1200.0, -700.0], [-1900.0, 300.0], [250.0, 2100.0], [0.0, 0.0]])
    found = landmarks.iris_to_camera(parameters(), torch.tensor(wanted)[None])[
        0
    ].numpy()
    for tangents, want in zip(found, wanted, strict=True):
        assert landed(tangents) == pytest.approx(want, abs=1e-5)


def test_one_step_is_already_near_and_the_next_squares_what_is_left():
    """Newton: micrometres are left after one step, nothing to speak of after three; no
    step is no ray but the straight
    projection of a pupil nearer by 0.55 mm and 13 % larger."""
    wanted = torch.tensor([[[1200.0, -700.0]]], dtype=torch.float64)
    left = []
    for steps in (0, 1, 2, 3):
        tangents = landmarks.iris_to_camera(parameters(), wanted, steps=steps)[
            0, 0
        ].numpy()
        left.append(np.abs(np.array(landed(tangents)) - [1200.0, -700.0]).max())
    there = CENTRE + 9_850 * EYE[2] + 1.13 * (1200 * EYE[0] - 700 * EYE[1])
    straight = landmarks.iris_to_camera(parameters(), wanted, steps=0)[0, 0].numpy()
    assert straight == pytest.approx(there[:2] / there[2], rel=1e-12)
    assert left[1] < 0.05 * left[0]
    assert left[2] < 1e-3 * left[1] or left[2] < 1e-4
    assert left[3] < 1e-5


def test_gradients_go_through_the_rays():
    wanted = torch.tensor([[[1200.0, -700.0]]], dtype=torch.float64, requires_grad=True)
    landmarks.iris_to_camera(parameters(), wanted)[0, 0, 0].backward()
    step = torch.tensor([[[1.0, 0.0]]], dtype=torch.float64)
    with torch.no_grad():
        ahead, behind = (
            landmarks.iris_to_camera(parameters(), wanted + s * step)[0, 0, 0]
            for s in (1, -1)
        )
    assert float(wanted.grad[0, 0, 0]) == pytest.approx(
        float(ahead - behind) / 2, rel=1e-4
    )
