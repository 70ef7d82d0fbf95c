"""Phase profiles of lenses: hyperbolic, double helix, cubic, and a map from file.

The last three add their term to the hyperbolic phase of the focus.
"""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from metalens.core.arrays import Array
from metalens.core.errors import ConfigError, LensError
from metalens.lens import Lens
from metalens.optics import Layers, check_gaps, media


@dataclass(frozen=True, slots=True)
class Focus:
    """What the lens images onto what.

    source_distance_um: object distance of best focus; inf for a collimated beam.
    layers: films in front and behind that the phase is corrected for; none by default.
    """

    wavelength_um: float
    sensor_distance_um: float
    source_distance_um: float = math.inf
    layers: Layers = field(default_factory=Layers)

    def __post_init__(self) -> None:
        for name in ("wavelength_um", "sensor_distance_um", "source_distance_um"):
            if not getattr(self, name) > 0:
                raise LensError(
                    f"{name} = {getattr(self, name)}: need a length above 0"
                )
        check_gaps(self.layers, self.sensor_distance_um, self.source_distance_um)

    def path_um(self, radius2_um2: Array) -> Array:
        """Optical path source - lens - sensor at radius r, less that along the axis,
        um.

        Paper Eq. 1 on both sides. Through films it is the path of the ray that reaches
        r, exact to rounding.

        Args:
            radius2_um2: r², um².
        """
        after = self.layers.after(self.sensor_distance_um, self.wavelength_um).layers
        total = media.path_difference(after, 0.0, 0.0, radius2_um2)[1]
        if math.isfinite(self.source_distance_um):
            front = self.layers.before(self.source_distance_um, self.wavelength_um)
            front_path = media.path_difference(front.layers, 0.0, 0.0, radius2_um2)[1]
            total = total + front_path
        return np.asarray(total)

    def aperture(self, radius_um: float) -> float:
        """Numerical aperture n sin θ of the cone that leaves a lens of this radius
        towards the sensor.
        """
        after = self.layers.after(self.sensor_distance_um, self.wavelength_um)
        return float(media.ray_direction(after, radius_um))

    def paths_from(
        self, x_um: Array, y_um: Array, tangent: float
    ) -> tuple[Array, Array]:
        """Optical paths to (x, y) of the lens from the source and from the sensor
        point.

        Both points belong to a field angle along x; the paths are less those to the
        middle of the lens.

        Args:
            x_um: places along x, um.
            y_um: places along y, um.
            tangent: of the field angle.

        Returns:
            Paths from the sensor point and from the source, um.
        """
        sine = tangent / math.hypot(1.0, tangent)
        behind = self.layers.after(self.sensor_distance_um, self.wavelength_um)
        gaps = [(1, behind)]
        if math.isfinite(self.source_distance_um):
            front = self.layers.before(self.source_distance_um, self.wavelength_um)
            gaps.append((-1, front))
        paths = [np.asarray(x_um * sine)]  # of a collimated source
        for side, gap in gaps:
            reach = side * sine * media.reach_per_direction(gap.layers, sine**2)
            change = x_um**2 + y_um**2 - 2 * reach * x_um
            path = media.path_difference(gap.layers, sine**2, reach**2, change)[1]
            paths.append(np.asarray(path))
        return paths[1], paths[-1] if len(gaps) > 1 else paths[0]


def lens_focus(lens: Lens) -> Focus:
    """What a lens images onto what: wavelength, distances and films of its design."""
    distances = lens.sensor_distance_um, lens.source_distance_um
    return Focus(lens.wavelength_um, *distances, lens.layers)


@dataclass(frozen=True, slots=True)
class DoubleHelix:
    """Annular vortices: ring l of ``zones`` carries the charge 2l - 1 (after Pavani et
    al. 2009, Prasad 2013).

    zones: number of rings.
    exponent: ring l ends at radius R (l / zones)**exponent; 1/2 gives rings of equal
    area.
    """

    zones: int = 4
    exponent: float = 0.5

    def __post_init__(self) -> None:
        if self.zones < 1 or not self.exponent > 0:
            raise ConfigError(
                f"double helix of {self.zones} zones, exponent {self.exponent}: need both above 0"
            )


@dataclass(frozen=True, slots=True)
class Cubic:
    """strength_rad ((x/R)³ + (y/R)³): extends the depth of field (Dowski and Cathey
    1995).

    strength_rad: phase at the rim of either axis.
    """

    strength_rad: float = 60.0


@dataclass(frozen=True, slots=True)
class PhaseMap:
    """Phase read from a file in radians, (y, x), +y down, for exp(-iwt); see
    :mod:`metalens.design.phase_map`.

    file: its path (.npy, .npz, .mat, a Zemax grid phase .dat, else text: a matrix, or
    rows of x, y and phase); in Python also the array itself. Complex values stand for
    exp(i phase), 0 for no data.
    pitch_um: sampling of the map, or a pair along x and y; a grid phase and rows of x,
    y and phase bring their own. Interpolated through the phasor exp(i phase).
    unit: of the phase: "rad", "deg" or "waves" (1 is 2 pi). Not stated: radians, unless
    the values look like another unit; then the map is refused.
    levels: number of levels of 2 pi, for maps of integers (256 for 8 bits).
    add_focus: whether the hyperbolic focus is added to the map.
    variable: name of the matrix in a .mat or .npz file that holds several.
    conjugate: change the sign, for maps made with exp(+iwt).
    """

    file: Array | Path
    pitch_um: float | tuple[float, float] | None = None
    add_focus: bool = False
    variable: str | None = None
    conjugate: bool = False
    unit: Literal["rad", "deg", "waves"] | None = None
    levels: int | None = None

    def __post_init__(self) -> None:
        if self.levels is not None and (self.levels < 2 or self.unit is not None):
            raise ConfigError(
                f"levels = {self.levels}, unit = {self.unit} of the phase map: "
                "need 2 levels or more, and no unit with them"
            )
        if self.pitch_um is not None and not np.min(self.pitch_um) > 0:
            raise ConfigError(
                f"pitch_um = {self.pitch_um} of the phase map: need a length above 0"
            )


def hyperbolic_phase(x_um: Array, y_um: Array, focus: Focus) -> Array:
    """Hyperbolic lens phase in rad: -k × optical path difference (paper Eq. 1, both
    sides).

    Paths source - lens - sensor are then equal over the aperture.

    Args:
        x_um: positions along x; broadcast with y_um to (y, x).
        y_um: positions along y.
        focus: source and sensor distances of the design.

    Returns:
        (y, x) phase in rad, 0 on the axis and negative outwards, float64.
    """
    return np.asarray(
        -2 * np.pi / focus.wavelength_um * focus.path_um(x_um**2 + y_um**2)
    )


def vortex_phase(
    x_um: Array, y_um: Array, *, radius_um: float, zones: int, exponent: float = 0.5
) -> Array:
    """Phase of annular vortices, (y, x) in rad: (2 l - 1) azimuth in ring l.

    l = ceil(zones (r/R)^(1/exponent)), 1 to ``zones``; 0 for no zones.

    Args:
        x_um: places along x, um.
        y_um: places along y, um; they broadcast to (y, x).
        radius_um: radius R of the aperture, um.
        zones: number of rings.
        exponent: of their radii; 1/2 gives rings of equal area.
    """
    if zones == 0:
        return np.zeros(np.broadcast_shapes(x_um.shape, y_um.shape))
    fraction = np.hypot(x_um, y_um) / radius_um
    ring = np.clip(np.ceil(zones * fraction ** (1 / exponent)), 1, zones)
    return np.asarray((2 * ring - 1) * np.arctan2(y_um, x_um))
