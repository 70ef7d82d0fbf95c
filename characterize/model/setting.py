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
    margin: pixels around it that blur may reach in from. fill: width of a pixel over the pitch.
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
    fill: float = 1.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.depth_um).all() and (self.depth_um > 0).all()):
            raise FitError("source depths must be finite and above 0; give them in stage.csv (depth_um)")
        if not (math.isfinite(self.pixel_um) and self.pixel_um > 0):
            raise FitError("pixel_um is missing: give the sensor's pixel in capture.toml; it cannot be fitted")

    @property
    def edges(self) -> tuple[Array, Array]:
        """(rows, 1) and (1, columns) of the pixels, -1 to 1 from edge to edge about the middle one."""
        y, x = ((np.arange(n) - n // 2) / (n / 2) for n in (self.rows, self.columns))
        return y[:, None], x[None]


def true_depth(x: Array, setting: Setting, centre_um: float) -> Array:
    """(n,) source depths after stage zero and scale; the scale acts about the middle of the stage."""
    stated = setting.depth_um
    depth = stated + x[PLACE["stage_zero_um"]] + x[PLACE["stage_scale"]] * (stated - centre_um)
    return np.asarray(np.maximum(depth, 0.2 * stated))


def brightness(x: Array, setting: Setting, *, centre_um: float, reference_um: float) -> Array:
    """(n,) electrons in a pixel for light of unit density from ``reference_um``, by gain, exposure and depth."""
    depth = true_depth(x, setting, centre_um)
    gain = np.exp(x[PLACE["log_gain"]]) * (setting.fill * setting.pixel_um) ** 2
    return np.asarray(gain * setting.exposure * (reference_um / depth) ** 2)


def dimming(x: Array, setting: Setting, centre_um: float) -> dict[str, Array]:
    """(n,) relative changes of :func:`brightness` by the stage: light falls as the square of the depth."""
    rate = -2 / true_depth(x, setting, centre_um)
    return {"stage_zero_um": rate, "stage_scale": rate * (setting.depth_um - centre_um)}


def background(x: Array, setting: Setting) -> Array:
    """(rows, columns) electrons of the background plane."""
    edge_y, edge_x = setting.edges
    along = x[PLACE["background_x_e"]] * edge_x + x[PLACE["background_y_e"]] * edge_y
    return np.asarray(x[PLACE["background_e"]] + along)


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
