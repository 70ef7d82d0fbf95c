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

TABLE, DENSE = 4096, 16  # entries of the table, and points of the curve for each
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
    """Diameters on a curve of the phase; see :meth:`metalens.proxy.Proxy.diameter_um`.

    excluded_um: (least, largest) of diameters that are moved to the nearer end.

    Args:
        p: phase over the diameter.
        phase_rad: (*shape) wanted phases, rad.
        within_um: (least, largest) diameter that is considered, um.
        gap: refuse or nearest, for phases that no pillar has.
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
    if not np.isfinite(phase).all():
        raise DomainError(f"phase at index {_first(~np.isfinite(phase))} is not finite")
    ends = polynomial.evaluate_curve(p, np.array(within))
    start, cover = float(ends.min()), float(abs(ends[1] - ends[0]))
    if gap == "refuse" and cover < TURN:
        missing = (phase.astype(float) - start) % TURN > cover + 1e-6
        if missing.any():
            raise DomainError(
                f"no pillar between {within[0]:.4g} and {within[1]:.4g} um has the phase at index {_first(missing)}: "
                f"they cover {cover / TURN:.3f} of a turn ({int(missing.sum())} sites); "
                "widen the diameters, change the cell, or take the nearest with gap='nearest'"
            )
    table = _tabulate_inverse(p, within)

    def work(chunk: Array) -> Array:
        target = (chunk.astype(np.float64) - start) % TURN
        if cover < TURN:
            beyond = target > cover
            target[beyond] = np.where(
                target[beyond] - cover <= TURN - target[beyond], cover, 0.0
            )
        found = _newton(p, target, start, cover, table)
        return _move_out_of(found, excluded, within).astype(chunk.dtype)

    return polynomial.over_chunks(work, phase)


def _move_out_of(d: Array, excluded: Intervals, within: tuple[float, float]) -> Array:
    """Diameters out of the excluded intervals, to the nearer end inside ``within``."""
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
    """Diameters whose phase is start + target: linear in the table, then steps of
    Newton, one as a rule.

    Each squares what is left, but where the slope ends in 0: there it halves it, and
    leaves what has no slope.
    """
    place = target * ((TABLE - 1) / cover)
    index = np.minimum(place.astype(np.int64), TABLE - 2)
    place -= index
    d = table[index]
    d += place * np.diff(table)[index]
    for _ in range(54):  # a double has 53 bits
        missed = (
            polynomial.evaluate_horner(p.monomials, polynomial.to_unit_interval(p, d))
            - start
            - target
        )
        # far below the 1e-10 that is promised, above rounding of 100 rad
        if np.abs(missed).max(initial=0.0) < 1e-12:
            break
        rise = polynomial.slope_of(p, d)
        d -= np.divide(missed, rise, out=np.zeros_like(d), where=rise != 0)
        np.clip(d, table.min(), table.max(), out=d)
    return d


def _tabulate_inverse(p: ChebyshevCurve, within: tuple[float, float]) -> Array:
    """(TABLE,) diameters at even steps of the phase, from the end of least phase."""
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
    """One differentiable Newton step on the detached answer: its derivative is exactly
    1 / (dphase/dD).
    """
    import torch

    values = phase.detach().cpu().numpy()
    found = _solve(p, values, within, gap, excluded)
    rise = torch.from_numpy(polynomial.evaluate_slope(p, found)).to(phase.device)
    return torch.from_numpy(found).to(phase.device) + (phase - phase.detach()) / rise


def _first(mask: Array) -> tuple[int, ...]:
    return tuple(int(i) for i in np.argwhere(mask)[0])
