"""Other cameras than the rig's: where the face sees them, against another rig, a turned
picture and another grid.
"""

import math
from dataclasses import replace

import pytest
import torch

from codesign.eye import CameraRig, renderer
from codesign.eye import population as eye
from codesign.eye.renderer import PinholeCamera
from codesign.eye.view import CameraView, face_axes, seen_axes
from metalens.core.errors import SceneError

STATES, SMALL = eye.draw_states(3, 5), PinholeCamera(48, 26.0)


def views(
    tilt=(0.0, 0.0, 0.0),
    side=(0.0, 0.0, 0.0),
    roll=(0.0, 0.0, 0.0),
    wide=(1.0, 1.0, 1.0),
):
    """Cameras of three frames; angles in degrees."""
    turns = (
        torch.tensor(v, dtype=torch.float64) * (math.pi / 180)
        for v in (tilt, side, roll)
    )
    return CameraView(*turns, torch.tensor(wide, dtype=torch.float64))


def test_the_face_sees_a_camera_where_it_was_put():
    """Towards the camera in the face's axes: latitude below is elevation less tilt,
    longitude to +x is the side.
    """
    axes = seen_axes(
        0.7,
        views(tilt=(11.0, -8.0, 0.0), side=(23.0, -31.0, 9.0), roll=(0.0, 17.0, -40.0)),
    )
    towards = -axes[..., 2]
    for row, tilt, side in zip(
        towards, (11.0, -8.0, 0.0), (23.0, -31.0, 9.0), strict=True
    ):
        low, right = 0.7 - math.radians(tilt), math.radians(side)
        want = [
            math.sin(right) * math.cos(low),
            math.sin(low),
            math.cos(right) * math.cos(low),
        ]
        assert row.tolist() == pytest.approx(want, abs=1e-12)
    torch.testing.assert_close(
        axes @ axes.mT,
        torch.eye(3, dtype=torch.float64).expand(3, 3, 3),
        rtol=0,
        atol=1e-12,
    )
    assert torch.linalg.det(axes).tolist() == pytest.approx(
        [torch.linalg.det(face_axes(0.7)).item()] * 3
    )


def test_a_tilt_is_a_rig_of_another_elevation_frame_by_frame():
    tilt = (20.0, 0.0, -13.0)
    whole = renderer.render(STATES, camera=SMALL, view=views(tilt=tilt))
    for k in range(3):
        rig = CameraRig(elevation_rad=CameraRig().elevation_rad - math.radians(tilt[k]))
        alone = renderer.render(STATES[k : k + 1], rig=rig, camera=SMALL)
        torch.testing.assert_close(
            whole.pinhole()[k], alone.pinhole()[0], rtol=1e-5, atol=1e-6
        )  # float32
        for name in renderer.FrameLabels.__slots__:
            torch.testing.assert_close(
                getattr(whole.labels, name)[k],
                getattr(alone.labels, name)[0],
                rtol=1e-5,
                atol=1e-4,
            )


def test_a_turned_camera_turns_the_picture_about_its_middle():
    """With the pupil on the axis, nothing slipped: every landmark and the pupil's
    refracted centre.
    """
    zero = torch.zeros(3, 2, dtype=torch.float64)
    still = replace(
        STATES, slip_um=torch.zeros(3, 3, dtype=torch.float64), mount_rad=zero
    )
    rig, roll = CameraRig(aim_um=(0.0, 0.0)), (25.0, -14.0, 90.0)
    plain = renderer.render(still, rig=rig, camera=SMALL).labels
    turned = renderer.render(still, rig=rig, camera=SMALL, view=views(roll=roll)).labels
    for name in ("landmarks_px", "pupil_px"):
        was, now = (
            getattr(labels, name).reshape(3, -1, 2) - 23.5 for labels in (plain, turned)
        )
        for k in range(3):
            c, s = math.cos(math.radians(roll[k])), math.sin(math.radians(roll[k]))
            want = was[k] @ torch.tensor(
                [[c, s], [-s, c]], dtype=torch.float64
            )  # right of the axis comes below it
            torch.testing.assert_close(now[k], want, rtol=0, atol=1e-5)


def test_a_wider_picture_is_that_of_a_coarser_grid_and_of_a_smaller_eye_at_its_depth():
    wide = (2.0, 1.0, 2.0)  # powers of two: to the bit
    got = renderer.render(STATES, camera=SMALL, view=views(wide=wide))
    for k in range(3):
        coarse = renderer.render(
            STATES[k : k + 1], camera=PinholeCamera(48, 26.0 * wide[k])
        )
        for name in ("radiance", "coverage", "depth_um"):
            assert torch.equal(
                getattr(got.frames, name)[k], getattr(coarse.frames, name)[0]
            )
        assert torch.equal(got.pupil[k], coarse.pupil[0])
        for name in ("pupil_px", "centroid_px", "landmarks_px", "visible"):
            torch.testing.assert_close(
                getattr(got.labels, name)[k], getattr(coarse.labels, name)[0]
            )
    near = renderer.render(STATES, camera=SMALL).labels
    shrink = torch.tensor(
        [[0.5, 0.5, 1.0], [1.0, 1.0, 1.0], [0.5, 0.5, 1.0]], dtype=torch.float64
    )
    torch.testing.assert_close(got.labels.centre_um, near.centre_um * shrink)
    torch.testing.assert_close(got.labels.pupil_um, near.pupil_um * shrink)
    here = torch.tensor(
        [*CameraRig().aim_um, CameraRig().distance_um], dtype=torch.float64
    )
    torch.testing.assert_close(
        got.labels.slip_um, (here + STATES.slip_um) * shrink - here
    )
    assert torch.equal(got.labels.optic_axis, near.optic_axis)


def test_a_camera_that_stands_where_the_rigs_does_sees_the_same():
    plain, same = (
        renderer.render(STATES, camera=SMALL),
        renderer.render(STATES, camera=SMALL, view=views()),
    )
    torch.testing.assert_close(same.pinhole(), plain.pinhole(), rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("change", [{"wide": (1.0, 0.0, 2.0)}, {"tilt": (1.0, 2.0)}])
def test_views_that_are_none_are_refused(change):
    with pytest.raises(SceneError, match="wide above 0"):
        views(**change)
