"""Phase to pillar diameter through a proxy: a table of the inverse, then Newton's
steps, for millions of pillars.
"""

import math
from typing import Any, TypeVar, cast

import numpy as np

from metalens.core.arrays import Array
from metalens.core.errors import DomainError
from metalens.library import polynomial
from metalens.library.polynomial import ChebyshevCurve

Values = TypeVar("Values")  # numpy array, torch tensor or number: leaves as it came

TABLE, DENSE = 4096, 16  # entries of the table, and samples of the curve per entry
TURN = 2 * math.pi


Intervals = tuple[tuple[float, float], ...]


def invert_phase(
    p: ChebyshevCurve,
    phase_rad: Values,
    *,
    within_um: tuple[float, float] | None,
    gap: str,
    excluded_um: Intervals = (),
) -> Values:
    """Diameters in um whose phase on a curve is ``phase_rad`` modulo 2 pi; see
    :meth:`metalens.library.Proxy.diameter_um`.

    Args:
        p: phase over the diameter.
        phase_rad: (*shape) phases, rad.
        within_um: (least, largest) diameter that is considered, um; the whole domain
            without it.
        gap: refuse or nearest, for phases that no pillar has.
        excluded_um: (least, largest) of intervals of diameters; one inside is moved to
            the closer end.

    Raises:
        DomainError: the phase is not monotone there, or no pillar has a phase.
    """
    low, high = within_um or (p.low, p.high)
    if not p.low - 1e-9 <= low < high <= p.high + 1e-9:
        raise DomainError(
            f"within_um = ({low}, {high}), need a range inside the curve's domain ({p.low}, {p.high}) um"
        )
    if not polynomial.is_monotonic(p, (low, high)):
        raise DomainError(
            f"the phase is not monotone between {low} and {high} um: no unique diameter; give a narrower within_um"
        )
    if is_tensor(phase_rad):
        return cast(Values, _torch(p, phase_rad, (low, high), gap, excluded_um))
    phase = np.asarray(phase_rad)
    phase = phase if phase.dtype.kind == "f" else phase.astype(float)
    return cast(Values, _solve(p, phase, (low, high), gap, excluded_um)[()])


def is_tensor(values: object) -> bool:
    """Whether ``values`` is a torch tensor; torch is not loaded."""
    return type(values).__module__.partition(".")[0] == "torch"


def _solve(
    p: ChebyshevCurve,
    phase: Array,
    within: tuple[float, float],
    gap: str,
    excluded: Intervals,
) -> Array:
    """Diameters of NumPy phases, um: the phase above that of one end, modulo 2 pi, is
    inverted on the monotone curve.

    With less than a turn covered, a phase beyond it is refused or takes the closer end.

    Args:
        p: phase over the diameter.
        phase: (*shape) rad.
        within: (least, largest) diameter, um.
        gap: refuse or nearest.
        excluded: intervals of diameters, um.
    """
    if not np.isfinite(phase).all():
        raise DomainError(f"phase at index {_first(~np.isfinite(phase))} is not finite")
    end_phases = polynomial.evaluate_curve(p, np.array(within))
    start = float(end_phases.min())
    cover = float(abs(end_phases[1] - end_phases[0]))
    if gap == "refuse" and cover < TURN:
        missing = (phase.astype(float) - start) % TURN > cover + 1e-6
        if missing.any():
            raise DomainError(
                f"no pillar between {within[0]:.4g} and {within[1]:.4g} um has the phase at index {_first(missing)}: "
                f"they cover {cover / TURN:.3f} of a turn ({int(missing.sum())} sites); "
                "widen the diameters, change the cell, or take the nearest with gap='nearest'"
            )
    table = _tabulate_inverse(p, within)

    def invert(chunk: Array) -> Array:
        target = (chunk.astype(np.float64) - start) % TURN
        if cover < TURN:
            beyond = target > cover
            target[beyond] = np.where(
                target[beyond] - cover <= TURN - target[beyond], cover, 0.0
            )
        diameter = _newton(p, target, start, cover, table)
        return _move_out_of(diameter, excluded, within).astype(chunk.dtype)

    return polynomial.over_chunks(invert, phase)


def _move_out_of(d: Array, excluded: Intervals, within: tuple[float, float]) -> Array:
    """Diameters d (um) moved out of the excluded intervals, to the closer end inside
    ``within``; in place.
    """
    for low, high in excluded:
        ends = [end for end in (low, high) if within[0] <= end <= within[1]]
        inside = (d > low) & (d < high)
        if ends and inside.any():
            choice = np.array(ends)
            d[inside] = choice[np.abs(d[inside][:, None] - choice).argmin(axis=1)]
    return d


def _newton(
    p: ChebyshevCurve, target: Array, start: float, cover: float, table: Array
) -> Array:
    """Diameters whose phase is start + target, by linear interpolation in the table and
    Newton's steps, d -= (phase(d) - start - target) / slope(d).

    Convergence is quadratic, and one step is the rule. It is linear (by halves) where
    the slope vanishes at the root; a diameter of zero slope stays.

    Args:
        p: phase over the diameter.
        target: (n,) phases above ``start``, rad, from 0 to ``cover``.
        start: least phase, rad.
        cover: range of the phase, rad.
        table: (TABLE,) diameters at even steps of the phase, um.
    """
    place = target * ((TABLE - 1) / cover)
    index = np.minimum(place.astype(np.int64), TABLE - 2)
    place -= index
    d = table[index]
    d += place * np.diff(table)[index]
    for _ in range(54):  # a double has 53 bits
        error = (
            polynomial.evaluate_horner(p.monomials, polynomial.to_unit_interval(p, d))
            - start
            - target
        )
        # below the documented 1e-10 rad, above the rounding of 100 rad
        if np.abs(error).max(initial=0.0) < 1e-12:
            break
        slope = polynomial.slope_of(p, d)
        d -= np.divide(error, slope, out=np.zeros_like(d), where=slope != 0)
        np.clip(d, table.min(), table.max(), out=d)
    return d


def _tabulate_inverse(p: ChebyshevCurve, within: tuple[float, float]) -> Array:
    """(TABLE,) diameters at even steps of the phase, from the end of least phase, um;
    by linear interpolation of a dense sampling.

    Args:
        p: monotone phase over the diameter.
        within: (least, largest) diameter, um.
    """
    d = np.linspace(*within, DENSE * TABLE)
    phase = polynomial.evaluate_curve(p, d)
    if phase[-1] < phase[0]:
        d, phase = d[::-1], phase[::-1]
    return np.interp(np.linspace(phase[0], phase[-1], TABLE), phase, d)


def _torch(
    p: ChebyshevCurve,
    phase: Any,
    within: tuple[float, float],
    gap: str,
    excluded: Intervals,
) -> Any:
    """Differentiable diameters of a tensor of phases: one Newton step on the detached
    answer, whose derivative is exactly 1 / (dphase/dD).

    The arguments are those of :func:`_solve`.
    """
    import torch

    values = phase.detach().cpu().numpy()
    diameter = _solve(p, values, within, gap, excluded)
    slope = torch.from_numpy(polynomial.evaluate_slope(p, diameter)).to(phase.device)
    return (
        torch.from_numpy(diameter).to(phase.device) + (phase - phase.detach()) / slope
    )


def _first(mask: Array) -> tuple[int, ...]:
    """Index of the first True value."""
    return tuple(int(i) for i in np.argwhere(mask)[0])
