"""Rays through plane-parallel media: reach and optical path as functions of what all
media share, p = n sin θ.

    reach(p) = Σ t_i p / √(n_i² - p²)          lateral distance that a ray gains (Snell)
    path(p)  = Σ n_i t_i (n_i / √(n_i² - p²) - 1)    optical path less that along the normal
    d path / d reach = p                       (Fermat): the phase on a plane moves by k p for every um

The order of the media does not matter to either. Numbers, numpy arrays and torch
tensors alike; complex arrays too, for
derivatives by complex steps. Squares (w = p², reach²) are used where a root would have
no derivative at the axis.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from metalens.core import paths
from metalens.core.errors import PropagationError

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


def reach(media: Media, p: Any) -> Any:
    """Lateral distance of a ray with n sin θ = p, um."""
    return p * bend(media.layers, p * p)


def path(media: Media, p: Any) -> Any:
    """Optical path of that ray less the path along the normal, um, without
    cancellation.
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
    g = bend(pairs, sine2)
    more = (x * x + y * y) * inverse + 2 * g * cosine * (x * tx + y * ty)
    return longer(pairs, sine2, sine2 * g * g, more, inverse)[1]


def spread(media: Media, p: Any) -> Any:
    """Area on the plane per area of p: (reach / p) (d reach / d p), um²."""
    return widening(media.layers, p * p)


def direction(media: Media, reach_um: Any) -> Any:
    """p of the ray that reaches so far: the inverse of :func:`reach`, to rounding."""
    layers = media.layers
    w = square(layers, reach_um * reach_um)
    return reach_um / bend(layers, w)


def chord(media: Media, reach_um: Any) -> Any:
    """Optical path of the ray that reaches so far, less the path along the normal, um."""
    return path(media, direction(media, reach_um))


def passed(order: Sequence[float], p: Any) -> Any:
    """Share of unpolarised power that passes the faces between media of indices
    ``order``, in a single pass.
    """
    return passed_at(order, p * p)


def passed_at(order: Sequence[float], w: Any) -> Any:
    """As :func:`passed`, of w = p²."""
    s_power, p_power = passed_apart(order, w)
    return (s_power + p_power) / 2


def passed_apart(order: Sequence[float], w: Any) -> tuple[Any, Any]:
    """Shares of the power of s and of p light that pass the faces, of w = p² (Fresnel);
    0 beyond a critical angle.
    """
    return _fresnel(order, w, lambda rest: (rest * (rest.real > 0)) ** 0.5)


def passed_on(order: Sequence[float], w: Any) -> tuple[Any, Any]:
    """As :func:`passed_apart` of complex w, without a cut: the analytic function that
    sums over plane waves need.
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


def bend(layers: Pairs, w: Any) -> Any:
    """reach / p = Σ t / √(n² - w), w = p²."""
    return _sum([t / rest for _, t, rest in _with_normals(layers, w)])


def widening(layers: Pairs, w: Any) -> Any:
    """Area on the plane per area of p, as :func:`spread`, of w = p²."""
    along = _sum(
        [t * n * n / (rest * rest * rest) for n, t, rest in _with_normals(layers, w)]
    )
    return bend(layers, w) * along


def whole_path(layers: Pairs, w: Any) -> Any:
    """Optical path Σ n² t / √(n² - w)."""
    return _sum([n * n * t / rest for n, t, rest in _with_normals(layers, w)])


def square(layers: Pairs, reach2: Any, along2: Any = 0.0) -> Any:
    """w = p² of the ray with (w - along2) (reach / p)² = reach2, to rounding.

    Without ``along2`` that is the ray of this reach. With it, p² = along2 + q²: along2
    is known, and how far q reaches.

    Newton's method in S = tan² inside the rarest medium, where a single medium is
    linear.
    """
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


def longer(
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
    """
    w = square(layers, reach2 + scale * more)
    pairs = [(n, t, (n * n - w) ** 0.5, (n * n - w0) ** 0.5) for n, t in layers]
    g, g0 = (
        _sum([t / s for _, t, s, _ in pairs]),
        _sum([t / s0 for _, t, _, s0 in pairs]),
    )
    slope = _sum([t / (s * s0 * (s + s0)) for _, t, s, s0 in pairs])
    extra = more / (g * g + w0 * (g + g0) * slope)
    return w, extra * _sum([t * n * n / (s * s0 * (s + s0)) for n, t, s, s0 in pairs])
