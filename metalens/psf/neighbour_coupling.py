"""Pillars among non-identical neighbours: the factor C of solved rows
(:class:`metalens.lens.NeighbourRows`) on a lens's maps.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from metalens.lens import NeighbourRows

# pillars to each side over which phasors are averaged: single pillars err, slopes of
# lenses hardly change
REACH = 2
_FLAT = 1e-8  # (rad/um)² below which a slope has no azimuth


class NeighbourJonesFactors(NamedTuple):
    """Complex factors on the field of every pillar, (…, y, x); yx is xy."""

    xx: Tensor
    yy: Tensor
    xy: Tensor


def phase_slopes(light: Tensor, pitch_um: float) -> tuple[Tensor, Tensor]:
    """(…, y, x) slopes along x and along y of the phase of complex t, rad/um.

    The angle of Σ t_{i+1} t_i* over pairs of neighbours around each pillar, over the
    pitch: slopes up to π / pitch, 0 where there is no pair. Differentiable.

    Args:
        light: (…, y, x) complex transmission t of every pillar.
        pitch_um: lattice constant, um.
    """
    slopes = []
    for axis in (-1, -2):
        count = light.shape[axis]
        if count < 2:
            slopes.append(torch.zeros_like(light.real))
            continue
        pairs = (
            light.narrow(axis, 1, count - 1) * light.narrow(axis, 0, count - 1).conj()
        )
        around = _around(pairs, along=axis)
        paired = around.abs() > 0
        turn = torch.angle(torch.where(paired, around, torch.ones_like(around)))
        slopes.append(turn / pitch_um)
    return slopes[0], slopes[1]


def _around(pairs: Tensor, *, along: int) -> Tensor:
    """(…, y, x) sum of the pairs within ``REACH`` pillars of each pillar.

    Args:
        pairs: (…, y, x) products of neighbours, one fewer than pillars on one axis.
        along: that axis, -1 or -2.
    """
    for axis in (-1, -2):
        wide = 2 * REACH + (axis != along)
        padded = torch.nn.functional.pad(
            pairs, (REACH, REACH) if axis == -1 else (0, 0, REACH, REACH)
        )
        count = padded.shape[axis] - wide + 1
        pairs = padded.narrow(axis, 0, count)
        for k in range(1, wide):
            pairs = pairs + padded.narrow(axis, k, count)
    return pairs


def mean_coupling(light: Tensor, neighbours: NeighbourRows, pitch_um: float) -> Tensor:
    """(…, y, x) complex coupling C of every pillar, the mean over both polarisations.

    Args:
        light: (…, y, x) complex transmission t.
        neighbours: solved rows of non-identical pillars.
        pitch_um: lattice constant, um.
    """
    s, sine2, _ = _turned(*phase_slopes(light, pitch_um), neighbours)
    coupling: Tensor = neighbours.of_both(s, sine2)
    return coupling


def apply_scalar_coupling(
    phase: Tensor, level: Tensor, neighbours: NeighbourRows, pitch_um: float
) -> tuple[Tensor, Tensor]:
    """(…, y, x) phase and transmission of maps times :func:`mean_coupling`.

    Args:
        phase: (…, y, x) phase, rad.
        level: (…, y, x) transmission amplitude.
        neighbours: solved rows of non-identical pillars.
        pitch_um: lattice constant, um.
    """
    factor = mean_coupling(torch.polar(level, phase), neighbours, pitch_um)
    return phase + torch.angle(factor), level * factor.abs()


def apply_jones_coupling(
    phase: Tensor, level: Tensor, neighbours: NeighbourRows, pitch_um: float
) -> NeighbourJonesFactors:
    """(…, y, x) complex Jones factors of the coupling of neighbours.

    With C_a along the slope, C_b across it, and α its azimuth: xx = C_b + (C_a - C_b)
    cos² α, yy = C_a - (C_a - C_b) cos² α, xy = (C_a - C_b) cos α sin α.

    Args:
        phase: (…, y, x) phase, rad.
        level: (…, y, x) transmission amplitude.
        neighbours: solved rows of non-identical pillars.
        pitch_um: lattice constant, um.
    """
    slopes = phase_slopes(torch.polar(level, phase), pitch_um)
    s, sine2, (cosine2, both) = _turned(*slopes, neighbours)
    along, across = (neighbours.of_field(field, s, sine2) for field in (0, 1))
    change = along - across
    return NeighbourJonesFactors(
        across + change * cosine2, along - change * cosine2, change * both
    )


def _turned(
    slope_x: Tensor, slope_y: Tensor, neighbours: NeighbourRows
) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor]]:
    """Sine of the deflection, sin² 2α, and (cos² α, cos α sin α), α its azimuth.

    Args:
        slope_x: (…, y, x) slope of the phase along x, rad/um.
        slope_y: the same along y.
        neighbours: with the wavelength.
    """
    slope2 = slope_x * slope_x + slope_y * slope_y
    steep = slope2 > _FLAT
    safe = torch.where(steep, slope2, torch.ones_like(slope2))
    s = torch.where(
        steep,
        torch.sqrt(safe) * (neighbours.wavelength_um / (2 * math.pi)),
        torch.zeros_like(slope2),
    )
    cosine2 = torch.where(steep, slope_x * slope_x / safe, 0.5)
    both = torch.where(steep, slope_x * slope_y / safe, 0.0)
    return s, 4 * both * both, (cosine2, both)
