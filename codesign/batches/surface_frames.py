"""Frames as one surface of varying depth in three bytes a pixel, and their image: what
training affords.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from metalens.core.arrays import Array
from metalens.image import Frames, Imager


@dataclass(frozen=True, eq=False, slots=True)
class SingleSurfaceFrames:
    """Opaque frames: every pixel has one radiance and one depth.

    light: (n, y, x) uint8, radiance 1 is 255. depth_um: (n, y, x) uint16, at unit
    scale.
    scale: (n,) factor of the depths of each frame.
    """

    light: Array
    depth_um: Array
    scale: Array


def flatten_layers(frames: Frames, scale: Tensor) -> SingleSurfaceFrames:
    """Both sheets as one: their radiance added, the depth of the sheet that covers
    more.

    Args:
        frames: with scaled depths. scale: (n,) their factor; it is stored separately.

    Accuracy: light to 1/510 of radiance 1, above which it is cut; depth to 0.5 um below
    65 mm.
    """
    light = (frames.radiance.sum(1).clamp(0, 1) * 255 + 0.5).to(torch.uint8)
    depth = torch.where(
        frames.coverage[:, 1] > 0.5, frames.depth_um[:, 1], frames.depth_um[:, 0]
    )
    unscaled = (depth / scale.to(depth)[:, None, None]).clamp(0, 65535).round()
    return SingleSurfaceFrames(
        light.numpy(),
        unscaled.numpy().astype(np.uint16),
        scale.numpy().astype(np.float32),
    )


def frame_samples(frames: Frames | SingleSurfaceFrames) -> int:
    """Samples along a side, margin included.

    Args:
        frames: rendered frames of two layers or of one.
    """
    if isinstance(frames, SingleSurfaceFrames):
        return int(frames.light.shape[-1])
    return int(frames.radiance.shape[-1])


def depth_um(
    frames: Frames | SingleSurfaceFrames,
    *,
    margin: int = 0,
    device: torch.device | str = "cpu",
) -> Tensor:
    """(n, y, x) depth in um of the visible surface at each sample without the margin.

    That of the layer with more coverage; at least 1 um.

    Args:
        frames: rendered frames of two layers or of one. margin: samples cut off.
        device: of the result.
    """
    if isinstance(frames, SingleSurfaceFrames):
        # the stored 16 bits are transferred, then converted on the device
        scale = torch.from_numpy(frames.scale.astype(np.float32)).to(device)
        stored = (
            torch.from_numpy(frames.depth_um.view(np.int16)).to(device).int() & 0xFFFF
        )
        depth = stored.float() * scale[:, None, None]
    else:
        moved = frames.to(device)
        depth = torch.where(
            moved.coverage[:, 1] > 0.5, moved.depth_um[:, 1], moved.depth_um[:, 0]
        )
    rows, columns = (slice(margin, n - margin) for n in depth.shape[-2:])
    return depth[:, rows, columns].clamp_min(1.0)


def sensor_irradiance(frames: Frames | SingleSurfaceFrames, optics: Imager) -> Tensor:
    """(n, y, x) light on the sensor grid; differentiable in the PSFs of ``optics``.

    Args:
        frames: rendered frames of two layers or of one, with the margin of ``optics``.
        optics: what forms the image.
    """
    device = optics.stack.device
    if isinstance(frames, Frames):
        return optics(frames.to(device))
    radiance = torch.from_numpy(frames.light).to(device).float() * (1 / 255)
    return optics.surface(radiance, depth_um(frames, device=device))


@dataclass(frozen=True, eq=False, slots=True)
class EyePose:
    """How the eye stands before the camera.

    shift_mm: (batch, 3) displacement of the head as the camera sees it
    (:class:`codesign.eye.FrameLabels`): what a network
        can learn of the slippage. axis: (batch, 3) optic axis, a unit vector in the
        camera's frame.
    points: (batch, points, 2) landmarks (:data:`codesign.eye.NAMES`), then the pupil's
    middle: x, y as a fraction of
        the image from its middle, beyond 0.5 outside of it.
    """

    shift_mm: Tensor
    axis: Tensor
    points: Tensor

    def to(self, device: torch.device) -> "EyePose":
        """The same on a device."""
        return EyePose(*(getattr(self, name).to(device) for name in EyePose.__slots__))


@dataclass(frozen=True, eq=False, slots=True)
class FrameBatch:
    """Rendered frames with what is true of them.

    frames: on the image grid, ``margin`` samples wider on every side.
    mask: (batch, y, x) pupil coverage without the margin. slip_mm: (batch, 3).
    pose: of the eye; None where nobody trains on it.
    """

    frames: Frames | SingleSurfaceFrames
    mask: Tensor
    slip_mm: Tensor
    pose: EyePose | None = None

    def to(self, device: torch.device) -> "FrameBatch":
        """What is true of the frames on a device; the frames themselves go there as
        they are imaged.
        """
        pose = None if self.pose is None else self.pose.to(device)
        return FrameBatch(
            self.frames, self.mask.to(device), self.slip_mm.to(device), pose
        )


class SceneSource(Protocol):
    """Where frames come from: the same step gives the same frames."""

    @property
    def margin(self) -> int:
        """Samples around the frames that are blurred in and then cut off."""

    def batch(self, step: int, size: int) -> FrameBatch:
        """``size`` frames of training step ``step``."""
