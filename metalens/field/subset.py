"""Gradient of an image's loss from a few field points and wavelengths, unbiased.

The image is linear in the light of the nodes. So a step goes in two halves: with the light of all nodes as a leaf
(no graph through the pupils), the loss gives G = d loss / d light; then for any set of (point, wavelength) drawn with
probabilities q,

    E[ Σ_drawn  w_λ <G_point, light_point,λ(phase)> / (n q) ]  has the gradient  Σ_points,λ w_λ G d light / d phase,

the gradient of the loss itself. Wavelengths are drawn by their weights, points evenly.
"""

import torch
from torch import Tensor

from metalens.field.plan import Plan, spectral
from metalens.field.points import Optics, psfs


def node_light(optics: Optics, plan: Plan) -> Tensor:
    """(rows, columns, depths, h, w) light of all nodes, without a graph: a leaf that gathers the gradient."""
    with torch.no_grad():
        light = spectral(optics, _places(plan), plan.depths_um, plan.waves, plan.window)
    return light.reshape(len(plan.y_um), len(plan.x_um), *light.shape[1:]).requires_grad_()


def surrogate(
    optics: Optics, plan: Plan, gradient: Tensor, *, draws: int, generator: torch.Generator | None = None
) -> Tensor:
    """A scalar whose gradient to the phase is, in the mean over the draws, that of the loss.

    Args:
        gradient: (rows, columns, depths, h, w) of the loss with respect to :func:`node_light`.
        draws: pairs of a field point and a wavelength, drawn with replacement.
    """
    points = torch.randint(len(plan.y_um) * len(plan.x_um), (draws,), generator=generator)
    waves = torch.multinomial(torch.as_tensor(plan.waves.weights), draws, replacement=True, generator=generator)
    return torch.stack(
        [term(optics, plan, gradient, int(p), int(w)) for p, w in zip(points, waves, strict=True)]
    ).mean()


def term(optics: Optics, plan: Plan, gradient: Tensor, point: int, wave: int) -> Tensor:
    """What one draw adds: number of points · <G_point, light_point,wave>."""
    places = _places(plan)
    light = psfs(
        optics,
        places[point : point + 1].to(gradient.device),
        depths_um=plan.depths_um,
        wavelength_um=float(plan.waves.wavelengths_um[wave]),
        window=plan.window,
        finest_um=float(plan.waves.wavelengths_um.min()),
    )[0]
    return len(places) * (gradient.flatten(0, 1)[point] * light).sum()


def _places(plan: Plan) -> Tensor:
    y, x = torch.meshgrid(plan.y_um, plan.x_um, indexing="ij")
    return torch.stack([x.flatten(), y.flatten()], -1)
