"""Gradients of an image's loss: exact in the PSFs of the nodes, and from few of them and of the wavelengths, unbiased.

Few kernels show the PSFs of a field, and not how they change: through them the derivative of an image of 1 % by a coma
is off by half. So an image is formed through kernels, and its derivative is that of the sum over all nodes

    image(X) = Σ_nodes Σ_x to_node(x) source(x) P_node(X - x)
    d loss / d P_node(k) = Σ_x to_node(x) source(x) G(x + k)

with G = d loss / d image: correlations of the source near a node with G, one a node, by transforms.

The image is linear in the light of the nodes. So a step goes in two halves: with the light of all nodes as a leaf
(no graph through the pupils), the loss gives G' = d loss / d light; then for any set of (point, wavelength) drawn with
probabilities q,

    E[ Σ_drawn  w_λ <G'_point, light_point,λ(phase)> / (n q) ]  has the gradient  Σ_points,λ w_λ G' d light / d phase,

the gradient of the loss itself. Wavelengths are drawn by their weights, points evenly.
"""

from collections.abc import Set
from typing import Any

import scipy.fft
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from metalens.field.plan import Plan, spectral
from metalens.field.points import Optics, psfs


def by_nodes(
    stack: Tensor,
    sources: list[Tensor],
    deep: tuple[Tensor, Tensor],
    between: list[Tensor],
    asked: Set[int] | None = None,
) -> Tensor:
    """Zeros as large as an image of sources (frames, kinds, sheets, y, x) and half a window at each side, whose
    derivative by the PSFs of the nodes is that of the image through all of them.

    Args:
        stack: (rows, columns, depths, h, w) of the nodes. sources: (frames, sheets, y, x) of each kind.
        deep: first depth node and weights (…, taps) of the nodes at the depth of every source.
        between: (pixel rows, node rows) and (pixel columns, node columns).
        asked: numbers of the nodes whose derivatives are wanted, the others' being 0; None for all.
    """
    zeros: Tensor = _ByNodes.apply(stack, sources, deep, between, asked)  # type: ignore[no-untyped-call]
    return zeros


class _ByNodes(torch.autograd.Function):
    """See :func:`by_nodes`."""

    @staticmethod
    def forward(
        ctx: Any,
        stack: Tensor,
        sources: list[Tensor],
        deep: tuple[Tensor, Tensor],
        between: list[Tensor],
        asked: Set[int] | None,
    ) -> Tensor:
        ctx.save_for_backward(*sources, *deep, *between)
        ctx.of, ctx.asked = stack.shape, asked
        first, size = sources[0], stack.shape[-1] - 1
        shape = len(first), len(sources), *first.shape[1:-2], first.shape[-2] + size, first.shape[-1] + size
        return first.new_zeros(shape)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        *sources, first, taps, rows, columns = ctx.saved_tensors
        light, out = torch.stack(sources, 1), gradient.new_zeros(ctx.of)
        for node in range(ctx.of[0] * ctx.of[1]) if ctx.asked is None else ctx.asked:
            place = divmod(node, ctx.of[1])
            to_row, to_column = (part[:, i].to(light) for part, i in zip((rows, columns), place, strict=True))
            y, x = _reach(to_row), _reach(to_column)
            near = light[..., y, x] * (to_row[y, None] * to_column[x])
            seen = gradient[..., y.start : y.stop + ctx.of[-2] - 1, x.start : x.stop + ctx.of[-1] - 1]
            out[place] = _correlated(near, (first[..., y, x], taps[..., y, x, :]), seen, ctx.of[2:])
        return out, None, None, None, None


def _reach(weights: Tensor) -> slice:
    """From the first weight that is not zero to the last."""
    there = torch.nonzero(weights)[:, 0]
    return slice(int(there[0]), int(there[-1]) + 1)


def _correlated(light: Tensor, deep: tuple[Tensor, Tensor], gradient: Tensor, of: tuple[int, ...]) -> Tensor:
    """(depths, h, w) Σ_x light(x) gradient(x + k) over frames, kinds, sheets and places, k in the window: of the share
    of the light that each depth node has."""
    depths, *window = of
    shape = [int(scipy.fft.next_fast_len(n, real=True)) for n in gradient.shape[-2:]]
    spectrum = torch.fft.rfft2(gradient, s=shape)
    first, taps = deep
    total = []
    for depth in range(depths):
        share = (taps * (first[..., None] + torch.arange(taps.shape[-1], device=first.device) == depth)).sum(-1)
        part = torch.fft.rfft2(light * share[:, None], s=shape)
        found = torch.fft.irfft2((part.conj() * spectrum).sum((0, 1, 2)), s=shape)
        total.append(found[: window[0], : window[1]])
    return torch.stack(total)


def node_light(optics: Optics, plan: Plan) -> Tensor:
    """(rows, columns, depths, h, w) light of all nodes, without a graph: a leaf that gathers the gradient."""
    with torch.no_grad():
        light = spectral(optics, _places(plan), plan.depths_um, plan.waves, plan.window)
    return light.reshape(len(plan.y_um), len(plan.x_um), *light.shape[1:]).requires_grad_()


def surrogate(optics: Optics, plan: Plan, gradient: Tensor, pairs: tuple[Tensor, Tensor]) -> Tensor:
    """A scalar whose gradient to the phase is, in the mean over the draws, that of the loss.

    Args:
        gradient: (rows, columns, depths, h, w) of the loss with respect to :func:`node_light`, of the field points that
            were drawn.
        pairs: a field point and a wavelength each, of :func:`drawn`.
    """
    return torch.stack([term(optics, plan, gradient, int(p), int(w)) for p, w in zip(*pairs, strict=True)]).mean()


def drawn(plan: Plan, draws: int, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
    """(draws,) numbers of field points, evenly, and of wavelengths, by their weights: what :func:`surrogate` takes."""
    points = torch.randint(len(plan.y_um) * len(plan.x_um), (draws,), generator=generator)
    return points, torch.multinomial(torch.as_tensor(plan.waves.weights), draws, replacement=True, generator=generator)


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
