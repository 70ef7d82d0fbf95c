"""An aperture stop before the pillars, as on the other face of their substrate: which
rays pass it.
"""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.special import fresnel

from metalens.core.arrays import Array
from metalens.core.errors import ConfigError
from metalens.optics import interpolant, media
from metalens.optics.media import Media

BENT, INNER = 0.005, 0.055  # of PSFs of 60 lenses against plane waves through the glass


@dataclass(frozen=True, slots=True)
class Stop:
    """A round hole in an opaque plane, on the axis or off it.

    radius_um: of the hole.
    distance_um: from its plane to that of the pillars, through the films between them,
        the last film at the pillars, and through air where the films are thinner.
    centre_um: (x, y) of its middle.

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
    """(x, y) where the rays to places of the pillars cross the stop, um.

    Args:
        before: media from source to pillars; None for collimated light.
        between: media from stop to pillars; None where the stop lies on them.
        tangents: (x, y) in air of the ray to the middle of the lens.
        x: places on the pillars, um; numpy or torch.
        y: places on the pillars, um; numpy or torch.
    """
    if between is None:
        return x, y
    slope = math.hypot(*tangents)
    p = slope / math.hypot(1, slope)
    if before is None:
        between_um = float(media.reach_per_direction(between.layers, p * p))
        between_um /= math.hypot(1, slope)
        return x - between_um * tangents[0], y - between_um * tangents[1]
    source_um = float(media.reach_per_direction(before.layers, p * p))
    source_um /= math.hypot(1, slope)
    dx = x + source_um * tangents[0]
    dy = y + source_um * tangents[1]
    share = _share(before, between, dx * dx + dy * dy)
    return x - share * dx, y - share * dy


def _share(before: Media, between: Media, away2: Any) -> Any:
    """Lateral distance from stop to pillars over that from source to pillars.

    A Chebyshev interpolant in the squared distance.

    Args:
        before: media from source to pillars.
        between: media from stop to pillars.
        away2: squared lateral distance from source to pillars, um².
    """

    def exact(u: Any) -> Any:
        w = media.solve_direction_square(before.layers, u)
        reach = media.reach_per_direction
        return reach(between.layers, w) / reach(before.layers, w)

    return interpolant.chebyshev_interpolant(exact, away2)


def stop_transmission(stop: Stop, at_um: tuple[Any, Any], width_um: Any) -> Any:
    """Share of light that passes the stop: 1 inside, 0 outside, a ramp at the edge.

    Args:
        stop: the aperture stop.
        at_um: (x, y) where rays cross the stop; numpy or torch.
        width_um: of a ray's patch, over which the ramp extends.
    """
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
    """Complex amplitude at the pillars behind the stop over that without it.

    Args:
        stop: the aperture stop.
        media_um: media from source and from stop to the pillars; each may be None, as
            in :func:`stop_crossing`.
        tangents: (x, y) in air of the ray to the middle of the lens.
        wavelength_um: in vacuum.
        at_um: (x, y) of the pillars, numpy arrays that broadcast.
        width_um: of a place, over which the amplitude is averaged.

    Accuracy: :func:`stop_model_error` of a PSF of sum 1. Energies are too low by
    0.18 / N, N the Fresnel number of the shadow.
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
    """Fresnel lengths in the plane of incidence and across it, um.

    1/L = 1/(stop to pillars) + 1/(source to stop), or L = a (1 - a/b) with a the length
    from stop to pillars and b that from source to pillars.

    Args:
        before: media from source to pillars; None for collimated light.
        between: media from stop to pillars.
        tangents: (x, y) of the field angle, in air.
    """
    slope2 = tangents[0] ** 2 + tangents[1] ** 2
    w = slope2 / (1 + slope2)
    across = float(media.reach_per_direction(between.layers, w))
    along = float(media.area_spreading(between.layers, w)) / across
    if before is None:
        return along, across
    whole = float(media.reach_per_direction(before.layers, w))
    area = float(media.area_spreading(before.layers, w))
    return along * (1 - along * whole / area), across * (1 - across / whole)


def stop_model_error(
    stop: Stop,
    media_um: tuple[Media | None, Media | None],
    tangents: tuple[float, float],
    wavelength_um: float,
    zones: float = 0.0,
) -> float:
    """Relative L2 error of a PSF by the approximations of :func:`stop_shadow`.

    (``BENT`` + ``INNER`` zones) / N, with N = R² / (λ L) the Fresnel number. The next
    term of the edge's curvature is ½ <(y² / 2R)²> d²E/ds², 0.04 |w| / N at the edge.
    Waves from the whole edge also meet near the axis, with the amplitude of the light
    at the axis itself. A defocused lens shows them: a blur of radius b on the sensor
    spans R b / (λ d) zones.

    Args:
        stop: the aperture stop.
        media_um: media from source and from stop to the pillars.
        tangents: (x, y) of the field angle, in air.
        wavelength_um: in vacuum.
        zones: Fresnel zones over the blur.
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
    """Radius of the illuminated disc on the pillars, um, paraxial, of a source on axis.

    Args:
        stop: the aperture stop.
        before: media from source to pillars; None for collimated light.
        between: media from stop to pillars.
    """
    if before is None or between is None:
        return stop.radius_um
    return stop.radius_um / (1 - between.reduced_um / before.reduced_um)


def _edge_wave(w: Array) -> tuple[Array, Array]:
    """Fresnel edge field E(w), and its integral w E(w) + i/π e^(-iπ/4)/√2 e^(iπw²/2).

    E = 1/2 + e^(-iπ/4)/√2 (C(w) + i S(w)) is the complex Fresnel integral from -∞ to w,
    of limit 1.
    """
    sine, cosine = fresnel(w)
    rotation = (1 - 1j) / 2
    field = 0.5 + rotation * (cosine + 1j * sine)
    wave = rotation * np.exp(0.5j * np.pi * w * w)
    return field, w * field + 1j / np.pi * wave


def edge_diffraction_factor(
    at_um: tuple[Array, Array],
    width_um: float | Array,
    ray: tuple[float, float],
    lengths_um: tuple[float, float],
    radius_um: float,
    wavelength_um: float,
) -> Array:
    """Complex amplitude S of light diffracted by the stop's edge, mean over a width.

    Fresnel's straight edge at the nearest point of the rim, with the curvature of the
    rim to first order.

    Args:
        at_um: (x, y) where rays cross the stop, from its centre, arrays of one shape.
        width_um: over which the mean is taken.
        ray: unit vector of the plane of incidence.
        lengths_um: Fresnel lengths in that plane and across it.
        radius_um: of the stop.
        wavelength_um: in vacuum.
    """
    x, y = at_um
    along, across = lengths_um
    r = np.maximum(np.hypot(x, y), 1e-12)
    normal = across + (along - across) * ((x * ray[0] + y * ray[1]) / r) ** 2
    scale = np.sqrt(2 / (wavelength_um * normal))
    middle, half = (radius_um - r) * scale, width_um * scale / 2
    outer, outer_integral = _edge_wave(middle - half)
    inner, inner_integral = _edge_wave(middle + half)
    curvature = along * across / (normal * 4 * np.pi * radius_um * width_um)
    mean = (inner_integral - outer_integral) / (2 * half)
    return np.asarray(mean - 1j * wavelength_um * curvature * (inner - outer))
