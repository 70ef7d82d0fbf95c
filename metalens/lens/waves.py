"""What a ray through plane-parallel media leaves out of its plane waves: their sum about the ray, over the ray itself.

    ∫ √T(p) exp(ik[p·ρ + Φ(p)]) d²p,    Φ = Σ t √(n² - p²),    T the power that the faces let through

has a stationary point at the ray p0 of reach ρ, where the phase is kL. Its lowest order is the ray; all others together
are the mean over the waves beside it, on the path of steepest descent p = p0 + (u, v) exp(-iπ/4):

    1 + iC/(kL) = <√(T(p) / T(p0)) exp(ik[p·ρ + Φ(p) - L] + (k/2)(reach' u² + (reach/p) v²))>

u and v normal with variances 1/(k reach') and 1/(k reach/p): Gauss-Hermite sums. C depends on the cosine in the rarest
medium, s = √(n² - p²), smoothly up to grazing rays, and is 1 in a single medium (d/(2πr²)(1/r - ik) exp(ikr) is exact).
"""

import functools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from metalens.ground.arrays import Array
from metalens.lens import media
from metalens.lens.media import Media

WAVES, FEWER = 28, 24  # nodes along u and along v, and those whose difference tells the error
DEGREES = 24  # of the series in s before what is below rounding goes
ROUNDING = 1e-14  # of the amplitude
STEEPEST = 0.9999  # of a ray, in units of the rarest index that the light meets


@dataclass(frozen=True, eq=False, slots=True)
class Saddle:
    """C as a power series in (s - middle) / half: real and imaginary coefficients, lowest first.

    rarest: index of which s is the normal part. left: relative error of the amplitude, from fewer waves.
    """

    rarest: float
    middle: float
    half: float
    real: Array
    imaginary: Array
    left: float

    def at(self, w: Any) -> tuple[Any, Any]:
        """Real and imaginary part of C for the ray of w = p², each for complex steps in w."""
        u = ((self.rarest * self.rarest - w) ** 0.5 - self.middle) / self.half
        return _horner(self.real, u), _horner(self.imaginary, u)


def saddle(behind: Media, wavenumber: float, reach_um: float) -> Saddle:
    """C of all rays up to this reach; ``wavenumber`` in vacuum, rad/um."""
    layers = behind.layers
    rarest = layers[0][0]
    w = float(media.square(layers, reach_um * reach_um))
    steep = max(w / max(rarest * rarest - w, 1e-300), 2.0**-6)
    steep = 2.0 ** (math.ceil(4 * math.log2(steep)) / 4)  # alike for windows of much the same rays
    most = min(rarest * rarest * steep / (1 + steep), (STEEPEST * min(behind.order)) ** 2)
    return _saddle(behind, wavenumber, most)


@functools.lru_cache(maxsize=64)
def _saddle(behind: Media, wavenumber: float, most: float) -> Saddle:
    """C of rays of w = p² up to ``most``."""
    rarest = behind.layers[0][0]
    ends = math.sqrt(rarest * rarest - most), rarest
    middle, half = sum(ends) / 2, (ends[1] - ends[0]) / 2
    if len(set(behind.order)) == 1:
        return Saddle(rarest, middle, half, np.ones(1), np.zeros(1), 0.0)
    u = np.cos(np.pi * (np.arange(2 * DEGREES) + 0.5) / (2 * DEGREES))
    w = rarest * rarest - (middle + half * u) ** 2
    turns = wavenumber * np.asarray(media.whole_path(behind.layers, w))
    mean = waves(behind, wavenumber, w)
    apart = np.abs(mean - waves(behind, wavenumber, w, FEWER))
    want = (mean - 1) * turns / 1j
    # grazing rays are known poorly: they bend the series where they are alone
    series = np.polynomial.chebyshev.chebfit(u, want, DEGREES - 1, w=1 / (turns * (apart + ROUNDING)))
    kept = np.abs(series) > ROUNDING * turns.min()
    power = np.polynomial.chebyshev.cheb2poly(series[: int(np.flatnonzero(kept)[-1]) + 1 if kept.any() else 1])
    real, imaginary = (np.ascontiguousarray(part) for part in (power.real, power.imag))
    missed = np.abs(_horner(power, u) - want) / turns
    return Saddle(rarest, middle, half, real, imaginary, float(np.maximum(apart, missed).max()))


def waves(behind: Media, wavenumber: float, w: Array, count: int = WAVES) -> Array:
    """(n,) 1 + iC/(kL) of rays of w (n,) = p²: the mean of the heading over ``count`` x ``count`` plane waves."""
    layers, k = behind.layers, wavenumber
    w = np.asarray(w, float)[:, None, None]
    node, share = np.polynomial.hermite_e.hermegauss(count)
    p, g = np.sqrt(w), np.asarray(media.bend(layers, w))
    along = np.asarray(media.widening(layers, w)) / g
    turned = np.exp(-0.25j * np.pi)
    u, v = turned * node[:, None] / np.sqrt(k * along), turned * node / np.sqrt(k * g)
    more = 2 * p * u + u * u + v * v
    # p·ρ + Φ - L, its part linear in u taken off in every medium by itself
    path = p * u * g - sum(t * more / ((n * n - w) ** 0.5 + (n * n - w - more) ** 0.5) for n, t in layers)
    level = np.sqrt(media.passed_at(behind.order, w + more) / media.passed_at(behind.order, w))
    wave = level * np.exp(k * (1j * path + (along * u * u + g * v * v) / 2 * 1j))
    weight = np.outer(share, share) / (2 * math.pi)
    return np.asarray(np.einsum("nij,ij->n", wave, weight))


def shares(order: tuple[float, ...], w: Any) -> tuple[Any, Any]:
    """Power of s and of p light that the faces let through, over that of unpolarised light, of w = p²."""
    s_power, p_power = media.passed_apart(order, w)
    mean = (s_power + p_power) / 2
    return s_power / mean, p_power / mean


def _horner(series: Array, u: Any) -> Any:
    total = u * 0 + series[-1]
    for coefficient in series[-2::-1]:
        total = total * u + coefficient
    return total
