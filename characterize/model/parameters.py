"""The parameters of an as-built lens and its bench: what each means, in which unit, and
what is known beforehand.

Those of the lens are the table of :mod:`metalens.fabrication.perturbations`; those of
the bench are in ``bench_parameters.toml``.
"""

import dataclasses
import functools
import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources

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


_OF_LENS = {row.name: _of(row) for row in PERTURBATIONS}
_OF_BENCH = tomllib.loads(
    resources.files("characterize")
    .joinpath("model", "bench_parameters.toml")
    .read_text(encoding="utf-8")
)
PARAMETERS: tuple[FitParameter, ...] = (
    *(_OF_LENS[name] for name in names_of_kind(CDError)),
    *(_OF_LENS[name] for name in names_of_kind(ResponseError)),
    *(FitParameter(**row) for row in _OF_BENCH["geometry"]),
    *(_OF_LENS[name] for name in names_of_kind(WavefrontError)),
    *(FitParameter(**row) for row in _OF_BENCH["detection"]),
)
UNFITTED = tuple(UnfittedEffect(**row) for row in _OF_BENCH["unfitted"])
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


def typical_scales(names: Sequence[str]) -> Array:
    """(n,) typical uncertainties of some parameters, each in its unit.

    Args:
        names: of the parameters.
    """
    return np.array([PARAMETERS[PLACE[name]].scale for name in names])


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
