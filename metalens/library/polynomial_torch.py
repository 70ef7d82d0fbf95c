"""The polynomials of :mod:`metalens.library.polynomial` for torch tensors, with exact
derivatives of every order.
"""

from typing import Any, cast

import torch

from metalens.library import polynomial
from metalens.library.polynomial import ChebyshevCurve


def evaluate_curve(p: ChebyshevCurve, diameter: torch.Tensor) -> torch.Tensor:
    """p(D) on the device and in the dtype of ``diameter``; differentiable by backward,
    forward and vmap.
    """
    return cast(torch.Tensor, _Polynomial.apply(diameter, p, 0))  # type: ignore[no-untyped-call]


def evaluate_slope(p: ChebyshevCurve, diameter: torch.Tensor) -> torch.Tensor:
    """dp/dD, differentiable again."""
    return cast(torch.Tensor, _Polynomial.apply(diameter, p, 1))  # type: ignore[no-untyped-call]


def _bend(p: ChebyshevCurve, diameter: torch.Tensor) -> torch.Tensor:
    """d²p/dD², in differentiable operations: x' = a D^m gives p'' x'² + p' x''."""
    m = p.power - 1
    bend = evaluate_curve(p.slope.slope, diameter) * (p.inner_slope * diameter**m) ** 2
    return (
        bend
        + evaluate_curve(p.slope, diameter) * (p.inner_slope * m * diameter ** (m - 1))
        if m
        else bend
    )


class _Polynomial(torch.autograd.Function):
    """Elementwise p(D) (order 0) or dp/dD (order 1) that keeps only its input for the
    backward pass.
    """

    @staticmethod
    def forward(diameter: torch.Tensor, p: ChebyshevCurve, order: int) -> torch.Tensor:
        if diameter.device.type == "cpu":
            verb = polynomial.evaluate_slope if order else polynomial.evaluate_curve
            return torch.from_numpy(verb(p, diameter.detach().numpy()))
        return _on_device(diameter, p, order)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        diameter, ctx.curve, ctx.order = inputs
        ctx.save_for_backward(diameter)
        ctx.save_for_forward(diameter)

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> Any:
        (diameter,) = ctx.saved_tensors
        weight = gradients[0]
        plain = not (
            ctx.order
            or torch.is_grad_enabled()
            or torch._C._functorch.maybe_current_level()
        )
        if plain and diameter.device.type == "cpu" and weight.dtype == diameter.dtype:
            fused = polynomial.pulled_back(
                ctx.curve, diameter.detach().numpy(), weight.detach().numpy()
            )
            return torch.from_numpy(fused), None, None
        return (
            weight * (_bend if ctx.order else evaluate_slope)(ctx.curve, diameter),
            None,
            None,
        )

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:
        (diameter,) = ctx.saved_tensors
        return tangents[0] * (_bend if ctx.order else evaluate_slope)(
            ctx.curve, diameter
        )

    @staticmethod
    def vmap(
        info: Any,
        in_dims: tuple[Any, ...],
        diameter: torch.Tensor,
        p: ChebyshevCurve,
        order: int,
    ) -> tuple[Any, Any]:
        return (evaluate_slope if order else evaluate_curve)(p, diameter), in_dims[0]


def _on_device(diameter: torch.Tensor, p: ChebyshevCurve, order: int) -> torch.Tensor:
    """p(D) (order 0) or dp/dD (order 1) by torch's own operations, on whatever device."""
    polynomial.check_domain(p, diameter)
    x = diameter**p.power * p.scale + p.shift
    if order:
        return _horner(p.slope, x) * (p.inner_slope * diameter ** (p.power - 1))
    return _horner(p, x).clamp_max(p.ceiling)


def _horner(p: ChebyshevCurve, x: torch.Tensor) -> torch.Tensor:
    total = torch.full_like(x, p.monomials[-1])
    for c in p.monomials[-2::-1]:
        total = total * x + c
    return total
