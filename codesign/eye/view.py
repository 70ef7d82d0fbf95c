"""Where another camera stands than the rig's, and how wide it sees: frame by frame."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from metalens.core.errors import SceneError


@dataclass(frozen=True, eq=False, slots=True)
class CameraView:
    """Another camera for each of n frames; its lamps go with it, and the nominal pupil
    lies where the rig's does.

    tilt_rad: (n,) seen from this much higher than the rig does, about the face's
    horizontal.
    side_rad: (n,) and from this far to the face's +x, about its vertical.
    roll_rad: (n,) turned about the camera's own axis; what is right of the axis comes
    below it.
    wide: (n,) tangents of the picture's rays over those of the rig's camera, above 0.
    """

    tilt_rad: Tensor
    side_rad: Tensor
    roll_rad: Tensor
    wide: Tensor

    def __post_init__(self) -> None:
        if not (
            all(self.tilt_rad.shape == getattr(self, n).shape for n in self.__slots__)
            and (self.wide > 0).all()
        ):
            raise SceneError(
                f"views {[tuple(getattr(self, n).shape) for n in self.__slots__]}: need (n,), wide above 0"
            )


def face_axes(elevation_rad: float) -> Tensor:
    """(3, 3) rows right, down and out of the face in the frame of a camera below it.

    Args:
        elevation_rad: of the face's normal above the camera's direction.
    """
    s, c = math.sin(elevation_rad), math.cos(elevation_rad)
    return torch.tensor(
        [[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, -s, -c]], dtype=torch.float64
    )


def seen_axes(elevation_rad: float, view: CameraView) -> Tensor:
    """(n, 3, 3) rows right, down and out of the face in the frames of n cameras.

    Rz(roll) applied to the axes after Ry(side), at elevation - tilt.

    Args:
        elevation_rad: of the face's normal above the rig camera's direction.
        view: cameras, one a frame.
    """
    elevation = elevation_rad - view.tilt_rad
    s, c = torch.sin(elevation), torch.cos(elevation)
    a, b = torch.sin(view.side_rad), torch.cos(view.side_rad)
    zero = torch.zeros_like(s)
    # cos(side) right + sin(side) out of a camera straight below
    right = torch.stack([b, -a * s, -a * c], 1)
    down = torch.stack([zero, c, -s], 1)
    out = torch.stack([-a, -b * s, -b * c], 1)
    x, y, z = torch.stack([right, down, out], 1).unbind(2)
    sine = torch.sin(view.roll_rad)[:, None]
    cosine = torch.cos(view.roll_rad)[:, None]
    return torch.stack([cosine * x - sine * y, sine * x + cosine * y, z], 2)
