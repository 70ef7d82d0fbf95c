"""A phase made by the turn of pillars of one size, for circular light (geometric
phase).
"""

import dataclasses
from typing import Literal

import numpy as np

from metalens.cell import Cell
from metalens.core.errors import LensError
from metalens.core.store import Provenance
from metalens.design.of_phase import Limits, MetricSums, Quality, lens_of
from metalens.design.profiles import Focus
from metalens.design.sites import PhaseOf, lattice_sites, least_period_um
from metalens.lens import HANDS, Lens
from metalens.library import GeometricPhase, PillarLibrary, Proxy


@dataclasses.dataclass(frozen=True, slots=True)
class ConversionMetrics:
    """What becomes of circular light of the design's hand, from solved cells of the
    pillar at several turns.

    size_um: of all pillars. converted, unconverted: shares of the light that leave with
    the other hand and the wanted
    phase, and with the same hand and no phase; their errors are those of the solver.
    isolated_error: of the amplitude
    of a pillar that is taken as turned alone.
    """

    size_um: float
    converted: float
    converted_error: float
    unconverted: float
    unconverted_error: float
    isolated_error: float


def assign_geometric_phase(
    phase: PhaseOf,
    focus: Focus,
    *,
    aperture_um: float,
    library: PillarLibrary,
    hand: Literal["left", "right"] = "right",
    limits: Limits | None = None,
    profile: str = "map",
    provenance: Provenance | None = None,
) -> tuple[Lens, Quality, ConversionMetrics]:
    """Fill a round aperture with pillars of the library's best size, each turned by
    half of its phase.

    Args:
        phase: wanted; :func:`metalens.design.phase_of`. library: for circular light,
            with its proxy.
        hand: of the light that comes: right is x + iy, left x - iy.

    Returns:
        The lens (turns in [0, pi), float32), its quality (that of the converted light),
        and the conversion.

    Raises:
        LensError: a library that is not for circular light, or pillars that the process
            does not print or that may
            meet their neighbours when turned; no pillar in the aperture.
    """
    turned, proxy = library.turned, library.proxy
    if turned is None or proxy is None:
        raise LensError(
            "hand: the library holds no turned pillars; sweep it with light = 'circular'"
        )
    cell, limits = library.cell, limits or Limits()
    _check(cell, turned, limits)
    place, sums = lattice_sites(cell, aperture_um, grid_nm=limits.grid_nm), MetricSums()
    size, angle = np.zeros(place.shape, np.float32), np.zeros(place.shape, np.float32)
    start, step = (
        float(proxy.phase_rad(turned.size_um, focus.wavelength_um)),
        HANDS[hand],
    )
    for rows, inside, wanted in place.blocks(phase):
        size[rows][inside] = turned.size_um
        angle[rows][inside] = np.mod((wanted - start) / step, np.pi)
        made = start + step * angle[rows][inside].astype(float)
        sums.add(wanted, made, _level(proxy, turned, focus, len(made)))
    made_map = place.map(size, angle)
    lens = lens_of(
        made_map, cell, proxy, focus, profile=profile, provenance=provenance, hand=hand
    )
    return (
        lens,
        sums.quality(focus, aperture_um / 2, 1.0, period_um=least_period_um(cell)),
        _conversion(turned, hand),
    )


def _level(
    proxy: Proxy, turned: GeometricPhase, focus: Focus, count: int
) -> np.ndarray:
    return np.full(
        count, float(proxy.transmission(turned.size_um, focus.wavelength_um))
    )


def _conversion(turned: GeometricPhase, hand: str) -> ConversionMetrics:
    sign = float(np.sign(HANDS[hand]))
    shares = *turned.efficiency(sign), *turned.unconverted(sign)
    return ConversionMetrics(turned.size_um, *shares, turned.model_error)


def _check(cell: Cell, turned: GeometricPhase, limits: Limits) -> None:
    """Refuse what is not printed at any turn of it and its neighbours."""
    outline = cell.outline(turned.size_um)
    gap = (
        min(np.hypot(*step) for step in cell.lattice.steps_um(cell.pitch_um))
        - 2 * outline.radius_um
    )
    if gap < limits.min_gap_nm * 1e-3 - 1e-9:
        raise LensError(
            f"a {cell.shape.name} of {turned.size_um:.4g} um leaves {1e3 * gap:.4g} nm to a neighbour when both are "
            f"turned towards each other, the process prints {limits.min_gap_nm:g} nm: take a larger pitch, or lower "
            "diameters_um of the library"
        )
    narrowest_um, _ = outline.spans_um
    if narrowest_um < limits.min_diameter_nm * 1e-3 - 1e-9:
        raise LensError(
            f"a {cell.shape.name} of {turned.size_um:.4g} um is {1e3 * narrowest_um:.4g} nm wide, the process "
            f"prints {limits.min_diameter_nm:g} nm: take a ratio nearer to 1, or a longer pillar"
        )
