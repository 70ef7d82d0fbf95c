"""Phase profiles of lenses: hyperbolic, double helix, cubic, and a map from file.

All focus a point source on the axis at ``source_distance_um`` before the lens onto the sensor at
``sensor_distance_um`` behind it; the last three add their own term to that hyperbolic phase.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from metalens.errors import ConfigError, LensError
from metalens.store import Array


@dataclass(frozen=True, slots=True)
class Focus:
    """What the lens images onto what.

    source_distance_um: object distance of best focus; inf for a collimated beam.
    """

    wavelength_um: float
    sensor_distance_um: float
    source_distance_um: float = math.inf

    def __post_init__(self) -> None:
        for name in ("wavelength_um", "sensor_distance_um", "source_distance_um"):
            if not getattr(self, name) > 0:
                raise LensError(f"{name} = {getattr(self, name)}: need a length above 0")


@dataclass(frozen=True, slots=True)
class DoubleHelix:
    """Annular vortices: ring l of ``zones`` carries the charge 2l - 1 (after Pavani et al. 2009, Prasad 2013).

    zones: number of rings.
    exponent: ring l ends at radius R (l / zones)**exponent; 1/2 gives rings of equal area.
    """

    zones: int = 4
    exponent: float = 0.5

    def __post_init__(self) -> None:
        if self.zones < 1 or not self.exponent > 0:
            raise ConfigError(f"double helix of {self.zones} zones, exponent {self.exponent}: need both above 0")


@dataclass(frozen=True, slots=True)
class Cubic:
    """strength_rad ((x/R)³ + (y/R)³): extends the depth of field (Dowski and Cathey 1995)."""

    strength_rad: float = 60.0


@dataclass(frozen=True, slots=True)
class PhaseMap:
    """Phase read from a file (.npy, or .csv of numbers) in radians, (y, x), centred on the lens axis.

    file: its path.
    pitch_um: sampling of the map; interpolated onto the pillars through the phasor exp(i phase).
    add_focus: whether the hyperbolic focus is added to the map.
    """

    file: Path
    pitch_um: float
    add_focus: bool = False

    def __post_init__(self) -> None:
        if not self.pitch_um > 0:
            raise ConfigError(f"pitch_um = {self.pitch_um} of the phase map: need a length above 0")


def path_difference(radius2_um2: Array, distance_um: float) -> Array:
    """Extra path from an axial point out to radius r, sqrt(r² + z²) - z, from r² without cancellation.

    Args:
        radius2_um2: (*shape) squared distance from the axis.
        distance_um: axial distance; inf gives 0.
    """
    if math.isinf(distance_um):
        return np.zeros_like(radius2_um2)
    return radius2_um2 / (np.sqrt(radius2_um2 + distance_um**2) + distance_um)


def hyperbolic(x_um: Array, y_um: Array, focus: Focus) -> Array:
    """Phase that brings all paths source - lens - sensor into step (paper Eq. 1 on both sides).

    Args:
        x_um, y_um: positions that broadcast to (y, x).

    Returns:
        (y, x) phase in rad, 0 on the axis and negative outwards, float64.
    """
    radius2 = x_um**2 + y_um**2
    path = path_difference(radius2, focus.sensor_distance_um) + path_difference(radius2, focus.source_distance_um)
    return np.asarray(-2 * np.pi / focus.wavelength_um * path)


def double_helix(x_um: Array, y_um: Array, focus: Focus, shape: DoubleHelix, *, radius_um: float) -> Array:
    """Hyperbolic phase plus the vortices of :class:`DoubleHelix`; the PSF is two lobes that turn with depth."""
    fraction = np.hypot(x_um, y_um) / radius_um
    ring = np.clip(np.ceil(shape.zones * fraction ** (1 / shape.exponent)), 1, shape.zones)
    return np.asarray(hyperbolic(x_um, y_um, focus) + (2 * ring - 1) * np.arctan2(y_um, x_um))


def cubic(x_um: Array, y_um: Array, focus: Focus, shape: Cubic, *, radius_um: float) -> Array:
    """Hyperbolic phase plus :class:`Cubic`."""
    x, y = x_um / radius_um, y_um / radius_um
    return np.asarray(hyperbolic(x_um, y_um, focus) + shape.strength_rad * (x**3 + y**3))


def read_map(shape: PhaseMap) -> Array:
    """(y, x) phase in rad from the file of a :class:`PhaseMap`.

    Raises:
        LensError: missing or unreadable file, not 2-D, or a value that is not finite (row and column named).
    """
    path = shape.file
    try:
        if path.suffix.lower() == ".npy":
            phase = np.load(path, allow_pickle=False)
        else:
            phase = np.loadtxt(path, delimiter=",", ndmin=2)
    except FileNotFoundError:
        raise LensError(f"{path}: no such file; need a phase map (.npy or .csv)") from None
    except ValueError as error:
        raise LensError(f"{path}: not a phase map: {error}") from error
    if phase.ndim != 2 or min(phase.shape) < 2 or phase.dtype.kind not in "fiu":
        raise LensError(f"{path}: holds {phase.dtype} of shape {phase.shape}, need real (y, x) of 2 by 2 or more")
    if not np.isfinite(phase).all():
        row, column = (int(i) for i in np.argwhere(~np.isfinite(phase))[0])
        raise LensError(f"{path}: phase at row {row}, column {column} is {phase[row, column]}, need finite radians")
    return np.asarray(phase, float)


def interpolate(phase_rad: Array, pitch_um: float, x_um: Array, y_um: Array) -> Array:
    """Phase of a map between its samples, (y, x), by bilinear interpolation of the phasor exp(i phase).

    Args:
        phase_rad: (rows, columns) samples ``pitch_um`` apart, centred on the axis.
        x_um: (x,) positions; y_um: (y,) positions, all inside the map.

    Raises:
        LensError: a position lies outside the map, or neighbouring samples differ by nearly half a turn, so
            that the phase between them is not known.
    """
    rows, columns = phase_rad.shape
    row, column = y_um / pitch_um + (rows - 1) / 2, x_um / pitch_um + (columns - 1) / 2
    if min(row.min(), column.min()) < -0.5 or row.max() > rows - 0.5 or column.max() > columns - 0.5:
        size = columns * pitch_um, rows * pitch_um
        raise LensError(f"the phase map covers {size[0]:.1f} x {size[1]:.1f} um, less than the aperture")
    phasor = np.exp(1j * phase_rad)
    between = _blend(_blend(phasor, row).T, column).T
    if np.abs(between).min() < 0.5:
        i, j = np.unravel_index(int(np.abs(between).argmin()), between.shape)
        raise LensError(
            f"the phase map turns by more than 2/3 of half a turn between samples near row {row[i]:.1f}, "
            f"column {column[j]:.1f}; give it on a finer pitch than {pitch_um} um"
        )
    return np.asarray(np.angle(between))


def _blend(samples: Array, position: Array) -> Array:
    """Linear interpolation along the first axis; positions beyond the ends take the end sample."""
    low = np.clip(np.floor(position).astype(int), 0, len(samples) - 2)
    weight = np.clip(position - low, 0, 1)[:, None]
    return np.asarray(samples[low] * (1 - weight) + samples[low + 1] * weight)
