"""Both polarisations of a field point: Ex, Ey, Ez of each as a few pupils whose images add.

    |E|² = Σ_c |∫ f_c(p) S(p) exp(ik p·δ) d²p|²      S: the scalar; f_c: six real factors, two polarisations by x, y, z
         = Σ_c |∫ g_c(p) S(p) exp(ik p·δ) d²p|²      g = O f for any orthogonal O

With O the principal axes of f, weighted by the light, the g_c fall off quickly: a lens of NA 0.24 has all but 1e-5 of
its image in three, of NA 0.64 all but 1e-3. As many are imaged as the tolerance asks for. A field point keeps the light
that its pupil passes; |E|² is how it lies on the window.
"""

import torch
from torch import Tensor

from metalens.field.rays import Rays
from metalens.psf import turned

ALL = 6  # components
STEEPEST = 1e-3  # cos² of nodes beyond the rim, which have no light


def factors(seen: Rays, tangents: Tensor, index: float) -> Tensor:
    """(6, nodes, nodes) float64 components of both polarisations on the nodes, as :func:`metalens.psf.turned`.

    Args:
        tangents: slopes (x, y) of the chief ray in air. index: of the medium in which the rays reach the sensor.
    """
    q, p = torch.meshgrid(seen.aside + seen.middle[1], seen.aside + seen.middle[0], indexing="ij")
    p, q = p / index, q / index
    b = torch.stack([p, q, torch.sqrt((1 - p * p - q * q).clamp_min(STEEPEST))])
    slope = torch.cat([tangents, tangents.new_ones(1)])
    return turned(slope / slope.norm(), b)


def strongest(pupils: Tensor, weight: Tensor, count: int) -> Tensor:
    """(count, …) mixtures of (6, …) factors that hold most of the light, whose sum of squares is that of ``weight``.

    Args:
        pupils: real or complex; differentiable. weight: (…) of each node.
    """
    light = (pupils.detach() * weight).flatten(1)
    power, axes = torch.linalg.eigh(light @ light.mH)
    kept = axes.flip(1)[:, :count]
    level = torch.sqrt((weight**2).sum() / power.flip(0)[:count].sum())
    return level * torch.einsum("dc,d...->c...", kept.conj(), pupils)
