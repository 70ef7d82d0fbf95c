"""Rays through plane-parallel media: reach and optical path as functions of what all
media share, p = n sin θ.
"""

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from metalens.core.arrays import Array
from metalens.core.errors import PropagationError
from metalens.optics import paths
from metalens.optics.interpolant import horner

NEWTON = 14  # steps at most; each doubles the digits
Pairs = Sequence[
    tuple[float, Any]
]  # (index, thickness) of each medium; thicknesses may be arrays that broadcast


@dataclass(frozen=True, slots=True)
class Media:
    """Plane-parallel media between two planes: refractive indices and thicknesses, in
    the order that the light takes.

    Raises:
        PropagationError: no medium, an index below 1 or not finite, a thickness below
            0, no thickness at all.
    """

    index: tuple[float, ...]
    thickness_um: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.index) != len(self.thickness_um) or not self.index:
            raise PropagationError(
                f"{len(self.index)} indices for {len(self.thickness_um)} thicknesses of media"
            )
        if not all(math.isfinite(n) and n >= 1 for n in self.index):
            raise PropagationError(
                f"refractive indices {self.index}: need finite values of 1 or more"
            )
        if not all(t >= 0 for t in self.thickness_um) or not sum(self.thickness_um) > 0:
            raise PropagationError(
                f"thicknesses {self.thickness_um} um: need 0 or more each, and some thickness"
            )

    @property
    def layers(self) -> list[tuple[float, float]]:
        """(index, thickness) of every medium that has a thickness, equal indices
        together, the rarest first.
        """
        total: dict[float, float] = {}
        for n, t in zip(self.index, self.thickness_um, strict=True):
            if t > 0:
                total[n] = total.get(n, 0.0) + t
        return sorted(total.items())

    @property
    def order(self) -> tuple[float, ...]:
        """Indices in the order that the light meets them, the first whether or not it
        has a thickness.
        """
        some = zip(self.index[1:], self.thickness_um[1:], strict=True)
        return (self.index[0], *(n for n, t in some if t > 0))

    @property
    def reduced_um(self) -> float:
        """Σ t / n: the distance in air that bends paraxial light as much."""
        return sum(t / n for n, t in self.layers)


def lateral_reach(media: Media, p: Any) -> Any:
    """Lateral distance of a ray with n sin θ = p, um.

    Args:
        media: plane-parallel media.
    """
    return p * reach_per_direction(media.layers, p * p)


def relative_path(media: Media, p: Any) -> Any:
    """Optical path of that ray less the path along the normal, um, without
    cancellation.

    Args:
        media: plane-parallel media.
        p: n sin θ of the ray.
    """
    return sum(
        (
            n * t * p * p / (rest * (n + rest))
            for n, t, rest in _with_normals(media.layers, p * p)
        ),
        p * 0,
    )


def source_path(front: Pairs, x: Any, y: Any, tangents: Any, inverse: Any) -> Any:
    """Optical path from a source to (x, y), less its path to the lens centre, um; for a
    source at infinity too.

    Args:
        front: films that the light goes through, air apart. tangents: (x, y) of the ray
            to the lens centre, in air.
            inverse: 1 / depth, 1/um; operands broadcast.
    """
    if not front:
        return paths.source_path(x, y, tangents, inverse)
    tx, ty = tangents
    sine2 = (tx * tx + ty * ty) / (1 + tx * tx + ty * ty)
    cosine = (1 - sine2) ** 0.5
    thick = sum(t for _, t in front)
    pairs = [(1.0, 1 - thick * inverse), *((n, t * inverse) for n, t in front)]
    g = reach_per_direction(pairs, sine2)
    more = (x * x + y * y) * inverse + 2 * g * cosine * (x * tx + y * ty)
    return path_difference(pairs, sine2, sine2 * g * g, more, inverse)[1]


def area_spreading(media: Media, p: Any) -> Any:
    """Area on the plane per area of p: (reach / p) (d reach / d p), um².

    Args:
        media: plane-parallel media.
    """
    return area_spreading_of_square(media.layers, p * p)


def ray_direction(media: Media, reach_um: Any) -> Any:
    """p of the ray that reaches so far: the inverse of :func:`lateral_reach`, to rounding.

    Args:
        media: plane-parallel media.
        reach_um: lateral distance, um.
    """
    layers = media.layers
    w = solve_direction_square(layers, reach_um * reach_um)
    return reach_um / reach_per_direction(layers, w)


def path_of_reach(media: Media, reach_um: Any) -> Any:
    """Optical path of the ray that reaches so far, less the path along the normal, um.

    Args:
        media: plane-parallel media.
        reach_um: lateral distance, um.
    """
    return relative_path(media, ray_direction(media, reach_um))


def transmitted_power(order: Sequence[float], p: Any) -> Any:
    """Share of unpolarised power that passes the faces between media of indices
    ``order``, in a single pass.

    Args:
        p: n sin θ of the ray.
    """
    return passed_at(order, p * p)


def passed_at(order: Sequence[float], w: Any) -> Any:
    """As :func:`transmitted_power`, of w = p².

    Args:
        order: indices that the faces lie between.
    """
    s_power, p_power = passed_apart(order, w)
    return (s_power + p_power) / 2


def passed_apart(order: Sequence[float], w: Any) -> tuple[Any, Any]:
    """Shares of the power of s and of p light that pass the faces, of w = p² (Fresnel);
    0 beyond a critical angle.

    Args:
        order: indices that the faces lie between.
    """
    return _fresnel(order, w, lambda rest: (rest * (rest.real > 0)) ** 0.5)


def passed_on(order: Sequence[float], w: Any) -> tuple[Any, Any]:
    """As :func:`passed_apart` of complex w, without a cut: the analytic function that
    sums over plane waves need.

    Args:
        order: indices that the faces lie between.
    """
    return _fresnel(order, w, lambda rest: rest**0.5)


def _fresnel(
    order: Sequence[float], w: Any, cosine: Callable[[Any], Any]
) -> tuple[Any, Any]:
    s_power, p_power = w * 0 + 1, w * 0 + 1
    for a, b in itertools.pairwise(order):
        ca, cb = cosine(1 - w / a**2), cosine(1 - w / b**2)
        s_power = s_power * (1 - ((a * ca - b * cb) / (a * ca + b * cb)) ** 2)
        p_power = p_power * (1 - ((b * ca - a * cb) / (b * ca + a * cb)) ** 2)
    return s_power, p_power


def _with_normals(layers: Pairs, w: Any) -> list[tuple[float, Any, Any]]:
    """(n, t, √(n² - w)) of every medium."""
    return [(n, t, (n * n - w) ** 0.5) for n, t in layers]


def _sum(parts: Sequence[Any]) -> Any:
    total = parts[0]
    for part in parts[1:]:
        total = total + part
    return total


def reach_per_direction(layers: Pairs, w: Any) -> Any:
    """reach / p = Σ t / √(n² - w), w = p².

    Args:
        layers: (index, thickness) of each medium.
    """
    return _sum([t / rest for _, t, rest in _with_normals(layers, w)])


def area_spreading_of_square(layers: Pairs, w: Any) -> Any:
    """Area on the plane per area of p, as :func:`area_spreading`, of w = p².

    Args:
        layers: (index, thickness) of each medium.
    """
    along = _sum(
        [t * n * n / (rest * rest * rest) for n, t, rest in _with_normals(layers, w)]
    )
    return reach_per_direction(layers, w) * along


def whole_path(layers: Pairs, w: Any) -> Any:
    """Optical path Σ n² t / √(n² - w).

    Args:
        layers: (index, thickness) of each medium.
    """
    return _sum([n * n * t / rest for n, t, rest in _with_normals(layers, w)])


def solve_direction_square(layers: Pairs, reach2: Any, along2: Any = 0.0) -> Any:
    """w = p² of the ray with (w - along2) (reach / p)² = reach2, to rounding.

    Without ``along2`` that is the ray of this reach. With it, p² = along2 + q²: along2
    is known, and how far q reaches.

    Newton's method in S = tan² inside the rarest medium, where a single medium is
    linear.

    Args:
        layers: (index, thickness) of each medium.
    """
    if len(layers) == 1:
        ((n, t),) = layers
        return (along2 * t * t + reach2 * n * n) / (t * t + reach2)
    low2 = min(n for n, _ in layers) ** 2
    reach2 = reach2 + along2 * 0
    s = along2 / (low2 - along2) + reach2 * 0
    for _ in range(NEWTON):
        w = low2 * s / (1 + s)
        near = [(t, 1 / (n * n - w) ** 0.5) for n, t in layers]
        g = _sum([t * v for t, v in near])
        slope = _sum([t * (v * v * v) for t, v in near])
        rate = (g * g + (w - along2) * g * slope) * low2 / (1 + s) ** 2
        step = (reach2 - (w - along2) * g * g) / rate
        s = s + step
        if _largest(step) <= 2e-15 * _largest(s):
            break
    return low2 * s / (1 + s)


def _largest(values: Any) -> float:
    size = abs(values.detach() if hasattr(values, "detach") else values)
    return float(size.max()) if hasattr(size, "max") else float(size)


def path_difference(
    layers: Pairs, w0: Any, reach2: Any, more: Any, scale: Any = 1.0
) -> tuple[Any, Any]:
    """(w, path) of the ray whose reach² is ``reach2 + scale·more``: the path less that
    of the ray w0 of reach²
    ``reach2``, without cancellation.

    With thicknesses and reach scaled by v = 1/z, ``reach2`` by v², ``more`` by v and
    ``scale`` = v the path is that of
    the media themselves, for a source at infinity too.

    (w - w0)/v = more / (g² + w0 (g + g0) Σ t/(s s0 (s + s0))),  path = (w - w0)/v Σ t
    n²/(s s0 (s + s0)),
    g = Σ t/s, s = √(n² - w): difference of reach² = w g² over that of w.

    Args:
        layers: (index, thickness) of each medium.
    """
    w = solve_direction_square(layers, reach2 + scale * more)
    pairs = [(n, t, (n * n - w) ** 0.5, (n * n - w0) ** 0.5) for n, t in layers]
    g = _sum([t / s for _, t, s, _ in pairs])
    g0 = _sum([t / s0 for _, t, _, s0 in pairs])
    slope = _sum([t / (s * s0 * (s + s0)) for _, t, s, s0 in pairs])
    extra = more / (g * g + w0 * (g + g0) * slope)
    return w, extra * _sum([t * n * n / (s * s0 * (s + s0)) for n, t, s, s0 in pairs])


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
        return horner(self.real, u), horner(self.imaginary, u)

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
    or the mean of both.

    Args:
        behind: media from lens to sensor.
        reach_um: lateral distance, um.
    """
    layers = behind.layers
    rarest = layers[0][0]
    w = float(solve_direction_square(layers, reach_um * reach_um))
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
    turns = wavenumber * np.asarray(whole_path(behind.layers, w))
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
    missed = np.abs(horner(power, u) - want) / turns
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

    Args:
        behind: media from lens to sensor.
        wavenumber: in vacuum, rad/um.
        light: s, p or their mean.
    """
    layers, k = behind.layers, wavenumber
    w = np.asarray(w, float)[:, None, None]
    node, share = np.polynomial.hermite_e.hermegauss(count)
    p, g = np.sqrt(w), np.asarray(reach_per_direction(layers, w))
    along = np.asarray(area_spreading_of_square(layers, w)) / g
    turned = np.exp(-0.25j * np.pi)
    u = turned * node[:, None] / np.sqrt(k * along)
    v = turned * node / np.sqrt(k * g)
    more = 2 * p * u + u * u + v * v
    # p·ρ + Φ - L, its part linear in u taken off in every medium by itself
    path = p * u * g - sum(
        t * more / ((n * n - w) ** 0.5 + (n * n - w - more) ** 0.5) for n, t in layers
    )
    level = np.sqrt(
        _passed_of(behind.order, w + more, light) / _passed_of(behind.order, w, light)
    )
    wave = level * np.exp(1j * k * (path + (along * u * u + g * v * v) / 2))
    return np.asarray(
        np.einsum("nij,ij->n", wave, np.outer(share, share) / (2 * math.pi))
    )


def _passed_of(order: tuple[float, ...], w: Any, light: Light) -> Any:
    """Power of this light that the faces let through."""
    s_power, p_power = passed_on(order, w)
    return {"s": s_power, "p": p_power, "mean": (s_power + p_power) / 2}[light]
