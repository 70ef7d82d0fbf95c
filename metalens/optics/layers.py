"""What stands before and behind the pillars: plane-parallel films, the medium that
fills the rest, and a stop.
"""

import itertools
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from metalens.cell import Film, Index, Material, index
from metalens.core.arrays import Array
from metalens.core.errors import ConfigError, PropagationError
from metalens.optics import media
from metalens.optics.aperture_stop import (
    Stop,
    illuminated_radius_um,
    stop_crossing,
    stop_model_error,
    stop_shadow,
    stop_transmission,
)
from metalens.optics.media import Media

MOST_ABSORBED = 0.02


@dataclass(frozen=True, slots=True)
class Layers:
    """Plane-parallel films around a lens; the light meets them in this order.

    front: between the source and the pillars (a cover glass, the substrate); the rest
    of the depth is air.
    behind: between the pillars and the sensor (filter, cover glass); the rest of the
    distance is ``cover``.
    cover: fills the gap behind the pillars; None for the cover of the lens' cell (air
    where there is none).
    stop: aperture stop in front, as on the other face of the substrate; None where the
    lens is its own.
    """

    front: tuple[Film, ...] = ()
    behind: tuple[Film, ...] = ()
    cover: Material | None = None
    stop: Stop | None = None

    @property
    def filling(self) -> Material:
        """The material behind the pillars that is no film."""
        return "air" if self.cover is None else self.cover

    @property
    def plain(self) -> bool:
        """Whether light goes through nothing but air; a stop may stand in it."""
        return not self.films and self.filling in ("air", Index(1.0))

    @property
    def films(self) -> tuple[Film, ...]:
        """All films that have a thickness."""
        return tuple(
            film for film in (*self.front, *self.behind) if film.thickness_um > 0
        )

    def covered_by(self, cover: Material) -> "Layers":
        """These films with the cover of a cell between them.

        Raises:
            ConfigError: they name another cover.
        """
        if self.cover not in (None, cover):
            raise ConfigError(
                f"layers.cover = {self.cover!r}, but the cell has {cover!r}: leave layers.cover out"
            )
        return replace(self, cover=cover)

    @property
    def open(self) -> "Layers":
        """The same without a stop."""
        return replace(self, stop=None)

    def after(self, distance_um: float, wavelength_um: float) -> Media:
        """Media from pillars to sensor, the cover first.

        Raises:
            PropagationError: the films are thicker than the distance, or one of them is
                metal.
        """
        return _media(
            self.behind, self.filling, distance_um, wavelength_um, "lens to sensor"
        )

    def before(self, depth_um: float, wavelength_um: float) -> Media:
        """Media from a source at this depth to the pillars, air first."""
        return _media(self.front, "air", depth_um, wavelength_um, "source to lens")

    def from_stop(self, wavelength_um: float) -> Media | None:
        """Media from the stop to the pillars, the last film first.

        None where the stop lies on the pillars.
        """
        left = 0.0 if self.stop is None else self.stop.distance_um
        films: list[Film] = []
        for film in reversed(self.front):
            films.append(replace(film, thickness_um=min(film.thickness_um, left)))
            left -= films[-1].thickness_um
        thick = sum(film.thickness_um for film in films)
        if thick + left == 0:
            return None
        return _media(tuple(films), "air", thick + left, wavelength_um, "stop to lens")

    def through_middle(
        self, tangents: Array, depth_um: float, wavelength_um: float
    ) -> Array:
        """(…, [x, y]) slopes in air of the rays through the middle of the stop.

        They come from the same sources as rays to the middle of the lens. Without a
        stop, and for collimated light, the slopes are those of ``tangents``.

        Args:
            tangents: (…, [x, y]) slopes in air of the rays to the middle of the lens.
            depth_um: of the sources.
            wavelength_um: in vacuum.
        """
        if self.stop is None or math.isinf(depth_um):
            return tangents
        before, between = self._around_stop(depth_um, wavelength_um)
        if before is None or (between is None and self.stop.centred):
            return tangents
        inner = {} if between is None else dict(between.layers)
        outer = [(n, t - inner.get(n, 0.0)) for n, t in before.layers]
        outer = [(n, t) for n, t in outer if t > 1e-9 * depth_um]
        slope2 = (tangents**2).sum(-1, keepdims=True)
        p = tangents / np.sqrt(1 + slope2)
        reach = media.reach_per_direction(before.layers, slope2 / (1 + slope2)) * p
        reach = reach + np.array(self.stop.centre_um)
        w = media.solve_direction_square(outer, (reach**2).sum(-1, keepdims=True))
        return np.asarray(reach / media.reach_per_direction(outer, w) / np.sqrt(1 - w))

    def stop_share(
        self,
        tangents: tuple[float, float],
        depth_um: float,
        wavelength_um: float,
        at_um: tuple[Any, Any],
        width_um: Any,
    ) -> Any:
        """Share of a source's light that passes the stop to places of the pillars.

        From 0 to 1, geometric; 1 without a stop.

        Args:
            tangents: (x, y) in air of the source's ray to the middle of the lens.
            depth_um: of the source, inf for collimated light.
            wavelength_um: in vacuum.
            at_um: (x, y) places on the pillars, which broadcast.
            width_um: of a place, over which the edge is a linear ramp.

        Raises:
            PropagationError: the source lies behind the stop.
        """
        if self.stop is None:
            return 1.0
        before, between = self._around_stop(depth_um, wavelength_um)
        return stop_transmission(
            self.stop, stop_crossing(before, between, tangents, *at_um), width_um
        )

    def shadow(
        self,
        tangents: tuple[float, float],
        depth_um: float,
        wavelength_um: float,
        at_um: tuple[Any, Any],
        width_um: Any,
    ) -> Array:
        """Complex amplitude at places of the pillars over that without the stop.

        As :meth:`stop_share`, with diffraction by the edge
        (:mod:`metalens.optics.aperture_stop`); numpy arrays.
        """
        if self.stop is None:
            return np.ones(np.broadcast_shapes(np.shape(at_um[0]), np.shape(at_um[1])))
        around = self._around_stop(depth_um, wavelength_um)
        return stop_shadow(self.stop, around, tangents, wavelength_um, at_um, width_um)

    def shadow_error(
        self,
        tangents: tuple[float, float],
        depth_um: float,
        wavelength_um: float,
        blur_rad: float = 0.0,
        window_share: float = 1.0,
    ) -> float:
        """Relative L2 error of a PSF by the approximations of :meth:`shadow`.

        0 without a stop. Waves that meet near the middle of a blur fall off as 1 / √r.
        Their share of the light grows as window_share^-½, and the error as window_share^-¼.

        Args:
            tangents: (x, y) in air of the source's ray to the middle of the lens.
            depth_um: of the source, inf for collimated light.
            wavelength_um: in vacuum.
            blur_rad: radius of the PSF over its distance from the lens.
            window_share: share of the PSF's light that lies in the window.
        """
        if self.stop is None:
            return 0.0
        zones = self.stop.radius_um * blur_rad / wavelength_um / window_share**0.25
        return stop_model_error(
            self.stop,
            self._around_stop(depth_um, wavelength_um),
            tangents,
            wavelength_um,
            zones,
        )

    def footprint_um(self, depth_um: float, wavelength_um: float) -> float:
        """Radius of the illuminated disc on the pillars' plane of a source on the axis.

        It is inf without a stop.
        """
        if self.stop is None:
            return math.inf
        around = self._around_stop(depth_um, wavelength_um)
        return illuminated_radius_um(self.stop, *around)

    def _around_stop(
        self, depth_um: float, wavelength_um: float
    ) -> tuple[Media | None, Media | None]:
        """Media from the source and from the stop to the pillars.

        The first is None for collimated light, the second for a stop on the pillars.

        Raises:
            PropagationError: the source lies behind the stop.
        """
        if self.stop is not None and depth_um <= self.stop.distance_um:
            raise PropagationError(
                f"layers: a source {depth_um:g} um before the pillars lies behind the stop, {self.stop.distance_um:g} "
                "um before them; need one in front of it"
            )
        before = None if math.isinf(depth_um) else self.before(depth_um, wavelength_um)
        return before, self.from_stop(wavelength_um)

    def ghost(self, wavelength_um: float) -> float:
        """Share of the light in the largest ghost image.

        It is reflected once by each of the two faces of highest reflectance on one side
        of the lens, ((a - b) / (a + b))² at normal incidence.
        """
        worst = 0.0
        for films, first in ((self.front, "air"), (self.behind, self.filling)):
            order = [
                float(index(m, wavelength_um).real)
                for m in (first, *(f.material for f in films))
            ]
            faces = sorted(
                (((a - b) / (a + b)) ** 2 for a, b in itertools.pairwise(order)),
                reverse=True,
            )
            worst = max(worst, math.prod(faces[:2]) if len(faces) > 1 else 0.0)
        return worst


def check_gaps(
    layers: Layers, sensor_distance_um: float, source_distance_um: float = math.inf
) -> None:
    """Raise for films that do not fit between source, pillars and sensor.

    Args:
        layers: films to check.
        sensor_distance_um: from lens to sensor.
        source_distance_um: from source to lens.

    Raises:
        PropagationError: naming the gap.
    """
    for films, gap_um, where in (
        (layers.front, source_distance_um, "source to lens"),
        (layers.behind, sensor_distance_um, "lens to sensor"),
    ):
        thick = sum(film.thickness_um for film in films)
        if thick > gap_um:
            raise PropagationError(_too_thick(thick, gap_um, where))


def _too_thick(thick_um: float, gap_um: float, where: str) -> str:
    return f"layers: films of {thick_um:g} um in the {gap_um:g} um from {where}; need films no thicker than the gap"


def _media(
    films: tuple[Film, ...],
    filling: Material,
    distance_um: float,
    wavelength_um: float,
    where: str,
) -> Media:
    """Films and the medium that fills the gap, as indices and thicknesses.

    Args:
        films: in order of the light; the filling comes first.
        filling: material that fills the gap.
        distance_um: length of the gap.
        wavelength_um: in vacuum.
        where: words for the gap, in the error's text.

    Raises:
        PropagationError: films thicker than the gap, or a medium that absorbs more than
            ``MOST_ABSORBED``.
    """
    thick = sum(film.thickness_um for film in films)
    if thick > distance_um:
        raise PropagationError(_too_thick(thick, distance_um, where))
    thicknesses = (distance_um - thick, *(film.thickness_um for film in films))
    indices = [
        index(name, wavelength_um)
        for name in (filling, *(film.material for film in films))
    ]
    for n, t in zip(indices, thicknesses, strict=True):
        absorption = 4 * math.pi * n.imag / wavelength_um  # per um
        lost = -math.expm1(-absorption * t) if absorption else 0.0
        if lost > MOST_ABSORBED:
            raise PropagationError(
                f"layers: {t:g} um of index {n:.4g} from {where} absorb {lost:.1%} at {wavelength_um} um, which the "
                f"propagation does not know; need at most {MOST_ABSORBED:.0%} (put a filter's curve into the spectrum)"
            )
    return Media(tuple(float(n.real) for n in indices), thicknesses)
