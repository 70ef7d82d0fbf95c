"""An aperture stop before the pillars, as on the other face of their substrate: which
rays pass it.

Through plane-parallel media a ray keeps p = n sin θ. One from a source at s that
reaches the pillars at x crosses the
plane of the stop at

    u = x - f (x - s),    f = bend(between) / bend(before),    bend = Σ t / √(n² - p²)    (:mod:`metalens.lens.media`)

and one of collimated light at u = x - p bend(between): ``before`` are the media from
source to pillars, ``between``
those from stop to pillars. Of a field angle the lens then uses the part that its light
falls on, which moves across
the pillars by the thickness times the slope in the substrate: with it go astigmatism
and field curvature.

The edge's shadow is that of waves, by its distance s = R - |u| from the ray and the
Fresnel length L along it, d reach
/ d p of the media between (less by their share of the way for light that diverges), for
an edge of radius R:

    S(s) = E(w) - i λ L' / (4π R) dE/ds,    w = s √(2 / (λ L)),    E(w) = e^(-iπ/4) / √2 ∫_-∞^w e^(iπv²/2) dv

E is the straight edge (Born and Wolf, Principles of Optics, 8.7.3). The second term is
how far an edge bends away
within the Fresnel zone: mean of its sagitta y² / 2R, <y²> = i λ L' / 2π, L' the Fresnel
length along the edge.
"""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from metalens.core.arrays import Array
from metalens.core.errors import ConfigError
from metalens.lens import media, smooth
from metalens.lens.edge import edge_diffraction_factor
from metalens.lens.media import Media

BENT, INNER = 0.005, 0.055  # of PSFs of 60 lenses against plane waves through the glass


@dataclass(frozen=True, slots=True)
class Stop:
    """A round hole, about the axis or beside it.

    radius_um: of the hole. distance_um: from its plane to that of the pillars, through
    the films in front of them that
    lie there, the last one at the pillars, and air where they are thinner. centre_um:
    (x, y) of its middle.

    Raises:
        ConfigError: a radius that is not above 0, a distance below 0, a centre that is
            not finite.
    """

    radius_um: float
    distance_um: float = 0.0
    centre_um: tuple[float, float] = field(
        default=(0.0, 0.0), metadata={"signed": True}
    )

    def __post_init__(self) -> None:
        if not (
            math.isfinite(self.radius_um)
            and self.radius_um > 0
            and 0 <= self.distance_um < math.inf
        ):
            raise ConfigError(
                f"stop: radius_um = {self.radius_um}, distance_um = {self.distance_um}; need a radius above 0 and a "
                "distance of 0 or more"
            )
        if not all(map(math.isfinite, self.centre_um)):
            raise ConfigError(
                f"stop: centre_um = {self.centre_um}; need a finite x and y"
            )

    @property
    def centred(self) -> bool:
        """Whether it lies about the axis."""
        return not any(self.centre_um)


def stop_crossing(
    before: Media | None,
    between: Media | None,
    tangents: tuple[float, float],
    x: Any,
    y: Any,
) -> tuple[Any, Any]:
    """(x, y) in um where the rays that reach the pillars at (x, y) cross the stop;
    numpy or torch.

    Args:
        before: media from source to pillars, None for collimated light. between: those
            from stop to pillars, None
            where the stop lies on them. tangents: (x, y) of the ray to the middle of
            the lens, in air.
    """
    if between is None:
        return x, y
    slope = math.hypot(*tangents)
    p = slope / math.hypot(1, slope)
    if before is None:
        way = float(media.bend(between.layers, p * p)) / math.hypot(1, slope)
        return x - way * tangents[0], y - way * tangents[1]
    back = float(media.bend(before.layers, p * p)) / math.hypot(1, slope)
    dx, dy = x + back * tangents[0], y + back * tangents[1]
    share = _share(before, between, dx * dx + dy * dy)
    return x - share * dx, y - share * dy


def _share(before: Media, between: Media, away2: Any) -> Any:
    """f of the heading, of the squared lateral way from source to pillars."""

    def exact(u: Any) -> Any:
        w = media.square(before.layers, u)
        return media.bend(between.layers, w) / media.bend(before.layers, w)

    return smooth.chebyshev_interpolant(exact, away2)


def stop_transmission(stop: Stop, at_um: tuple[Any, Any], width_um: Any) -> Any:
    """Share of light that passes where rays cross the stop at (x, y): 1 inside, 0
    outside, over the edge as much of a
    patch of ``width_um`` as lies inside; numpy or torch."""
    x, y = (at - middle for at, middle in zip(at_um, stop.centre_um, strict=True))
    radius = (x * x + y * y) ** 0.5
    share = (stop.radius_um - radius) / width_um + 0.5
    return share.clip(0, 1) if isinstance(share, np.ndarray) else share.clamp(0, 1)


def stop_shadow(
    stop: Stop,
    media_um: tuple[Media | None, Media | None],
    tangents: tuple[float, float],
    wavelength_um: float,
    at_um: tuple[Any, Any],
    width_um: Any,
) -> Array:
    """Complex amplitude behind the stop over that without it, mean over ``width_um`` of
    a place; numpy arrays.

    Args:
        media_um: before and between, tangents: as in :func:`stop_crossing`. at_um: (x,
            y) of
            the pillars, broadcast.

    Accuracy: of a PSF of sum 1, by :func:`stop_model_error`; energies are 0.18 / N
    short, N the
    Fresnel number there.
    """
    x, y = stop_crossing(*media_um, tangents, *at_um)
    if media_um[1] is None:
        return np.asarray(stop_transmission(stop, (x, y), width_um))
    slope = math.hypot(*tangents)
    ray = (tangents[0] / slope, tangents[1] / slope) if slope else (1.0, 0.0)
    lengths = fresnel_um(media_um[0], media_um[1], tangents)
    x, y = np.broadcast_arrays(x - stop.centre_um[0], y - stop.centre_um[1])
    return edge_diffraction_factor(
        (x, y), width_um, ray, lengths, stop.radius_um, wavelength_um
    )


def fresnel_um(
    before: Media | None, between: Media, tangents: tuple[float, float]
) -> tuple[float, float]:
    """Fresnel lengths in the plane of the ray and across it: of 1/L = 1/(stop to
    pillars) + 1/(source to stop).
    """
    slope2 = tangents[0] ** 2 + tangents[1] ** 2
    w = slope2 / (1 + slope2)
    across = float(media.bend(between.layers, w))
    along = float(media.widening(between.layers, w)) / across
    if before is None:
        return along, across
    whole = float(media.bend(before.layers, w))
    return along * (
        1 - along * whole / float(media.widening(before.layers, w))
    ), across * (1 - across / whole)


def stop_model_error(
    stop: Stop,
    media_um: tuple[Media | None, Media | None],
    tangents: tuple[float, float],
    wavelength_um: float,
    zones: float = 0.0,
) -> float:
    """Relative L2 error of a PSF by what :func:`stop_shadow` leaves out: (``BENT`` +
    ``INNER`` zones) / N.

    N = R² / (λ L) is the Fresnel number of the shadow. Of the edge's bend the next term
    is ½ <(y² / 2R)²> d²E/ds², 0.04
    |w| / N at the edge. Inside, waves from the whole edge gather about the axis (a
    point of it has the amplitude of the
    light), which a lens out of focus shows: zones, of a blur of radius b on the sensor,
    are R b / (λ d).
    """
    if media_um[1] is None:
        return 0.0
    number = stop.radius_um**2 / (
        wavelength_um * max(fresnel_um(media_um[0], media_um[1], tangents))
    )
    return (BENT + INNER * zones) / number


def illuminated_radius_um(
    stop: Stop, before: Media | None, between: Media | None
) -> float:
    """Radius of what a source on the axis lights on the pillars (paraxial)."""
    if before is None or between is None:
        return stop.radius_um
    return stop.radius_um / (1 - between.reduced_um / before.reduced_um)
