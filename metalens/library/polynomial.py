"""Chebyshev polynomials of a pillar's diameter over millions of pillars: value, slope
and certified bounds.
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

CHUNK = 65536  # pillars a pass: its work arrays stay in the cache
EDGE_UM = 1e-6  # a diameter this far outside the domain is rounding


@dataclass(frozen=True, slots=True)
class ChebyshevCurve:
    """p(x) with x = (2 D^power - low^power - high^power) / (high^power - low^power), x
    in [-1, 1] on the domain.

    monomials: coefficients of 1, x, x², ... (Python floats, so that they never raise
    the dtype of an array).
    low, high: ends of the domain.
    power: of the diameter; the phase of a pillar follows its area or a higher power
    better than its diameter.
    ceiling: above which the exact polynomial never is: what rounding adds there is
    taken off.
    """

    monomials: tuple[float, ...]
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

    @property
    def slope(self) -> "ChebyshevCurve":
        """dp/dx; times :meth:`inner_slope` it is dp/dD."""
        terms = tuple(k * c for k, c in enumerate(self.monomials))[1:] or (0.0,)
        return ChebyshevCurve(terms, self.low, self.high, self.power)

    @property
    def inner_slope(self) -> float:
        """dx/dD = inner_slope * D^(power-1)."""
        return self.scale * self.power


def chebyshev_curve(
    coefficients: Array,
    domain: tuple[float, float],
    power: int,
    ceiling: float = math.inf,
) -> ChebyshevCurve:
    """The curve of 1-D Chebyshev ``coefficients`` on ``domain``."""
    return ChebyshevCurve(
        _monomials(tuple(coefficients.tolist())), *domain, power, ceiling
    )


@functools.lru_cache(maxsize=256)
def _monomials(coefficients: tuple[float, ...]) -> tuple[float, ...]:
    """Of 1, x, x², ...: those of Chebyshev polynomials; value and slope at a wavelength
    ask for the same.
    """
    return tuple(float(c) for c in chebyshev.cheb2poly(coefficients))


def evaluate_curve(p: ChebyshevCurve, diameter: Array) -> Array:
    """p(D), shape and dtype of ``diameter``.

    Accuracy: of Horner's rule, a few times the rounding of the dtype times the sum of
    |monomials|.

    Raises:
        DomainError: a diameter lies outside the domain, or is not a number.
    """
    check_domain(p, diameter)
    return over_chunks(
        lambda d: np.minimum(
            evaluate_horner(p.monomials, to_unit_interval(p, d)), p.ceiling
        ),
        diameter,
    )


def evaluate_slope(p: ChebyshevCurve, diameter: Array) -> Array:
    """dp/dD, shape and dtype of ``diameter``; raises as :func:`evaluate_curve`."""
    check_domain(p, diameter)
    return over_chunks(lambda d: slope_of(p, d), diameter)


def pulled_back(p: ChebyshevCurve, diameter: Array, weight: Array) -> Array:
    """``weight`` times dp/dD in one pass; the diameters were checked before, the weight
    may be broadcast.
    """

    def part(start: int, d: Array) -> Array:
        rise = slope_of(p, d)
        rise *= weight if weight.ndim == 0 else weight[start : start + len(d)]
        return rise

    if weight.ndim and not any(weight.strides):
        weight = weight[(0,) * weight.ndim]
    if weight.ndim:
        weight = np.ascontiguousarray(weight).reshape(-1)
    return over_chunks(part, diameter, places=True)


def check_domain(p: ChebyshevCurve, diameter: Any) -> None:
    """Refuse diameters (numpy or torch) outside the domain of ``p``."""
    if 0 in diameter.shape:
        return
    least, most = float(diameter.min()), float(diameter.max())
    if not (least >= p.low - EDGE_UM and most <= p.high + EDGE_UM):
        raise DomainError(
            f"diameters run from {least:.6g} to {most:.6g} um, but the proxy holds from {p.low:.6g} to "
            f"{p.high:.6g} um; keep the diameters inside, or sweep a library over a wider range"
        )


def slope_of(p: ChebyshevCurve, diameter: Array) -> Array:
    """dp/dD of one chunk."""
    rise = evaluate_horner(p.slope.monomials, to_unit_interval(p, diameter))
    rise *= p.inner_slope
    for _ in range(p.power - 1):
        rise *= diameter
    return rise


def to_unit_interval(p: ChebyshevCurve, diameter: Array) -> Array:
    """x of one chunk."""
    x = diameter * p.scale
    for _ in range(p.power - 1):
        x *= diameter
    x += p.shift
    return x


def is_monotonic(p: ChebyshevCurve, within: tuple[float, float]) -> bool:
    """Whether the curve rises or falls throughout: no root of its slope lies inside
    (certified, not sampled).
    """
    low, high = to_unit_interval(p, np.array(within, float))
    roots = (
        np.polynomial.Polynomial(p.slope.monomials).roots()
        if len(p.monomials) > 2
        else np.array([])
    )
    inside = (
        (np.abs(roots.imag) < 1e-9)
        & (roots.real > low + 1e-9)
        & (roots.real < high - 1e-9)
    )
    return bool(np.any(p.slope.monomials) and not inside.any())


def evaluate_horner(monomials: tuple[float, ...], x: Array) -> Array:
    """Sum of monomials[k] x^k, in the dtype of ``x``."""
    total = np.full_like(x, monomials[-1])
    for c in monomials[-2::-1]:
        total *= x
        total += c
    return total


def over_chunks(
    work: Callable[..., Array], values: Array, *, places: bool = False
) -> Array:
    """``work`` elementwise over an array in cache-sized chunks, on all cores that the
    process may use.

    places: ``work`` also takes, first, where the chunk starts.
    """
    flat = np.ascontiguousarray(values).ravel()

    def made(start: int) -> Array:
        chunk = flat[start : start + CHUNK]
        return work(start, chunk) if places else work(chunk)

    if flat.size <= CHUNK:
        return made(0).reshape(values.shape)
    out = np.empty_like(flat)

    def run(start: int) -> None:
        out[start : start + CHUNK] = made(start)

    with ThreadPoolExecutor(
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None
    ) as pool:
        list(pool.map(run, range(0, flat.size, CHUNK)))
    return out.reshape(values.shape)


def certified_bounds(coefficients: Array, *, points: int = 64) -> tuple[float, float]:
    """Certified (lower, upper) bound of a tensor Chebyshev sum on [-1, 1]^n.

    With N >= points * degree Chebyshev nodes on the last axis (24 * degree on the
    others), a polynomial q of degree d
    has max|q| <= max over the nodes |q| / cos(pi d / 2N) an axis (Ehlich and Zeller 1964); applied to q = p - middle.

    Accuracy: the bound is too wide by at most 3e-4 (points = 64) of the polynomial's
    half-range for the last axis and
    2e-3 for each other.
    """
    values, slack = np.asarray(coefficients, float), 1.0
    for axis, count in enumerate(values.shape):
        degree = count - 1
        nodes = chebyshev.chebpts1(
            max(1, (points if axis == values.ndim - 1 else 24) * degree)
        )
        values = np.moveaxis(
            np.tensordot(chebyshev.chebvander(nodes, degree), values, (1, axis)),
            0,
            axis,
        )
        slack /= math.cos(math.pi * degree / (2 * len(nodes))) if degree else 1.0
    middle, half = (values.max() + values.min()) / 2, (values.max() - values.min()) / 2
    return float(middle - half * slack), float(middle + half * slack)
