"""Gradients of an image's loss by the PSFs at the nodes: exact, and by few of them."""

from collections.abc import Set
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from metalens.image.low_rank import PsfField, fast_shape, frame_maps
from metalens.image.plan import Plan, sum_over_spectrum
from metalens.image.points import Optics, psfs
from metalens.image.splines import TAPS, spline_coefficients, spline_taps


def by_nodes(
    field: PsfField,
    content: Tensor,
    depth_um: Tensor,
    *,
    illuminated: bool = True,
    asked: Set[int] | None = None,
) -> Tensor:
    """Zeros (frames, *sheets, y, x) whose derivatives by PSFs and depths are those of
    the image through all nodes.

    Args:
        field: sampled field or PSFs.
        content, depth_um: (frames, *sheets, y, x) light or coverage, and depth.
        illuminated: whether the content is light, which the illumination weighs.
        asked: numbers of the nodes whose derivatives are wanted, the others' being 0;
            None for all.
    """
    shares = depth_shares(depth_um, field.depths_um)
    about = field.illumination.detach(), illuminated, asked
    zeros: Tensor = _ByNodes.apply(field.psf, shares, content, about)  # type: ignore[no-untyped-call]
    return zeros


class _ByNodes(torch.autograd.Function):
    """See :func:`by_nodes`."""

    @staticmethod
    def forward(
        ctx: Any, psf: Tensor, shares: Tensor, content: Tensor, about: Any
    ) -> Tensor:
        ctx.save_for_backward(psf, shares, content)
        ctx.about = about
        return torch.zeros_like(content)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        psf, shares, content = tuple[Tensor, ...](ctx.saved_tensors)
        illumination, illuminated, asked = ctx.about
        of_psf, of_depth, *_ = ctx.needs_input_grad
        rows, columns, depths, h, w = psf.shape
        level = illumination[..., None, None] if illuminated else torch.ones(1)
        deep = spline_coefficients(depths).to(content)
        frame = content.shape[-2:]
        maps = frame_maps((frame[0], frame[1]), psf.shape[:2], content)
        shape = fast_shape((frame[0] + h - 1, frame[1] + w - 1))
        # image samples half a window beyond the frame are not part of it
        seen = torch.nn.functional.pad(gradient, (w // 2, w // 2, h // 2, h // 2))
        spectrum = torch.fft.rfft2(seen, s=shape)
        out, back = torch.zeros_like(psf), torch.zeros_like(shares)
        every = range(rows * columns) if of_depth or asked is None else asked
        for node in every:
            a, b = divmod(node, columns)
            near = content * (maps[0][:, a, None] * maps[1][:, b])
            if of_psf and (asked is None or node in asked):
                found = []
                for share in shares:
                    part = torch.fft.rfft2(near * share, s=shape).conj() * spectrum
                    whole = torch.fft.irfft2(part.flatten(0, -3).sum(0), s=shape)
                    found.append(whole[:h, :w])
                out[a, b] = torch.einsum("cz,cyx->zyx", deep, torch.stack(found))
            if of_depth:
                light = (psf[a, b] * level[a, b] if illuminated else psf[a, b]).to(
                    content
                )
                for k, psf_k in enumerate(torch.einsum("cz,zyx->cyx", deep, light)):
                    part = torch.fft.rfft2(psf_k, s=shape).conj() * spectrum
                    whole = torch.fft.irfft2(part, s=shape)
                    back[k] += near * whole[..., : frame[0], : frame[1]]
        if illuminated:
            out *= level.to(out)
        return out if of_psf else None, back if of_depth else None, None, None


def depth_shares(depth_um: Tensor, depths_um: Tensor) -> Tensor:
    """(coefficients, …) B-spline of every depth coefficient at these depths.

    Args:
        depth_um: source depth from the lens, um.
        depths_um: source depths from the lens, um.
    """
    near, far = 1 / float(depths_um[0]), 1 / float(depths_um[-1])
    unit = ((near - 1 / depth_um) / max(near - far, 1e-30)).clamp(0, 1)
    nodes = len(depths_um)
    first, taps = spline_taps(unit, nodes)
    number = first[..., None] + torch.arange(TAPS, device=first.device)
    shares = [
        (taps * (number == coefficient)).sum(-1)
        for coefficient in range(max(nodes + 2, TAPS))
    ]
    return torch.stack(shares)


def node_light(optics: Optics, plan: Plan) -> Tensor:
    """(rows, columns, depths, h, w) light of all nodes, without a graph: a leaf that
    gathers the gradient.

    Args:
        optics: lens, light and distances at the nodes.
        plan: field nodes, depths and wavelengths.
    """
    with torch.no_grad():
        light = sum_over_spectrum(
            optics, plan.places_um, plan.depths_um, plan.waves, plan.window
        )
    size = len(plan.y_um), len(plan.x_um)
    return light.reshape(*size, *light.shape[1:]).requires_grad_()


def surrogate_loss(
    optics: Optics, plan: Plan, gradient: Tensor, pairs: tuple[Tensor, Tensor]
) -> Tensor:
    """A scalar whose gradient to the phase is, in the mean over the draws, that of the
    loss.

    Args:
        optics: lens, light and distances at the nodes.
        plan: field nodes, depths and wavelengths.
        gradient: (rows, columns, depths, h, w) of the loss with respect to
            :func:`node_light`, of the field points that
            were drawn.
        pairs: a field point and a wavelength each, of :func:`draw_nodes`.
    """
    return torch.stack(
        [
            gradient_term(optics, plan, gradient, int(p), int(w))
            for p, w in zip(*pairs, strict=True)
        ]
    ).mean()


def draw_nodes(
    plan: Plan, draws: int, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor]:
    """(draws,) numbers of field points, evenly, and of wavelengths, by their weights:
    what :func:`surrogate_loss` takes.

    Args:
        plan: field nodes, depths and wavelengths.
        generator: of the random draws; the global one without it.
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


def gradient_term(
    optics: Optics, plan: Plan, gradient: Tensor, point: int, wave: int
) -> Tensor:
    """What one draw adds: number of points · <G_point, light_point,wave>.

    Args:
        optics: lens, light and distances at the nodes.
        plan: field nodes, depths and wavelengths.
    """
    places = plan.places_um
    light = psfs(
        optics,
        places[point : point + 1].to(gradient.device),
        depths_um=plan.depths_um,
        wavelength_um=float(plan.waves.wavelengths_um[wave]),
        window=plan.window,
        finest_um=float(plan.waves.wavelengths_um.min()),
    )[0]
    return len(places) * (gradient.flatten(0, 1)[point] * light).sum()
