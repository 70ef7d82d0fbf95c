"""The light that meets a pillar cell, as every solver takes it."""

import math
from dataclasses import dataclass
from typing import Literal, get_args

from metalens.core.errors import CellError

Polarization = Literal["x", "y", "s", "p"]


@dataclass(frozen=True, slots=True)
class Incidence:
    """One plane wave from the substrate.

    wavelength_um: in vacuum.
    angle_rad: of the light outside, in vacuum: the tangential wave vector is k0
    sin(angle_rad).
    polarization: s or p, or x or y for the field along that axis of the plane of
    incidence.
    azimuth_rad: of the plane of incidence, from +x to +y.

    Raises:
        CellError: a wavelength that is no length, what is no direction of light, an
            unknown polarisation.
    """

    wavelength_um: float
    angle_rad: float = 0.0
    polarization: Polarization = "x"
    azimuth_rad: float = 0.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.wavelength_um) and self.wavelength_um > 0):
            raise CellError(
                f"wavelength_um = {self.wavelength_um}: need a finite length above 0"
            )
        if self.polarization not in get_args(Polarization):
            raise CellError(
                f"polarization = {self.polarization!r}: need 'x', 'y', 's' or 'p'"
            )
        check_direction(self.angle_rad, self.azimuth_rad)


def check_direction(angle_rad: float, azimuth_rad: float) -> None:
    """Refuse what is no direction of light.

    Args:
        angle_rad: of incidence. azimuth_rad: of the plane of incidence.

    Raises:
        CellError: an angle that is not finite, or not below a right angle.
    """
    if not (
        math.isfinite(angle_rad)
        and abs(angle_rad) < math.pi / 2
        and math.isfinite(azimuth_rad)
    ):
        raise CellError(
            f"angle_rad = {angle_rad}, azimuth_rad = {azimuth_rad}: need finite angles, |angle| < pi/2"
        )


def check_tolerance(tolerance: float) -> None:
    """Refuse what is not a finite number above 0.

    Raises:
        CellError: says which tolerance.
    """
    if not (math.isfinite(tolerance) and tolerance > 0):
        raise CellError(f"tolerance = {tolerance}: need a finite number above 0")
