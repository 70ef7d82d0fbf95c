"""Frames of eyes: radiance and coverage of two sheets, depth, pupil masks and labels."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from codesign.eye import kernel, model, textures
from codesign.eye.landmarks import iris_to_camera, landmark_points
from codesign.eye.population import (
    CameraRig,
    EyeStates,
    _turn,
    eye_axes,
    model_parameters,
)
from metalens.core.arrays import Array
from metalens.core.errors import SceneError
from metalens.image import Frames


@dataclass(frozen=True, slots=True)
class PinholeCamera:
    """The pinhole grid that frames are rendered on: the image side of the lens, turned
    upright.

    pixels: along both sides. pitch_um: of the grid.
    """

    pixels: int = 160
    pitch_um: float = 9.0

    def __post_init__(self) -> None:
        if not (1 <= self.pixels <= 8192 and 0 < self.pitch_um < 1e4):
            raise SceneError(
                f"camera of {self.pixels} pixels of {self.pitch_um} um: need 1-8192 pixels, pitch above 0"
            )

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
    centroid_px: (n, 2) centroid of the visible pupil; ``pupil_px`` where none is seen.
    visible: (n,) seen share of the pupil's area, 0 where it is hidden or out of the
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
    centroid_px: Tensor
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

        def of(record: Any) -> Any:
            parts = (getattr(record, name)[rows] for name in type(record).__slots__)
            return type(record)(*parts)

        return RenderedFrames(of(self.frames), self.pupil[rows], of(self.labels))

    def pinhole(self) -> Tensor:
        """(n, y, x) what a perfect lens would show."""
        return self.frames.radiance.sum(1)


def render(
    states: EyeStates,
    *,
    rig: CameraRig | None = None,
    camera: PinholeCamera | None = None,
    texture_seed: int = 0,
    exposed: EyeStates | None = None,
) -> RenderedFrames:
    """Render states with labels, pupil masks and depth, float32, on all threads of
    numba.

    Args:
        states: subjects with gaze and slippage. rig: pose of camera and lamps.
        camera: pixel grid; the defaults without both. texture_seed: of the textures.
        exposed: states that the automatic exposure was set at; by default these.

    Raises:
        SceneError: non-finite states (from :class:`States`) or an impossible camera.
    """
    rig, camera = rig or CameraRig(), camera or PinholeCamera()
    p = model_parameters(
        states, rig, pixel_rad=camera.pitch_um / rig.sensor_distance_um, exposed=exposed
    )
    frames, mask = _render_arrays(p, states.scale, rig, camera, texture_seed)
    return RenderedFrames(
        frames, mask, _labels(states, p, mask, rig=rig, camera=camera)
    )


def _render_arrays(
    p: Tensor, scale: Tensor, rig: CameraRig, camera: PinholeCamera, seed: int
) -> tuple[Frames, Tensor]:
    """Frames and pupil masks from renderer parameters, by the compiled kernel in
    float32.

    Args:
        p: (n, COUNT) parameters. scale: (n,) factor of the depths.
    """
    n, size = len(p), camera.pixels
    light, cover, depth = (np.empty((n, 2, size, size), np.float32) for _ in range(3))
    pupil = np.empty((n, 1, size, size), np.float32)
    values, scales = (a.detach().numpy().astype(np.float32) for a in (p, scale))
    rays = camera.tangents(rig).astype(np.float32)
    bank = textures.packed_bank(seed)
    kernel.render_rows(values, scales, bank, rays, rays, light, cover, depth, pupil)
    sheets = Frames(*map(torch.from_numpy, (light, cover, depth)))
    return sheets, torch.from_numpy(pupil[:, 0])


def _labels(
    states: EyeStates, p: Tensor, mask: Tensor, *, rig: CameraRig, camera: PinholeCamera
) -> FrameLabels:
    """Labels of frames from states, renderer parameters and pupil masks.

    The visible share is the mask's area over that of the refracted pupil's outline
    (shoelace formula).

    Args:
        p: (n, COUNT) parameters. mask: (n, y, x) visible share of pupil.
    """
    p = p.detach()
    scale = states.scale[:, None]
    centre = p[:, model.CENTRE : model.CENTRE + 3]
    pupil = centre + p[:, model.PUPIL_D, None] * p[:, model.AXIS : model.AXIS + 3]
    optic, visual = eye_axes(states, rig)
    nominal = torch.tensor([*rig.aim_um, rig.distance_um], dtype=torch.float64)
    middle_and_rim = camera.position_px(iris_to_camera(p, _pupil_points(p)), rig)
    middle = middle_and_rim[:, 0]
    x, y = middle_and_rim[:, 1:].unbind(-1)
    area = 0.5 * (x * y.roll(-1, 1) - y * x.roll(-1, 1)).sum(1).abs()
    rows, columns = mask.sum(2).double(), mask.sum(1).double()
    visible_area = rows.sum(1)
    index = torch.arange(camera.pixels, dtype=torch.float64)
    sums = [
        (line * index).sum(1) / visible_area.clamp_min(1e-9) for line in (columns, rows)
    ]
    centroid = torch.where(visible_area[:, None] > 1e-6, torch.stack(sums, 1), middle)
    return FrameLabels(
        slip_um=scale * (nominal + states.slip_um) - nominal,
        shift_um=scale * (_unslipped_place_um(states, rig) + states.slip_um) - nominal,
        optic_axis=optic.detach(),
        visual_axis=visual.detach(),
        centre_um=scale * centre,
        pupil_um=scale * pupil,
        pupil_px=middle,
        centroid_px=centroid,
        visible=(visible_area / area.clamp_min(1e-6)).clamp(0, 1),
        landmarks_px=camera.position_px(landmark_points(p), rig),
    )


def _unslipped_place_um(states: EyeStates, rig: CameraRig) -> Tensor:
    """(n, 3) pupil position of an eye that looks straight ahead, without slip, um.

    In the frame of a camera turned by its mounting.
    """
    depth = (
        torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        * states.trait("depth_um")[:, None]
    )
    return _turn(
        torch.tensor([*rig.aim_um, rig.distance_um], dtype=torch.float64) + depth,
        states.mount_rad,
    )


def _pupil_points(p: Tensor, rim: int = 24) -> Tensor:
    """(n, 1 + rim, 2) centre and rim of the pupil in the plane of the iris."""
    turn = torch.arange(rim, dtype=torch.float64) * (2 * torch.pi / rim)
    circle = torch.cat(
        [
            torch.zeros(1, 2, dtype=torch.float64),
            torch.stack([torch.cos(turn), torch.sin(turn)], 1),
        ]
    )
    return p[:, model.PUPIL_R, None, None] * circle
