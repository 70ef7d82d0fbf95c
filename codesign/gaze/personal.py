"""Gaze of one person from pupil and slippage: the spherical eye fitted to a few points,
then a small regressor.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from codesign.eye import CameraRig
from codesign.eye import population as eye
from codesign.gaze import regressor
from codesign.gaze.axis import EyeGeometry, angle_rad, optical_axis
from codesign.gaze.readings import NetworkReadings, face_angles
from codesign.gaze.regressor import ResidualRegressor
from metalens.core.arrays import Array
from metalens.core.errors import TrainingError

# Standard deviations between people: centre of the eye 1 mm each way (mounting and
# head), its radius 0.6 mm (size, and magnification by the cornea), angles between sphere
# and gaze 5 degrees (kappa and mounting), roll 0.05 rad.
SPREAD = np.array([1.0, 1.0, 1.0, 0.6, 5.0, 5.0, 0.05])


@dataclass(frozen=True, eq=False, slots=True)
class PersonalGaze:
    """A calibrated person.

    mean: the population's eye. own: (7,) centre and radius beside it in mm, two angles
    in deg, roll in rad.
    rig: pose of the camera. rest: of the sphere's angles and the
    slippage, to what it misses.
    """

    mean: EyeGeometry
    rig: CameraRig
    own: Array
    rest: ResidualRegressor | None

    def sphere(self, pupil_mm: Array, slip_mm: Array) -> Array:
        """(n, 2) gaze of the fitted spherical eye alone, across and down, deg.

        The optic axis through pupil and rotation centre, plus two angles, rotated by
        the roll.

        Args:
            pupil_mm: (n, 2) pupil on the sensor. slip_mm: (n, 3) slippage.
        """
        x, y, z = np.asarray(self.mean.centre_mm) + self.own[:3]
        geometry = EyeGeometry(
            (x, y, z), self.mean.radius_mm + self.own[3], self.mean.sensor_distance_mm
        )
        ray = optical_axis(pupil_mm, -slip_mm, geometry)
        angles = face_angles(ray, self.rig) + self.own[4:6]
        c, s = math.cos(self.own[6]), math.sin(self.own[6])
        return np.asarray(angles @ np.array([[c, s], [-s, c]]))

    def __call__(self, read: NetworkReadings) -> Array:
        """(n, 2) gaze across and down, deg: sphere plus the regressor of its
        residuals.
        """
        first = self.sphere(read.pupil_mm, read.slip_mm)
        if self.rest is None:
            return first
        return np.asarray(first + self.rest(np.concatenate([first, read.slip_mm], 1)))


def mean_geometry(rig: CameraRig) -> EyeGeometry:
    """The population's mean eye before this camera.

    Args:
        rig: pose of camera and lamps.
    """
    centre, radius = eye.mean_eye_um(rig)
    x, y, z = (1e-3 * v for v in centre)
    return EyeGeometry((x, y, z), 1e-3 * radius, 1e-3 * rig.sensor_distance_um)


@dataclass(frozen=True, slots=True)
class SphereCalibrator:
    """Calibrates by pupil and slippage alone: spherical eye by regularised least
    squares, then a regressor.

    hidden: neurons of the regressor; 0 for none. seed: of its first weights.
    """

    rig: CameraRig
    hidden: int = 10
    seed: int = 0

    def person(self, read: NetworkReadings, gaze_deg: Array) -> PersonalGaze:
        """Calibrate a person who looked at ``gaze_deg`` (n, 2), across and down.

        Minimises |gaze error / reading|² + |parameters / SPREAD|² twice, the second
        time with the residual of the first (1 degree in the first fit, 0.3 at least) as
        reading error. The regressor learns the
        remaining errors; its penalty is 1 where there are no more points than
        parameters of the sphere, else cross-validated.

        Args:
            read: pupil and slippage as a network reads them.

        Raises:
            TrainingError: fewer than 3 points.
        """
        if len(read) < 3:
            raise TrainingError(
                f"a personal calibration from {len(read)} points, need 3 or more"
            )
        mean = mean_geometry(self.rig)
        pupil, slip = (
            np.ascontiguousarray(a, dtype=float) for a in (read.pupil_mm, read.slip_mm)
        )

        def sphere_of(own: Array) -> PersonalGaze:
            return PersonalGaze(mean, self.rig, own, None)

        def residual(unit: Array, reading_deg: float) -> Array:
            error = sphere_of(unit * SPREAD).sphere(pupil, slip) - gaze_deg
            return np.concatenate([error.ravel() / reading_deg, unit])

        own = least_squares(residual, np.zeros(len(SPREAD)), args=(1.0,)).x
        degrees_of_freedom = max(1, 2 * len(pupil) - len(own))
        square = (residual(own, 1.0)[: 2 * len(pupil)] ** 2).sum()
        reading_deg = max(0.3, float(np.sqrt(square / degrees_of_freedom)))
        person = sphere_of(least_squares(residual, own, args=(reading_deg,)).x * SPREAD)
        if not self.hidden:
            return person
        sphere_deg = person.sphere(pupil, slip)
        features = np.concatenate([sphere_deg, slip], 1)
        errors = gaze_deg - sphere_deg
        penalty = 1.0
        if len(pupil) > len(SPREAD):
            penalty = _cross_validated_penalty(
                features, errors, gaze_deg, hidden=self.hidden, seed=self.seed
            )
        rest = regressor.fit_regressor(
            features, errors, hidden=self.hidden, penalty=penalty, seed=self.seed
        )
        return replace(person, rest=rest)


def _cross_validated_penalty(
    features: Array, errors: Array, gaze_deg: Array, *, hidden: int, seed: int
) -> float:
    """Penalty of least cross-validated error; all frames of one stimulus are in one
    fold.

    Args:
        features: (n, 5). errors: (n, 2) errors of the sphere, deg.
    """
    _, stimulus = np.unique(gaze_deg, axis=0, return_inverse=True)
    fold: Array = np.ravel(stimulus) % 4

    def validation_error(penalty: float) -> float:
        total = 0.0
        for number in range(4):
            held_out = fold == number
            if held_out.any() and (~held_out).sum() >= 3:
                fitted = regressor.fit_regressor(
                    features[~held_out],
                    errors[~held_out],
                    hidden=hidden,
                    penalty=penalty,
                    seed=seed,
                    steps=40,
                )
                total += float(
                    ((fitted(features[held_out]) - errors[held_out]) ** 2).sum()
                )
        return total

    return min((0.01, 0.1, 1.0, 10.0), key=validation_error)


def angle_deg(one: Array, other: Array) -> Array:
    """(n,) angle between directions, deg, each (n, 2) angles across and down.

    Args:
        one: to compare. other: the reference.
    """
    a, b = (gaze_direction(np.radians(v)) for v in (one, other))
    return np.asarray(np.degrees(angle_rad(a, b)))


def gaze_direction(angles_rad: Array) -> Array:
    """(n, 3) unit vectors (right, down, out of the face) of angles x, y across and
    down.

    (sin x cos y, sin y, cos x cos y).

    Args:
        angles_rad: (n, 2) across and down.
    """
    x, y = angles_rad.T
    return np.stack([np.sin(x) * np.cos(y), np.sin(y), np.cos(x) * np.cos(y)], 1)
