"""Optical paths from the source to the lens and on to the sensor: in air, through films
of the lens, and through a plate of glass, tilted or not, in front of it.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from characterize.model.parameters import PLACE
from metalens.core.arrays import Array
from metalens.core.errors import FitError
from metalens.optics import Layers, media

INDEX = 1.51  # of crown glass from 0.6 to 1.1 um: 1.515 to 1.506
Pairs = tuple[tuple[float, float], ...]  # (index, thickness, um)


@dataclass(frozen=True, slots=True)
class BenchGeometry:
    """Source, lens and sensor for one field angle.

    tangents: (x, y) of the chief ray in air; the window is where it meets the sensor.
    reference_um: source depth whose phase is removed before gathering.
    """

    distance_um: float
    wavelength_um: float
    reference_um: float
    tangents: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, slots=True)
class FilmStack:
    """Plane-parallel films of a lens at one wavelength.

    front: (index, thickness in um) between source and lens, without the air.
    behind: from lens to sensor in the light's order, without the gap.
    filling: index of the gap, whose thickness is what the distance leaves.
    """

    front: Pairs = ()
    behind: Pairs = ()
    filling: float = 1.0

    @classmethod
    def of(cls, layers: Layers, wavelength_um: float) -> "FilmStack":
        """The films of a lens file at a wavelength, without those of no thickness.

        Raises:
            PropagationError: one of them is metal.
        """
        if layers.plain:
            return AIR
        sides = (
            layers.before(math.inf, wavelength_um),
            layers.after(math.inf, wavelength_um),
        )
        front, behind = (
            tuple(
                (n, t)
                for n, t in zip(side.index[1:], side.thickness_um[1:], strict=True)
                if t > 0
            )
            for side in sides
        )
        return cls(front, behind, sides[1].index[0])

    def pairs(self, distance_um: float) -> Pairs:
        """(index, thickness in um) of the media from lens to sensor, the gap first.

        The gap is negative where films are thicker than the distance.
        """
        gap_um = distance_um - sum(t for _, t in self.behind)
        return (self.filling, gap_um), *self.behind

    def reduced_um(self, distance_um: float) -> float:
        """Distance in air that bends paraxial light as the way from lens to sensor, um."""
        return sum(t / n for n, t in self.pairs(distance_um))

    def apparent_um(self, depth_um: Any) -> Any:
        """Depths in air of the paraxial images of sources at ``depth_um``, um."""
        return depth_um - sum(t - t / n for n, t in self.front)

    def chief_um(
        self, distance_um: float, tangents: tuple[float, float]
    ) -> tuple[float, float]:
        """(x, y) where the chief ray through the lens centre meets the sensor, um.

        Args:
            tangents: (x, y) of the ray in air.
        """
        secant2 = 1 + tangents[0] ** 2 + tangents[1] ** 2
        reach = media.reach_per_direction(self.pairs(distance_um), 1 - 1 / secant2)
        reach_um = reach / math.sqrt(secant2)
        return reach_um * tangents[0], reach_um * tangents[1]

    def drift(self, tangents: tuple[float, float]) -> tuple[float, float]:
        """Change of :meth:`chief_um` by the distance: tangents in the gap."""
        secant2 = 1 + tangents[0] ** 2 + tangents[1] ** 2
        share = 1 / math.sqrt((self.filling**2 - 1) * secant2 + 1)
        return share * tangents[0], share * tangents[1]

    def path_change(
        self, distance_um: float, reach2_um2: Array, more_um2: Array
    ) -> Array:
        """Path from lens to sensor of squared reach ``reach2_um2 + more_um2`` less that
        of ``reach2_um2``, um, without cancellation.
        """
        pairs = self.pairs(distance_um)
        direct = media.solve_direction_square(pairs, reach2_um2)
        path_um = media.path_difference(pairs, direct, reach2_um2, more_um2)[1]
        return np.asarray(path_um)

    def amplitude(self, distance_um: float, reach2_um2: Array) -> tuple[Array, Array]:
        """(size, path r) of the amplitude size (1/r - ik) exp(ikr) of rays from lens to
        sensor of a squared reach: √(passed / spread) / (2 pi); d / (2 pi r²) in air.
        """
        pairs = self.pairs(distance_um)
        w = media.solve_direction_square(pairs, reach2_um2)
        passed = media.passed_at((self.filling, *(n for n, _ in self.behind)), w)
        spread = media.area_spreading(pairs, w)
        size = np.sqrt(passed / spread) / (2 * np.pi)
        return size, np.asarray(media.whole_path(pairs, w))

    def sensor_path(
        self,
        x_um: Array,
        y_um: Array,
        centre_um: tuple[float, float],
        distance_um: float,
    ) -> Array:
        """(*shape) path from (x, y) on the lens to ``centre_um`` on the sensor, um.

        Less that from the lens centre.
        """
        axis2 = np.array(centre_um[0] ** 2 + centre_um[1] ** 2)
        reach2 = (x_um - centre_um[0]) ** 2 + (y_um - centre_um[1]) ** 2
        return self.path_change(distance_um, axis2, reach2 - axis2)


AIR = FilmStack()


def source_paths(
    x_um: Array,
    y_um: Array,
    *,
    depth_um: Array,
    tangents: tuple[float, float],
    values: Array,
    films: FilmStack = AIR,
) -> Array:
    """(frames, *shape) path from the sources to (x, y) on the lens, um.

    Less that to its centre. The plate of glass acts as in air alone.

    Args:
        x_um: places on the lens along x.
        y_um: places on the lens along y.
        depth_um: (frames,) of the sources.
        tangents: (x, y) of the chief ray of a source on the axis, in air.
        values: all parameters, of which source_x_um, source_y_um, glass_um and the
            tilts of the glass are used.
        films: of which those in front of the lens are passed.

    Raises:
        FitError: the plate does not fit between source and lens.
    """
    z = depth_um.reshape(-1, *(1,) * x_um.ndim)
    apparent_um = films.apparent_um(z)
    chief = (
        tangents[0] - values[PLACE["source_x_um"]] / apparent_um,
        tangents[1] - values[PLACE["source_y_um"]] / apparent_um,
    )
    path_um = media.source_path(films.front, x_um, y_um, chief, 1 / z)
    if values[PLACE["glass_um"]] != 0:
        at = {"tangents": chief, "depth_um": apparent_um, "values": values}
        path_um = path_um + extra_path(x_um, y_um, **at)
    return np.asarray(path_um)


def extra_path(
    x_um: Array, y_um: Array, *, tangents: tuple[Any, Any], depth_um: Any, values: Array
) -> Array:
    """(*shape) path added by the plate of glass for (x, y) on the lens, um.

    Less that added at the lens centre. The ray crosses plate and air as plane-parallel
    media, whose thicknesses along the plate's normal add up to the source's distance.

    Args:
        x_um: places on the lens along x.
        y_um: places on the lens along y.
        tangents: (x, y) of the chief ray; the source is at (-z tx, -z ty, -z), z =
            ``depth_um``.
        values: all parameters, of which glass_um and its tilts are used.

    Raises:
        FitError: the plate does not fit between source and lens.
    """
    t = float(values[PLACE["glass_um"]])
    tilt = [math.tan(math.radians(values[PLACE[f"glass_tilt_{a}_deg"]])) for a in "xy"]
    normal = np.array([*tilt, 1.0]) / math.hypot(*tilt, 1.0)

    def added_path(x: Array, y: Array) -> Array:
        ray = x + depth_um * tangents[0], y + depth_um * tangents[1]
        r2 = ray[0] ** 2 + ray[1] ** 2 + depth_um**2
        along = ray[0] * normal[0] + ray[1] * normal[1] + depth_um * normal[2]
        if along.min() <= t:
            raise FitError(
                f"{t:.4g} um of glass between lens and source, which leave {along.min():.4g} um for it"
            )
        pairs = (1.0, along - t), (INDEX, t)
        w = media.solve_direction_square(pairs, np.maximum(r2 - along**2, 0.0))
        return np.asarray(media.whole_path(pairs, w) - np.sqrt(r2))

    return np.asarray(
        added_path(np.asarray(x_um), np.asarray(y_um))
        - added_path(np.zeros(1), np.zeros(1))
    )
