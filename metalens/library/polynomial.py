"""Chebyshev polynomials of a pillar's diameter over millions of pillars: value, slope
and certified bounds, for NumPy arrays and torch tensors.
"""

import functools
import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev

from metalens.core.arrays import Array
from metalens.core.errors import DomainError

CHUNK = 65536  # pillars per pass: its work arrays stay in the cache
EDGE_UM = 1e-6  # a diameter this far outside the domain is rounding
Monomials = tuple[float, ...]  # Python floats never raise the dtype of an array


@dataclass(frozen=True, slots=True)
class ChebyshevCurve:
    """p(x) with x = (2 D^power - low^power - high^power) / (high^power - low^power), x
    in [-1, 1] on the domain.

    Attributes:
        monomials: coefficients of 1, x, x², …
        low: least diameter of the domain, um.
        high: largest diameter of the domain, um.
        power: of the diameter; the phase of a pillar follows its area or a higher power
            better than its diameter.
        ceiling: the exact polynomial stays below it; rounding above it is removed.
    """

    monomials: Monomials
    low: float
    high: float
    power: int = 1
    ceiling: float = math.inf

    @property
    def scale(self) -> float:
        """dx / d(D^power)."""
        return 2 / (self.high**self.power - self.low**self.power)

    @property
    def shift(self) -> float:
        """x at D = 0."""
        return -1 - self.scale * self.low**self.power


def chebyshev_curve(
    coefficients: Array,
    domain: tuple[float, float],
    power: int,
    ceiling: float = math.inf,
) -> ChebyshevCurve:
    """Curve of a 1-D Chebyshev sum on a domain.

    Args:
        coefficients: (degree + 1,) of the sum.
        domain: (least, largest) diameter, um.
        power: of the diameter, see :class:`ChebyshevCurve`.
        ceiling: upper limit of the values.
    """
    monomials = _to_monomials(tuple(coefficients.tolist()))
    return ChebyshevCurve(monomials, *domain, power, ceiling)


@functools.lru_cache(maxsize=256)
def _to_monomials(coefficients: tuple[float, ...]) -> Monomials:
    """Coefficients of 1, x, x², … of a Chebyshev sum."""
    return tuple(float(c) for c in chebyshev.cheb2poly(coefficients))


def _derivative(p: ChebyshevCurve, monomials: Monomials) -> Monomials:
    """Monomials in x of (dq/dD) / D^(power - 1), by dx/dD = scale power D^(power - 1).

    Args:
        p: curve that maps D to x.
        monomials: of q.
    """
    inner = p.scale * p.power
    return tuple(k * inner * c for k, c in enumerate(monomials))[1:] or (0.0,)


def evaluate_curve(p: ChebyshevCurve, diameter: Any) -> Any:
    """p(D) by Horner's rule, in the shape, dtype and on the device of ``diameter``.

    Args:
        p: the curve.
        diameter: NumPy array or torch tensor, um; tensors carry derivatives of every
            order by backward, forward and vmap, and keep only x for them.

    Accuracy: a few roundings of the dtype times the sum of |monomials|.

    Raises:
        DomainError: a diameter lies outside the domain, or is not a number.
    """
    value = _evaluate_term(p, p.monomials, 0, diameter)
    return value.clip(max=p.ceiling) if math.isfinite(p.ceiling) else value


def evaluate_slope(p: ChebyshevCurve, diameter: Any) -> Any:
    """dp/dD at ``diameter`` (um); otherwise as :func:`evaluate_curve` of ``p``."""
    slope = _derivative(p, p.monomials)
    return _evaluate_term(p, slope, p.power - 1, diameter)


def slope_of(p: ChebyshevCurve, diameter: Array) -> Array:
    """dp/dD at ``diameter`` (um), without a check of the domain of ``p``."""
    slope = _derivative(p, p.monomials)
    return np.asarray(_term(p, slope, p.power - 1, diameter))


def to_unit_interval(p: ChebyshevCurve, diameter: Any) -> Any:
    """x of ``diameter`` (um) on the curve ``p``: scale diameter^power + shift."""
    x = diameter * p.scale
    for _ in range(p.power - 1):
        x *= diameter
    x += p.shift
    return x


def evaluate_horner(monomials: Monomials, x: Any) -> Any:
    """Sum of monomials[k] x^k in the dtype of ``x``, NumPy or torch."""
    total = x * 0 + monomials[-1]
    for c in monomials[-2::-1]:
        total *= x
        total += c
    return total


def _term(p: ChebyshevCurve, monomials: Monomials, exponent: int, diameter: Any) -> Any:
    """D^exponent q(x(D)), NumPy or torch.

    Args:
        p: curve that maps D to x.
        monomials: of q.
        exponent: of D.
        diameter: D, um.
    """
    total = evaluate_horner(monomials, to_unit_interval(p, diameter))
    for _ in range(exponent):
        total *= diameter
    return total


def _evaluate_term(
    p: ChebyshevCurve, monomials: Monomials, exponent: int, diameter: Any
) -> Any:
    """:func:`_term` inside the domain, differentiable where ``diameter`` is a tensor."""
    if not isinstance(diameter, np.ndarray):
        return _torch_term()(diameter, p, monomials, exponent)
    check_domain(p, diameter)
    return over_chunks(functools.partial(_term, p, monomials, exponent), diameter)


@functools.cache
def _torch_term() -> Callable[[Any, ChebyshevCurve, Monomials, int], Any]:
    """:func:`_term` as a torch function that saves only its input for derivatives.

    Terms are closed under differentiation: with a = dx/d(D^m) and m = power, d/dD [D^k
    q(x)] = k D^(k-1) q(x) + D^(k+m-1) a m q'(x).
    """
    import torch

    class Term(torch.autograd.Function):
        @staticmethod
        def forward(diameter: Any, p: Any, monomials: Any, exponent: Any) -> Any:
            if diameter.device.type == "cpu":
                values = diameter.detach().numpy()
                value = _evaluate_term(p, monomials, exponent, values)
                return torch.from_numpy(value)
            check_domain(p, diameter)
            return _term(p, monomials, exponent, diameter)

        @staticmethod
        def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
            diameter, *ctx.term = inputs
            ctx.save_for_backward(diameter)
            ctx.save_for_forward(diameter)

        @staticmethod
        def backward(ctx: Any, *gradients: Any) -> Any:
            return gradients[0] * term_slope(ctx), None, None, None

        @staticmethod
        def jvp(ctx: Any, *tangents: Any) -> Any:
            return tangents[0] * term_slope(ctx)

        @staticmethod
        def vmap(info: Any, dims: Any, diameter: Any, *term: Any) -> Any:
            return apply(diameter, *term), dims[0]

    def term_slope(ctx: Any) -> Any:
        (diameter,), (p, q, k) = ctx.saved_tensors, ctx.term
        value = apply(diameter, p, _derivative(p, q), k + p.power - 1)
        return value + k * apply(diameter, p, q, k - 1) if k else value

    apply: Callable[..., Any] = Term.apply
    return apply


def over_chunks(work: Callable[[Array], Array], values: Array) -> Array:
    """Elementwise ``work`` on an array, in cache-sized chunks on all cores that the
    process may use.

    Args:
        work: function of a 1-D array that keeps its shape and dtype.
        values: array of any shape.
    """
    flat = np.ascontiguousarray(values).ravel()
    if flat.size <= CHUNK:
        return work(flat).reshape(values.shape)
    out = np.empty_like(flat)

    def fill(start: int) -> None:
        out[start : start + CHUNK] = work(flat[start : start + CHUNK])

    with ThreadPoolExecutor(
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None
    ) as pool:
        list(pool.map(fill, range(0, flat.size, CHUNK)))
    return out.reshape(values.shape)


def check_domain(p: ChebyshevCurve, diameter: Any) -> None:
    """Refuse diameters (NumPy or torch, um) outside the domain of ``p``.

    Args:
        diameter: array or tensor of diameters, um.

    Raises:
        DomainError: naming both ranges.
    """
    if 0 in diameter.shape:
        return
    least, most = float(diameter.min()), float(diameter.max())
    if not (least >= p.low - EDGE_UM and most <= p.high + EDGE_UM):
        raise DomainError(
            f"diameters run from {least:.6g} to {most:.6g} um, but the proxy holds from "
            f"{p.low:.6g} to {p.high:.6g} um; keep the diameters inside, or sweep a "
            "library over a wider range"
        )


def is_monotonic(p: ChebyshevCurve, within: tuple[float, float]) -> bool:
    """Whether ``p`` rises or falls throughout ``within`` (um): its slope has no root
    inside, by the roots of the polynomial, not by sampling.
    """
    low, high = to_unit_interval(p, np.array(within, float))
    slope = _derivative(p, p.monomials)
    roots = np.polynomial.Polynomial(slope).roots() if len(slope) > 1 else np.empty(0)
    inside = (
        (np.abs(roots.imag) < 1e-9)
        & (roots.real > low + 1e-9)
        & (roots.real < high - 1e-9)
    )
    return bool(np.any(slope) and not inside.any())


def certified_bounds(coefficients: Array, *, points: int = 64) -> tuple[float, float]:
    """Certified (lower, upper) bound of a tensor Chebyshev sum on [-1, 1]^n.

    With N >= points * degree Chebyshev nodes on the last axis (24 * degree on the
    others), a polynomial q of degree d has max|q| <= max over the nodes |q| / cos(pi d
    / 2N) per axis (Ehlich and Zeller 1964); applied to q = p - middle.

    Args:
        coefficients: (…) of the sum, one axis per variable.
        points: nodes per degree on the last axis.

    Accuracy: the bound is too wide by at most 3e-4 (points = 64) of the polynomial's
        half-range for the last axis and 2e-3 for each other.
    """
    values = np.asarray(coefficients, float)
    slack = 1.0
    for axis, count in enumerate(values.shape):
        degree = count - 1
        per_degree = points if axis == values.ndim - 1 else 24
        nodes = chebyshev.chebpts1(max(1, per_degree * degree))
        basis = chebyshev.chebvander(nodes, degree)
        values = np.moveaxis(np.tensordot(basis, values, (1, axis)), 0, axis)
        slack /= math.cos(math.pi * degree / (2 * len(nodes))) if degree else 1.0
    middle = (values.max() + values.min()) / 2
    half = (values.max() - values.min()) / 2
    return float(middle - half * slack), float(middle + half * slack)
