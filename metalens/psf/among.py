"""Pillars among unlike neighbours: the factor C of solved rows
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
ROWS = 256  # of pillars at a time
_FLAT = 1e-8  # (rad/um)² below which a slope has no azimuth


class NeighbourJonesFactors(NamedTuple):
    """Complex factors on the field of every pillar, (…, y, x); yx is xy."""

    xx: Tensor
    yy: Tensor
    xy: Tensor


def phase_slopes(light: Tensor, pitch_um: float) -> tuple[Tensor, Tensor]:
    """(…, y, x) slopes along x and y of the phase of complex t, rad/um, from the pairs
    of pillars around each.

    Slopes up to π / pitch. 0 where no pair stands. Differentiable.

    Args:
        light: (..., y, x) irradiance.
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
    """Sum of the pairs around each pillar; there is one more pillar than pairs on the
    axis ``along``.
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
    """(…, y, x) complex: mean of C over both polarisations at every pillar of complex
    t.

    Args:
        light: (..., y, x) irradiance.
        neighbours: solved rows of non-identical pillars.
        pitch_um: lattice constant, um.
    """
    parts = []
    for inner, some in _shares(light):
        s, aside, _ = _turned(*phase_slopes(some, pitch_um), neighbours)
        parts.append(neighbours.of_both(s, aside)[..., inner, :])
    return torch.cat(parts, -2)


def apply_scalar_coupling(
    phase: Tensor, level: Tensor, neighbours: NeighbourRows, pitch_um: float
) -> tuple[Tensor, Tensor]:
    """(phase, transmission) of (…, y, x) maps times that mean.

    Args:
        level: transmission amplitude.
        neighbours: solved rows of non-identical pillars.
        pitch_um: lattice constant, um.
    """
    factor = mean_coupling(torch.polar(level, phase), neighbours, pitch_um)
    return phase + torch.angle(factor), level * factor.abs()


def apply_jones_coupling(
    phase: Tensor, level: Tensor, neighbours: NeighbourRows, pitch_um: float
) -> NeighbourJonesFactors:
    """J of (…, y, x) maps, complex.

    Args:
        phase: function of x and y, um, to phase, rad.
        level: transmission amplitude.
        neighbours: solved rows of non-identical pillars.
        pitch_um: lattice constant, um.
    """
    parts = []
    for inner, some in _shares(torch.polar(level, phase)):
        s, aside, (cosine2, both) = _turned(*phase_slopes(some, pitch_um), neighbours)
        along, across = (neighbours.of_field(field, s, aside) for field in (0, 1))
        apart = along - across
        found = across + apart * cosine2, along - apart * cosine2, apart * both
        parts.append([one[..., inner, :] for one in found])
    return NeighbourJonesFactors(
        *(torch.cat(one, -2) for one in zip(*parts, strict=True))
    )


def _shares(light: Tensor) -> list[tuple[slice, Tensor]]:
    """Rows of the map with those around them, and which of these count."""
    rows, shares = light.shape[-2], []
    for start in range(0, rows, ROWS):
        first = max(start - REACH - 1, 0)
        last = min(start + ROWS + REACH + 1, rows)
        shares.append(
            (
                slice(start - first, min(start + ROWS, rows) - first),
                light[..., first:last, :],
            )
        )
    return shares


def _turned(
    across: Tensor, down: Tensor, neighbours: NeighbourRows
) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor]]:
    """Sine by which light is turned, sin² 2α, and (cos² α, cos α sin α)."""
    square = across * across + down * down
    steep = square > _FLAT
    safe = torch.where(steep, square, torch.ones_like(square))
    s = torch.where(
        steep,
        torch.sqrt(safe) * (neighbours.wavelength_um / (2 * math.pi)),
        torch.zeros_like(square),
    )
    cosine2 = torch.where(steep, across * across / safe, 0.5)
    both = torch.where(steep, across * down / safe, 0.0)
    return s, 4 * both * both, (cosine2, both)
