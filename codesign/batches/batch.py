"""What training takes a step: frames and what is true of them."""

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from codesign.batches.surface_frames import SingleSurfaceFrames
from metalens.image import Frames


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
        """Samples around the frames that are blurred in but not seen."""

    def batch(self, step: int, size: int) -> FrameBatch:
        """``size`` frames of training step ``step``."""
