"""Gradients of an image's loss: exact in the PSFs of the nodes, and from few of them
and of the wavelengths, unbiased.

Few kernels show the PSFs of a field, and not how they change: through them the
derivative of an image of 1 % by a coma
is off by half. So an image is formed through kernels, and its derivative is that of the
sum over all nodes

    image(X) = Σ_nodes Σ_x to_node(x) source(x) P_node(X - x)
    d loss / d P_node(k) = Σ_x to_node(x) source(x) G(x + k)

with G = d loss / d image: correlations of the source near a node with G, one a node, by
transforms. The derivative by
the depth of a source is that of the same sum, through the weights of the depth nodes
(4-point polynomials in 1/z).

The image is linear in the light of the nodes. So a step goes in two halves: with the
light of all nodes as a leaf
(no graph through the pupils), the loss gives G' = d loss / d light; then for any set of
(point, wavelength) drawn with
probabilities q,

    E[ Σ_drawn  w_λ <G'_point, light_point,λ(phase)> / (n q) ]  has the gradient
    Σ_points,λ w_λ G' d light / d phase,

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
    """Zeros as large as an image of sources (frames, kinds, sheets, y, x) and half a
    window at each side, whose
    derivatives by the PSFs of the nodes, by the sources and by the weights of the
    depths are those of the image through
    all nodes.

    Args:
        stack: (rows, columns, depths, h, w) of the nodes. sources: (frames, sheets, y,
            x) of each kind.
        deep: first depth node and weights (…, taps) of the nodes at the depth of every
            source.
        between: (pixel rows, node rows) and (pixel columns, node columns).
        asked: numbers of the nodes whose derivatives are wanted, the others' being 0;
            None for all.
    """
    first, taps = deep
    zeros: Tensor = _ByNodes.apply(stack, taps, first, between, asked, *sources)  # type: ignore[no-untyped-call]
    return zeros


class _ByNodes(torch.autograd.Function):
    """See :func:`by_nodes`."""

    @staticmethod
    def forward(
        ctx: Any,
        stack: Tensor,
        taps: Tensor,
        first: Tensor,
        between: list[Tensor],
        asked: Set[int] | None,
        *sources: Tensor,
    ) -> Tensor:
        ctx.save_for_backward(stack, taps, first, *between, *sources)
        ctx.asked = asked
        one, size = sources[0], stack.shape[-1] - 1
        shape = (
            len(one),
            len(sources),
            *one.shape[1:-2],
            one.shape[-2] + size,
            one.shape[-1] + size,
        )
        return one.new_zeros(shape)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        stack, taps, first, rows, columns, *sources = tuple[Tensor, ...](
            ctx.saved_tensors
        )
        of_stack, of_taps, *_ = ctx.needs_input_grad
        of_sources = of_taps or any(ctx.needs_input_grad[5:])
        light, (high, wide) = torch.stack(sources, 1), stack.shape[-2:]
        out = gradient.new_zeros(stack.shape)
        back = torch.zeros_like(light), torch.zeros_like(taps)
        every = range(stack.shape[0] * stack.shape[1])
        for node in every if of_sources or ctx.asked is None else ctx.asked:
            place = divmod(node, stack.shape[1])
            to_row, to_column = (
                part[:, i].to(light)
                for part, i in zip((rows, columns), place, strict=True)
            )
            y, x = _reach(to_row), _reach(to_column)
            to = to_row[y, None] * to_column[x]
            near, deep = light[..., y, x] * to, (first[..., y, x], taps[..., y, x, :])
            seen = gradient[
                ..., y.start : y.stop + high - 1, x.start : x.stop + wide - 1
            ]
            if of_stack and (ctx.asked is None or node in ctx.asked):
                out[place] = _correlated(near, deep, seen, stack.shape[2:])
            if of_sources:
                by_light, by_taps = _returned(stack[place], near, deep, seen)
                back[0][..., y, x] += by_light * to
                back[1][..., y, x, :] += by_taps
        return (
            out if of_stack else None,
            back[1] if of_taps else None,
            None,
            None,
            None,
            *back[0].unbind(1),
        )


def _reach(weights: Tensor) -> slice:
    """From the first weight that is not zero to the last."""
    there = torch.nonzero(weights)[:, 0]
    return slice(int(there[0]), int(there[-1]) + 1)


def _correlated(
    light: Tensor, deep: tuple[Tensor, Tensor], gradient: Tensor, of: tuple[int, ...]
) -> Tensor:
    """(depths, h, w) Σ_x light(x) gradient(x + k) over frames, kinds, sheets and
    places, k in the window: of the share
    of the light that each depth node has."""
    depths, *window = of
    shape = [int(scipy.fft.next_fast_len(n, real=True)) for n in gradient.shape[-2:]]
    spectrum = torch.fft.rfft2(gradient, s=shape)
    first, taps = deep
    total = []
    for depth in range(depths):
        share = (
            taps
            * (
                first[..., None] + torch.arange(taps.shape[-1], device=first.device)
                == depth
            )
        ).sum(-1)
        part = torch.fft.rfft2(light * share[:, None], s=shape)
        found = torch.fft.irfft2((part.conj() * spectrum).sum((0, 1, 2)), s=shape)
        total.append(found[: window[0], : window[1]])
    return torch.stack(total)


def _returned(
    psfs: Tensor, light: Tensor, deep: tuple[Tensor, Tensor], gradient: Tensor
) -> tuple[Tensor, Tensor]:
    """Derivatives by the light near a node (before its share of it) and by the weights
    of the depths: of each depth's
    PSF, Σ_k P(k) gradient(x + k) at the places of the light."""
    shape = [int(scipy.fft.next_fast_len(n, real=True)) for n in gradient.shape[-2:]]
    spectrum, (high, wide) = torch.fft.rfft2(gradient, s=shape), light.shape[-2:]
    first, taps = deep
    by_light, by_taps = torch.zeros_like(light), torch.zeros_like(taps)
    for depth, psf in enumerate(psfs.to(gradient)):
        at = (
            first[..., None] + torch.arange(taps.shape[-1], device=first.device)
            == depth
        )
        seen = torch.fft.irfft2(
            torch.fft.rfft2(psf, s=shape).conj() * spectrum, s=shape
        )[..., :high, :wide]
        by_light += (taps * at).sum(-1)[:, None] * seen
        by_taps += at * (light * seen).sum(1)[..., None]
    return by_light, by_taps


def node_light(optics: Optics, plan: Plan) -> Tensor:
    """(rows, columns, depths, h, w) light of all nodes, without a graph: a leaf that
    gathers the gradient.
    """
    with torch.no_grad():
        light = spectral(optics, _places(plan), plan.depths_um, plan.waves, plan.window)
    return light.reshape(
        len(plan.y_um), len(plan.x_um), *light.shape[1:]
    ).requires_grad_()


def surrogate(
    optics: Optics, plan: Plan, gradient: Tensor, pairs: tuple[Tensor, Tensor]
) -> Tensor:
    """A scalar whose gradient to the phase is, in the mean over the draws, that of the
    loss.

    Args:
        gradient: (rows, columns, depths, h, w) of the loss with respect to
            :func:`node_light`, of the field points that
            were drawn.
        pairs: a field point and a wavelength each, of :func:`drawn`.
    """
    return torch.stack(
        [
            term(optics, plan, gradient, int(p), int(w))
            for p, w in zip(*pairs, strict=True)
        ]
    ).mean()


def drawn(
    plan: Plan, draws: int, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor]:
    """(draws,) numbers of field points, evenly, and of wavelengths, by their weights:
    what :func:`surrogate` takes.
    """
    points = torch.randint(
        len(plan.y_um) * len(plan.x_um), (draws,), generator=generator
    )
    return points, torch.multinomial(
        torch.as_tensor(plan.waves.weights),
        draws,
        replacement=True,
        generator=generator,
    )


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
