"""What is added to one hyperbolic focus: the rings of a double helix, and the terms of
phase that training moves.
"""

from typing import Literal

import torch
from torch import Tensor

Family = Literal["free", "radial"]


def double_helix_phase(x: Tensor, y: Tensor, zones: int) -> Tensor:
    """Phase of a double helix over the unit disc, rad, float64; zero for no zones.

    Vortices (2 k - 1) theta in k = 1 … ``zones`` rings of equal area.

    Args:
        x, y: coordinates over the radius of the lens. zones: rings.
    """
    x, y = x + torch.zeros_like(y), y + torch.zeros_like(x)
    if not zones:
        return torch.zeros_like(x, dtype=torch.float64)
    ring = torch.ceil(zones * (x**2 + y**2)).clamp(1, zones)
    return (2 * ring - 1) * torch.atan2(y, x)


def phase_terms(x: Tensor, y: Tensor, count: int, family: Family) -> list[Tensor]:
    """The first ``count`` polynomial phase terms over the unit disc, not orthogonal.

    free: rho^n cos(m theta), rho^n sin(m theta) for n = 2, 3, …, |m| <= n of the parity
    of n. radial: rho^2, rho^4, …

    Args:
        x, y: coordinates over the radius of the lens. count: of terms.
        family: "free" or "radial".
    """
    square = x**2 + y**2
    # by recurrence: products of x and y cost a tenth of powers and cosines
    radial_powers = [square]  # rho^2, rho^4, …
    cosine = [torch.ones_like(square), x]  # rho^m cos(m theta)
    sine = [torch.zeros_like(square), y]  # rho^m sin(m theta)
    if family == "radial":
        while len(radial_powers) < count:
            radial_powers.append(radial_powers[-1] * square)
        return radial_powers[:count]
    terms: list[Tensor] = []
    order = 2
    while len(terms) < count:
        cosine.append(cosine[-1] * x - sine[-1] * y)
        sine.append(sine[-1] * x + cosine[-2] * y)
        radial_powers.append(radial_powers[-1] * square)
        for m in range(-order, order + 1, 2):
            wave = (cosine if m >= 0 else sine)[abs(m)]
            index = (order - abs(m)) // 2
            terms.append(radial_powers[index - 1] * wave if index else wave)
        order += 1
    return terms[:count]
