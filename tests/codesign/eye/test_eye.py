"""The eye's geometry against closed forms: Listing's law, refraction at the cornea,
projection, population limits.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from codesign.eye import landmarks
from codesign.eye import population as eye
from codesign.eye.population import POPULATION, CameraRig, EyeStates, MotionRanges
from codesign.eye.renderer import PinholeCamera
from tests.codesign.eye import model, plain_eye

FRONTAL = CameraRig(elevation_rad=0.0, aim_um=(0.0, 0.0))


def mean_states(n=1, **changes):
    """The mean subject, looking straight ahead, nothing slipped."""
    still = eye.draw_states(n, 0)
    traits = torch.tensor(
        [[t.mean for t in POPULATION.values()]] * n, dtype=torch.float64
    )
    zero = torch.zeros(n, dtype=torch.float64)
    pair = torch.zeros(n, 2, dtype=torch.float64)
    triple = torch.zeros(n, 3, dtype=torch.float64)
    base = EyeStates(
        traits, still.textures, pair, zero, triple, pair, zero + 1, zero + 1
    )
    return replace(base, **changes)


def pack(states, rig=FRONTAL):
    return eye.model_parameters(states, rig, pixel_rad=0.0045)


def test_same_seed_same_states_and_limits_hold():
    a, b = eye.draw_states(200, 7), eye.draw_states(200, 7)
    assert all(
        torch.equal(getattr(a, name), getattr(b, name)) for name in EyeStates.__slots__
    )
    for name, trait in POPULATION.items():
        values = a.trait(name)
        assert float(values.min()) >= trait.low
        assert float(values.max()) <= trait.high


def test_people_are_cut_where_few_of_them_are():
    """A limit lies 1.5 to 5.3 deviations from the mean, so a draw's mean is the
    trait's: the longer tail of a normal
    cut at 1.5 and never moves it by 0.14 of a deviation. A thousand draws tell it to
    0.03, four times that."""
    drawn = eye.draw_states(1000, 3)
    for name, trait in POPULATION.items():
        values = drawn.trait(name).double().numpy()
        if trait.sd == 0:
            assert trait.low == trait.mean == trait.high
            assert (values == trait.mean).all()
            continue
        below = (trait.mean - trait.low) / trait.sd
        above = (trait.high - trait.mean) / trait.sd
        assert min(below, above) > 1.5 - 1e-9
        assert max(below, above) < 5.3
        assert abs(values.mean() - trait.mean) < (0.14 + 4 * 0.032) * trait.sd, name
        assert 0.75 * trait.sd < values.std() < 1.12 * trait.sd, name


@pytest.mark.parametrize(
    "gaze", [(0.0, 0.0), (0.3, 0.0), (0.2, -0.3), (0.0, 1.2), (2.0, 1.0)]
)
def test_listing_turns_by_the_shortest_way(gaze):
    """Axes stay orthonormal, the axis makes the stated angle, and the rotation has no
    part about the primary axis.
    """
    p = pack(mean_states(gaze_rad=torch.tensor([gaze], dtype=torch.float64)))
    axes = torch.stack([p[name][0] for name in ("iris_x", "iris_y", "axis")])
    face = torch.stack([p[name][0] for name in ("face_x", "face_y", "face_z")])
    assert torch.allclose(axes @ axes.mT, torch.eye(3, dtype=torch.float64), atol=1e-12)
    assert float(axes[2] @ face[2]) == pytest.approx(
        math.cos(math.hypot(*gaze)), abs=1e-12
    )
    turn = face @ axes.mT  # rotation in face coordinates
    assert float(turn[0, 1] - turn[1, 0]) == pytest.approx(0, abs=1e-12)


def test_pupil_is_seen_nearer_and_larger_through_the_cornea():
    """Paraxial closed form for one surface: 1/s' = n/s - (n-1)/R, magnification n s' /
    s... seen on the axis.
    """
    p = pack(mean_states())
    radius = torch.tensor([[[10.0, 0.0]]], dtype=torch.float64)  # um: paraxial
    tangent = float(landmarks.iris_to_camera(p, radius)[0, 0, 0])
    s, n, r = 3600.0, 1.3375, 7800.0
    virtual = 1 / (n / s - (n - 1) / r)
    apex = 21000.0 - 3600.0
    assert tangent * (apex + virtual) == pytest.approx(10.0 * n * virtual / s, rel=1e-4)
    ray = torch.tensor([[0.0]], dtype=torch.float64)
    q = model.rows(mean_states(), FRONTAL, 0.0045).mT[:, :, None]
    dx, dy, dz = plain_eye.ray(ray, ray)
    bank = torch.zeros(80, 256, 256, dtype=torch.float64)
    _, depth, pupil = plain_eye.eye(q, bank, ray, ray, ray + 5e3, ray + 5e3, dx, dy, dz)
    assert float(depth) == pytest.approx(apex + virtual, rel=1e-6)
    assert float(pupil) == 1.0


def test_refracted_rays_obey_snell_at_the_cornea():
    p = pack(
        mean_states(gaze_rad=torch.tensor([[0.35, 0.2]], dtype=torch.float64)),
        CameraRig(),
    )
    target = torch.tensor([[[1500.0, -700.0]]], dtype=torch.float64)
    t = landmarks.iris_to_camera(p, target)[0, 0].numpy()
    d = np.array([*t, 1.0]) / math.hypot(*t, 1.0)
    value = {name: part[0].numpy() for name, part in p.items()}
    centre, axis, x, y = (value[k] for k in ("centre", "axis", "iris_x", "iris_y"))
    ball = centre + value["cornea_d"] * axis
    b = ball @ d
    hit = (b - math.sqrt(b**2 - ball @ ball + value["cornea_r"] ** 2)) * d
    normal = (hit - ball) / value["cornea_r"]
    point = centre + value["pupil_d"] * axis + 1500.0 * x - 700.0 * y
    inner = (point - hit) / np.linalg.norm(point - hit)
    assert np.linalg.norm(np.cross(normal, d)) == pytest.approx(
        1.3375 * np.linalg.norm(np.cross(normal, inner)), rel=1e-7
    )
    assert abs(np.linalg.det([normal, d, inner])) < 1e-9  # in one plane


def test_slip_to_plus_x_moves_landmarks_by_the_pinhole_law():
    still = mean_states()
    moved = mean_states(slip_um=torch.tensor([[500.0, 0.0, 0.0]], dtype=torch.float64))
    camera = PinholeCamera()
    a, b = (
        camera.position_px(landmarks.landmark_points(pack(s)), FRONTAL)[0]
        for s in (still, moved)
    )
    apex = landmarks.NAMES.index("corneal apex")
    assert float(b[apex, 0] - a[apex, 0]) == pytest.approx(
        500 / (21000 - 3600) * 2000 / 9, rel=1e-9
    )
    assert float((b - a)[:, 1].abs().max()) < 1e-9


def test_visual_axis_is_kappa_from_the_optic_axis():
    states = mean_states()
    optic, visual = eye.eye_axes(states, FRONTAL)
    want = math.hypot(math.tan(math.radians(5)), math.tan(math.radians(1.5)))
    assert float(
        torch.linalg.cross(optic, visual).norm() / (optic * visual).sum()
    ) == pytest.approx(want, rel=1e-9)
    assert float(visual[0, 0]) < 0  # towards the nose, at -x


def test_gradient_of_the_parameters_is_exact():
    states = eye.draw_states(3, 5)

    def packed(gaze, slip):
        moved = replace(states, gaze_rad=gaze, slip_um=slip)
        p = model.rows(moved, CameraRig(), 0.0045)
        # edge and exposure are held
        return torch.cat([p[:, : model.EDGE], p[:, model.UPPER : model.SKEW]], 1)

    held = (
        states.gaze_rad.clone().requires_grad_(True),
        states.slip_um.clone().requires_grad_(True),
    )
    assert torch.autograd.gradcheck(packed, held, atol=1e-4, rtol=1e-5)


def test_motion_ranges_hold():
    drawn = eye.draw_states(
        500, 1, motion=MotionRanges(slip_um=(1.0, 2.0, 3.0), scale=0.2)
    )
    assert (drawn.slip_um.abs().amax(0) <= torch.tensor([1.0, 2.0, 3.0])).all()
    assert 0.8 <= float(drawn.scale.min()) < float(drawn.scale.max()) <= 1.2


@pytest.mark.parametrize(("elevation", "azimuth"), [(0.7, 0.0), (-0.3, 0.4)])
def test_a_camera_sees_the_face_from_its_elevation_and_azimuth(elevation, azimuth):
    """Spherical angles of the camera in the face: below the eyes and towards the temple,
    at +x of a left eye.
    """
    rig = CameraRig(elevation_rad=elevation, azimuth_rad=azimuth)
    to_camera = rig.face_axes @ torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    c = math.cos(elevation)
    want = [c * math.sin(azimuth), math.sin(elevation), c * math.cos(azimuth)]
    assert to_camera.tolist() == pytest.approx(want, abs=1e-14)
    square = rig.face_axes @ rig.face_axes.mT
    assert torch.allclose(square, torch.eye(3, dtype=torch.float64))
    assert float(rig.face_axes[1, 0]) == 0  # rows of the camera are level
