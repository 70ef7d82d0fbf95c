"""The parameters of an as-built lens and its bench: what each means, in which unit, and what is known beforehand."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from metalens.errors import ConfigError, nearest
from metalens.store import Array


@dataclass(frozen=True, slots=True)
class Parameter:
    """One number that describes lens or bench.

    scale: a typical uncertainty, for steps and plots. sigma: prior knowledge without any metrology (inf: none).
    low, high: bounds. free: fitted unless told otherwise.
    """

    name: str
    meaning: str
    scale: float
    sigma: float = math.inf
    low: float = -math.inf
    high: float = math.inf
    start: float = 0.0
    free: bool = True


ABERRATIONS = ("astigmatism", "oblique_astigmatism", "coma_x", "coma_y", "trefoil_x", "trefoil_y", "spherical")
BIAS = ("bias_nm", "bias_x_nm", "bias_y_nm", "bias_r_nm", "bias_a_nm", "bias_o_nm")
PARAMETERS: tuple[Parameter, ...] = (
    Parameter("bias_nm", "diameter minus design, mean over the lens", 1.0, 15.0, -26.0, 26.0),
    Parameter("bias_x_nm", "diameter bias at the +x rim less that at the axis", 1.0, 10.0, -15.0, 15.0),
    Parameter("bias_y_nm", "diameter bias at the +y rim less that at the axis", 1.0, 10.0, -15.0, 15.0),
    Parameter(
        "bias_r_nm", "diameter bias at the rim less that at the axis, times 1/2 (2 rho² - 1)", 1.0, 10.0, -15.0, 15.0
    ),
    Parameter("bias_a_nm", "saddle of the diameter bias, x² - y² over R²", 1.0, 10.0, -15.0, 15.0, free=False),
    Parameter("bias_o_nm", "oblique saddle of the diameter bias, 2xy over R²", 1.0, 10.0, -15.0, 15.0, free=False),
    Parameter("height_nm", "pillar height minus design", 5.0, 10.0, -28.0, 28.0),
    Parameter("index", "refractive index of the pillars minus design", 0.02, 0.02, -0.075, 0.075, free=False),
    Parameter("sidewall_deg", "sidewall angle minus design", 0.3, 0.5, -1.6, 1.6, free=False),
    Parameter("wavelength_nm", "wavelength minus stated", 0.3, 0.5, -5.0, 5.0),
    Parameter("bandwidth_nm", "standard deviation of the spectrum", 0.5, 1.0, 0.0, 8.0, free=False),
    Parameter("distance_um", "lens to sensor, minus design", 2.0, 100.0, -400.0, 400.0),
    Parameter("decentre_x_um", "window centre minus chief ray on the sensor", 1.0, 30.0, -60.0, 60.0),
    Parameter("decentre_y_um", "window centre minus chief ray on the sensor", 1.0, 30.0, -60.0, 60.0),
    Parameter("tilt_x_deg", "tilt of the lens about the y axis", 0.2, 1.0, -3.0, 3.0, free=False),
    Parameter("tilt_y_deg", "tilt of the lens about the x axis", 0.2, 1.0, -3.0, 3.0, free=False),
    Parameter("source_x_um", "source off the stage's axis", 5.0, 50.0, -300.0, 300.0, free=False),
    Parameter("source_y_um", "source off the stage's axis", 5.0, 50.0, -300.0, 300.0, free=False),
    Parameter("stage_zero_um", "true source depth minus stated (with the substrate's plate shift)", 50.0, 1000.0),
    Parameter("stage_scale", "true stage step over stated, minus 1", 1e-3, 0.01, -0.05, 0.05),
    *(Parameter(name + "_rad", f"Zernike {name} of the wave front, rms", 0.05, 1.0, -6.0, 6.0) for name in ABERRATIONS),
    Parameter("pinhole_um", "diameter of the source", 1.0, math.inf, 0.0, 2000.0, free=False),
    Parameter("crosstalk_px", "standard deviation of pixel crosstalk and vibration", 0.1, 0.3, 0.02, 3.0, start=0.2),
    Parameter("log_gain", "logarithm of the electrons through the aperture in a frame at the reference depth", 0.02),
    Parameter("background_e", "background at the window's centre", 2.0),
    Parameter("background_x_e", "background at the right edge less that at the centre", 2.0),
    Parameter("background_y_e", "background at the lower edge less that at the centre", 2.0),
)
NAMES = tuple(p.name for p in PARAMETERS)
PLACE = {name: i for i, name in enumerate(NAMES)}


@dataclass(frozen=True, slots=True)
class Known:
    """What metrology says of a parameter: spectrometer (wavelength), AFM (height), SEM (bias), ellipsometer (index).

    sigma: standard error; 0 holds the parameter at ``value``, inf frees it entirely.
    """

    name: str
    value: float
    sigma: float = 0.0

    def __post_init__(self) -> None:
        if self.name not in PLACE:
            raise ConfigError(f"unknown parameter {self.name!r}{nearest(self.name, NAMES)}")
        if not math.isfinite(self.value) or not self.sigma >= 0:
            raise ConfigError(f"{self.name}: value {self.value}, sigma {self.sigma}; need finite, and sigma >= 0")


def vector(values: Mapping[str, float] | None = None) -> Array:
    """(parameters,) starts, with some set by name.

    Raises:
        ConfigError: an unknown name.
    """
    out = np.array([p.start for p in PARAMETERS])
    for name, value in (values or {}).items():
        if name not in PLACE:
            raise ConfigError(f"unknown parameter {name!r}{nearest(name, NAMES)}")
        out[PLACE[name]] = value
    return out


def bias_um(x: Array, u: Array, v: Array) -> tuple[Array, Array]:
    """Diameter bias, um, at lens places (u, v) over the radius, and its (6, *shape) derivative by the parameters."""
    rho2 = u * u + v * v
    maps = np.stack([np.ones_like(u), u, v, rho2 - 0.5, u * u - v * v, 2 * u * v]) * 1e-3
    return np.tensordot([x[PLACE[name]] for name in BIAS], maps, 1), maps


def aberrations(u: Array, v: Array) -> Array:
    """(7, *shape) Zernike polynomials in the order of ABERRATIONS, unit rms on the disc."""
    rho2 = u * u + v * v
    return np.stack(
        [
            math.sqrt(6) * (u * u - v * v),
            math.sqrt(6) * 2 * u * v,
            math.sqrt(8) * (3 * rho2 - 2) * u,
            math.sqrt(8) * (3 * rho2 - 2) * v,
            math.sqrt(8) * (u**3 - 3 * u * v * v),
            math.sqrt(8) * (3 * u * u * v - v**3),
            math.sqrt(5) * (6 * rho2 * rho2 - 6 * rho2 + 1),
        ]
    )
