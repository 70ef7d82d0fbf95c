"""What a ray through plane-parallel media leaves out of its plane waves: their sum
about the ray, over the ray itself.

    ∫ √T(p) exp(ik[p·ρ + Φ(p)]) d²p,    Φ = Σ t √(n² - p²),    T the power that the faces let through

has a stationary point at the ray p0 of reach ρ, where the phase is kL. Its lowest order
is the ray; all others together
are the mean over the waves beside it, on the path of steepest descent p = p0 + (u, v)
exp(-iπ/4):

    1 + iC/(kL) = <√(T(p) / T(p0)) exp(ik[p·ρ + Φ(p) - L] + (k/2)(reach' u² + (reach/p)
    v²))>

u and v normal with variances 1/(k reach') and 1/(k reach/p): Gauss-Hermite sums. C
depends on the cosine in the rarest
medium, s = √(n² - p²), smoothly up to grazing rays, and is 1 in a single medium
(d/(2πr²)(1/r - ik) exp(ikr) is exact).
"""

import functools
import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from metalens.core.arrays import Array
from metalens.lens import media
from metalens.lens.media import Media

Light = Literal["s", "p", "mean"]
WAVES = (
    6,
    8,
    12,
    16,
    20,
    24,
    28,
)  # nodes along u and along v; each ray takes those whose difference from fewer is least
DEGREES = 24  # of the series in s before what is below rounding goes
ROUNDING = 1e-14  # of the amplitude
STEEPEST = 0.9999  # of a ray, in units of the rarest index that the light meets


@dataclass(frozen=True, eq=False, slots=True)
class SaddleCorrection:
    """C as a power series in (s - middle) / half: real and imaginary coefficients,
    lowest first.

    rarest: index of which s is the normal part. normal, left: (n,) values of s,
    ascending, and the relative error of
    the amplitude there, from fewer waves.
    """

    rarest: float
    middle: float
    half: float
    real: Array
    imaginary: Array
    normal: Array
    left: Array

    def at(self, w: Any) -> tuple[Any, Any]:
        """Real and imaginary part of C for the ray of w = p², each for complex steps in
        w.
        """
        u = ((self.rarest * self.rarest - w) ** 0.5 - self.middle) / self.half
        return _horner(self.real, u), _horner(self.imaginary, u)

    def error(self, w: Array) -> Array:
        """Relative error of the amplitude of rays of w = p²."""
        s = np.sqrt(np.maximum(self.rarest * self.rarest - w, 0.0))
        return np.asarray(
            np.exp(
                np.interp(s, self.normal, np.log(np.maximum(self.left, ROUNDING**2)))
            )
        )


def saddle_correction(
    behind: Media, wavenumber: float, reach_um: float, light: Light = "mean"
) -> SaddleCorrection:
    """C of all rays up to this reach; ``wavenumber`` in vacuum, rad/um. light: whose
    power passes the faces, of s, of p
    or the mean of both."""
    layers = behind.layers
    rarest = layers[0][0]
    w = float(media.square(layers, reach_um * reach_um))
    steep = max(w / max(rarest * rarest - w, 1e-300), 2.0**-6)
    steep = 2.0 ** (
        math.ceil(4 * math.log2(steep)) / 4
    )  # alike for windows of much the same rays
    most = min(
        rarest * rarest * steep / (1 + steep), (STEEPEST * min(behind.order)) ** 2
    )
    return _saddle(behind, wavenumber, most, light)


@functools.lru_cache(maxsize=64)
def _saddle(
    behind: Media, wavenumber: float, most: float, light: Light
) -> SaddleCorrection:
    """C of rays of w = p² up to ``most``."""
    rarest = behind.layers[0][0]
    ends = math.sqrt(rarest * rarest - most), rarest
    middle, half = sum(ends) / 2, (ends[1] - ends[0]) / 2
    if len(set(behind.order)) == 1:
        return SaddleCorrection(
            rarest,
            middle,
            half,
            np.ones(1),
            np.zeros(1),
            np.array([rarest]),
            np.zeros(1),
        )
    u = np.cos(np.pi * (np.arange(2 * DEGREES) + 0.5) / (2 * DEGREES))
    w = rarest * rarest - (middle + half * u) ** 2
    turns = wavenumber * np.asarray(media.whole_path(behind.layers, w))
    mean, apart = _settled(behind, wavenumber, w, light)
    want = (mean - 1) * turns / 1j
    # grazing rays are known poorly: they bend the series where they are alone, and not
    # at all beyond rounding (full)
    series, _ = np.polynomial.chebyshev.chebfit(
        u, want, DEGREES - 1, w=1 / (turns * (apart + ROUNDING)), full=True
    )
    kept = np.abs(series) > ROUNDING * turns.min()
    power = np.polynomial.chebyshev.cheb2poly(
        series[: int(np.flatnonzero(kept)[-1]) + 1 if kept.any() else 1]
    )
    real, imaginary = (np.ascontiguousarray(part) for part in (power.real, power.imag))
    missed = np.abs(_horner(power, u) - want) / turns
    return SaddleCorrection(
        rarest,
        middle,
        half,
        real,
        imaginary,
        (middle + half * u)[::-1],
        np.maximum(apart, missed)[::-1],
    )


def _settled(
    behind: Media, wavenumber: float, w: Array, light: Light
) -> tuple[Array, Array]:
    """(n,) :func:`plane_wave_correction` with as many as suit each ray, and by how much
    fewer differ:
    steep rays through thin films
    settle at first, and part again where nodes lie beyond what the ray alone governs.
    """
    every = np.stack(
        [plane_wave_correction(behind, wavenumber, w, count, light) for count in WAVES]
    )
    apart = np.abs(np.diff(every, axis=0))
    best = np.argmin(apart, axis=0)
    at = np.arange(len(w))
    return every[best + 1, at], apart[best, at]


def plane_wave_correction(
    behind: Media,
    wavenumber: float,
    w: Array,
    count: int = WAVES[-1],
    light: Light = "mean",
) -> Array:
    """(n,) 1 + iC/(kL) of rays of w (n,) = p²: the mean of the heading over ``count`` x
    ``count`` plane waves.
    """
    layers, k = behind.layers, wavenumber
    w = np.asarray(w, float)[:, None, None]
    node, share = np.polynomial.hermite_e.hermegauss(count)
    p, g = np.sqrt(w), np.asarray(media.bend(layers, w))
    along = np.asarray(media.widening(layers, w)) / g
    turned = np.exp(-0.25j * np.pi)
    u, v = turned * node[:, None] / np.sqrt(k * along), turned * node / np.sqrt(k * g)
    more = 2 * p * u + u * u + v * v
    # p·ρ + Φ - L, its part linear in u taken off in every medium by itself
    path = p * u * g - sum(
        t * more / ((n * n - w) ** 0.5 + (n * n - w - more) ** 0.5) for n, t in layers
    )
    level = np.sqrt(
        _passed(behind.order, w + more, light) / _passed(behind.order, w, light)
    )
    wave = level * np.exp(1j * k * (path + (along * u * u + g * v * v) / 2))
    return np.asarray(
        np.einsum("nij,ij->n", wave, np.outer(share, share) / (2 * math.pi))
    )


def _passed(order: tuple[float, ...], w: Any, light: Light) -> Any:
    """Power of this light that the faces let through."""
    s_power, p_power = media.passed_on(order, w)
    return {"s": s_power, "p": p_power, "mean": (s_power + p_power) / 2}[light]


def _horner(series: Array, u: Any) -> Any:
    total = u * 0 + series[-1]
    for coefficient in series[-2::-1]:
        total = total * u + coefficient
    return total
