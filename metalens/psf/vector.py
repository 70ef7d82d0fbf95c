"""Both polarisations: Ex, Ey, Ez of light whose rays the lens turns, each propagated as
a scalar.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from metalens.core.arrays import Array
from metalens.optics import media
from metalens.propagate import (
    PropagationCase,
    Pupils,
    polarized_amplitudes,
    ray_cosines,
)
from metalens.psf.among import NeighbourJonesFactors

# blocks of pillars along an axis over which the cosine of a ray is taken as alike
POOLED = 64
NOTHING = 1e-12  # of the light of the strongest combination of factors: rounding


@dataclass(frozen=True, eq=False, slots=True)
class VectorPupil:
    """pupils: (components, …) factors on the scalar's pupil, real or complex; signs: 1
    or -1, of what each adds
    to the light."""

    pupils: Tensor
    signs: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class PolarizationMixing:
    """Both polarisations of light from maps of pillars, as smooth factors where a lens
    is known by a few nodes.

    flux: through the sensor's plane, else |E|². apart: of three maps
    (:func:`apart_maps`) in place of one, whose
    pillars treat both polarisations alike.
    """

    flux: bool
    apart: bool = False

    @property
    def maps(self) -> int:
        """Of every wavelength."""
        return 3 if self.apart else 1

    def pupils(self, case: PropagationCase) -> Pupils:
        """Components of the light of a case: of one map four of the flux of light along
        x, which is that of light along
        y but behind films, or six of the mean |E|²; of three maps or behind films eight
        of the mean flux, or six. Those
        that are 0 all over are left out."""
        return lambda y_um, x_um: self._components(case, (y_um, x_um))

    def _components(
        self, case: PropagationCase, at_um: tuple[Array, Array]
    ) -> tuple[Array, Array]:
        """(components,) signs and (components, map, y, x) factors."""
        order = case.media.order
        first, b = rays_to(case, at_um, order[0]), rays_to(case, at_um)
        steep = math.sqrt(1 + case.tangents[0] ** 2 + case.tangents[1] ** 2)
        a = torch.tensor(
            [case.tangents[0] / steep, case.tangents[1] / steep, 1 / steep],
            dtype=torch.float64,
        )
        x, y = beyond_faces(transmitted_polarization(a, first), first, order).chunk(2)
        none = torch.zeros_like(x)
        both = [
            torch.cat(pair)
            for pair in ([(x, none), (none, y), (y, x)] if self.apart else [(x, y)])
        ]
        fields = [
            of_flux(one, b) if self.flux else VectorPupil(one, (1.0,) * len(one))
            for one in both
        ]
        factors = torch.stack([one.pupils for one in fields], 1).numpy()
        signs = np.array(fields[0].signs)
        if self.flux and not self.apart and not has_faces(case):
            factors, signs = factors[:4], signs[:4]
        else:
            factors = factors * math.sqrt(0.5)
        size = np.abs(factors).max((1, 2, 3))
        nonzero = size > NOTHING * size.max()
        return signs[nonzero], factors[nonzero]

    def power(
        self, case: PropagationCase, powers: Sequence[float], levels: Tensor
    ) -> float:
        """Mean over both polarisations of what the pillars let through, from the sums
        of squares of the maps; of |E|²
        over the cosine of every ray, as it lies on the plane.

        levels: (map, y, x) transmissions.
        """
        weights = (0.5, 0.5, 1.0) if self.apart else (1.0,)
        total = 0.0
        for weight, power, level in zip(weights, powers, levels, strict=True):
            total += (
                weight
                * power
                * (1.0 if self.flux or not power > 0 else self._steep(case, level))
            )
        return total

    def _steep(self, case: PropagationCase, level: Tensor) -> float:
        """Mean of 1/cos of the rays to the sensor, weighed by the light of the pillars;
        from means over blocks.
        """
        counts = min(POOLED, case.shape[0]), min(POOLED, case.shape[1])
        light = (
            torch.nn.functional.adaptive_avg_pool2d(level.detach()[None] ** 2, counts)[
                0
            ]
            .double()
            .cpu()
        )
        halves = [
            (n * step) / 2 for n, step in zip(case.shape, case.steps_um, strict=True)
        ]
        y, x = (
            half * ((2 * np.arange(n) + 1) / n - 1)
            for half, n in zip(halves, counts, strict=True)
        )
        return float((light / rays_to(case, (y, x))[2]).sum() / light.sum())


def has_faces(case: PropagationCase) -> bool:
    """Whether light goes from one medium to another behind the lens.

    Args:
        case: maps, geometry and window of the propagation.
    """
    return len(set(case.media.order)) > 1


def rays_to(
    case: PropagationCase, at_um: tuple[Array, Array], index: float | None = None
) -> Tensor:
    """(3, y, x) directions of the rays from (y,), (x,) of the lens to the window's
    centre, as they reach the sensor, or
    in a medium of this index.

    Args:
        case: maps, geometry and window of the propagation.
        at_um: (points, 2) field points on the sensor, um.
    """
    across = at_um[1][None, :] - case.centre_um[0]
    down = (at_um[0] - case.centre_um[1])[:, None]
    n = index or case.media.order[-1]
    p, q = (
        torch.as_tensor(-ray_cosines(case, *at) / n)
        for at in ((across, down), (down, across))
    )
    return torch.stack([p, q, torch.sqrt(1 - p * p - q * q)])


def s_and_p(case: PropagationCase) -> Pupils:
    """Two components of a scalar's light behind films: light that is s all over, and p,
    whose mean power is the light;
    each over the one amplitude that the scalar takes for both, as they reach the
    window's middle.

    Args:
        case: maps, geometry and window of the propagation.
    """

    def components(y_um: Array, x_um: Array) -> tuple[Array, Array]:
        b = rays_to(case, (y_um, x_um), 1.0).numpy()  # p = n sin θ
        return np.ones(2), np.stack(polarized_amplitudes(case, b[0] ** 2 + b[1] ** 2))[
            :, None
        ] * math.sqrt(0.5)

    return components


def beyond_faces(electric: Tensor, first: Tensor, order: tuple[float, ...]) -> Tensor:
    """(2 polarisations x 3 components, …) fields in the last medium of rays whose
    fields in the first are ``electric``.

    E = √S (E·s) s + √P (E·p) p', times √(cos / cos') to keep |E|² cos θ: s across the
    plane of the ray, p and p' in it,
    S and P the powers that pass over the mean of both.

    Args:
        first: (3, …) directions in the first medium. order: indices of the media.
    """
    if len(set(order)) == 1:
        return electric
    w = (first[0] ** 2 + first[1] ** 2) * order[0] ** 2
    sine, least = torch.sqrt(w), torch.finfo(w.dtype).tiny
    along_x = torch.stack(
        [torch.ones_like(w), torch.zeros_like(w)]
    )  # of the ray along the axis any plane is its own
    ux, uy = torch.where(
        sine > least, first[:2] * order[0] / sine.clamp_min(least), along_x
    )
    steep, cosine = sine / order[-1], torch.sqrt(1 - w / order[-1] ** 2)
    s_power, p_power = media.passed_apart(order, w)
    both = (s_power + p_power) / 2 * cosine / first[2]
    s_level = torch.sqrt(s_power / both)
    p_level = torch.sqrt(p_power / both)
    out = []
    for e in electric.reshape(2, 3, *electric.shape[1:]):
        s = (ux * e[1] - uy * e[0]) * s_level
        p = (first[2] * (ux * e[0] + uy * e[1]) - sine / order[0] * e[2]) * p_level
        out += [p * cosine * ux - s * uy, p * cosine * uy + s * ux, -p * steep]
    return torch.stack(out)


def apart_maps(
    maps: tuple[Tensor, Tensor], fields: NeighbourJonesFactors
) -> tuple[Tensor, Tensor]:
    """(…, wavelength · 3, y, x) phase and transmission of light from x to x, y to y,
    and between, of (…, wavelength, y,
    x) maps of pillars with factors ``fields`` on the light that comes."""
    phase, level = (one.unsqueeze(-3) for one in maps)
    responses = torch.stack([fields.xx, fields.yy, fields.xy], -3)
    return (phase + torch.angle(responses)).flatten(-4, -3), (
        level * responses.abs()
    ).flatten(-4, -3)


def transmitted_polarization(a: Tensor, b: Tensor) -> Tensor:
    """(2 polarisations x 3 components, …) of light of amplitude 1 that a lens turns
    from the direction a to b.

    Args:
        a: (3,) unit vector of the light that comes. b: (3, …) of the rays that leave,
            both towards the sensor.

    Returns:
        x, y, z component of light polarised along x, then along y (both turned to a);
        squares add up to 2 / b_z.
    """
    both = (a.reshape(3, *[1] * (b.ndim - 1)) + b) / (
        1 + torch.einsum("i,i...->...", a, b)
    )
    out = []
    for e in _polarisations(a):
        turned = e.reshape(3, *[1] * (b.ndim - 1)) - both * torch.einsum(
            "i,i...->...", e, b
        )
        out.append(turned / torch.sqrt(b[2]))
    return torch.cat(out)


def _polarisations(a: Tensor) -> list[Tensor]:
    """Two unit vectors across the direction a: x and y turned to it."""
    unit = torch.eye(3, dtype=a.dtype, device=a.device)
    axis, unit = unit[2] + a, unit[:2]
    return [e - axis * (a @ e) / (1 + a[2]) for e in unit]


def of_flux(electric: Tensor, b: Tensor) -> VectorPupil:
    """From (2 polarisations x 3 components, …) fields of rays in the directions b (3,
    …) to those of their flux.
    """
    parts: list[Tensor] = []
    for e in electric.reshape(2, 3, *electric.shape[1:]):
        h = torch.linalg.cross(b.expand_as(e), e, dim=0)
        parts += [e[0] + h[1], e[0] - h[1], e[1] - h[0], e[1] + h[0]]
    return VectorPupil(torch.stack(parts) / 2, (1.0, -1.0) * 4)


def dominant_components(fields: VectorPupil, weight: Tensor, count: int) -> VectorPupil:
    """Mixtures, ``count`` or all that are not 0, that hold most of the light, whose sum
    is that of ``weight``².

    With A Aᴴ the products of the fields over the nodes and D their signs, axes y of Aᵀ
    D A* of eigenvalue λ are pupils
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
    mixture = (
        (axes[:, kept].conj() / root) @ turn[:, first] * torch.sqrt(size[first].abs())
    )
    level = torch.sqrt((weight**2).sum() / size[first].sum())
    return VectorPupil(
        level * torch.einsum("dc,d...->c...", mixture, fields.pupils),
        tuple(torch.sign(size[first]).tolist()),
    )
