"""Frames of eyes: radiance and coverage of two sheets, depth, pupil masks and labels."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from codesign.eye import kernel, textures
from codesign.eye.landmarks import iris_to_camera, landmark_points
from codesign.eye.population import (
    CameraRig,
    EyeStates,
    _turn,
    eye_axes,
    model_parameters,
    select_rows,
)
from metalens.core.arrays import Array
from metalens.image import Frames


@dataclass(frozen=True, slots=True)
class PinholeCamera:
    """The pinhole grid that frames are rendered on: the image side of the lens, turned
    upright.

    pixels: along both sides. pitch_um: of the grid.
    """

    pixels: int = 160
    pitch_um: float = 9.0

    def tangents(self, rig: CameraRig) -> Array:
        """(pixels,) tangents of the rays through the pixel centres along one side.

        Args:
            rig: pose of camera and lamps.
        """
        return (np.arange(self.pixels) - (self.pixels - 1) / 2) * (
            self.pitch_um / rig.sensor_distance_um
        )

    def position_px(self, tangent: Tensor, rig: CameraRig) -> Tensor:
        """Pixel coordinates (x, y) of tangents; the first pixel's centre is 0.

        Args:
            tangent: (..., 2) tangents of rays. rig: pose of camera and lamps.
        """
        return (
            tangent * (rig.sensor_distance_um / self.pitch_um) + (self.pixels - 1) / 2
        )


@dataclass(frozen=True, eq=False, slots=True)
class FrameLabels:
    """What is true of each frame, in the camera's frame; lengths with the scale of the
    state applied.

    slip_um: (n, 3) displacement of the head from the rig's nominal place.
    shift_um: (n, 3) the same as the camera sees it: with what its own turn and the
    person's depth displace the head.
    optic_axis, visual_axis: (n, 3) unit vectors, pointing out of the eye.
    centre_um, pupil_um: (n, 3) centre of rotation and of the pupil.
    pupil_px: (n, 2) where the refracted centre of the pupil lands (x, y).
    visible: (n,) visible share of the pupil's area, 0 where it is hidden or out of the
    frame.
    landmarks_px: (n, len(landmarks.NAMES), 2).
    """

    slip_um: Tensor
    shift_um: Tensor
    optic_axis: Tensor
    visual_axis: Tensor
    centre_um: Tensor
    pupil_um: Tensor
    pupil_px: Tensor
    visible: Tensor
    landmarks_px: Tensor


@dataclass(frozen=True, eq=False, slots=True)
class RenderedFrames:
    """frames: near and far sheet. pupil: (n, y, x) visible share of pupil in every
    pixel. labels: of every frame.
    """

    frames: Frames
    pupil: Tensor
    labels: FrameLabels

    def rows(self, rows: Tensor) -> "RenderedFrames":
        """Some of the frames with their labels; ``rows``: their numbers."""
        return RenderedFrames(
            select_rows(self.frames, rows),
            self.pupil[rows],
            select_rows(self.labels, rows),
        )

    def pinhole(self) -> Tensor:
        """(n, y, x) what a perfect lens would show."""
        return self.frames.radiance.sum(1)


def render(
    states: EyeStates,
    *,
    rig: CameraRig | None = None,
    camera: PinholeCamera | None = None,
    exposed: EyeStates | None = None,
) -> RenderedFrames:
    """Render states with labels, pupil masks and depth, float32, on all threads of
    numba.

    Args:
        states: subjects with gaze and slippage. rig: pose of camera and lamps.
        camera: pixel grid; the defaults without both.
        exposed: states that the automatic exposure was set at; by default these.

    Raises:
        SceneError: non-finite states (from :class:`States`) or an impossible camera.
    """
    rig, camera = rig or CameraRig(), camera or PinholeCamera()
    p = model_parameters(
        states, rig, pixel_rad=camera.pitch_um / rig.sensor_distance_um, exposed=exposed
    )
    rays = camera.tangents(rig).astype(np.float32)
    bank = textures.packed_bank()
    columns = [p[name] for name in kernel.VECTORS + kernel.NUMBERS]
    rows = torch.cat([c.reshape(len(c), -1) for c in columns], 1).float().numpy()
    planes = torch.from_numpy(kernel.render_frames(rows, bank, rays))
    light, cover, depth = planes[:, :2], planes[:, 2:4], planes[:, 4:6]
    depth *= states.scale.float()[:, None, None, None]
    mask = planes[:, 6]
    labels = _labels(states, p, mask, rig=rig, camera=camera)
    return RenderedFrames(Frames(light, cover, depth), mask, labels)


def _labels(
    states: EyeStates,
    p: Mapping[str, Tensor],
    mask: Tensor,
    *,
    rig: CameraRig,
    camera: PinholeCamera,
) -> FrameLabels:
    """Labels of frames from states, renderer parameters and pupil masks.

    The visible share is the mask's area over that of the refracted pupil's outline
    (shoelace formula).

    Args:
        p: of :func:`model_parameters`. mask: (n, y, x) visible share of pupil.
    """
    scale, nominal = states.scale[:, None], rig.pupil_um
    centre = p["centre"]
    pupil = centre + p["pupil_d"][:, None] * p["axis"]
    optic, visual = eye_axes(states, rig)
    depth = torch.zeros_like(centre)
    depth[:, 2] = states.trait("depth_um")
    # of an eye that looks straight ahead, before a camera turned by its mounting
    unslipped = _turn(nominal + depth, states.mount_rad)
    # centre and rim of the pupil in the plane of the iris
    turn = torch.arange(24, dtype=torch.float64) * (2 * torch.pi / 24)
    circle = F.pad(torch.stack([torch.cos(turn), torch.sin(turn)], 1), (0, 0, 1, 0))
    points_um = p["pupil_r"][:, None, None] * circle
    middle_and_rim = camera.position_px(iris_to_camera(p, points_um), rig)
    middle = middle_and_rim[:, 0]
    x, y = middle_and_rim[:, 1:].unbind(-1)
    area = 0.5 * (x * y.roll(-1, 1) - y * x.roll(-1, 1)).sum(1).abs()
    visible_area = mask.sum((1, 2)).double()
    return FrameLabels(
        slip_um=scale * (nominal + states.slip_um) - nominal,
        shift_um=scale * (unslipped + states.slip_um) - nominal,
        optic_axis=optic,
        visual_axis=visual,
        centre_um=scale * centre,
        pupil_um=scale * pupil,
        pupil_px=middle,
        visible=(visible_area / area.clamp_min(1e-6)).clamp(0, 1),
        landmarks_px=camera.position_px(landmark_points(p), rig),
    )
