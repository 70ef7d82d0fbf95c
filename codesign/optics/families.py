"""What is added to one hyperbolic focus: the rings of a double helix, and the terms of
phase that training moves.
"""

from typing import Literal

import torch
from torch import Tensor

Family = Literal["free", "radial"]


def double_helix_phase(x: Tensor, y: Tensor, zones: int) -> Tensor:
    """Vortices of order 1, 3, 5, ... in ``zones`` rings of equal area over the unit
    disc, rad, float64; zero for none.

    Args:
        x, y: places over the radius of the lens. zones: rings.
    """
    x, y = x + torch.zeros_like(y), y + torch.zeros_like(x)
    if not zones:
        return torch.zeros_like(x, dtype=torch.float64)
    ring = torch.ceil(zones * (x**2 + y**2)).clamp(1, zones)
    return (2 * ring - 1) * torch.atan2(y, x)


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
            wave = (cosine if m >= 0 else sine)[abs(m)]
            ring = (order - abs(m)) // 2
            found.append(rings[ring - 1] * wave if ring else wave)
        order += 1
    return found[:count]
