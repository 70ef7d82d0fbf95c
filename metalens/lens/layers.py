"""What stands before and behind the pillars: plane-parallel films and the medium that fills the rest."""

import itertools
import math
from dataclasses import dataclass, replace

from metalens.cell import Film, Index, Material, index
from metalens.ground.errors import ConfigError, PropagationError
from metalens.lens.media import Media

MOST_ABSORBED = 0.02


@dataclass(frozen=True, slots=True)
class Layers:
    """Plane-parallel films around a lens; the light meets them in this order.

    front: between the source and the pillars (a cover glass, the substrate); the rest of the depth is air.
    behind: between the pillars and the sensor (filter, cover glass); the rest of the distance is ``cover``.
    cover: fills the gap behind the pillars; None for the cover of the lens' cell (air where there is none).
    """

    front: tuple[Film, ...] = ()
    behind: tuple[Film, ...] = ()
    cover: Material | None = None

    @property
    def filling(self) -> Material:
        """The material behind the pillars that is no film."""
        return "air" if self.cover is None else self.cover

    @property
    def plain(self) -> bool:
        """Whether there is nothing but air."""
        return not self.films and self.filling in ("air", Index(1.0))

    @property
    def films(self) -> tuple[Film, ...]:
        """All films that have a thickness."""
        return tuple(film for film in (*self.front, *self.behind) if film.thickness_um > 0)

    def covered_by(self, cover: Material) -> "Layers":
        """These films with the cover of a cell between them.

        Raises:
            ConfigError: they name another cover.
        """
        if self.cover not in (None, cover):
            raise ConfigError(f"layers.cover = {self.cover!r}, but the cell has {cover!r}: leave layers.cover out")
        return replace(self, cover=cover)

    def after(self, distance_um: float, wavelength_um: float) -> Media:
        """Media from pillars to sensor, the cover first.

        Raises:
            PropagationError: the films are thicker than the distance, or one of them is metal.
        """
        return _media(self.behind, self.filling, distance_um, wavelength_um, "lens to sensor")

    def before(self, depth_um: float, wavelength_um: float) -> Media:
        """Media from a source at this depth to the pillars, air first."""
        return _media(self.front, "air", depth_um, wavelength_um, "source to lens")

    def ghost(self, wavelength_um: float) -> float:
        """Share of the light that goes twice between the two faces that reflect most: the largest ghost image."""
        worst = 0.0
        for films, first in ((self.front, "air"), (self.behind, self.filling)):
            order = [float(index(m, wavelength_um).real) for m in (first, *(f.material for f in films))]
            faces = sorted((((a - b) / (a + b)) ** 2 for a, b in itertools.pairwise(order)), reverse=True)
            worst = max(worst, math.prod(faces[:2]) if len(faces) > 1 else 0.0)
        return worst


def check_gaps(layers: Layers, sensor_distance_um: float, source_distance_um: float = math.inf) -> None:
    """Refuse films that do not fit between source, pillars and sensor.

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


def _media(films: tuple[Film, ...], rest: Material, distance_um: float, wavelength_um: float, where: str) -> Media:
    thick = sum(film.thickness_um for film in films)
    if thick > distance_um:
        raise PropagationError(_too_thick(thick, distance_um, where))
    thicknesses = (distance_um - thick, *(film.thickness_um for film in films))
    indices = [index(name, wavelength_um) for name in (rest, *(film.material for film in films))]
    for n, t in zip(indices, thicknesses, strict=True):
        lost = -math.expm1(-4 * math.pi * n.imag * t / wavelength_um)
        if lost > MOST_ABSORBED:
            raise PropagationError(
                f"layers: {t:g} um of index {n:.4g} from {where} absorb {lost:.1%} at {wavelength_um} um, which the "
                f"propagation does not know; need at most {MOST_ABSORBED:.0%} (put a filter's curve into the spectrum)"
            )
    return Media(tuple(float(n.real) for n in indices), thicknesses)
