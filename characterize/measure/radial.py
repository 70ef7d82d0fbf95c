"""Profile of a pillar along rays from its middle: levels, edge crossings, and the
change of its radius by blur.
"""

import math

import numpy as np
from scipy import ndimage, special

from metalens.core.arrays import Array

RAYS = 72
# radius over blur above which a disc is wide: its middle is lowered by exp(-12.5)
_WIDE = 5.0
# least level of a solid disc's middle over that of its rim; lower tops are dark
_SOLID = 0.8
# most iterations of a search, and change (pixels, square pixels) at which it stops
_ITERATIONS, _TOLERANCE = 30, 1e-3
_MOST_GAIN = 5.0  # largest change of the corrected with the measured radius


def ray_smoothing(pitch: float) -> float:
    """Standard deviation in pixels by which rays are smoothed along themselves.

    Args:
        pitch: distance of neighbours, pixels.
    """
    return max(1.0, pitch / 150)


def rim_and_gap_levels(reach: Array, rays: Array) -> tuple[float, float, int]:
    """(level of the rim, level of the gap, index of the rim) about the steepest fall of
    the mean over the rays.

    The fall is weighted by sqrt(min(spacing of the rays, 1 pixel)), its inverse noise.
    The rim is the maximum just inside it, within a fifth of its radius or 16 samples:
    tops may be dark. The gap is the mean of the darkest third outside.

    Args:
        reach: (r,) distances from the middle, pixels.
        rays: (r, rays) levels along the rays.
    """
    mean = rays.mean(1)
    arc_px = reach[:-1] * 2 * math.pi / RAYS
    steepest = int(np.argmin(np.diff(mean) * np.sqrt(np.minimum(arc_px, 1.0))))
    outside = np.sort(mean[steepest + 1 :])
    outer = float(outside[: max(len(outside) // 3, 2)].mean())
    slope = float(mean[steepest] - mean[steepest + 1])
    inner = float(mean[max(steepest - 16, 0) : steepest + 1].max())
    blur = (inner - outer) / max(math.sqrt(2 * math.pi) * slope, 1e-12)  # samples
    first = max(
        steepest - max(16, steepest // 5, int(min(3 * blur, steepest))), steepest // 4
    )
    rim = first + int(np.argmax(mean[first : steepest + 1]))
    return float(mean[rim]), outer, rim


def edge_crossings(reach: Array, rays: Array, half: float, rim: int) -> Array:
    """(rays,) distance at which each ray first falls below a level outside the rim, by
    linear interpolation; nan where it does not.

    Args:
        reach: (r,) distances from the middle, pixels.
        rays: (r, rays) levels along the rays.
        half: the level, midway between rim and gap.
        rim: index of the rim.
    """
    crossings = np.full(rays.shape[1], math.nan)
    for j in range(rays.shape[1]):
        below = rim + np.flatnonzero(rays[rim:, j] < half)
        if len(below) and below[0] > rim:
            i = int(below[0])
            high = rays[i - 1, j]
            low = rays[i, j]
            crossings[j] = reach[i - 1] + (reach[1] - reach[0]) * (high - half) / (
                high - low
            )
    return crossings


def drawn_in(
    reach: Array, rays: Array, edge: Array, radius: float, smooth: float
) -> float:
    """Decrease of the half-level radius by blur, pixels: s² / (2 R) of a disc that is
    wide compared with its blur s.

    Args:
        reach: (r,) distances from the middle, pixels.
        rays: (r, rays) levels, smoothed along the rays by ``smooth``.
        edge: (rays,) distance of the fitted edge.
        radius: root-mean-square of ``edge``.
        smooth: standard deviation of the smoothing, pixels.
    """
    inner, outer, _ = rim_and_gap_levels(reach, rays)
    variance = (
        _variance_of_share(_share_of_fall(reach, rays, edge, inner - outer)) - smooth**2
    )
    return max(variance, 0.0) / (2 * radius)


def blur_variance(reach: Array, rays: Array, smooth: float) -> float:
    """Variance s² of the blur of a narrow solid disc, square pixels; nan for wide discs
    and dark tops.

    Blur lowers the middle of a narrow disc and moves its half level outwards, by 0.2
    pixels at a radius of 4.5 and a blur of 2. Radius and blur are iterated until a
    blurred disc gives the measured half-level radius and steepness.

    Args:
        reach: (r,) distances from the middle, pixels.
        rays: (r, rays) smoothed levels along the rays.
        smooth: standard deviation by which rays are smoothed, pixels.
    """
    mean = rays.mean(1)
    reading, share, inner, outer = _read_profile(reach, mean, smooth=0.0)
    if not math.isfinite(reading):
        return math.nan
    variance = max(_variance_of_share(share) - smooth**2, 0.0)
    is_solid = mean[: max(int(0.3 * reading / reach[1]), 1)].mean() - outer > _SOLID * (
        inner - outer
    )
    if not is_solid or is_wide_disc(reading, variance, smooth):
        return math.nan
    radius = reading
    for _ in range(_ITERATIONS):
        disc_reading, disc_share, *_ = _read_profile(
            reach, _blurred_disc(reach, radius, variance), smooth=smooth
        )
        radius = min(max(radius + reading - disc_reading, 0.5 * reading), 1.5 * reading)
        change = _variance_of_share(share) - _variance_of_share(disc_share)
        variance = max(variance + change, 0.0)
        if max(abs(reading - disc_reading), abs(change)) < _TOLERANCE:
            break
    return variance


def is_wide_disc(
    radius: float, variance: float, smooth: float, *, times: float = _WIDE
) -> bool:
    """Whether radius > times * sqrt(variance + smooth²); by default, so wide that blur
    does not lower its middle.

    Args:
        radius: radius, pixels.
        variance: variance of the blur, square pixels.
        smooth: standard deviation by which rays are smoothed, pixels.
        times: least radius of a wide disc over the blur.
    """
    return radius > times * math.hypot(math.sqrt(variance), smooth)


def deblur_radius(
    reach: Array, radius: float, variance: float, smooth: float
) -> tuple[float, float]:
    """(true radius of a disc whose half level lies at a radius after blur, derivative
    of the true by the measured radius), in pixels.

    Args:
        reach: (r,) distances from the middle, pixels.
        radius: measured half-level radius, pixels.
        variance: variance of the blur, square pixels.
        smooth: standard deviation by which rays are smoothed, pixels.
    """
    corrected = radius
    step = 0.1
    for _ in range(_ITERATIONS):
        reading = _read_profile(
            reach, _blurred_disc(reach, corrected, variance), smooth=smooth
        )[0]
        corrected = min(max(corrected + radius - reading, 0.5 * radius), 1.5 * radius)
        if abs(radius - reading) < _TOLERANCE:
            break
    reading, stepped_reading = (
        _read_profile(reach, _blurred_disc(reach, trial, variance), smooth=smooth)[0]
        for trial in (corrected, corrected + step)
    )
    return corrected, min(
        max(step / max(stepped_reading - reading, 1e-9), 1.0), _MOST_GAIN
    )


def _share_of_fall(reach: Array, rays: Array, edge: Array, step: float) -> float:
    """Mean fall of the rays from one pixel inside to one pixel outside their edges,
    over the step from rim to gap; 0.05 to 0.99.
    """
    positions = np.clip(
        (edge + np.array([[-1.0], [1.0]])) / reach[1], 0, len(reach) - 1
    )
    ray_index = np.arange(rays.shape[1])
    inside, outside = (
        ndimage.map_coordinates(rays, (position, ray_index), order=1)
        for position in positions
    )
    return float(np.clip((inside - outside).mean() / step, 0.05, 0.99))


def _variance_of_share(share: float) -> float:
    """Blur variance s² of a straight edge whose fall within ±1 pixel is a share
    erf(1 / (s sqrt 2)) of the step.
    """
    return 0.5 / float(special.erfinv(share)) ** 2


def _blurred_disc(reach: Array, radius: float, variance: float) -> Array:
    """(r,) profile of a disc of level 1 and radius R after a Gaussian blur of variance
    s².

    At distance r it is the noncentral chi-square distribution function of (R / s)² with
    two degrees of freedom and noncentrality (r / s)².
    """
    variance = max(variance, 0.1)
    return np.asarray(special.chndtr(radius**2 / variance, 2, reach**2 / variance))


def _read_profile(
    reach: Array, profile: Array, *, smooth: float
) -> tuple[float, float, float, float]:
    """(half-level radius, share of the fall within ±1 pixel, level of the rim, level of
    the gap) of a radial profile.

    Args:
        reach: (r,) distances from the middle, pixels.
        profile: (r,) levels.
        smooth: standard deviation by which the profile is smoothed first, pixels.
    """
    if smooth:
        profile = ndimage.gaussian_filter1d(profile, smooth / reach[1], mode="nearest")
    levels = profile[:, None]
    inner, outer, rim = rim_and_gap_levels(reach, levels)
    crossing = edge_crossings(reach, levels, (inner + outer) / 2, rim)
    return (
        float(crossing[0]),
        _share_of_fall(reach, levels, crossing, inner - outer),
        inner,
        outer,
    )
