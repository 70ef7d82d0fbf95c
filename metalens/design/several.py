"""Pillars for several wavelengths at once: achromatic lenses, and another target for
each wavelength.

At every site that diameter D is taken whose answers lie nearest to what all wavelengths
want,

    Σ_l w_l |t_l(D) - exp(i (φ_l + c_l))|²   least over the printable diameters,      (1)

least squares over wavelengths. The pistons c_l, which no intensity knows, are part of
the search: for given pillars
the best are the phases of Σ t_l exp(-iφ_l), the amplitude in the focus; for given
pistons the best pillars are those of
(1). Both in turn never raise the sum over the sites, and end where neither lowers it,
from several starts.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from metalens.cell import Cell
from metalens.design.of_phase import Limits, Quality, Sums, lens_of, printable
from metalens.design.profiles import Focus
from metalens.design.sites import PhaseOf, Sites, least_period_um, sites
from metalens.ground.arrays import Array
from metalens.ground.errors import LensError
from metalens.ground.store import Provenance
from metalens.ground.threads import split
from metalens.lens import Lens
from metalens.pillars import Proxy

# of phase between diameters of the table, at any wavelength; a parabola finds what lies
# between
_STEP_RAD = 0.05
_STARTS, _TURNS, _SAMPLE = (
    16,
    40,
    1500,
)  # of the pistons: starts, turns of each at most, sites that choose them
_SETTLED_RAD = 1e-3  # pistons that move less have ended
_ROWS = 256  # pillars whose sums (1) stay in a processor's cache


@dataclass(frozen=True, slots=True)
class Wanted:
    """What light of a wavelength is to see.

    phase: :func:`metalens.design.phase_of` of the focus. weight: w of (1), above 0.
    """

    phase: PhaseOf
    focus: Focus
    weight: float = 1.0


def make_several(
    wanted: Sequence[Wanted],
    *,
    aperture_um: float,
    cell: Cell,
    proxy: Proxy,
    limits: Limits | None = None,
    profile: str = "map",
    provenance: Provenance | None = None,
) -> tuple[Lens, tuple[Quality, ...]]:
    """Fill a round aperture with the pillars that serve all wavelengths best by (1).

    Args:
        wanted: of every wavelength, the design's own first. proxy: of pillars at all of
            them.

    Returns:
        The lens (of the first wavelength; float32 diameters), and its quality at each.

    Raises:
        LensError: no wavelength, equal wavelengths, a weight that is not above 0, no
            printable pillar, or an aperture
            that holds none. DomainError: a wavelength that the proxy lacks.

    Accuracy:
        diameters lie within 1e-4 rad of phase of the least sum (1) for the pistons that
        were found; of these, the best
        of 16 starts, another minimum may be lower.
    """
    _check(wanted)
    limits = limits or Limits()
    waves = [one.focus.wavelength_um for one in wanted]
    span, *_ = (
        printable(proxy, cell, limits, wave, accept_partial_turn=True) for wave in waves
    )  # all alike
    stock = _stock(proxy, span, waves, np.array([one.weight for one in wanted]))
    place = sites(cell, aperture_um, grid_nm=limits.grid_nm)
    pistons = stock.pistons(_sampled(place, wanted))
    diameter, sums = np.zeros(place.shape, np.float32), [Sums() for _ in wanted]
    for blocks in zip(*(place.blocks(one.phase) for one in wanted), strict=True):
        rows, inside, _ = blocks[0]
        phases = np.stack(
            [phase + c for (*_, phase), c in zip(blocks, pistons, strict=True)]
        )
        diameter[rows][inside] = stock.diameter_um(phases)
        made = diameter[rows][inside].astype(float).clip(*span)
        for one, phase, wave in zip(sums, phases, waves, strict=True):
            one.add(phase, proxy.phase_rad(made, wave), proxy.transmission(made, wave))
    first = wanted[0].focus
    lens = lens_of(
        place.map(diameter), cell, proxy, first, profile=profile, provenance=provenance
    )
    turns = [proxy.coverage_rad(wave, within_um=span) / (2 * math.pi) for wave in waves]
    about = zip(sums, wanted, turns, strict=True)
    period = least_period_um(cell)
    return lens, tuple(
        s.quality(one.focus, aperture_um / 2, t, period_um=period)
        for s, one, t in about
    )


@dataclass(frozen=True, eq=False, slots=True)
class _Stock:
    """Printable diameters (n,), evenly spaced, and t (l, n) of them at every
    wavelength.

    table: (2 l, n) float32 by which the cosines and sines of the wanted phases give the
    sums (1) less what they share;
    power: (n,) the part that no phase changes.
    """

    sizes_um: Array
    t: Array
    table: Array
    power: Array

    def sums(self, phases: Array) -> Array:
        """(pillar, n) the sums (1) of wanted phases (l, pillar), less the sum of the
        weights.
        """
        wanted = np.concatenate([np.cos(phases), np.sin(phases)]).astype(np.float32)
        return np.asarray(self.power + wanted.T @ self.table)

    def nearest(self, phases: Array) -> Array:
        """Places in the table of the least sums."""
        return np.asarray(self.sums(phases).argmin(1))

    def diameter_um(self, phases: Array) -> Array:
        """(pillar,) diameters of the least sums, also between those of the table."""
        out = np.empty(phases.shape[1])

        def work(start: int, stop: int) -> None:
            for a in range(start, stop, _ROWS):
                some = slice(a, min(a + _ROWS, stop))
                out[some] = self._between(self.sums(phases[:, some]))

        split(len(out), work)
        return out

    def _between(self, sums: Array) -> Array:
        """Vertices of the parabolas through the least sums and those beside them; the
        ends of the table as they are.
        """
        last, row = len(self.sizes_um) - 1, np.arange(len(sums))
        best = sums.argmin(1)
        inner = best.clip(1, last - 1)
        before, here, after = (sums[row, inner + i].astype(float) for i in (-1, 0, 1))
        bend = before - 2 * here + after
        off = np.where(
            (best == inner) & (bend > 0),
            (before - after) / (2 * np.maximum(bend, 1e-30)),
            best - inner,
        )
        return np.asarray(
            self.sizes_um[inner] + off * (self.sizes_um[1] - self.sizes_um[0])
        )

    def pistons(self, phases: Array) -> Array:
        """(l,) pistons of the least sum over sites of wanted phases (l, site)."""
        found = [self._settled(phases, start) for start in _starts(len(phases))]
        return min(found, key=lambda one: one[0])[1]

    def _settled(self, phases: Array, pistons: Array) -> tuple[float, Array]:
        """The sum over the sites, and its pistons, where pillars and pistons in turn
        lower it no more.
        """
        for _ in range(_TURNS):
            pick = self.nearest(phases + pistons[:, None])
            before, pistons = (
                pistons,
                np.angle((self.t[:, pick] * np.exp(-1j * phases)).sum(1)),
            )
            if np.abs(np.angle(np.exp(1j * (pistons - before)))).max() < _SETTLED_RAD:
                break
        return float(
            self.sums(phases + pistons[:, None]).min(1).sum(dtype=float)
        ), pistons


def _check(wanted: Sequence[Wanted]) -> None:
    waves = [one.focus.wavelength_um for one in wanted]
    if not waves or len(set(waves)) < len(waves):
        raise LensError(
            f"wavelengths {', '.join(f'{w:g}' for w in waves)} um: need one or more, each once"
        )
    if not all(one.weight > 0 and math.isfinite(one.weight) for one in wanted):
        raise LensError(
            f"weights {', '.join(f'{one.weight:g}' for one in wanted)}: need all above 0"
        )


def _stock(
    proxy: Proxy,
    span_um: tuple[float, float],
    waves_um: Sequence[float],
    weights: Array,
) -> _Stock:
    """The table of a span of diameters, its steps no more than ``_STEP_RAD`` at any
    wavelength.
    """
    probe = np.linspace(*span_um, 513)
    steepest = max(
        float(np.abs(proxy.dphase_ddiameter(probe, wave)).max()) for wave in waves_um
    )
    count = max(64, math.ceil(steepest * (span_um[1] - span_um[0]) / _STEP_RAD) + 1)
    sizes = np.linspace(*span_um, count)
    t = np.stack(
        [
            proxy.transmission(sizes, w) * np.exp(1j * proxy.phase_rad(sizes, w))
            for w in waves_um
        ]
    )
    weighed = -2 * weights[:, None] * t
    power = (weights @ np.abs(t) ** 2).astype(np.float32)
    return _Stock(
        sizes, t, np.concatenate([weighed.real, weighed.imag]).astype(np.float32), power
    )


def _starts(count: int) -> Array:
    """(start, count) pistons spread evenly over all turns: the additive recurrence of
    the roots of x^(n+1) = x + 1.
    """
    root = 2.0
    for _ in range(50):
        root = (1 + root) ** (1 / (count + 1))
    steps = root ** -np.arange(1.0, count + 1)
    return np.asarray(2 * np.pi * (np.arange(_STARTS)[:, None] * steps % 1))


def _sampled(place: Sites, wanted: Sequence[Wanted]) -> Array:
    """(l, site) phases at some of the sites, evenly picked."""
    phases = [
        np.concatenate([phase for *_, phase in place.blocks(one.phase)])
        for one in wanted
    ]
    pick = np.unique(np.linspace(0, len(phases[0]) - 1, _SAMPLE).astype(int))
    return np.stack([phase[pick] for phase in phases])
