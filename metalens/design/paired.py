"""Assignment of two-size pillars for light polarised along x and along y: one lens, or
two in one place (:mod:`metalens.design.candidates`).

Where both phases are one, they share a piston: any polarisation stays as it is.
"""

import math
from dataclasses import dataclass

import numpy as np

from metalens.core.arrays import Array
from metalens.core.errors import LensError
from metalens.core.store import Provenance
from metalens.design.candidates import make_candidates, sample_phases, wanted_blocks
from metalens.design.of_phase import Limits, MetricSums, Quality
from metalens.design.profiles import Focus
from metalens.design.sites import PhaseOf, lattice_sites, least_period_um
from metalens.lens import Lens, TwoSizeTable
from metalens.library.axes import AxesLibrary, cell_of_sizes

_COVERED_RAD = (
    0.2  # a wanted pair of phases is covered where a pillar gives both within this, and
)
_COVERED_LEVEL = 0.7  # with no less than this |t|
_GAPS = 12  # sizes along each axis at which the gap to the neighbours is worked out


@dataclass(frozen=True, slots=True)
class PolarizationMetrics:
    """What a lens of two sizes makes of light along x and along y.

    x, y: quality for either; their ``wavefront_efficiency`` is the share of that light
    in its
    focus. wavefront_efficiency_error: bar of
    each, from the error bars of the pillars. leaked: mean power that leaves with the
    other polarisation, for x and y.
    covered: share of pairs of phases (of single phases, where both are one) that a
    pillar gives within 0.2 rad and a
    level of 0.7. multiplexed: whether the two phases differ. pairs: distinct pairs of
    sizes used.
    """

    x: Quality
    y: Quality
    wavefront_efficiency_error: tuple[float, float]
    leaked: tuple[float, float]
    covered: float
    multiplexed: bool
    pairs: int


def assign_polarization_multiplexed(
    phases: tuple[PhaseOf, PhaseOf | None],
    focuses: tuple[Focus, Focus],
    *,
    aperture_um: float,
    library: AxesLibrary,
    limits: Limits | None = None,
    profile: str = "map",
    provenance: Provenance | None = None,
) -> tuple[Lens, PolarizationMetrics]:
    """Fill a round aperture with pillars of two sizes, entries of the library.

    Args:
        phases: wanted for light along x and along y; None: one phase for both. focuses:
            what each images onto what.

    Returns:
        The lens (of light along x; ``lens.seen("y")`` is that of light along y), and
        what it makes of both.

    Raises:
        LensError: no printable pair of sizes within its error bar. DomainError: a
            wavelength that the library lacks.
    """
    limits, at = limits or Limits(), library.at(focuses[0].wavelength_um)
    stock = _stock(library, at, limits)
    place = lattice_sites(library.cell, aperture_um, grid_nm=limits.grid_nm)
    wanted = phases[0], phases[1] or phases[0]
    table = make_candidates(stock.t.T, np.ones(2), common_piston=phases[1] is None)
    pistons = table.pistons(sample_phases(place, wanted))
    size, length = np.zeros(place.shape, np.float32), np.zeros(place.shape, np.float32)
    sums, chosen = (MetricSums(), MetricSums()), []
    for rows, inside, block in wanted_blocks(place, wanted, pistons):
        pick = table.nearest(block)
        size[rows][inside], length[rows][inside] = stock.sizes[pick].T
        for one, phase, k in zip(sums, block, (0, 1), strict=True):
            one.add(phase, np.angle(stock.t[pick, k]), np.abs(stock.t[pick, k]))
        chosen.append(np.bincount(pick, minlength=len(stock.t)))
    used = np.sum(chosen, axis=0)
    made = Lens(
        place.map(size, length_um=length),
        library.cell,
        (pairs := _pairs(library, focuses[1], stock.entry_error(used))).proxy,
        focuses[0].wavelength_um,
        focuses[0].sensor_distance_um,
        focuses[0].source_distance_um,
        profile,
        provenance or Provenance(),
        focuses[0].layers,
        pairs=pairs,
    )
    return made, _split(
        stock, sums, used, focuses, aperture_um, library, alike=phases[1] is None
    )


@dataclass(frozen=True, eq=False, slots=True)
class _Stock:
    """Pairs of sizes to choose from: (n, 2) sizes in um, (n, 2) t_x and t_y, (n,) bars,
    (n, 2) power that leaks.
    """

    sizes: Array
    t: Array
    error: Array
    leaked: Array

    def entry_error(self, used: Array) -> float:
        """Root mean square over the pillars of the bars relative to |t|, of the light
        that has the less; used: (n,) how
        often each pair stands in the lens."""
        relative = self.error / np.abs(self.t).min(axis=1).clip(1e-6)
        return math.sqrt(float((used * relative**2).sum() / used.sum()))


def _stock(library: AxesLibrary, at: int, limits: Limits) -> _Stock:
    printed = library.usable[at] & _printable(library, limits)
    if not printed.any():
        raise LensError(
            f"no printable pair of sizes within its error bar: the library holds {library.x_um[0]:.4g}-"
            f"{library.x_um[-1]:.4g} um by {library.y_um[0]:.4g}-{library.y_um[-1]:.4g} um, the process prints "
            f"{limits.min_diameter_nm:g} nm and gaps of {limits.min_gap_nm:g} nm"
        )
    row, column = np.nonzero(printed)
    jones = library.t[at, row, column]
    t = np.stack([jones[:, 0, 0], jones[:, 1, 1]], axis=1)
    leaked = np.abs(np.stack([jones[:, 1, 0], jones[:, 0, 1]], axis=1)) ** 2
    sizes = np.stack([library.x_um[row], library.y_um[column]], axis=1)
    return _Stock(sizes, t, library.t_error[at, row, column], leaked)


def _printable(library: AxesLibrary, limits: Limits) -> Array:
    """(m, n) whether the process prints a pillar, and the gap to neighbours like it."""
    x, y = library.x_um, library.y_um
    wide = np.minimum(x[:, None], y) >= limits.min_diameter_nm * 1e-3 - 1e-9
    least, turn = (
        limits.min_gap_nm * 1e-3,
        getattr(library.cell.shape, "angle_rad", 0.0),
    )
    if library.cell.lattice.kind != "hexagonal" and turn % (math.pi / 2) == 0:
        px, py = library.cell.lattice.periods_um(library.cell.pitch_um)
        px, py = (py, px) if round(turn / (math.pi / 2)) % 2 else (px, py)
        return np.asarray(
            wide & (px - x[:, None] >= least - 1e-9) & (py - y >= least - 1e-9)
        )
    ends = [np.linspace(v[0], v[-1], _GAPS) for v in (x, y)]
    gap = np.array(
        [
            [cell_of_sizes(library.cell, a, b).gap_um(a) for b in ends[1]]
            for a in ends[0]
        ]
    )
    row, column = (
        np.minimum(np.searchsorted(e, v), _GAPS - 1)
        for e, v in zip(ends, (x, y), strict=True)
    )
    return np.asarray(
        wide & (gap[row[:, None], column] >= least)
    )  # of the next larger pair


def _pairs(library: AxesLibrary, focus_y: Focus, entry_error: float) -> TwoSizeTable:
    t = np.stack([library.t[..., 0, 0], library.t[..., 1, 1]], axis=-1)
    distances = focus_y.sensor_distance_um, focus_y.source_distance_um
    return TwoSizeTable(
        library.wavelength_um, library.x_um, library.y_um, t, distances, entry_error
    )


def _split(
    stock: _Stock,
    sums: tuple[MetricSums, MetricSums],
    used: Array,
    focuses: tuple[Focus, Focus],
    aperture_um: float,
    library: AxesLibrary,
    *,
    alike: bool,
) -> PolarizationMetrics:
    covered = _covered(stock, alike)
    period = least_period_um(library.cell)
    qualities = [
        one.quality(f, aperture_um / 2, 1.0, period_um=period)
        for one, f in zip(sums, focuses, strict=True)
    ]
    mean = float(
        (used * stock.error).sum() / used.sum()
    )  # of t: the peak's amplitude is off by no more
    errors = [2 * math.sqrt(q.wavefront_efficiency) * mean + mean**2 for q in qualities]
    leaked = (used[:, None] * stock.leaked).sum(axis=0) / used.sum()
    return PolarizationMetrics(
        qualities[0],
        qualities[1],
        (errors[0], errors[1]),
        (float(leaked[0]), float(leaked[1])),
        covered,
        not alike,
        int(np.count_nonzero(used)),
    )


def _covered(stock: _Stock, alike: bool) -> float:
    """Share of the phases, or of pairs of them, that a pillar gives."""
    turn = 2 * np.pi * np.arange(72 if alike else 36) / (72 if alike else 36)
    x, y = (turn, turn) if alike else (v.ravel() for v in np.meshgrid(turn, turn))
    pick = make_candidates(stock.t.T, np.ones(2)).nearest(np.stack([x, y]))
    off = np.abs(np.angle(stock.t[pick] * np.exp(-1j * np.stack([x, y], axis=1)))).max(
        axis=1
    )
    return float(
        (
            (off <= _COVERED_RAD)
            & (np.abs(stock.t[pick]).min(axis=1) >= _COVERED_LEVEL)
        ).mean()
    )
