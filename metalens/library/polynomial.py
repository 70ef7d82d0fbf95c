"""Chebyshev polynomials of a pillar's diameter over millions of pillars: value, slope,
inverse and certified bounds, for NumPy arrays and torch tensors.
"""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar, cast

import numpy as np
from numpy.polynomial import chebyshev

from metalens.core.arrays import Array
from metalens.core.errors import DomainError
from metalens.core.threads import run_each

Values = TypeVar("Values")  # numpy array, torch tensor or number: leaves as it came
Intervals = tuple[tuple[float, float], ...]


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
    def derivative(self) -> "ChebyshevCurve":
        """dp / d(D^power), on the same domain."""
        terms = (k * self.scale * c for k, c in enumerate(self.monomials))
        return replace(self, monomials=(*terms, 0.0)[1:], ceiling=math.inf)


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
    monomials = tuple(chebyshev.cheb2poly(coefficients).tolist())
    return ChebyshevCurve(monomials, *domain, power, ceiling)


def is_tensor(values: object) -> bool:
    """Whether ``values`` is a torch tensor; torch is not loaded."""
    return type(values).__module__.partition(".")[0] == "torch"


def _to_floats(values: Any) -> Array:
    """Values as an array of floats; single precision is kept."""
    array = np.asarray(values)
    return array if array.dtype.kind == "f" else array.astype(float)


def evaluate_curve(p: ChebyshevCurve, diameter: Values) -> Values:
    """p(D) by Horner's rule, in the shape, dtype and on the device of ``diameter``.

    Args:
        p: the curve.
        diameter: number, NumPy array or torch tensor, um; tensors carry derivatives of
            every order by backward, and are all that is kept for them.

    Accuracy: a few roundings of the dtype times the sum of |monomials|.

    Raises:
        DomainError: a diameter lies outside the domain, or is not a number.
    """
    if is_tensor(diameter):
        return cast(Values, _torch_curve()(diameter, p))
    d = _to_floats(diameter)
    check_domain(p, d)
    return cast(Values, _over_chunks(functools.partial(_sum_powers, p), d)[()])


def evaluate_slope(p: ChebyshevCurve, diameter: Values) -> Values:
    """dp/dD at ``diameter`` (um); otherwise as :func:`evaluate_curve` of ``p``."""
    d: Any = diameter
    by_power = evaluate_curve(p.derivative, d)
    return cast(Values, by_power * p.power * d ** (p.power - 1))


def _sum_powers(p: ChebyshevCurve, d: Any) -> Any:
    """p(D) in the dtype of ``d``, NumPy or torch, without a check of the domain."""
    x = d * p.scale
    for _ in range(p.power - 1):
        x *= d
    x += p.shift
    total = x * 0 + p.monomials[-1]
    for c in p.monomials[-2::-1]:
        total *= x
        total += c
    return total.clip(max=p.ceiling) if math.isfinite(p.ceiling) else total


def _over_chunks(
    work: Callable[[Array], Array], values: Array, chunk: int = 65536
) -> Array:
    """Elementwise ``work`` on an array, in cache-sized chunks on all cores that the
    process may use.

    Args:
        work: function of a 1-D array that keeps its shape and dtype.
        values: array of any shape.
        chunk: pillars per pass, whose work arrays stay in the cache.
    """
    flat = np.ascontiguousarray(values).ravel()
    if flat.size <= chunk:
        return work(flat).reshape(values.shape)
    out = np.empty_like(flat)

    def fill(start: int) -> None:
        out[start : start + chunk] = work(flat[start : start + chunk])

    run_each(fill, range(0, flat.size, chunk))
    return out.reshape(values.shape)


@functools.cache
def _torch_curve() -> Callable[[Any, ChebyshevCurve], Any]:
    """:func:`evaluate_curve` as a torch function that saves only its input for
    derivatives.
    """
    import torch

    class Curve(torch.autograd.Function):
        @staticmethod
        def forward(ctx: Any, diameter: Any, p: ChebyshevCurve) -> Any:
            ctx.curve = p
            ctx.save_for_backward(diameter)
            if diameter.device.type == "cpu":
                value = np.asarray(evaluate_curve(p, diameter.detach().numpy()))
                return torch.from_numpy(value)
            check_domain(p, diameter)
            return _sum_powers(p, diameter)

        @staticmethod
        def backward(ctx: Any, *gradients: Any) -> Any:
            return gradients[0] * evaluate_slope(ctx.curve, *ctx.saved_tensors), None

    apply: Callable[[Any, ChebyshevCurve], Any] = Curve.apply
    return apply


def check_domain(p: ChebyshevCurve, diameter: Any, edge_um: float = 1e-6) -> None:
    """Refuse diameters (NumPy or torch, um) outside the domain of ``p``.

    Args:
        diameter: array or tensor of diameters, um.
        edge_um: what a diameter outside may be by rounding.

    Raises:
        DomainError: naming both ranges.
    """
    if 0 in diameter.shape:
        return
    least, most = float(diameter.min()), float(diameter.max())
    if not (least >= p.low - edge_um and most <= p.high + edge_um):
        raise DomainError(
            f"diameters run from {least:.6g} to {most:.6g} um, but the proxy holds from "
            f"{p.low:.6g} to {p.high:.6g} um; keep the diameters inside, or sweep a "
            "library over a wider range"
        )


def is_monotonic(p: ChebyshevCurve, within: tuple[float, float]) -> bool:
    """Whether ``p`` rises or falls throughout ``within`` (um): its slope has no root
    inside, by the roots of the polynomial, not by sampling.
    """
    low, high = p.scale * np.array(within, float) ** p.power + p.shift
    slope = np.polynomial.Polynomial(p.derivative.monomials)
    roots = slope.trim().roots()
    inside = (
        (np.abs(roots.imag) < 1e-9)
        & (roots.real > low + 1e-9)
        & (roots.real < high - 1e-9)
    )
    return bool(np.any(slope.coef) and not inside.any())


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


def invert_phase(
    p: ChebyshevCurve,
    phase_rad: Values,
    *,
    within_um: tuple[float, float] | None,
    gap: str,
    excluded_um: Intervals = (),
    entries: int = 4096,
) -> Values:
    """Diameters in um whose phase on a curve is ``phase_rad`` modulo 2 pi; see
    :meth:`metalens.library.Proxy.diameter_um`.

    A tensor takes one more Newton step on the detached diameter, whose derivative is
    exactly 1 / (dphase/dD).

    Args:
        p: phase over the diameter.
        phase_rad: (*shape) phases, rad.
        within_um: (least, largest) diameter that is considered, um; the whole domain
            without it.
        gap: refuse or nearest, for phases that no pillar has.
        excluded_um: (least, largest) of intervals of diameters; one inside is moved to
            the closer end.
        entries: of the table from which Newton's steps start.

    Raises:
        DomainError: the phase is not monotone there, or no pillar has a phase.
    """
    if is_tensor(phase_rad):
        import torch

        phase: Any = phase_rad
        diameter = invert_phase(
            p,
            phase.detach().cpu().numpy(),
            within_um=within_um,
            gap=gap,
            excluded_um=excluded_um,
        )
        slope = torch.from_numpy(evaluate_slope(p, diameter)).to(phase.device)
        step = (phase - phase.detach()) / slope
        return cast(Values, torch.from_numpy(diameter).to(phase.device) + step)
    low, high = within = within_um or (p.low, p.high)
    if not p.low - 1e-9 <= low < high <= p.high + 1e-9:
        raise DomainError(
            f"within_um = ({low}, {high}), need a range inside the curve's domain ({p.low}, {p.high}) um"
        )
    if not is_monotonic(p, within):
        raise DomainError(
            f"the phase is not monotone between {low} and {high} um: no unique diameter; give a narrower within_um"
        )
    values = _to_floats(phase_rad)
    if not np.isfinite(values).all():
        raise DomainError(
            f"phase at index {_first(~np.isfinite(values))} is not finite"
        )
    # the table of the inverse, from the end of least phase
    d = np.linspace(low, high, 16 * entries)
    phases = evaluate_curve(p, d)
    if phases[-1] < phases[0]:
        d, phases = d[::-1], phases[::-1]
    start, cover = float(phases[0]), float(phases[-1] - phases[0])
    if gap == "refuse" and cover < math.tau:
        missing = (values.astype(float) - start) % math.tau > cover + 1e-6
        if missing.any():
            raise DomainError(
                f"no pillar between {low:.4g} and {high:.4g} um has the phase at index {_first(missing)}: "
                f"they cover {cover / math.tau:.3f} of a turn ({int(missing.sum())} sites); "
                "widen the diameters, change the cell, or take the nearest with gap='nearest'"
            )
    table = np.interp(np.linspace(start, start + cover, entries), phases, d)

    def invert(chunk: Array) -> Array:
        target = (chunk.astype(float) - start) % math.tau
        beyond = target > cover
        nearest = target - cover <= math.tau - target
        target[beyond] = np.where(nearest[beyond], cover, 0.0)
        diameter = _newton(p, start + target, target * ((entries - 1) / cover), table)
        for least, most in excluded_um:
            # an end outside the considered range is no place to move to
            middle = np.inf if most > high else (least + most) / 2
            middle = -np.inf if least < low else middle
            inside = (diameter > least) & (diameter < most)
            diameter[inside] = np.where(diameter[inside] < middle, least, most)
        return diameter.astype(chunk.dtype)

    return cast(Values, _over_chunks(invert, values)[()])


def _newton(p: ChebyshevCurve, phase: Array, place: Array, table: Array) -> Array:
    """Diameters of phases, by linear interpolation in a table and Newton's steps, d -=
    (p(d) - phase) / slope(d).

    Convergence is quadratic, and one step is the rule. It is linear (by halves) where
    the slope vanishes at the root; a diameter of zero slope stays.

    Args:
        p: monotone phase over the diameter.
        phase: (n,) rad.
        place: (n,) place in the table.
        table: (entries,) diameters at even steps of the phase, um.
    """
    index = np.minimum(place.astype(np.int64), len(table) - 2)
    d = table[index] + (place - index) * np.diff(table)[index]
    for _ in range(54):  # a double has 53 bits
        error = _sum_powers(p, d) - phase
        # below the documented 1e-10 rad, above the rounding of 100 rad
        if np.abs(error).max(initial=0.0) < 1e-12:
            break
        slope = _sum_powers(p.derivative, d) * p.power * d ** (p.power - 1)
        d -= np.divide(error, slope, out=np.zeros_like(d), where=slope != 0)
        np.clip(d, table.min(), table.max(), out=d)
    return np.asarray(d)


def _first(mask: Array) -> tuple[int, ...]:
    """Index of the first True value."""
    return tuple(int(i) for i in np.argwhere(mask)[0])
