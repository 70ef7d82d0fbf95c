"""Whether the pillars focus where they should, by the direct Rayleigh-Sommerfeld sum on a small window."""

import math
from dataclasses import dataclass, replace

import numpy as np

from metalens.ground.arrays import Array
from metalens.lens import Lens
from metalens.propagate import Case, field_at

_ARM = np.linspace(-1.2, 1.2, 9)  # arms of the cross of points, in units of wavelength / (2 NA)
_SHIFTS = np.array([-0.5, -0.25, 0.0, 0.25, 0.5])  # sensor distances tried, in units of wavelength / NA²


@dataclass(frozen=True, slots=True)
class FocusCheck:
    """Where the light of the design source meets.

    x_um, y_um: of the brightest point of the sensor plane (0, 0 is meant).
    z_um: distance of the brightest point of the axis from the sensor plane (0 is meant); nan where not asked for.
    strehl: peak intensity against all pillars' magnitudes in step.
    resolution_um: wavelength / (2 NA); depth_um: wavelength / NA².
    """

    x_um: float
    y_um: float
    z_um: float
    strehl: float
    resolution_um: float
    depth_um: float

    @property
    def passed(self) -> bool:
        """Within a quarter of the resolution and of the depth of focus, with a Strehl ratio of 0.8 or more."""
        lateral = max(abs(self.x_um), abs(self.y_um)) <= self.resolution_um / 4
        return lateral and not abs(self.z_um) > self.depth_um / 4 and self.strehl >= 0.8

    @property
    def text(self) -> str:
        """One line for a person."""
        axial = "" if math.isnan(self.z_um) else f", {self.z_um:+.2f} um from the sensor plane"
        verdict = "focus" if self.passed else "NO FOCUS WHERE IT SHOULD BE"
        return (
            f"{verdict}: peak at ({self.x_um:+.3f}, {self.y_um:+.3f}) um"
            f"{axial}, Strehl ratio {self.strehl:.3f} (resolution {self.resolution_um:.2f} um, "
            f"depth of focus {self.depth_um:.1f} um)"
        )


def check_focus(lens: Lens, *, axial: bool = True) -> FocusCheck:
    """Sum the light of every pillar on a cross of points around the axis, and along it.

    Args:
        axial: also look before and behind the sensor plane; five more sums over the lens. Lenses of fewer than
            five Fresnel zones (R² / (wavelength x distance)) have their brightest point far before the focus and
            are not judged by it.

    Accuracy:
        the sum is exact to rounding; the peak is the vertex of a parabola through the three brightest points
        of a line, within 2 % of the resolution.
    """
    d = lens.diameters
    aperture = math.sin(math.atan((d.radius_um + d.pitch_um / 2) / lens.sensor_distance_um))
    resolution, depth = lens.wavelength_um / (2 * aperture), lens.wavelength_um / aperture**2
    zones = (d.radius_um + d.pitch_um / 2) ** 2 / (lens.wavelength_um * lens.sensor_distance_um)
    phase, level = lens.phase_rad(), lens.transmission()
    case = Case(
        shape=(d.diameter_um.shape[0], d.diameter_um.shape[1]),
        pitch_um=d.pitch_um,
        wavelength_um=lens.wavelength_um,
        sensor_distance_um=lens.sensor_distance_um,
        tangents=(0.0, 0.0),
        inverse_depths_per_um=(1 / lens.source_distance_um,),
        centre_um=(0.0, 0.0),
        step_um=resolution,
        samples=(1, 1),
    )
    arm, rest = _ARM * resolution, np.zeros_like(_ARM)
    cross = np.concatenate([np.stack([arm, rest], 1), np.stack([rest, arm], 1)])
    power = np.abs(field_at(phase, level, case, cross)[0]) ** 2
    along_x, along_y = power[: len(arm)], power[len(arm) :]
    return FocusCheck(
        x_um=_vertex(arm, along_x),
        y_um=_vertex(arm, along_y),
        z_um=_axial_peak(phase, level, case, depth) if axial and zones >= 5 else math.nan,
        strehl=float(max(along_x.max(), along_y.max())) / _in_step(level, case) ** 2,
        resolution_um=resolution,
        depth_um=depth,
    )


def _axial_peak(phase: Array, level: Array, case: Case, depth_um: float) -> float:
    shifts = _SHIFTS * depth_um
    power = [
        float(
            np.abs(field_at(phase, level, replace(case, sensor_distance_um=case.sensor_distance_um + s), _AXIS)[0, 0])
        )
        ** 2
        for s in shifts
    ]
    return _vertex(shifts, np.array(power))


_AXIS = np.zeros((1, 2))


def _in_step(level: Array, case: Case) -> float:
    """Magnitude at the focus if all pillars were in step: sum of p² T d / (2 pi r²) |1/r - ik|."""
    y, x = case.pillars_um
    total = 0.0
    for row, position in zip(level, y, strict=True):
        r2 = x**2 + position**2 + case.sensor_distance_um**2
        total += float((row / r2 * np.sqrt(1 / r2 + case.wavenumber**2)).sum())
    return total * case.pitch_um**2 * case.sensor_distance_um / (2 * math.pi)


def _vertex(position: Array, value: Array) -> float:
    """Top of the parabola through the largest value and its neighbours; the end itself if it is the largest."""
    i = int(value.argmax())
    if i in (0, len(value) - 1):
        return float(position[i])
    before, here, after = value[i - 1 : i + 2]
    return float(position[i] + (position[1] - position[0]) * (before - after) / (2 * (before - 2 * here + after)))
