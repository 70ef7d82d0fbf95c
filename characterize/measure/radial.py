"""The profile of a pillar along rays from its middle: its levels, where it falls, and
what blur takes of its radius.
"""

import math

import numpy as np
from scipy import ndimage, special

from metalens.core.arrays import Array

RAYS = 72
# radius over blur from which on a disc has a flat top: its middle is lowered by
# exp(-12.5)
_WIDE = 5.0
# level of a solid disc's middle over that of its rim, from the gap: less has a dark top
_SOLID = 0.8
_TURNS, _SETTLED = (
    30,
    1e-3,
)  # of a search, and pixels (or square pixels) by which its last turn changes anything
_MOST_GAIN = 5.0  # a disc as narrow as its blur has no width of its own


def ray_smoothing(pitch: float) -> float:
    """Standard deviation in pixels by which rays are smoothed along themselves.

    Args:
        pitch: distance of neighbours, pixels.
    """
    return max(1.0, pitch / 150)


def rim_and_gap_levels(reach: Array, rays: Array) -> tuple[float, float, int]:
    """(level of the rim, of the gap, where the rim is brightest) about the steepest
    fall of the mean over the rays.

    A fall counts by its steepness over its noise: where rays are less than a pixel
    apart they cross the same pixels.
    The rim is looked for just inside the fall, within a fifth of its radius or 16
    samples: tops may be dark. The gap is
    the darkest third beyond the fall: of crowded pillars it is a few pixels wide.

    Args:
        reach: (r,) distances from the middle, pixels.
    """
    mean = rays.mean(1)
    apart = reach[:-1] * 2 * math.pi / RAYS
    fall = int(np.argmin(np.diff(mean) * np.sqrt(np.minimum(apart, 1.0))))
    beyond = np.sort(mean[fall + 1 :])
    outer = float(beyond[: max(len(beyond) // 3, 2)].mean())
    steep = float(mean[fall] - mean[fall + 1])
    inner = float(mean[max(fall - 16, 0) : fall + 1].max())
    blur = (inner - outer) / max(math.sqrt(2 * math.pi) * steep, 1e-12)  # samples
    first = max(fall - max(16, fall // 5, int(min(3 * blur, fall))), fall // 4)
    rim = first + int(np.argmax(mean[first : fall + 1]))
    return float(mean[rim]), outer, rim


def edge_crossings(reach: Array, rays: Array, half: float, rim: int) -> Array:
    """(ray,) where each first falls below a level beyond the rim; nan where it does
    not.

    Args:
        reach: (r,) distances from the middle, pixels.
        rays: (r, rays) levels along the rays.
        half: level of half of the step.
    """
    found = np.full(rays.shape[1], math.nan)
    for j in range(rays.shape[1]):
        below = rim + np.flatnonzero(rays[rim:, j] < half)
        if len(below) and below[0] > rim:
            i = int(below[0])
            high, low = rays[i - 1, j], rays[i, j]
            found[j] = reach[i - 1] + (reach[1] - reach[0]) * (high - half) / (
                high - low
            )
    return found


def drawn_in(
    reach: Array, rays: Array, edge: Array, radius: float, smooth: float
) -> float:
    """What blur takes of the radius at half of the step: s² / (2 R), of a disc that is
    wide beside its blur s.

    Args:
        reach, rays: as smoothed by ``smooth`` along them.
        edge: (ray,) where the fitted edge crosses each; its mean square radius is
            ``radius``.
    """
    inner, outer, _ = rim_and_gap_levels(reach, rays)
    variance = _variance(_steepness(reach, rays, edge, inner - outer)) - smooth**2
    return max(variance, 0.0) / (2 * radius)


def blur_variance(reach: Array, rays: Array, smooth: float) -> float:
    """Variance s² of the blur about a disc that is not wide beside it, by the mean over
    its rays; nan about others.

    Blur lowers the middle of such a disc, and half of a lowered step lies farther out,
    by 0.2 pixels of a radius of 4.5
    in a blur of 2. So radius and blur are those of which the same reading gives the
    same radius and the same steepness.
    A dark top is no disc's.

    Args:
        reach: (r,) distances from the middle, pixels.
        smooth: standard deviation by which rays are smoothed, pixels.
    """
    mean = rays.mean(1)
    half, share, inner, outer = _reading(reach, mean, smooth=0.0)
    if not math.isfinite(half):
        return math.nan
    variance = max(_variance(share) - smooth**2, 0.0)
    solid = mean[: max(int(0.3 * half / reach[1]), 1)].mean() - outer > _SOLID * (
        inner - outer
    )
    if not solid or is_wide_disc(half, variance, smooth):
        return math.nan
    radius = half
    for _ in range(_TURNS):
        found, steep, *_ = _reading(
            reach, _disc(reach, radius, variance), smooth=smooth
        )
        radius = min(max(radius + half - found, 0.5 * half), 1.5 * half)
        change = _variance(share) - _variance(steep)
        variance = max(variance + change, 0.0)
        if max(abs(half - found), abs(change)) < _SETTLED:
            break
    return variance


def is_wide_disc(
    radius: float, variance: float, smooth: float, *, times: float = _WIDE
) -> bool:
    """Whether a disc is wider than so many blurs; by default, so wide that its middle
    is not lowered.

    Args:
        radius: radius, pixels.
        variance: of the blur, square pixels.
        smooth: standard deviation by which rays are smoothed, pixels.
        times: blurs that a wide disc is wider than.
    """
    return radius > times * math.hypot(math.sqrt(variance), smooth)


def deblur_radius(
    reach: Array, radius: float, variance: float, smooth: float
) -> tuple[float, float]:
    """(radius of the disc that is read at a radius in a blur, its change with what is
    read), in pixels.

    Args:
        reach: (r,) distances from the middle, pixels.
        variance: of the blur, square pixels.
        smooth: standard deviation by which rays are smoothed, pixels.
    """
    true, step = radius, 0.1
    for _ in range(_TURNS):
        found = _reading(reach, _disc(reach, true, variance), smooth=smooth)[0]
        true = min(max(true + radius - found, 0.5 * radius), 1.5 * radius)
        if abs(radius - found) < _SETTLED:
            break
    found, more = (
        _reading(reach, _disc(reach, r, variance), smooth=smooth)[0]
        for r in (true, true + step)
    )
    return true, min(max(step / max(more - found, 1e-9), 1.0), _MOST_GAIN)


def _steepness(reach: Array, rays: Array, edge: Array, step: float) -> float:
    """What rays fall by within a pixel of their edges, as a share of the step."""
    near = np.clip((edge + np.array([[-1.0], [1.0]])) / reach[1], 0, len(reach) - 1)
    at = np.arange(rays.shape[1])
    inside, outside = (
        ndimage.map_coordinates(rays, (places, at), order=1) for places in near
    )
    return float(np.clip((inside - outside).mean() / step, 0.05, 0.99))


def _variance(share: float) -> float:
    """s² of a straight edge that falls by a share within a pixel: erf(1 / (s sqrt 2))."""
    return 0.5 / float(special.erfinv(share)) ** 2


def _disc(reach: Array, radius: float, variance: float) -> Array:
    """A disc in a Gaussian blur, 1 deep within it.

    The share of a Gaussian about a place r off the middle that lies within R is that of
    noncentral chi square: two
    degrees of freedom, (r / s)² off, below (R / s)².
    """
    variance = max(variance, 0.1)
    return np.asarray(special.chndtr(radius**2 / variance, 2, reach**2 / variance))


def _reading(
    reach: Array, profile: Array, *, smooth: float
) -> tuple[float, float, float, float]:
    """(radius at half of the step, steepness there, level of the rim, of the gap) as
    they are read of a profile.
    """
    if smooth:
        profile = ndimage.gaussian_filter1d(profile, smooth / reach[1], mode="nearest")
    ray = profile[:, None]
    inner, outer, rim = rim_and_gap_levels(reach, ray)
    found = edge_crossings(reach, ray, (inner + outer) / 2, rim)
    return float(found[0]), _steepness(reach, ray, found, inner - outer), inner, outer
