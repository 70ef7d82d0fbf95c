"""The parameters of an as-built lens and its bench: what each means, in which unit, and
what is known beforehand.

Those of the lens are the table of :mod:`metalens.fabrication.perturbations`; those of
the bench stand
here.
"""

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from metalens.core.arrays import Array
from metalens.core.errors import ConfigError, nearest_name_hint
from metalens.fabrication import (
    PERTURBATIONS,
    CDError,
    Perturbation,
    ResponseError,
    State,
    WavefrontError,
    names_of_kind,
    prior_scale,
    wavelength_scale,
)
from metalens.lens import Lens


@dataclass(frozen=True, slots=True)
class FitParameter:
    """One number that describes lens or bench.

    scale: typical uncertainty, for steps and plots. sigma: prior standard deviation
    without any metrology (inf: none). low, high: bounds. free: fitted unless stated
    otherwise.
    plausible: standard deviation where it is neither fitted nor stated; 0 for sigma.
    effect: its name as a cause in score tests while it is not fitted; empty for none.
    probe: amount of it in these tests.
    reversible: near focus the opposite sign gives similar images.
    measured_by: measurement that determines it independently of the frames.
    """

    name: str
    meaning: str
    scale: float
    sigma: float = math.inf
    low: float = -math.inf
    high: float = math.inf
    start: float = 0.0
    free: bool = True
    plausible: float = 0.0
    effect: str = ""
    probe: float = 0.0
    reversible: bool = False
    measured_by: str = ""

    @property
    def unstated(self) -> float:
        """Prior standard deviation where nobody states the effect."""
        return self.plausible or self.sigma


@dataclass(frozen=True, slots=True)
class UnfittedEffect:
    """Effect of bench or mask without a fitted parameter; its prior widens the total
    intervals.

    sigma: its size (standard deviation) where nobody states it; ``[[known]]`` with
    value 0 and a sigma states it.
    """

    name: str
    meaning: str
    sigma: float


def _of(row: Perturbation) -> FitParameter:
    shared = (field.name for field in dataclasses.fields(FitParameter))
    entries = {name: getattr(row, name) for name in shared if name != "start"}
    return FitParameter(**entries)


def _light(name: str, meaning: str) -> FitParameter:
    return FitParameter(
        name,
        meaning,
        0.1,
        0.3,
        -2.0,
        2.0,
        free=False,
        plausible=0.2,
        measured_by="the profile of the lamp without the lens",
    )


_OF_LENS = {row.name: _of(row) for row in PERTURBATIONS}
PARAMETERS: tuple[FitParameter, ...] = (
    *(
        _OF_LENS[name]
        for name in (*names_of_kind(CDError), *names_of_kind(ResponseError))
    ),
    FitParameter(
        "wavelength_nm",
        "wavelength minus stated",
        0.3,
        0.5,
        -5.0,
        5.0,
        measured_by="the wavelength (spectrometer)",
    ),
    FitParameter(
        "bandwidth_nm",
        "standard deviation of the spectrum",
        0.5,
        math.inf,
        0.0,
        30.0,
        free=False,
        plausible=1.0,
        effect="a spectrum of finite width",
        probe=2.0,
        measured_by="the spectrum",
    ),
    FitParameter(
        "distance_um",
        "lens to sensor, minus design",
        2.0,
        100.0,
        -400.0,
        400.0,
        measured_by="a wider range of depths",
    ),
    FitParameter(
        "decentre_x_um",
        "window centre minus chief ray on the sensor",
        1.0,
        30.0,
        -60.0,
        60.0,
        measured_by="the place of the axis on the sensor",
    ),
    FitParameter(
        "decentre_y_um",
        "window centre minus chief ray on the sensor",
        1.0,
        30.0,
        -60.0,
        60.0,
        measured_by="the place of the axis on the sensor",
    ),
    FitParameter(
        "tilt_x_deg",
        "tilt of the lens about the y axis",
        0.2,
        1.0,
        -3.0,
        3.0,
        free=False,
        effect="a tilt of the lens about y",
        probe=0.3,
        measured_by="frames at opposite field angles",
    ),
    FitParameter(
        "tilt_y_deg",
        "tilt of the lens about the x axis",
        0.2,
        1.0,
        -3.0,
        3.0,
        free=False,
        effect="a tilt of the lens about x",
        probe=0.3,
        measured_by="frames at opposite field angles",
    ),
    FitParameter(
        "source_x_um",
        "source off the stage's axis",
        5.0,
        50.0,
        -300.0,
        300.0,
        free=False,
        effect="a source off the axis of the stage along x",
        probe=5.0,
    ),
    FitParameter(
        "source_y_um",
        "source off the stage's axis",
        5.0,
        50.0,
        -300.0,
        300.0,
        free=False,
        effect="a source off the axis of the stage along y",
        probe=5.0,
    ),
    FitParameter(
        "stage_zero_um",
        "true source depth minus stated (with the substrate's plate shift)",
        50.0,
        1000.0,
        measured_by="the zero of the stage, or a wider range of depths",
    ),
    FitParameter(
        "stage_scale",
        "true stage step over stated, minus 1",
        1e-3,
        0.01,
        -0.05,
        0.05,
        measured_by="the stage against a gauge",
    ),
    FitParameter(
        "glass_um",
        "plane glass of index 1.51 between source and lens",
        20.0,
        math.inf,
        0.0,
        3000.0,
        free=False,
        plausible=100.0,
        effect="a plate of glass in the beam",
        probe=100.0,
        measured_by="the thickness of the glass",
    ),
    FitParameter(
        "glass_tilt_x_deg",
        "tilt of that glass about the y axis",
        1.0,
        5.0,
        -45.0,
        45.0,
        free=False,
        effect="a tilt of {:g} um of glass about y",
        probe=5.0,
    ),
    FitParameter(
        "glass_tilt_y_deg",
        "tilt of that glass about the x axis",
        1.0,
        5.0,
        -45.0,
        45.0,
        free=False,
        effect="a tilt of {:g} um of glass about x",
        probe=5.0,
    ),
    *(_OF_LENS[name] for name in names_of_kind(WavefrontError)),
    _light(
        "light_x",
        "ln of the irradiance at the +x rim of the lens over that at its axis",
    ),
    _light(
        "light_y",
        "ln of the irradiance at the +y rim of the lens over that at its axis",
    ),
    _light(
        "light_r",
        "ln of the irradiance at the rim all round over that at the axis, times rho² - 1/2",
    ),
    FitParameter(
        "pinhole_um",
        "diameter of the source",
        1.0,
        math.inf,
        0.0,
        2000.0,
        free=False,
        plausible=5.0,
        effect="a source of finite size",
        probe=6.0,
        measured_by="the pinhole, or frames at more distant depths",
    ),
    FitParameter(
        "crosstalk_px",
        "standard deviation of pixel crosstalk and vibration",
        0.1,
        0.3,
        0.02,
        3.0,
        start=0.2,
    ),
    FitParameter(
        "pixel_percent",
        "true pixel pitch over the stated one, less 1",
        0.3,
        1.0,
        -8.0,
        8.0,
        free=False,
        effect="a wrong pixel pitch",
        probe=1.0,
        measured_by="the pixel pitch",
    ),
    FitParameter(
        "log_gain",
        "logarithm of the electrons through the aperture in a frame at the reference depth",
        0.02,
        measured_by="the power",
    ),
    FitParameter(
        "background_e",
        "background at the window's centre, in the longest exposure",
        2.0,
    ),
    FitParameter(
        "background_x_e", "background at the right edge less that at the centre", 2.0
    ),
    FitParameter(
        "background_y_e", "background at the lower edge less that at the centre", 2.0
    ),
)
UNFITTED: tuple[UnfittedEffect, ...] = (
    UnfittedEffect(
        "stitching_nm",
        "shift of each write field of the mask, four across the lens",
        60.0,
    ),
    UnfittedEffect(
        "camera_turn_deg", "turn of the camera against the lens, from +x to +y", 1.0
    ),
    UnfittedEffect(
        "window_px",
        "window of a field angle off the chief ray there, each way, in addition to the common decentre",
        0.3,
    ),
    UnfittedEffect(
        "stop_um",
        "aperture stop of the lens off its place in the design, each way",
        3.0,
    ),
)
NAMES = tuple(p.name for p in PARAMETERS)
PLACE = {name: i for i, name in enumerate(NAMES)}
_IN_PIXELS = (
    "decentre_x_um",
    "decentre_y_um",
)  # which are as wide as the blur, and that as the wave is long
_SIZES = "scale", "sigma", "low", "high", "plausible"  # that grow with the wavelength
_UNFITTED = tuple(row.name for row in UNFITTED)
_CAUSES = [PLACE[row.name] for row in PERTURBATIONS]


@dataclass(frozen=True, slots=True)
class KnownValue:
    """What metrology says of a parameter: spectrometer (wavelength), AFM (height), SEM
    (bias), ellipsometer (index).

    sigma: standard error; 0 holds the parameter at ``value``, inf frees it entirely. Of
    what is never fitted
    (:data:`UNFITTED`) ``value`` is 0 and ``sigma`` says how large it may be.
    name: of the parameter, its unit included. value: as measured, in that unit.
    """

    name: str
    value: float = field(metadata={"signed": True})
    sigma: float = 0.0

    def __post_init__(self) -> None:
        if self.name not in PLACE and self.name not in _UNFITTED:
            raise ConfigError(
                f"unknown parameter {self.name!r}{nearest_name_hint(self.name, (*NAMES, *_UNFITTED))}"
            )
        if self.name in _UNFITTED and not (
            self.value == 0 and math.isfinite(self.sigma)
        ):
            raise ConfigError(
                f"{self.name} = {self.value} +- {self.sigma}: it is never fitted; need value = 0, and how large it may "
                "be as sigma"
            )
        if not math.isfinite(self.value) or not self.sigma >= 0:
            raise ConfigError(
                f"{self.name}: value {self.value}, sigma {self.sigma}; need finite, and sigma >= 0"
            )


def usual_parameters(names: Sequence[str], lens: Lens) -> list[FitParameter]:
    """Rows of some parameters for a lens, scaled with its wavelength.

    What is in nm, and decentre, grow for longer waves (:func:`wavelength_scale`). The
    distance is bounded to a quarter of itself, so that no search runs into the lens.

    Args:
        names: of the parameters.
    """
    rows = []
    for name in names:
        in_pixels = name in _IN_PIXELS
        scale = wavelength_scale if in_pixels else functools.partial(prior_scale, name)
        row, factor = PARAMETERS[PLACE[name]], scale(lens.wavelength_um)
        sizes = {key: factor * getattr(row, key) for key in _SIZES}
        if name == "distance_um":
            most = lens.sensor_distance_um / 4
            sizes["low"] = max(sizes["low"], -most)
            sizes["high"] = min(sizes["high"], most)
        rows.append(dataclasses.replace(row, **sizes))
    return rows


def type_b_sigma(name: str, lens: Lens) -> float:
    """Type B standard deviation of a parameter or effect where nobody states it.

    Args:
        name: of a parameter, or of an unfitted effect.
        lens: the design.
    """
    if name in PLACE:
        return usual_parameters([name], lens)[0].unstated
    row = next(row for row in UNFITTED if row.name == name)
    return row.sigma * prior_scale(name, lens.wavelength_um)


def unfitted_sizes(known: dict[str, KnownValue], lens: Lens) -> dict[str, float]:
    """Stated sizes of unfitted effects, by name; they are removed from ``known``.

    Raises:
        ConfigError: that of a stop, which the lens does not have.
    """
    if "stop_um" in known and lens.layers.stop is None:
        raise ConfigError(
            "stop_um: the lens has no aperture stop; leave it out of [[known]]"
        )
    return {
        row.name: known.pop(row.name).sigma for row in UNFITTED if row.name in known
    }


def parameter_vector(values: Mapping[str, float] | None = None) -> Array:
    """(parameters,) starts, with some set by name.

    Args:
        values: by name.

    Raises:
        ConfigError: an unknown name.
    """
    out = np.array([p.start for p in PARAMETERS])
    for name, value in (values or {}).items():
        if name in _UNFITTED:
            raise ConfigError(
                f"{name} is never fitted: it belongs in [[known]] of --metrology alone"
            )
        if name not in PLACE:
            raise ConfigError(
                f"unknown parameter {name!r}{nearest_name_hint(name, NAMES)}"
            )
        out[PLACE[name]] = value
    return out


def process_state_of(x: Array) -> State:
    """State of the as-built lens by all parameters, without those of the bench.

    Args:
        x: all parameters, in the order of ``PARAMETERS``.
    """
    return State(x[_CAUSES])
