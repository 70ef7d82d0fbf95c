"""Phase to pillar diameter through a proxy: a table of the inverse, then Newton's steps, for millions of pillars."""

import math
from typing import Any, cast

import numpy as np

from metalens import polynomial
from metalens.errors import DomainError
from metalens.polynomial import Curve
from metalens.proxy import Proxy, Values
from metalens.store import Array

TABLE = 4096
TURN = 2 * math.pi


def diameter(
    proxy: Proxy,
    phase_rad: Values,
    wavelength_um: float,
    *,
    angle_rad: float,
    within_um: tuple[float, float] | None,
    gap: str,
) -> Values:
    """See :meth:`metalens.proxy.Proxy.diameter_um`."""
    p = proxy.at(wavelength_um, angle_rad)
    low, high = within_um or proxy.domain_um
    if not proxy.domain_um[0] - 1e-9 <= low < high <= proxy.domain_um[1] + 1e-9:
        raise DomainError(f"within_um = ({low}, {high}), need a range inside the proxy's domain {proxy.domain_um} um")
    if not proxy.monotone(wavelength_um, angle_rad, (low, high)):
        raise DomainError(
            f"the phase is not monotone between {low} and {high} um at {wavelength_um} um: no unique diameter; "
            "give a narrower within_um"
        )
    if type(phase_rad).__module__.partition(".")[0] == "torch":
        return cast(Values, _torch(p, phase_rad, (low, high), gap))
    phase = np.asarray(phase_rad)
    phase = phase if phase.dtype.kind == "f" else phase.astype(float)
    return cast(Values, _solve(p, phase, (low, high), gap)[()])


def _solve(p: Curve, phase: Array, within: tuple[float, float], gap: str) -> Array:
    if not np.isfinite(phase).all():
        raise DomainError(f"phase at index {_first(~np.isfinite(phase))} is not finite")
    ends = polynomial.value(p, np.array(within))
    start, cover = float(ends.min()), float(abs(ends[1] - ends[0]))
    if gap == "refuse" and cover < TURN:
        missing = (phase.astype(float) - start) % TURN > cover + 1e-6
        if missing.any():
            raise DomainError(
                f"no pillar between {within[0]:.4g} and {within[1]:.4g} um has the phase at index {_first(missing)}: "
                f"they cover {cover / TURN:.3f} of a turn ({int(missing.sum())} sites); "
                "widen the diameters, change the cell, or take the nearest with gap='nearest'"
            )
    table = _table(p, within)

    def work(chunk: Array) -> Array:
        target = (chunk.astype(np.float64) - start) % TURN
        if cover < TURN:
            beyond = target > cover
            target[beyond] = np.where(target[beyond] - cover <= TURN - target[beyond], cover, 0.0)
        return _newton(p, target, start, cover, table).astype(chunk.dtype)

    return polynomial.over_chunks(work, phase)


def _newton(p: Curve, target: Array, start: float, cover: float, table: Array) -> Array:
    """Diameters whose phase is start + target: linear in the table, then two steps of Newton."""
    place = target * ((TABLE - 1) / cover)
    index = np.minimum(place.astype(np.int64), TABLE - 2)
    place -= index
    d = table[index]
    d += place * np.diff(table)[index]
    for _ in range(2):
        d -= (polynomial.horner(p.monomials, polynomial.unit(p, d)) - start - target) / polynomial.slope_of(p, d)
        np.clip(d, table.min(), table.max(), out=d)
    return d


def _table(p: Curve, within: tuple[float, float]) -> Array:
    """(TABLE,) diameters at even steps of the phase, from the end of least phase, by bisection."""
    ends = polynomial.value(p, np.array(within))
    target = np.linspace(ends.min(), ends.max(), TABLE)
    left, right = (np.full(TABLE, within[i]) for i in np.argsort(ends))
    for _ in range(54):
        middle = (left + right) / 2
        below = polynomial.value(p, middle) < target
        left, right = np.where(below, middle, left), np.where(below, right, middle)
    return np.asarray((left + right) / 2)


def _torch(p: Curve, phase: Any, within: tuple[float, float], gap: str) -> Any:
    """One differentiable Newton step on the detached answer: its derivative is exactly 1 / (dphase/dD)."""
    import torch

    values = phase.detach().cpu().numpy()
    found = _solve(p, values, within, gap)
    rise = torch.from_numpy(polynomial.slope(p, found)).to(phase.device)
    return torch.from_numpy(found).to(phase.device) + (phase - phase.detach()) / rise


def _first(mask: Array) -> tuple[int, ...]:
    return tuple(int(i) for i in np.argwhere(mask)[0])
