"""Gradients of an image's loss by the PSFs at the nodes: exact, and by few of them."""

from collections.abc import Set
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from metalens.image.low_rank import PsfField, fast_shape, frame_maps
from metalens.image.plan import ImagingPlan, sum_over_spectrum
from metalens.image.points import Optics, psfs
from metalens.image.splines import depth_position, spline_basis, spline_coefficients


def by_nodes(
    field: PsfField,
    content: Tensor,
    depth_um: Tensor,
    *,
    illuminated: bool = True,
    asked: Set[int] | None = None,
) -> Tensor:
    """Zeros that carry the derivatives of the image by the PSFs of all nodes.

    Added to an image by low-rank kernels, (frames, *sheets, y, x), they give it the
    exact derivatives by PSFs.

    Args:
        field: PSFs of the nodes and their illumination.
        content, depth_um: (frames, *sheets, y, x) light or coverage, and depth.
        illuminated: whether the content is light, which the illumination weighs.
        asked: numbers of the nodes whose derivatives are computed, those of other nodes
            being 0; None for all.
    """
    vergence = 1 / float(field.depths_um[0]), 1 / float(field.depths_um[-1])
    unit = depth_position(depth_um, vergence)
    shares = spline_basis(unit, len(field.depths_um)).movedim(-1, 0)
    options = field.illumination.detach(), illuminated, asked
    zeros: Tensor = _ByNodes.apply(field.psf, shares, content, options)  # type: ignore[no-untyped-call]
    return zeros


class _ByNodes(torch.autograd.Function):
    """See :func:`by_nodes`."""

    @staticmethod
    def forward(
        ctx: Any, psf: Tensor, shares: Tensor, content: Tensor, options: Any
    ) -> Tensor:
        ctx.save_for_backward(psf, shares, content)
        ctx.options = options
        return torch.zeros_like(content)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        """Gradient by PSFs (rows, columns, depths, h, w).

        The image is Σ_nodes PSF * (content · spline · share): the gradient is the
        correlation of the image's gradient with the other factors, by FFT.
        """
        psf, shares, content = tuple[Tensor, ...](ctx.saved_tensors)
        illumination, illuminated, asked = ctx.options
        rows, columns, depths, h, w = psf.shape
        to_coefficients = spline_coefficients(depths).to(content)
        height, width = content.shape[-2:]
        maps = frame_maps((height, width), psf.shape[:2], content)
        shape = fast_shape((height + h - 1, width + w - 1))
        # image samples half a window beyond the frame are not part of it
        padded = torch.nn.functional.pad(gradient, (w // 2, w // 2, h // 2, h // 2))
        spectrum = torch.fft.rfft2(padded, s=shape)
        by_psf = torch.zeros_like(psf)
        for node in range(rows * columns) if asked is None else asked:
            a, b = divmod(node, columns)
            sources = content * (maps[0][:, a, None] * maps[1][:, b])
            by_coefficient = []
            for share in shares:
                part = torch.fft.rfft2(sources * share, s=shape).conj() * spectrum
                whole = torch.fft.irfft2(part.flatten(0, -3).sum(0), s=shape)
                by_coefficient.append(whole[:h, :w])
            by_psf[a, b] = torch.einsum(
                "cz,cyx->zyx", to_coefficients, torch.stack(by_coefficient)
            )
        if illuminated:
            by_psf *= illumination[..., None, None].to(by_psf)
        return by_psf, None, None, None


def node_light(optics: Optics, plan: ImagingPlan) -> Tensor:
    """(rows, columns, depths, h, w) light of all nodes, as a leaf tensor.

    It has no graph of its own and receives the gradient of the loss.

    Args:
        optics: wave of the lens, layers and lens-sensor distance.
        plan: field nodes, depths and wavelengths.
    """
    with torch.no_grad():
        light = sum_over_spectrum(
            optics, plan.places_um, plan.depths_um, plan.waves, plan.window
        )
    size = len(plan.y_um), len(plan.x_um)
    return light.reshape(*size, *light.shape[1:]).requires_grad_()


def surrogate_loss(
    optics: Optics, plan: ImagingPlan, gradient: Tensor, pairs: tuple[Tensor, Tensor]
) -> Tensor:
    """A scalar whose expected gradient to the phase is that of the loss.

    The mean of :func:`gradient_term` over random field points and wavelengths.

    Args:
        optics: wave of the lens, layers and lens-sensor distance.
        plan: field nodes, depths and wavelengths.
        gradient: (rows, columns, depths, h, w) of the loss with respect to
            :func:`node_light`, at least at the drawn field points.
        pairs: (draws,) numbers of field points and of wavelengths (:func:`draw_nodes`).
    """
    return torch.stack(
        [
            gradient_term(optics, plan, gradient, int(p), int(w))
            for p, w in zip(*pairs, strict=True)
        ]
    ).mean()


def draw_nodes(
    plan: ImagingPlan, draws: int, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor]:
    """(draws,) random field points, uniform, and wavelengths, by their weights.

    Args:
        plan: field nodes, depths and wavelengths.
        draws: number of pairs.
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
    optics: Optics, plan: ImagingPlan, gradient: Tensor, point: int, wave: int
) -> Tensor:
    """The term of one draw: number of field points · <G_point, light_point,wave>.

    Args:
        optics: wave of the lens, layers and lens-sensor distance.
        plan: field nodes, depths and wavelengths.
        gradient: (rows, columns, depths, h, w) G, of the loss by the nodes' light.
        point: number of the field point, row by row.
        wave: number of the wavelength.
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
