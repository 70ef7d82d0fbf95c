"""Rays through plane-parallel media: reach and optical path as functions of what all media share, p = n sin θ.

    reach(p) = Σ t_i p / √(n_i² - p²)          lateral distance that a ray gains (Snell)
    path(p)  = Σ n_i t_i (n_i / √(n_i² - p²) - 1)    optical path less that along the normal
    d path / d reach = p                       (Fermat): the phase on a plane moves by k p for every um

The order of the media does not matter to either. All in float64; one medium has closed forms, several take Newton.
"""

import itertools
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from metalens.ground.errors import PropagationError

NEWTON = 12  # steps at most; each doubles the digits


@dataclass(frozen=True, slots=True)
class Media:
    """Plane-parallel media between two planes: refractive indices and thicknesses, in any order.

    Raises:
        PropagationError: no medium, an index below 1 or not finite, a thickness below 0, no thickness at all.
    """

    index: tuple[float, ...]
    thickness_um: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.index) != len(self.thickness_um) or not self.index:
            raise PropagationError(f"{len(self.index)} indices for {len(self.thickness_um)} thicknesses of media")
        if not all(math.isfinite(n) and n >= 1 for n in self.index):
            raise PropagationError(f"refractive indices {self.index}: need finite values of 1 or more")
        if not all(t >= 0 for t in self.thickness_um) or not sum(self.thickness_um) > 0:
            raise PropagationError(f"thicknesses {self.thickness_um} um: need 0 or more each, and some thickness")

    @property
    def layers(self) -> list[tuple[float, float]]:
        """(index, thickness) of every medium that has a thickness, equal indices together."""
        total: dict[float, float] = {}
        for n, t in zip(self.index, self.thickness_um, strict=True):
            if t > 0:
                total[n] = total.get(n, 0.0) + t
        return sorted(total.items())

    @property
    def reduced_um(self) -> float:
        """Σ t / n: the distance in air that bends paraxial light as much."""
        return sum(t / n for n, t in self.layers)


def reach(media: Media, p: Tensor) -> Tensor:
    """Lateral distance of a ray with n sin θ = p, um."""
    return torch.stack([t * p / torch.sqrt(n * n - p * p) for n, t in media.layers]).sum(0)


def path(media: Media, p: Tensor) -> Tensor:
    """Optical path of that ray less the path along the normal, um, without cancellation."""
    total = torch.zeros_like(p)
    for n, t in media.layers:
        rest = torch.sqrt(n * n - p * p)
        total = total + n * t * p * p / (rest * (n + rest))
    return total


def spread(media: Media, p: Tensor) -> Tensor:
    """Area on the plane per area of p: (reach / p) (d reach / d p), um²."""
    across = torch.stack([t / torch.sqrt(n * n - p * p) for n, t in media.layers]).sum(0)
    along = torch.stack([t * n * n / (n * n - p * p) ** 1.5 for n, t in media.layers]).sum(0)
    return across * along


def direction(media: Media, reach_um: Tensor) -> Tensor:
    """p of the ray that reaches so far: the inverse of :func:`reach`, to rounding.

    In the tangent s inside the rarest medium the reach is concave: Newton climbs to the root from below.
    """
    layers = media.layers
    low = layers[0][0]
    if len(layers) == 1:
        return low * reach_um / torch.hypot(reach_um, torch.full_like(reach_um, layers[0][1]))
    s = reach_um / sum(t * low / n for n, t in layers)
    for _ in range(NEWTON):
        p = low * s / torch.sqrt(1 + s * s)
        slope = torch.stack([t * n * n / (n * n - p * p) ** 1.5 for n, t in layers]).sum(0) * low * (1 + s * s) ** -1.5
        step = (reach_um - reach(media, p)) / slope
        s = s + step
        if float(step.abs().max()) <= 1e-14 * float(s.abs().max()):
            break
    return low * s / torch.sqrt(1 + s * s)


def chord(media: Media, reach_um: Tensor) -> Tensor:
    """Optical path of the ray that reaches so far, less the path along the normal, um."""
    return path(media, direction(media, reach_um))


def passed(order: tuple[float, ...], p: Tensor) -> Tensor:
    """Share of unpolarised power that passes the faces between media of indices ``order``, in a single pass."""
    s_power, p_power = torch.ones_like(p), torch.ones_like(p)
    for a, b in itertools.pairwise(order):
        ca, cb = torch.sqrt(1 - (p / a) ** 2), torch.sqrt(1 - (p / b) ** 2)
        s_power = s_power * (1 - ((a * ca - b * cb) / (a * ca + b * cb)) ** 2)
        p_power = p_power * (1 - ((b * ca - a * cb) / (b * ca + a * cb)) ** 2)
    return (s_power + p_power) / 2
