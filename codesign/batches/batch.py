"""What training takes a step: frames and what is true of them."""

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from codesign.batches.flat import Flat
from metalens.image import Frames


@dataclass(frozen=True, eq=False, slots=True)
class Pose:
    """How the eye stands before the camera.

    shift_mm: (batch, 3) displacement of the head as the camera sees it
    (:class:`codesign.eye.Labels`): what a network
        can learn of the slippage. axis: (batch, 3) optic axis, a unit vector in the
        camera's frame.
    points: (batch, points, 2) landmarks (:data:`codesign.eye.NAMES`), then the pupil's
    middle: x, y as a fraction of
        the image from its middle, beyond 0.5 outside of it.
    """

    shift_mm: Tensor
    axis: Tensor
    points: Tensor

    def to(self, device: torch.device) -> "Pose":
        """The same on a device."""
        return Pose(*(getattr(self, name).to(device) for name in Pose.__slots__))


@dataclass(frozen=True, eq=False, slots=True)
class Batch:
    """Rendered frames with what is true of them.

    frames: on the image grid, ``margin`` samples wider on every side.
    mask: (batch, y, x) pupil coverage without the margin. slip_mm: (batch, 3).
    pose: of the eye; None where nobody trains on it.
    """

    frames: Frames | Flat
    mask: Tensor
    slip_mm: Tensor
    pose: Pose | None = None

    def to(self, device: torch.device) -> "Batch":
        """What is true of the frames on a device; the frames themselves go there as
        they are imaged.
        """
        pose = None if self.pose is None else self.pose.to(device)
        return Batch(self.frames, self.mask.to(device), self.slip_mm.to(device), pose)


class Scenes(Protocol):
    """Where frames come from: the same step gives the same frames."""

    @property
    def margin(self) -> int:
        """Samples around the frames that are blurred in but not seen."""

    def batch(self, step: int, size: int) -> Batch:
        """``size`` frames of training step ``step``."""
