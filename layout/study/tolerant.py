"""The tolerant choice: among pillars of the same phase, the one whose light changes
least with the bias.

A proxy that covers more than a turn offers two or more diameters for some phases, and a
tolerance on the phase
offers neighbours for all. What harms a lens is not the change that all pillars share,
which is a common phase, but
the spread about it: the choice is scored by |d ln t / dD - common|, with the common
change that the chosen
pillars themselves have.
"""

from dataclasses import dataclass, replace

import numpy as np

from layout.process import Process
from metalens.ground.arrays import Array
from metalens.ground.errors import ProcessError
from metalens.lens import Lens

_BINS = 2048  # phases that are told apart: 3 mrad
_STARTS = np.linspace(
    0.02, 0.98, 13
)  # quantiles of the slopes that are tried as the common one


@dataclass(frozen=True, eq=False, slots=True)
class TolerantChoice:
    """A lens with the pillars chosen anew.

    lens: with the chosen diameters. moved: share of the pillars that changed.
    before, after: rms over the pillars of |d ln t / dD - common|, per nm.
    phase_error_rad: rms distance from the phase of the former pillars.
    transmission_before, transmission: mean |T|.
    """

    lens: Lens
    moved: float
    before: float
    after: float
    phase_error_rad: float
    transmission_before: float
    transmission: float


def choose(
    lens: Lens,
    process: Process,
    *,
    tolerance_rad: float = 0.1,
    loss: float = 0.05,
) -> TolerantChoice:
    """Choose each pillar anew among the printable diameters within ``tolerance_rad`` of
    its phase.

    Args:
        loss: how much |T| may fall below that of the present pillars of the phase.

    Raises:
        ProcessError: no printable diameter in the proxy's domain, a tolerance outside
            (0, pi).
    """
    if not 0 < tolerance_rad < np.pi:
        raise ProcessError(
            f"tolerance_rad = {tolerance_rad}: need a phase between 0 and pi"
        )
    present = lens.diameters.diameter_um > 0
    wanted = lens.phase_rad()
    bins = (np.remainder(wanted, 2 * np.pi) * (_BINS / (2 * np.pi))).astype(
        np.int32
    ) % _BINS
    weight = np.bincount(bins[present], minlength=_BINS)
    stock = _stock(lens, process)
    level = np.bincount(
        bins[present], lens.transmission()[present], minlength=_BINS
    ) / np.maximum(weight, 1)
    best = _assign(stock, weight, tolerance_rad, level - loss)
    chosen = np.where(present, stock.diameter_um[best][bins], 0.0)
    made = replace(lens, diameters=replace(lens.diameters, diameter_um=chosen))
    old, new = _statistics(lens, wanted, present), _statistics(made, wanted, present)
    moved = float((abs(chosen - lens.diameters.diameter_um) > 1e-6)[present].mean())
    return TolerantChoice(made, moved, old[0], new[0], new[1], old[2], new[2])


@dataclass(frozen=True, eq=False, slots=True)
class _Stock:
    """Printable pillars: diameter, phase, |T| and d ln t / dD per nm."""

    diameter_um: Array
    phase_rad: Array
    level: Array
    rate: Array


def _stock(lens: Lens, process: Process) -> _Stock:
    rules, step = process.rules, process.rules.diameter_step_nm
    low = max(lens.proxy.domain_um[0] * 1e3, rules.minimum_feature_nm)
    high = min(
        lens.proxy.domain_um[1] * 1e3,
        lens.diameters.pitch_um * 1e3 - rules.minimum_gap_nm,
    )
    sizes = (
        np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1) * step
    )
    sizes = sizes[[_fits(lens, float(size), process) for size in sizes]]
    if not sizes.size:
        raise ProcessError(
            f"no printable diameter between {low:.0f} and {high:.0f} nm in steps of {step} nm"
        )
    d, at = sizes * 1e-3, lens.wavelength_um
    level = lens.proxy.transmission(d, at)
    slope = lens.proxy.dtransmission_ddiameter(
        d, at
    ) / level + 1j * lens.proxy.dphase_ddiameter(d, at)
    return _Stock(d, lens.proxy.phase_rad(d, at), level, slope * 1e-3)


def _fits(lens: Lens, size_nm: float, process: Process) -> bool:
    """Whether walls, bars and gaps of a shape keep the rules, on its lattice."""
    cell, rules = lens.cell, process.rules
    if lens.diameters.plain and cell.shape.kind == "circle":
        return True
    wide, gap = cell.outline(size_nm * 1e-3).spans_um[0], cell.gap_um(size_nm * 1e-3)
    return (
        wide * 1e3 >= rules.minimum_feature_nm - 1e-6
        and gap * 1e3 >= rules.minimum_gap_nm - 1e-6
    )


def _assign(stock: _Stock, weight: Array, tolerance_rad: float, least: Array) -> Array:
    """(phase bins,) index of the pillar for each phase; the common change settles from
    several starts.
    """
    phases = (np.arange(_BINS) + 0.5) * (2 * np.pi / _BINS)
    away = abs(np.angle(np.exp(1j * (stock.phase_rad - phases[:, None]))))
    allowed = (away <= tolerance_rad) & (stock.level >= least[:, None])
    allowed |= ~allowed.any(axis=1, keepdims=True) & (
        away == away.min(axis=1, keepdims=True)
    )
    found = [
        _settle(stock, weight, allowed, start)
        for start in np.quantile(stock.rate.imag, _STARTS) * 1j
    ]
    return min(found, key=lambda each: each[0])[1]


def _settle(
    stock: _Stock, weight: Array, allowed: Array, common: complex
) -> tuple[float, Array]:
    """(weighted variance, choice) that a start leads to; each round lowers the
    variance.
    """
    best = np.zeros(_BINS, int)
    for _ in range(20):
        before, best = (
            best,
            np.where(allowed, abs(stock.rate - common), np.inf).argmin(axis=1),
        )
        common = (stock.rate[best] * weight).sum() / weight.sum()
        if (before == best).all():
            break
    return float((abs(stock.rate[best] - common) ** 2 * weight).sum()), best


def _statistics(
    lens: Lens, wanted_rad: Array, present: Array
) -> tuple[float, float, float]:
    """(rms rate about the common one per nm, rms phase error about its mean, mean |T|)
    over the pillars.
    """
    entries, place = np.unique(
        np.rint(lens.diameters.diameter_um[present] * 2e4), return_inverse=True
    )
    d, at = np.clip(entries / 2e4, *lens.proxy.domain_um), lens.wavelength_um
    level = lens.proxy.transmission(d, at)
    rate = 1e-3 * (
        lens.proxy.dtransmission_ddiameter(d, at) / level
        + 1j * lens.proxy.dphase_ddiameter(d, at)
    )
    count = np.bincount(place)
    share = count / count.sum()
    common = (rate * share).sum()
    turn = np.exp(1j * (lens.proxy.phase_rad(d, at)[place] - wanted_rad[present]))
    error = np.angle(turn / turn.mean())
    spread = float(np.sqrt((abs(rate - common) ** 2 * share).sum()))
    return spread, float(np.sqrt((error**2).mean())), float((level * share).sum())
