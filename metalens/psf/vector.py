"""Both polarisations: Ex, Ey, Ez of light whose rays the lens turns, each propagated as a scalar.

A ray of direction a, polarised along e, leaves a pillar in direction b for the window: its field is turned with it,
R e = e - (a + b)(b·e)/(1 + a·b), and |E|² cos θ is kept: E = t R e / √b_z (Richards and Wolf 1959, for the two
polarisations of the source). The direction is that to the window's centre. Intensity is |Ex|² + |Ey|² + |Ez|², the mean
of both polarisations.

What a pixel counts is the power through its face, S_z = Re(Ex Hy* - Ey Hx*), whatever the slope of the rays. With
H = b x E of every ray it is a sum of squares with signs, like that of E:

    S_z = Σ_c s_c |Σ_j f_c(j) S_j|²        S_j: the scalar's light; f_c: (Ex ± Hy)/2, (Ey ± Hx)/2; s_c = ±1
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from metalens.propagate import Case, cosines
from metalens.psf.among import Jones

NOTHING = 1e-12  # of the light of the strongest combination of factors: rounding


@dataclass(frozen=True, eq=False, slots=True)
class Mixed:
    """pupils: (components, …) factors on the scalar's pupil, real or complex; signs: 1 or -1, of what each adds
    to the light."""

    pupils: Tensor
    signs: tuple[float, ...]


def components(case: Case, *, flux: bool = False) -> Mixed:
    """Both polarisations, (components, y, x) real factors on the transmission of every pillar, float64: six of |E|², or
    eight of the flux through the sensor's plane."""
    y, x = case.pillars_um
    across, down = x[None, :] - case.centre_um[0], (y - case.centre_um[1])[:, None]
    last = 1.0 if case.behind is None else case.behind.order[-1]
    p, q = (torch.as_tensor(-cosines(case, *at) / last) for at in ((across, down), (down, across)))
    b = torch.stack([p, q, torch.sqrt(1 - p * p - q * q)])
    steep = math.sqrt(1 + case.tangents[0] ** 2 + case.tangents[1] ** 2)
    a = torch.tensor([case.tangents[0] / steep, case.tangents[1] / steep, 1 / steep], dtype=torch.float64)
    electric = turned(a, b)
    return of_flux(electric, b) if flux else Mixed(electric, (1.0,) * len(electric))


def turned(a: Tensor, b: Tensor) -> Tensor:
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


def _polarisations(a: Tensor) -> list[Tensor]:
    """Two unit vectors across the direction a: x and y turned to it."""
    unit = torch.eye(3, dtype=a.dtype, device=a.device)
    axis, unit = unit[2] + a, unit[:2]
    return [e - axis * (a @ e) / (1 + a[2]) for e in unit]


def of_flux(electric: Tensor, b: Tensor) -> Mixed:
    """From (2 polarisations x 3 components, …) fields of rays in the directions b (3, …) to those of their flux."""
    parts: list[Tensor] = []
    for e in electric.reshape(2, 3, *electric.shape[1:]):
        h = torch.linalg.cross(b.expand_as(e), e, dim=0)
        parts += [e[0] + h[1], e[0] - h[1], e[1] - h[0], e[1] + h[0]]
    return Mixed(torch.stack(parts) / 2, (1.0, -1.0) * 4)


def strongest(fields: Mixed, weight: Tensor, count: int) -> Mixed:
    """Mixtures, ``count`` or all that are not 0, that hold most of the light, whose sum is that of ``weight``².

    With A Aᴴ the products of the fields over the nodes and D their signs, axes y of Aᵀ D A* of eigenvalue λ are pupils
    √|λ| (A*)⁻¹ y of sign λ. Differentiable in the fields.

    Args:
        weight: (…) of each node.
    """
    light = (fields.pupils.detach() * weight).flatten(1)
    power, axes = torch.linalg.eigh(light @ light.mH)
    kept = power > NOTHING * power[-1]
    root = torch.sqrt(power[kept])
    signs = torch.tensor(fields.signs, dtype=light.dtype, device=light.device)
    lit = axes[:, kept] * root
    inner = lit.mT @ (signs[:, None] * lit.conj())
    size, turn = torch.linalg.eigh(inner)
    first = torch.argsort(size.abs(), descending=True)[:count]
    first = first[size[first].abs() > NOTHING * size.abs().max()]
    mixture = (axes[:, kept].conj() / root) @ turn[:, first] * torch.sqrt(size[first].abs())
    level = torch.sqrt((weight**2).sum() / size[first].sum())
    return Mixed(level * torch.einsum("dc,d...->c...", mixture, fields.pupils), tuple(torch.sign(size[first]).tolist()))


def expanded(
    maps: tuple[Tensor, Tensor],
    cases: Sequence[Case],
    weights: Sequence[float],
    *,
    flux: bool = False,
    fields: Jones | None = None,
) -> tuple[tuple[Tensor, Tensor], list[Case], list[float]]:
    """Maps (…, wavelength, y, x), cases and weights of a scalar as those of the components of both polarisations.

    flux: of the flux through the sensor's plane in place of |E|²: four components, eight with ``fields``.
    fields: what every pillar does to the field of the light that comes, for each wavelength.
    """
    phase, level = maps
    made, whole = [components(case, flux=flux) for case in cases], 2.0
    if flux and fields is None:
        lit = (level.detach() > 0).flatten(0, -3).any(0).double()
        few = [strongest(one, lit, len(one.pupils)) for one in made]
        if len({one.signs for one in few}) == 1:
            made, whole = few, 1.0
    signs = made[0].signs
    pupils = torch.stack([one.pupils for one in made])
    each = [sign * weight / whole for weight in weights for sign in signs]
    longer = phase.repeat_interleave(len(signs), -3), [case for case in cases for _ in signs]
    if fields is None:
        return (longer[0], (level.unsqueeze(-3) * pupils.to(level)).flatten(-4, -3)), longer[1], each
    answered = _answered(pupils.to(level), fields)
    turned_by = torch.angle(answered).flatten(-4, -3)
    return (longer[0] + turned_by, (level.unsqueeze(-3) * answered.abs()).flatten(-4, -3)), longer[1], each


def _answered(pupils: Tensor, fields: Jones) -> Tensor:
    """(…, wavelength, components, y, x) complex: factors of light whose field every pillar changes.

    pupils: (wavelength, components, y, x), those of light along x first, then as many of light along y.
    """
    x, y = pupils.chunk(2, -3)
    xx, yy, xy = (one.unsqueeze(-3) for one in fields)
    return torch.cat([xx * x + xy * y, xy * x + yy * y], -3)
