"""Assignment of diameters for several wavelengths: achromatic lenses, and another
target
for each wavelength; least squares over wavelengths (:mod:`metalens.design.candidates`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from metalens.cell import Cell
from metalens.core.arrays import Array
from metalens.core.errors import LensError
from metalens.core.store import Provenance
from metalens.design.candidates import make_candidates, sample_phases, wanted_blocks
from metalens.design.of_phase import (
    Limits,
    MetricSums,
    Quality,
    lens_of,
    printable_range_um,
)
from metalens.design.profiles import Focus
from metalens.design.sites import PhaseOf, lattice_sites, least_period_um
from metalens.lens import Lens
from metalens.library import Proxy

# of phase between diameters of the table, at any wavelength; a parabola finds what lies
# between
_STEP_RAD = 0.05


@dataclass(frozen=True, slots=True)
class WavelengthTarget:
    """What light of a wavelength is to see.

    phase: :func:`metalens.design.phase_of` of the focus. weight: of its squared error,
    above 0.
    """

    phase: PhaseOf
    focus: Focus
    weight: float = 1.0


def assign_multi_wavelength(
    wanted: Sequence[WavelengthTarget],
    *,
    aperture_um: float,
    cell: Cell,
    proxy: Proxy,
    limits: Limits | None = None,
    profile: str = "map",
    provenance: Provenance | None = None,
) -> tuple[Lens, tuple[Quality, ...]]:
    """Fill a round aperture with the pillars of least squared error over all
    wavelengths.

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
        diameters lie within 1e-4 rad of phase of the least sum for the pistons that
        were found; of these, the best
        of 16 starts, another minimum may be lower.
    """
    _check(wanted)
    limits = limits or Limits()
    waves = [one.focus.wavelength_um for one in wanted]
    span, *_ = (
        printable_range_um(proxy, cell, limits, wave, accept_partial_turn=True)
        for wave in waves
    )  # all alike
    sizes = _sizes(proxy, span, waves)
    step_um = sizes[1] - sizes[0]
    t = [
        proxy.transmission(sizes, w) * np.exp(1j * proxy.phase_rad(sizes, w))
        for w in waves
    ]
    table = make_candidates(np.stack(t), np.array([one.weight for one in wanted]))
    place, phases = (
        lattice_sites(cell, aperture_um, grid_nm=limits.grid_nm),
        [one.phase for one in wanted],
    )
    pistons = table.pistons(sample_phases(place, phases))
    diameter, sums = np.zeros(place.shape, np.float32), [MetricSums() for _ in wanted]
    for rows, inside, block in wanted_blocks(place, phases, pistons):
        diameter[rows][inside] = span[0] + step_um * table.between(block)
        made = diameter[rows][inside].astype(float).clip(*span)
        for one, phase, wave in zip(sums, block, waves, strict=True):
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


def _check(wanted: Sequence[WavelengthTarget]) -> None:
    waves = [one.focus.wavelength_um for one in wanted]
    if not waves or len(set(waves)) < len(waves):
        raise LensError(
            f"wavelengths {', '.join(f'{w:g}' for w in waves)} um: need one or more, each once"
        )
    if not all(one.weight > 0 and math.isfinite(one.weight) for one in wanted):
        raise LensError(
            f"weights {', '.join(f'{one.weight:g}' for one in wanted)}: need all above 0"
        )


def _sizes(
    proxy: Proxy, span_um: tuple[float, float], waves_um: Sequence[float]
) -> Array:
    """Evenly spaced diameters, their steps at most ``_STEP_RAD`` at any wavelength."""
    probe = np.linspace(*span_um, 513)
    steepest = max(
        float(np.abs(proxy.dphase_ddiameter(probe, wave)).max()) for wave in waves_um
    )
    count = max(64, math.ceil(steepest * (span_um[1] - span_um[0]) / _STEP_RAD) + 1)
    return np.linspace(*span_um, count)
