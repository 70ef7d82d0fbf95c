"""Which frames are predicted: depths, angles, exposures, window; where the source truly stood, and its spectrum."""

import math
from dataclasses import dataclass

import numpy as np

from characterize.model.parameters import PLACE
from metalens.ground.arrays import Array
from metalens.ground.errors import FitError


@dataclass(frozen=True, eq=False, slots=True)
class Setting:
    """The frames that are to be predicted.

    depth_um: (n,) stated source depths. angle_rad: (n, 2). exposure: (n,) relative.
    pixel_um: of the sensor; rows, columns: of the window about the chief ray.
    margin: pixels around it that blur may reach in from.
    tolerance: relative error of the field allowed to the reduction.
    """

    depth_um: Array
    angle_rad: Array
    exposure: Array
    pixel_um: float
    rows: int
    columns: int
    margin: int = 4
    tolerance: float = 5e-4

    def __post_init__(self) -> None:
        if not (np.isfinite(self.depth_um).all() and (self.depth_um > 0).all()):
            raise FitError("source depths must be finite and above 0; give them in stage.csv (depth_um)")
        if not (math.isfinite(self.pixel_um) and self.pixel_um > 0):
            raise FitError("pixel_um is missing: give the sensor's pixel in capture.toml; it cannot be fitted")


def true_depth(x: Array, setting: Setting, centre_um: float) -> Array:
    """(n,) source depths after stage zero and scale; the scale acts about the middle of the stage."""
    stated = setting.depth_um
    depth = stated + x[PLACE["stage_zero_um"]] + x[PLACE["stage_scale"]] * (stated - centre_um)
    return np.asarray(np.maximum(depth, 0.2 * stated))


LIGHT = ("light_x", "light_y", "light_r")


def light_maps(u: Array, v: Array) -> Array:
    """(3, *shape) ln of the irradiance at lens places over the radius, for one unit of each of ``LIGHT``."""
    return np.stack([u, v, u * u + v * v - 0.5])


def spectrum(bandwidth_nm: float) -> list[tuple[float, float]]:
    """(offset in nm, weight) of a Gaussian line by 5-point Gauss-Hermite quadrature; one line for no width."""
    if bandwidth_nm <= 0:
        return [(0.0, 1.0)]
    place, weight = np.polynomial.hermite_e.hermegauss(5)
    return [(float(p) * bandwidth_nm, float(w)) for p, w in zip(place, weight / weight.sum(), strict=True)]
