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
from metalens.propagate import PropagationCase, Pupils, ray_cosines
from metalens.psf.neighbour_coupling import NeighbourJonesFactors

# pillars along an axis whose rays are computed for a mean
SAMPLED = 64
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
    """Both polarisations of the light from maps of pillars, as factors on the maps.

    flux: of the power through the sensor's plane, else of |E|².
    anisotropic: of three maps (:func:`jones_maps`), for pillars that respond differently to x
        and y; else of one map.
    """

    flux: bool
    anisotropic: bool = False

    @property
    def maps(self) -> int:
        """Of every wavelength."""
        return 3 if self.anisotropic else 1

    def pupils(self, case: PropagationCase) -> Pupils:
        """Function from places (y, x) of the lens to signs and factors of a case.

        One map without films has four components of the flux of light along x, equal to
        that of light along y. Three maps, or films, have eight of the mean flux. |E|²
        has six. Components that are 0 everywhere are left out.
        """
        return lambda y_um, x_um: self._components(case, (y_um, x_um))

    def _components(
        self, case: PropagationCase, at_um: tuple[Array, Array]
    ) -> tuple[Array, Array]:
        """(components,) signs and (components, map, y, x) factors on the maps.

        Args:
            case: direction of the light, media and window.
            at_um: (y,) and (x,) places on the lens.
        """
        order = case.media.order
        first = rays_to(case, at_um, order[0])
        last = rays_to(case, at_um)
        steep = math.sqrt(1 + case.tangents[0] ** 2 + case.tangents[1] ** 2)
        incident = torch.tensor(
            [case.tangents[0] / steep, case.tangents[1] / steep, 1 / steep],
            dtype=torch.float64,
        )
        behind = beyond_faces(transmitted_polarization(incident, first), first, order)
        x, y = behind.chunk(2)
        zero = torch.zeros_like(x)
        pairs = [(x, zero), (zero, y), (y, x)] if self.anisotropic else [(x, y)]
        both = [torch.cat(pair) for pair in pairs]
        fields = [
            of_flux(e, last) if self.flux else VectorPupil(e, (1.0,) * len(e))
            for e in both
        ]
        factors = torch.stack([field.pupils for field in fields], 1).numpy()
        signs = np.array(fields[0].signs)
        if self.flux and not self.anisotropic and not has_faces(case):
            factors = factors[:4]
            signs = signs[:4]
        else:
            factors = factors * math.sqrt(0.5)
        size = np.abs(factors).max((1, 2, 3))
        nonzero = size > NOTHING * size.max()
        return signs[nonzero], factors[nonzero]

    def power(
        self, case: PropagationCase, powers: Sequence[float], levels: Tensor
    ) -> float:
        """Power behind the pillars, the mean over both polarisations.

        For |E|² the power of each ray is divided by the cosine of its angle.

        Args:
            case: geometry of the rays.
            powers: sum of squares of the transmission of each map.
            levels: (map, y, x) transmissions.
        """
        weights = (0.5, 0.5, 1.0) if self.anisotropic else (1.0,)
        total = 0.0
        for weight, power, level in zip(weights, powers, levels, strict=True):
            steep = 1.0 if self.flux or not power > 0 else self._steep(case, level)
            total += weight * power * steep
        return total

    def _steep(self, case: PropagationCase, level: Tensor) -> float:
        """Mean of 1/cos θ of the rays to the sensor, weighted with the pillars' light.

        Computed from some ``SAMPLED`` x ``SAMPLED`` of the pillars.

        Args:
            case: geometry of the rays.
            level: (y, x) transmission of a map.
        """
        y, x = (slice(None, None, max(1, n // SAMPLED)) for n in case.shape)
        light = level.detach()[y, x].double() ** 2
        rows, columns = case.pillars_um
        return float(
            (light / rays_to(case, (rows[y], columns[x]))[2]).sum() / light.sum()
        )


def has_faces(case: PropagationCase) -> bool:
    """Whether light goes from one medium to another behind the lens.

    Args:
        case: maps, geometry and window of the propagation.
    """
    return len(set(case.media.order)) > 1


def rays_to(
    case: PropagationCase, at_um: tuple[Array, Array], index: float | None = None
) -> Tensor:
    """(3, y, x) unit vectors of the rays from the lens to the window's centre.

    Args:
        case: geometry, media and window of the propagation.
        at_um: (y,) and (x,) places on the lens, um.
        index: of the medium in which they are; None for the last, at the sensor.
    """
    dx = at_um[1][None, :] - case.centre_um[0]
    dy = (at_um[0] - case.centre_um[1])[:, None]
    n = index or case.media.order[-1]
    p, q = (torch.as_tensor(-ray_cosines(case, *at) / n) for at in ((dx, dy), (dy, dx)))
    return torch.stack([p, q, torch.sqrt(1 - p * p - q * q)])


def s_and_p(case: PropagationCase) -> Pupils:
    """Function from places of the lens to the s and p components of light behind films.

    Each is the transmitted amplitude of s or p over the scalar's one amplitude, along
    the ray to the window's middle. The light is the mean of both powers.

    Args:
        case: maps, geometry and window of the propagation.
    """

    def components(y_um: Array, x_um: Array) -> tuple[Array, Array]:
        p, q, _ = rays_to(case, (y_um, x_um), 1.0).numpy()  # n sin θ
        powers = np.stack(media.fresnel_powers(case.media.order, p * p + q * q))
        return np.ones(2), np.sqrt(powers / powers.sum(0))[:, None]

    return components


def beyond_faces(electric: Tensor, first: Tensor, order: tuple[float, ...]) -> Tensor:
    """(6, …) fields of rays in the last medium, from their fields in the first.

    E' = √(cos θ / cos θ') (√S (E·s) s + √P (E·p) p'). The unit vector s is normal to
    the plane of the ray, p and p' lie in it. S and P are transmitted powers over the
    mean of both, and the root preserves |E|² cos θ.

    Args:
        electric: (2 polarisations x 3 components, …) fields in the first medium.
        first: (3, …) unit vectors of the rays in the first medium.
        order: indices of the media.
    """
    if len(set(order)) == 1:
        return electric
    w = (first[0] ** 2 + first[1] ** 2) * order[0] ** 2
    sine = torch.sqrt(w)
    least = torch.finfo(w.dtype).tiny
    # a ray along the axis lies in every plane: that of x is used
    along_x = torch.stack([torch.ones_like(w), torch.zeros_like(w)])
    ux, uy = torch.where(
        sine > least, first[:2] * order[0] / sine.clamp_min(least), along_x
    )
    last_sine = sine / order[-1]
    cosine = torch.sqrt(1 - w / order[-1] ** 2)
    s_power, p_power = media.fresnel_powers(order, w)
    both = (s_power + p_power) / 2 * cosine / first[2]
    s_level = torch.sqrt(s_power / both)
    p_level = torch.sqrt(p_power / both)
    out = []
    for e in electric.reshape(2, 3, *electric.shape[1:]):
        s = (ux * e[1] - uy * e[0]) * s_level
        p = (first[2] * (ux * e[0] + uy * e[1]) - sine / order[0] * e[2]) * p_level
        out += [p * cosine * ux - s * uy, p * cosine * uy + s * ux, -p * last_sine]
    return torch.stack(out)


def jones_maps(
    maps: tuple[Tensor, Tensor], fields: NeighbourJonesFactors
) -> tuple[Tensor, Tensor]:
    """(…, wavelength · 3, y, x) phase, rad, and transmission of xx, yy and xy.

    Args:
        maps: (…, wavelength, y, x) phase and transmission of the pillars.
        fields: factors of their neighbours on both fields.
    """
    phase, level = (part.unsqueeze(-3) for part in maps)
    responses = torch.stack([fields.xx, fields.yy, fields.xy], -3)
    phases = phase + torch.angle(responses)
    levels = level * responses.abs()
    return phases.flatten(-4, -3), levels.flatten(-4, -3)


def transmitted_polarization(a: Tensor, b: Tensor) -> Tensor:
    """(6, …) fields of light of amplitude 1 that a lens turns from direction a to b.

    The rotation about a x b takes e, normal to a, to e - (a + b) (e·b) / (1 + a·b). It
    is divided by √b_z, so that the squares add up to 2 / b_z.

    Args:
        a: (3,) unit vector of the incident light, towards the sensor.
        b: (3, …) unit vectors of the rays that leave, towards the sensor.

    Returns:
        x, y, z component of light polarised along x, then along y (both turned to a).
    """
    column = 3, *[1] * (b.ndim - 1)
    both = (a.reshape(column) + b) / (1 + torch.einsum("i,i...->...", a, b))
    out = []
    unit = torch.eye(3, dtype=a.dtype, device=a.device)
    axis = unit[2] + a
    for e in unit[:2] - (unit[:2] @ a)[:, None] * axis / (1 + a[2]):
        turned = e.reshape(column) - both * torch.einsum("i,i...->...", e, b)
        out.append(turned / torch.sqrt(b[2]))
    return torch.cat(out)


def of_flux(electric: Tensor, b: Tensor) -> VectorPupil:
    """Eight pupils and signs; Σ sign |·|² is the flux E_x H_y - E_y H_x, H = b x E.

    E_x H_y = ((E_x + H_y)² - (E_x - H_y)²) / 4 of each polarisation, and so for y.

    Args:
        electric: (2 polarisations x 3 components, …) fields of the rays.
        b: (3, …) unit vectors of the rays.
    """
    parts: list[Tensor] = []
    for e in electric.reshape(2, 3, *electric.shape[1:]):
        h = torch.linalg.cross(b.expand_as(e), e, dim=0)
        parts += [e[0] + h[1], e[0] - h[1], e[1] - h[0], e[1] + h[0]]
    return VectorPupil(torch.stack(parts) / 2, (1.0, -1.0) * 4)


def dominant_components(fields: VectorPupil, weight: Tensor, count: int) -> VectorPupil:
    """The ``count`` strongest mixtures of fields, scaled to the light Σ ``weight``².

    With A Aᴴ the Gram matrix of the weighted fields and D their signs, an eigenvector y
    of Aᵀ D A* with eigenvalue λ gives the pupil √|λ| (A*)⁻¹ y of sign λ. Mixtures of no
    light are left out. The result is differentiable in the fields.

    Args:
        fields: pupils (components, …) and their signs.
        weight: (…) amplitude of each node.
        count: largest number of mixtures.
    """
    light = (fields.pupils.detach() * weight).flatten(1)
    power, axes = torch.linalg.eigh(light @ light.mH)
    nonzero = power > NOTHING * power[-1]
    root = torch.sqrt(power[nonzero])
    signs = torch.tensor(fields.signs, dtype=light.dtype, device=light.device)
    roots = axes[:, nonzero] * root
    signed_gram = roots.mT @ (signs[:, None] * roots.conj())
    eigenvalues, eigenvectors = torch.linalg.eigh(signed_gram)
    strongest = torch.argsort(eigenvalues.abs(), descending=True)[:count]
    strongest = strongest[
        eigenvalues[strongest].abs() > NOTHING * eigenvalues.abs().max()
    ]
    mixture = (
        (axes[:, nonzero].conj() / root)
        @ eigenvectors[:, strongest]
        * torch.sqrt(eigenvalues[strongest].abs())
    )
    scale = torch.sqrt((weight**2).sum() / eigenvalues[strongest].sum())
    return VectorPupil(
        scale * torch.einsum("dc,d...->c...", mixture, fields.pupils),
        tuple(torch.sign(eigenvalues[strongest]).tolist()),
    )
