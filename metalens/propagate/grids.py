"""Grids for wide windows (:mod:`metalens.propagate.wide`): how fine, how far, and what
is faded out.
"""

import functools
import itertools
import math
from dataclasses import dataclass

import numpy as np

from metalens.core.arrays import Array
from metalens.optics import media
from metalens.propagate.geometry import PropagationCase
from metalens.propagate.paths import from_source, ray_cosines, reference_depth

RAYS = 33  # along an axis, whose reach the quadratic follows
SPARE = 1.2  # grid of the lens over the least that the kernel's band asks for
MOST = 20000  # points of a transform along an axis
# points of the lens that a window asks for, and half-waves in it, from which no other
# method does as well; below some
# 35 the fading and the grid beyond the lens's rim are as wide as lens and window, and
# errors miss any setting (on
# random lenses of 20 to 120 pillars by up to 3e-2; their estimates say so)
WIDE = 120
# of the digits asked for that fading keeps where it does most: on light of the lens's
# far rim at the far end of the
# window, which weighs little; light that is even over both misses the setting, as the
# estimate says, and is done again
FADED = 0.4
STEEPEST = 0.93  # |p| of a ray, fading included, in units of the rarest index


@dataclass(frozen=True, slots=True)
class WideAxis:
    """One axis of a wide window.

    count, first_um, step_um: of the even grid over the lens, which stands over by
    ``taps`` on both sides; ``over``: as
    fine as the kernel asks for, times this. first: points of the first transform, of
    which the middle ``size`` are over
    the padded window, and go on. fine: of the last one, whose step is that
    of the window's samples or a whole part of it, ``every``. middle, reach_um,
    stretch_um: p0, A, D of the module.
    most, guard: largest |p - p0| of a ray to the window; band beyond it in which the
    light is faded out; sharp: half of
    that in standard deviations. steepest: |p| of a ray to the window.
    """

    count: int
    first_um: float
    step_um: float
    taps: int
    over: float
    first: int
    size: int
    fine: int
    every: int
    middle: float
    reach_um: float
    stretch_um: float
    most: float
    guard: float
    sharp: float
    steepest: float


@dataclass(frozen=True, slots=True)
class QuadraticFit:
    """The quadratic along one axis: p0, A, D of the module; most: largest |p - p0| of a
    ray to the window; extra: what
    the quadratic leaves of its reach; steepest: |p| of any ray."""

    middle: float
    reach_um: float
    stretch_um: float
    most: float
    extra_um: float
    steepest: float


@functools.lru_cache(maxsize=256)
def wide_axes(
    case: PropagationCase, tolerance: float
) -> tuple[WideAxis, WideAxis] | None:
    """(y, x) grids for a window; None where its rays are too steep or too far from
    quadratic for the method.

    Args:
        case: geometry of the propagation.
        tolerance: relative error of the field.
    """
    fits, extra = _fitted(case, list(case.half_window_um)), [0.0, 0.0]
    for _ in range(2):
        if fits is None:
            return None
        extra = [fit.extra_um for fit in fits]
        if any(
            e > 2 * (w + h)
            for e, w, h in zip(
                extra, case.half_window_um, case.half_size_um, strict=True
            )
        ):
            return None
        fits = _fitted(
            case, [w + e for w, e in zip(case.half_window_um, extra, strict=True)]
        )
    if fits is None:
        return None
    sharp = math.sqrt(2 * FADED * math.log(1 / tolerance))
    fade = 2 * sharp**2 / case.wavenumber
    widths = [
        2 * (w + fit.extra_um) for w, fit in zip(case.half_window_um, fits, strict=True)
    ]
    guards = [
        math.sqrt(2 * fade * fit.most / width)
        for width, fit in zip(widths, fits, strict=True)
    ]
    if fits[0].steepest + max(guards) > STEEPEST * _rarest(case):
        return None
    beyond = _beyond(case, fits, guards)
    made = [
        _axis(case, i, fits[i], (guards[i], sharp, beyond[i]), tolerance)
        for i in (0, 1)
    ]
    return None if made[0] is None or made[1] is None else (made[0], made[1])


def _rarest(case: PropagationCase) -> float:
    return 1.0 if case.behind is None else case.behind.layers[0][0]


def _beyond(
    case: PropagationCase, fits: tuple[QuadraticFit, QuadraticFit], guards: list[float]
) -> list[float]:
    """What the quadratic leaves of the reach of the light that is faded out, along y
    and x.
    """
    y, x = (
        f.middle + np.linspace(-1, 1, RAYS) * (f.most + g)
        for f, g in zip(fits, guards, strict=True)
    )
    w = y[:, None] ** 2 + x**2
    seen = w <= (fits[0].steepest + max(guards)) ** 2
    pairs = (
        [(1.0, case.sensor_distance_um)] if case.behind is None else case.behind.layers
    )
    bend = media.reach_per_direction(pairs, np.where(seen, w, 0.0))
    found = []
    for fit, p in zip(fits, (y[:, None], x), strict=True):
        left = p * bend - fit.reach_um - fit.stretch_um * (p - fit.middle)
        found.append(float(np.abs(np.where(seen, left, 0)).max()))
    return found


def is_wide(case: PropagationCase, tolerance: float) -> bool:
    """Whether the method is the quickest without a look at the others, whose plans take
    long for such windows.

    Args:
        case: geometry of the propagation.
        tolerance: relative error of the field.
    """
    found = wide_axes(case, tolerance)
    if found is None:
        return False
    waves = (
        4 * axis.most * half / case.wavelength_um
        for axis, half in zip(found, case.half_window_um, strict=True)
    )
    return min(*waves, *(axis.count - 2 * axis.taps for axis in found)) > WIDE


def _fitted(
    case: PropagationCase, half: list[float]
) -> tuple[QuadraticFit, QuadraticFit] | None:
    """Along y and x, for rays to ``half`` about the window's middle."""
    unit = np.cos(np.pi * (np.arange(RAYS) + 0.5) / RAYS)
    centre = case.centre_um[::-1]
    y, x = (
        c + unit * (w + h)
        for c, w, h in zip(centre, half, case.half_size_um, strict=True)
    )
    both = [
        np.asarray(ray_cosines(case, *at)) for at in ((y[:, None], x), (x, y[:, None]))
    ]
    steepest = float(np.sqrt((both[0] ** 2 + both[1] ** 2).max()))
    if steepest > STEEPEST * _rarest(case):
        return None
    out = []
    for along, p in zip((y[:, None], x), both, strict=True):
        reach, p0 = np.broadcast_to(along, p.shape), float(p.min() + p.max()) / 2
        slope, level = np.polyfit((p - p0).ravel(), reach.ravel(), 1)
        left = float(np.abs(reach - level - slope * (p - p0)).max())
        out.append(
            QuadraticFit(
                p0,
                float(level),
                float(slope),
                float(np.abs(p - p0).max()),
                left,
                steepest,
            )
        )
    return out[0], out[1]


def _axis(
    case: PropagationCase,
    i: int,
    fit: QuadraticFit,
    faded: tuple[float, float, float],
    tolerance: float,
) -> WideAxis | None:
    """The grids of an axis; faded: width in p of what is faded out, half of it in
    standard deviations, and how far
    that light goes astray."""
    guard, sharp, beyond = faded
    coarse = case.wavelength_um / 2 / (fit.most + guard)
    every = math.ceil(case.step_um / coarse)
    width = (
        2 * (case.half_window_um[i] + beyond) + 4 * sharp**2 / case.wavenumber / guard
    )
    fine = _quick(width * every / case.step_um)
    period = fine * case.step_um / every
    size = min(_quick(period / coarse), fine)
    least = (
        case.wavelength_um * fit.stretch_um * size / period
    )  # grid step of the lens times points of the first transform
    band, first = _band(case, i, fit.extra_um), size
    while first <= MOST:
        over = case.wavelength_um / (2 * band) * first / least
        if over >= SPARE:
            taps = math.ceil(
                1 + math.log(10 / tolerance) * over / (math.pi * (over - 1))
            )
            count = math.ceil(2 * case.half_size_um[i] * first / least) + 2 * taps + 1
            if count <= first:
                low = -(count - 1) / 2 * least / first
                grid = count, low, least / first, taps, over, first, size, fine, every
                return WideAxis(
                    *grid,
                    fit.middle,
                    fit.reach_um,
                    fit.stretch_um,
                    fit.most,
                    guard,
                    sharp,
                    fit.steepest,
                )
        first = _quick(max(first + 1, min(SPARE / over, 1.5) * first))
    return None


def _quick(points: float) -> int:
    """Size of a transform: a multiple of 4 of factors 2, 3, 5 and 7; others take up to
    twice as long a point.
    """
    return next(
        n for n in itertools.count(4 * math.ceil((points - 1e-9) / 4), 4) if _smooth(n)
    )


@functools.lru_cache(maxsize=4096)
def _smooth(n: int) -> bool:
    for factor in (2, 3, 5, 7):
        while n % factor == 0:
            n //= factor
    return n == 1


def _band(case: PropagationCase, i: int, extra: float) -> float:
    """Largest |d path / d x| along an axis of the kernel without its carrier, over
    lens, window and depths.
    """
    (hy, hx), (wy, wx) = case.half_size_um, case.half_window_um
    ends = np.array([-1.0, 0.0, 1.0])
    y, x, Y, X = np.meshgrid(ends * hy, ends * hx, ends * wy, ends * wx, indexing="ij")
    Y, X = (Y + np.sign(Y) * extra, X) if i == 0 else (Y, X + np.sign(X) * extra)
    far = [(case.centre_um[1] - y, Y), (case.centre_um[0] - x, X)]
    away, beside = far[i], far[1 - i]
    turned = ray_cosines(case, away[0] + away[1], beside[0] + beside[1]) - ray_cosines(
        case, away[0], beside[0]
    )
    tiny = np.array([-0.5, 0.5])[:, None, None] * 1e-3
    at = [ends[:, None] * hy, ends * hx]
    at[i] = at[i] + tiny
    steep = 0.0
    for inverse in (min(case.inverse_depths_per_um), max(case.inverse_depths_per_um)):
        path = from_source(case, at[1], at[0], case.tangents, inverse)
        path = np.asarray(
            path - from_source(case, at[1], at[0], case.tangents, reference_depth(case))
        )
        steep = max(steep, float(np.abs(path[1] - path[0]).max() / 1e-3))
    return max(float(np.abs(turned).max()) + steep, 1e-6)


def grid_um(axis: WideAxis) -> Array:
    """(count,) places of the even grid over the lens.

    Args:
        axis: grids along one axis.
    """
    return axis.first_um + axis.step_um * np.arange(axis.count)


def spread_weights(axis: WideAxis, places_um: Array) -> Array:
    """(place, grid) sinc under Kaiser's window: f(x) = Σ_m weight f(x_m) for what the
    kernel's band holds.

    Args:
        axis: grids along one axis.
        places_um: positions on the lens.
    """
    t = (places_um[:, None] - grid_um(axis)) / axis.step_um
    inside = np.clip(1 - (t / axis.taps) ** 2, 0, None)
    beta = math.pi * axis.taps * (1 - 1 / axis.over)
    return np.asarray(
        np.sinc(t)
        * np.where(inside > 0, np.i0(beta * np.sqrt(inside)), 0)
        / np.i0(beta)
    )
