"""Families of lenses that training starts from: what is added to one hyperbolic focus,
and the terms that move.
"""

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from metalens.core.errors import ConfigError
from metalens.design import Focus

Family = Literal["free", "radial"]


@dataclass(frozen=True, slots=True)
class StartingPhase:
    """A fixed phase on top of a hyperbolic focus.

    zones: rings of a double helix. parts: sectors; apart_um: diameter of the circle
    that their images lie on.
    foci_um: source distance of each ring; none for one focus.
    """

    focus: Focus
    radius_um: float
    zones: int = 0
    parts: int = 1
    apart_um: float = 0.0
    foci_um: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if (
            self.zones < 0
            or self.parts < 1
            or not self.apart_um >= 0
            or any(not f > 0 for f in self.foci_um)
        ):
            raise ConfigError(
                f"zones = {self.zones}, parts = {self.parts}, apart_um = {self.apart_um}, foci = {self.foci_um} um: "
                "need zones of 0 or more, 1 part or more, a distance of 0 or more, and foci above 0"
            )

    def phase_rad(self, x_um: Tensor, y_um: Tensor) -> Tensor:
        """The phase at any places of the lens, float64.

        Args:
            x_um: x on the lens. y_um: y on the lens.
        """
        x, y = x_um + torch.zeros_like(y_um), y_um + torch.zeros_like(x_um)
        total = torch.zeros_like(x, dtype=torch.float64)
        if not (self.zones or self.foci_um or (self.parts > 1 and self.apart_um)):
            return total
        share = (x**2 + y**2) / self.radius_um**2  # of the aperture's area within
        if self.zones:
            ring = torch.ceil(self.zones * share).clamp(1, self.zones)
            total = total + (2 * ring - 1) * torch.atan2(y, x)
        if self.parts > 1 and self.apart_um:
            total = total + self._split(x, y)
        if self.foci_um:
            total = total + self._refocused(x**2 + y**2, share)
        return total

    def _split(self, x: Tensor, y: Tensor) -> Tensor:
        """k (s/2) (cos θ_i x + sin θ_i y) / d in sector i, θ_i the sector's middle:
        light goes that way by s/2.
        """
        sector = torch.floor(
            torch.remainder(torch.atan2(y, x) / (2 * math.pi) + 0.5 / self.parts, 1)
            * self.parts
        )
        way = sector * (2 * math.pi / self.parts)
        k = 2 * math.pi / self.focus.wavelength_um
        slope = k * self.apart_um / 2 / self.focus.sensor_distance_um
        return slope * (torch.cos(way) * x + torch.sin(way) * y)

    def _refocused(self, r2: Tensor, share: Tensor) -> Tensor:
        """Phase of each ring's own source distance less that of the common one."""
        ring = (
            torch.floor(share * len(self.foci_um))
            .clamp(0, len(self.foci_um) - 1)
            .long()
        )
        own = torch.tensor(self.foci_um, dtype=torch.float64, device=ring.device)[ring]
        k, s = 2 * math.pi / self.focus.wavelength_um, self.focus.source_distance_um

        def path(distance: Tensor | float) -> Tensor:
            whole: Tensor = r2 / (torch.sqrt(r2 + distance**2) + distance)
            return whole

        return -k * (path(own) - path(s))


def phase_terms(x: Tensor, y: Tensor, count: int, family: Family) -> list[Tensor]:
    """The first ``count`` terms over the unit disc, where x and y lie.

    free: rho^n cos(m theta), rho^n sin(m theta) for n = 2, 3, …, |m| <= n of the parity
    of n. radial: rho^2, rho^4, …

    Args:
        family: "free" or "radial".
    """
    square = x**2 + y**2
    rings = [
        square
    ]  # rho^2, rho^4, …; products of x and y cost a tenth of powers and cosines
    cosine, sine = (
        [torch.ones_like(square), x],
        [torch.zeros_like(square), y],
    )  # rho^m cos(m theta), rho^m sin(m theta)
    if family == "radial":
        while len(rings) < count:
            rings.append(rings[-1] * square)
        return rings[:count]
    found: list[Tensor] = []
    order = 2
    while len(found) < count:
        cosine.append(cosine[-1] * x - sine[-1] * y)
        sine.append(sine[-1] * x + cosine[-2] * y)
        rings.append(rings[-1] * square)
        for m in range(-order, order + 1, 2):
            wave, ring = (cosine if m >= 0 else sine)[abs(m)], (order - abs(m)) // 2
            found.append(rings[ring - 1] * wave if ring else wave)
        order += 1
    return found[:count]
