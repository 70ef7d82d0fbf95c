"""Both polarisations: Ex, Ey, Ez of light whose rays the lens turns, each propagated as a scalar.

A ray of direction a, polarised along e, leaves a pillar in direction b for the window: its field is turned with it,
R e = e - (a + b)(b·e)/(1 + a·b), and |E|² cos θ is kept: E = t R e / √b_z (Richards and Wolf 1959, for the two
polarisations of the source). The direction is that to the window's centre. Intensity is |Ex|² + |Ey|² + |Ez|², the mean
of both polarisations.
"""

import math
from collections.abc import Sequence

import torch

from metalens.propagate import Case, cosines


def components(case: Case) -> torch.Tensor:
    """(2 polarisations x 3 components, y, x) real factors on the transmission of every pillar, float64."""
    y, x = case.pillars_um
    across, down = x[None, :] - case.centre_um[0], (y - case.centre_um[1])[:, None]
    last = 1.0 if case.behind is None else case.behind.order[-1]
    p, q = (torch.as_tensor(-cosines(case, *at) / last) for at in ((across, down), (down, across)))
    b = torch.stack([p, q, torch.sqrt(1 - p * p - q * q)])
    steep = math.sqrt(1 + case.tangents[0] ** 2 + case.tangents[1] ** 2)
    a = torch.tensor([case.tangents[0] / steep, case.tangents[1] / steep, 1 / steep], dtype=torch.float64)
    return turned(a, b)


def turned(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """(2 polarisations x 3 components, …) of light of amplitude 1 that a lens turns from the direction a to b.

    Args:
        a: (3,) unit vector of the light that comes. b: (3, …) of the rays that leave, both towards the sensor.

    Returns:
        x, y, z component of light polarised along x, then along y (both turned to a); squares add up to 2 / b_z.
    """
    both = (a.reshape(3, *[1] * (b.ndim - 1)) + b) / (1 + torch.einsum("i,i...->...", a, b))
    out = []
    for e in _polarisations(a):
        turned = e.reshape(3, *[1] * (b.ndim - 1)) - both * torch.einsum("i,i...->...", e, b)
        out.append(turned / torch.sqrt(b[2]))
    return torch.cat(out)


def _polarisations(a: torch.Tensor) -> list[torch.Tensor]:
    """Two unit vectors across the direction a: x and y turned to it."""
    unit = torch.eye(3, dtype=a.dtype, device=a.device)
    axis, unit = unit[2] + a, unit[:2]
    return [e - axis * (a @ e) / (1 + a[2]) for e in unit]


def expanded(
    maps: tuple[torch.Tensor, torch.Tensor], cases: Sequence[Case], weights: Sequence[float]
) -> tuple[tuple[torch.Tensor, torch.Tensor], list[Case], list[float]]:
    """Maps (…, wavelength, y, x), cases and weights of a scalar as those of six components each."""
    phase, level = maps
    factors = torch.stack([components(case) for case in cases]).to(level)
    count = factors.shape[1]
    turned = (level.unsqueeze(-3) * factors).flatten(-4, -3)
    return (
        (phase.repeat_interleave(count, -3), turned),
        [case for case in cases for _ in range(count)],
        [weight / 2 for weight in weights for _ in range(count)],
    )
