"""Rays through plane-parallel media: reach and optical path as functions of what all
media share, p = n sin θ.
"""

import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from metalens.core.arrays import Array
from metalens.core.errors import PropagationError
from metalens.optics import paths
from metalens.optics.interpolant import sum_powers

NEWTON = 14  # steps at most; each doubles the digits
Pairs = Sequence[
    tuple[float, Any]
]  # (index, thickness) of each medium; thicknesses may be arrays that broadcast


@dataclass(frozen=True, slots=True)
class Media:
    """Plane-parallel media between two planes: refractive indices and thicknesses, in
    the order that the light takes.

    Raises:
        PropagationError: an index below 1 or not finite, a thickness below 0, no
            thickness at all.
    """

    index: tuple[float, ...]
    thickness_um: tuple[float, ...]

    def __post_init__(self) -> None:
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
        """Σ t / n, um: the distance in air of equal paraxial refraction."""
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
            n * t * p * p / (normal * (n + normal))
            for n, t, normal in _with_normals(media.layers, p * p)
        ),
        p * 0,
    )


def source_path(front: Pairs, x: Any, y: Any, tangents: Any, inverse: Any) -> Any:
    """Optical path from a source to (x, y), less its path to the lens centre, um.

    It holds for a source at infinity too. All operands broadcast.

    Args:
        front: (index, thickness) of the films before the lens, without the air.
        x: place on the lens, um.
        y: place on the lens, um.
        tangents: (x, y) slopes in air of the ray to the lens centre.
        inverse: 1 / depth of the source, 1/um.
    """
    if not front:
        return paths.source_path(x, y, tangents, inverse)
    tx, ty = tangents
    sine2 = (tx * tx + ty * ty) / (1 + tx * tx + ty * ty)
    cosine = (1 - sine2) ** 0.5
    films_um = sum(t for _, t in front)
    pairs = [(1.0, 1 - films_um * inverse), *((n, t * inverse) for n, t in front)]
    reach_per_p = reach_per_direction(pairs, sine2)
    extra_reach2 = (x * x + y * y) * inverse + 2 * reach_per_p * cosine * (
        x * tx + y * ty
    )
    return path_difference(
        pairs, sine2, sine2 * reach_per_p * reach_per_p, extra_reach2, inverse
    )[1]


def ray_direction(media: Media, reach_um: Any) -> Any:
    """p of the ray of this reach: the inverse of :func:`lateral_reach`, to rounding.

    Args:
        media: plane-parallel media.
        reach_um: lateral distance, um.
    """
    layers = media.layers
    w = solve_direction_square(layers, reach_um * reach_um)
    return reach_um / reach_per_direction(layers, w)


def passed_at(order: Sequence[float], w: Any) -> Any:
    """Share of unpolarised power that passes the faces between media, in a single pass.

    Args:
        order: indices of the media in the order that the light meets them.
        w: p², where p = n sin θ.
    """
    s_power, p_power = fresnel_powers(order, w)
    return (s_power + p_power) / 2


def fresnel_powers(
    order: Sequence[float], w: Any, *, analytic: bool = False
) -> tuple[Any, Any]:
    """Fresnel transmittances of s and of p power, multiplied over all faces.

    Args:
        order: indices of the media in the order that the light meets them.
        w: p², where p = n sin θ.
        analytic: the function of complex w that sums over plane waves need; else 0
            beyond a critical angle.
    """
    s_power = w * 0 + 1
    p_power = w * 0 + 1
    for a, b in itertools.pairwise(order):
        squares: tuple[Any, ...] = (1 - w / a**2, 1 - w / b**2)
        if not analytic:
            squares = tuple(square * (square.real > 0) for square in squares)
        ca, cb = (square**0.5 for square in squares)
        s_power = s_power * (1 - ((a * ca - b * cb) / (a * ca + b * cb)) ** 2)
        p_power = p_power * (1 - ((b * ca - a * cb) / (b * ca + a * cb)) ** 2)
    return s_power, p_power


def _with_normals(layers: Pairs, w: Any) -> list[tuple[float, Any, Any]]:
    """(n, t, √(n² - w)) of every medium."""
    return [(n, t, (n * n - w) ** 0.5) for n, t in layers]


def reach_per_direction(layers: Pairs, w: Any) -> Any:
    """reach / p = Σ t / √(n² - w), w = p².

    Args:
        layers: (index, thickness) of each medium.
    """
    return sum([t / normal for _, t, normal in _with_normals(layers, w)])


def area_spreading(layers: Pairs, w: Any) -> Any:
    """Area on the plane per area of p, (reach / p) (d reach / d p), um², of w = p².

    (Σ t / s) (Σ t n² / s³) with s = √(n² - w).

    Args:
        layers: (index, thickness) of each medium.
    """
    reach_slope = sum(
        [
            t * n * n / (normal * normal * normal)
            for n, t, normal in _with_normals(layers, w)
        ]
    )
    return reach_per_direction(layers, w) * reach_slope


def whole_path(layers: Pairs, w: Any) -> Any:
    """Optical path Σ n² t / √(n² - w), um, of the ray of w = p².

    Args:
        layers: (index, thickness) of each medium.
    """
    return sum([n * n * t / normal for n, t, normal in _with_normals(layers, w)])


def solve_direction_square(layers: Pairs, reach2: Any, along2: Any = 0.0) -> Any:
    """w = p² of the ray with (w - along2) (reach / p)² = reach2, to rounding.

    Without ``along2`` that is the ray of this reach. With it, p² = along2 + q², and
    reach2 is the squared reach along q alone.

    Newton's method solves for S = tan² θ in the rarest medium, in which a single medium
    is linear. A single medium has the closed form.

    Args:
        layers: (index, thickness) of each medium, um.
        reach2: squared lateral distance, um².
        along2: squared component of p that is fixed.
    """
    if len(layers) == 1:
        ((n, t),) = layers
        return (along2 * t * t + reach2 * n * n) / (t * t + reach2)
    low2 = min(n for n, _ in layers) ** 2
    reach2 = reach2 + along2 * 0
    tan2 = along2 / (low2 - along2) + reach2 * 0
    for _ in range(NEWTON):
        w = low2 * tan2 / (1 + tan2)
        inverse_normals = [(t, 1 / (n * n - w) ** 0.5) for n, t in layers]
        reach_per_p = sum([t * v for t, v in inverse_normals])
        slope = sum([t * (v * v * v) for t, v in inverse_normals])
        rate = (
            (reach_per_p * reach_per_p + (w - along2) * reach_per_p * slope)
            * low2
            / (1 + tan2) ** 2
        )
        step = (reach2 - (w - along2) * reach_per_p * reach_per_p) / rate
        tan2 = tan2 + step
        if _largest(step) <= 2e-15 * _largest(tan2):
            break
    return low2 * tan2 / (1 + tan2)


def _largest(values: Any) -> float:
    size = abs(values.detach() if hasattr(values, "detach") else values)
    return float(size.max()) if hasattr(size, "max") else float(size)


def path_difference(
    layers: Pairs, w0: Any, reach2: Any, more: Any, scale: Any = 1.0
) -> tuple[Any, Any]:
    """(w, path) of the ray of reach² = ``reach2 + scale·more``, without cancellation.

    The path, in um, is less that of the ray w0, whose reach² is ``reach2``:

        path = δ Σ t n² / (s s0 (s + s0))
        δ = (w - w0) / scale = more / (g² + w0 (g + g0) Σ t / (s s0 (s + s0)))

    with s = √(n² - w) and g = Σ t/s = reach / p; s0 and g0 are those of w0.

    A source at z, or at infinity, has ``scale`` = v = 1/z. Thicknesses are then times
    v, ``reach2`` times v², and ``more`` times v.

    Args:
        layers: (index, thickness) of each medium.
        w0: p² of the reference ray.
        reach2: squared reach of the reference ray.
        more: difference of the squared reaches over ``scale``.
        scale: 1 for plain thicknesses in um.
    """
    w = solve_direction_square(layers, reach2 + scale * more)
    pairs = [(n, t, (n * n - w) ** 0.5, (n * n - w0) ** 0.5) for n, t in layers]
    g = sum([t / s for _, t, s, _ in pairs])
    g0 = sum([t / s0 for _, t, _, s0 in pairs])
    slope = sum([t / (s * s0 * (s + s0)) for _, t, s, s0 in pairs])
    w_change = more / (g * g + w0 * (g + g0) * slope)
    return w, w_change * sum([t * n * n / (s * s0 * (s + s0)) for n, t, s, s0 in pairs])


# nodes along u and along v; each ray takes the number that differs least from fewer
WAVES = (6, 8, 12, 16, 20, 24, 28)
DEGREES = 24  # of the series in s, before terms below rounding are cut off
ROUNDING = 1e-14  # of the amplitude
STEEPEST = 0.9999  # of a ray, in units of the rarest index that the light meets


@dataclass(frozen=True, eq=False, slots=True)
class SaddleCorrection:
    """C as a power series in (s - middle) / half: real and imaginary coefficients,
    lowest first.

    rarest: index n in s = √(n² - p²).
    normal, left: (n,) values of s, ascending, and the relative error of the amplitude
        at each, estimated with fewer plane waves.
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
        return sum_powers(self.real, u), sum_powers(self.imaginary, u)

    def error(self, w: Array) -> Array:
        """Relative error of the amplitude of rays of w = p²."""
        s = np.sqrt(np.maximum(self.rarest * self.rarest - w, 0.0))
        return np.asarray(
            np.exp(
                np.interp(s, self.normal, np.log(np.maximum(self.left, ROUNDING**2)))
            )
        )


def saddle_correction(
    behind: Media, wavenumber: float, reach_um: float
) -> SaddleCorrection:
    """Correction C of the stationary-phase amplitude, for all rays up to this reach.

    The amplitude of a ray is that of geometric optics times 1 + iC/(kL), where L is its
    optical path.

    Args:
        behind: media from lens to sensor.
        wavenumber: in vacuum, rad/um.
        reach_um: largest lateral distance, um.
    """
    layers = behind.layers
    rarest = layers[0][0]
    w = float(solve_direction_square(layers, reach_um * reach_um))
    tan2 = max(w / max(rarest * rarest - w, 1e-300), 2.0**-6)
    # rounded up, so that windows of similar rays share a cached series
    tan2 = 2.0 ** (math.ceil(4 * math.log2(tan2)) / 4)
    grazing = (STEEPEST * min(behind.order)) ** 2
    largest_w = min(rarest * rarest * tan2 / (1 + tan2), grazing)
    return _saddle(behind, wavenumber, largest_w)


@functools.lru_cache(maxsize=64)
def _saddle(behind: Media, wavenumber: float, most: float) -> SaddleCorrection:
    """Power series of C in the normal component s, for rays of w = p² up to ``most``.

    A Chebyshev fit to (mean - 1) k L / i at ``2 DEGREES`` nodes of s = √(n² - w), its
    coefficients below rounding cut off. One medium needs no correction: C = 0.

    Args:
        behind: media from lens to sensor.
        wavenumber: in vacuum, rad/um.
        most: largest p² of the rays.
    """
    rarest = behind.layers[0][0]
    ends = math.sqrt(rarest * rarest - most), rarest
    middle = sum(ends) / 2
    half = (ends[1] - ends[0]) / 2
    if len(set(behind.order)) == 1:
        one = np.ones(1)
        zero = np.zeros(1)
        return SaddleCorrection(
            rarest, middle, half, one, zero, np.array([rarest]), zero
        )
    u = np.cos(np.pi * (np.arange(2 * DEGREES) + 0.5) / (2 * DEGREES))
    w = rarest * rarest - (middle + half * u) ** 2
    path_rad = wavenumber * np.asarray(whole_path(behind.layers, w))
    mean, difference = _best_corrections(behind, wavenumber, w)
    samples = (mean - 1) * path_rad / 1j
    # the weights keep uncertain grazing rays from bending the series; full=True
    # silences the warning about its rank
    series, _ = np.polynomial.chebyshev.chebfit(
        u, samples, DEGREES - 1, w=1 / (path_rad * (difference + ROUNDING)), full=True
    )
    above = np.flatnonzero(np.abs(series) > ROUNDING * path_rad.min())
    count = int(above[-1]) + 1 if len(above) else 1
    power = np.polynomial.chebyshev.cheb2poly(series[:count])
    misfit = np.abs(sum_powers(power, u) - samples) / path_rad
    return SaddleCorrection(
        rarest,
        middle,
        half,
        np.ascontiguousarray(power.real),
        np.ascontiguousarray(power.imag),
        (middle + half * u)[::-1],
        np.maximum(difference, misfit)[::-1],
    )


def _best_corrections(
    behind: Media, wavenumber: float, w: Array
) -> tuple[Array, Array]:
    """(n,) corrections 1 + iC/(kL) of each ray, and (n,) estimates of their error.

    :func:`plane_wave_correction` is computed with every number of nodes in ``WAVES``.
    Each ray takes the number whose difference from the next smaller number is least.
    Steep rays through thin films converge at first, then diverge again.

    Args:
        behind: media from lens to sensor.
        wavenumber: in vacuum, rad/um.
        w: (n,) p² of the rays.
    """
    corrections = np.stack(
        [plane_wave_correction(behind, wavenumber, w, count) for count in WAVES]
    )
    differences = np.abs(np.diff(corrections, axis=0))
    best = np.argmin(differences, axis=0)
    ray = np.arange(len(w))
    return corrections[best + 1, ray], differences[best, ray]


def plane_wave_correction(
    behind: Media, wavenumber: float, w: Array, count: int = WAVES[-1]
) -> Array:
    """(n,) amplitude factor 1 + iC/(kL) of rays by Gauss-Hermite quadrature.

    The plane waves near each ray's stationary point are summed with the exact phase and
    Fresnel amplitude, over the same sum with the quadratic phase and the ray's own
    amplitude. The nodes lie on the path of steepest descent.

    Args:
        behind: media from lens to sensor.
        wavenumber: k in vacuum, rad/um.
        w: (n,) p² of the rays, p = n sin θ.
        count: plane waves along each of two axes.
    """
    layers = behind.layers
    k = wavenumber
    w = np.asarray(w, float)[:, None, None]
    node, node_weight = np.polynomial.hermite_e.hermegauss(count)
    p = np.sqrt(w)
    g = np.asarray(reach_per_direction(layers, w))
    reach_slope = np.asarray(area_spreading(layers, w)) / g
    rotation = np.exp(-0.25j * np.pi)
    u = rotation * node[:, None] / np.sqrt(k * reach_slope)
    v = rotation * node / np.sqrt(k * g)
    w_change = 2 * p * u + u * u + v * v
    # p·ρ + Φ - L, its part linear in u taken off in every medium by itself
    path = p * u * g - sum(
        t * w_change / ((n * n - w) ** 0.5 + (n * n - w - w_change) ** 0.5)
        for n, t in layers
    )
    level = np.sqrt(
        sum(fresnel_powers(behind.order, w + w_change, analytic=True))
        / sum(fresnel_powers(behind.order, w, analytic=True))
    )
    wave = level * np.exp(1j * k * (path + (reach_slope * u * u + g * v * v) / 2))
    return np.asarray(
        np.einsum("nij,ij->n", wave, np.outer(node_weight, node_weight) / (2 * math.pi))
    )
