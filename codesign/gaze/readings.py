"""Network readings in the units of gaze calibration, and protocols of calibrators."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from codesign.eye import CameraRig
from metalens.core.arrays import Array


@dataclass(frozen=True, eq=False, slots=True)
class NetworkReadings:
    """Of n frames.

    pupil_mm: (n, 2) pupil on the sensor, upright image, from the lens axis. slip_mm:
    (n, 3) displacement of the head.
    axis_deg: (n, 2) angles of the optic axis across and down in the frame of the face;
    None where no axis is read.
    """

    pupil_mm: Array
    slip_mm: Array
    axis_deg: Array | None = None

    def __len__(self) -> int:
        return len(self.pupil_mm)

    def __getitem__(self, rows: Array | slice) -> "NetworkReadings":
        return NetworkReadings(
            self.pupil_mm[rows],
            self.slip_mm[rows],
            None if self.axis_deg is None else self.axis_deg[rows],
        )


class CalibratedPerson(Protocol):
    """A calibrated person."""

    def __call__(self, read: NetworkReadings) -> Array:
        """(n, 2) gaze across and down, deg."""


class PersonCalibrator(Protocol):
    """A way to calibrate people."""

    def person(self, read: NetworkReadings, gaze_deg: Array) -> CalibratedPerson:
        """Calibrate a person who looked at ``gaze_deg`` (n, 2), across and down.

        Args:
            read: pupil, slippage and axis as a network reads them.
        """


def face_angles(direction: Array, rig: CameraRig) -> Array:
    """(n, 2) angles across and down, deg, in the frame of the face, of directions (n,
    3) in the camera's.

    Args:
        direction: (n, 3) unit vectors in the camera's frame.
        rig: pose of the camera.
    """
    right, down, out = rig.face_axes.numpy() @ np.asarray(direction).T
    return np.asarray(
        np.degrees(
            np.stack([np.arctan2(right, out), np.arcsin(np.clip(down, -1, 1))], 1)
        )
    )
