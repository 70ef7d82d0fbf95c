"""Assignment of meta-atoms to lattice sites in the locally periodic approximation.

One loop (:func:`_fill_sites`) serves a phase at one wavelength, several wavelengths,
two polarisations and the geometric phase; they differ in how a site's pillar is chosen.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from metalens.cell import Cell, no_resonance_um
from metalens.core.arrays import Array
from metalens.core.errors import ConfigError, LensError
from metalens.core.store import Provenance
from metalens.design import phase_map, profiles
from metalens.design.candidates import CandidateTable
from metalens.design.focusing import field_angle
from metalens.design.profiles import Cubic, DoubleHelix, Focus, PhaseMap
from metalens.design.sites import LatticeSites, PhaseOf, lattice_sites, least_period_um
from metalens.lens import HANDS, DiameterMap, Hand, Lens, TwoSizeTable
from metalens.library import GeometricPhase, PillarLibrary, Proxy, height_hint
from metalens.library.axes import AxesLibrary

EDGE_UM = 2e-3  # a proxy that ends this near a printable limit is ended by the process
_SIZES = 1025  # tabulated diameters, with parabolas between them

# target phases (channels, sites) -> (maps (k, sites), [(phase, |t|) of each channel])
_Choice = Callable[
    [Array], tuple[Sequence[Array] | Array, Sequence[tuple[Array, Array]]]
]


@dataclass(frozen=True, slots=True)
class DesignMetrics:
    """Figures of the assigned pillars at the design wavelength.

    pillars: count.
    numerical_aperture: of the cone that leaves the lens towards the sensor.
    wavefront_efficiency: |sum T exp(i error)|² / N²: power on the aperture that leaves
    in the target wave front. The focusing efficiency is that of the PSF
    (:func:`metalens.design.check_focus`).
    transmission: mean |T|².
    strehl: |sum T exp(i error)|² / (sum T)²: Strehl ratio left by the phase errors.
    field_of_view_rad: full angle over which the hyperbolic lens of this focus keeps a
    Strehl ratio of 0.8 on its flat sensor (Maréchal's criterion).
    max_phase_error_rad: largest difference between target and assigned phase.
    rms_phase_error_rad: its root mean square over the pillars.
    turns: phase coverage of the pillars over 2 pi; below 1 some phases are replaced by
    the nearest.
    focuses: whether rays of the design source meet in one spot
    (:func:`metalens.design.has_focus`); where they do not, aperture and field have no
    meaning.
    steepest: phase slope at the rim over the wave number (of the hyperbolic lens).
    sampled_aperture: largest slope that the lattice samples, wavelength / (2 longest
    period); nan if not known.
    """

    pillars: int
    numerical_aperture: float
    wavefront_efficiency: float
    transmission: float
    strehl: float
    field_of_view_rad: float
    max_phase_error_rad: float
    rms_phase_error_rad: float = 0.0
    turns: float = 1.0
    focuses: bool = True
    steepest: float = 0.0
    sampled_aperture: float = math.nan


@dataclass(frozen=True, slots=True)
class Limits:
    """Printing limits of the process.

    min_diameter_nm: thinnest pillar.
    min_gap_nm: least distance between neighbouring pillars.
    grid_nm: of the mask; the rows of a hexagonal lattice are placed on it.
    """

    min_diameter_nm: float = 82.0
    min_gap_nm: float = 70.0
    grid_nm: float = field(default=1.0, metadata={"above": 0})

    def __post_init__(self) -> None:
        if not (self.min_diameter_nm > 0 and self.min_gap_nm > 0):
            raise ConfigError(
                f"min_diameter_nm = {self.min_diameter_nm}, "
                f"min_gap_nm = {self.min_gap_nm}: need both above 0"
            )


@dataclass(frozen=True, slots=True)
class WavelengthTarget:
    """Target phase at one wavelength.

    phase: function of position, see :func:`metalens.design.phase_of`.
    focus: what is imaged onto what at this wavelength.
    weight: of its squared error, above 0.
    """

    phase: PhaseOf
    focus: Focus
    weight: float = 1.0


@dataclass(frozen=True, slots=True)
class PolarizationMetrics:
    """Figures of a lens of two-size pillars for light along x and along y.

    x, y: quality for either; ``wavefront_efficiency`` is the share of that light.
    wavefront_efficiency_error: its error for x and y, from the library's error bars.
    leaked: mean power that leaves in the other polarisation, for x and y.
    """

    x: DesignMetrics
    y: DesignMetrics
    wavefront_efficiency_error: tuple[float, ...]
    leaked: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class ConversionMetrics:
    """Conversion of circular light by the rotated pillar, from solved unit cells.

    size_um: of all pillars.
    converted, converted_error: share that leaves with the other hand and the wanted
    phase, and the solver's error of it.
    unconverted, unconverted_error: share that keeps its hand and carries no phase.
    isolated_error: error of t of the assumption that neighbours are not rotated.
    """

    size_um: float
    converted: float
    converted_error: float
    unconverted: float
    unconverted_error: float
    isolated_error: float


def phase_of(
    shape: DoubleHelix | Cubic | PhaseMap | None, focus: Focus, *, radius_um: float
) -> PhaseOf:
    """Target phase of a lens profile in rad as a function of position.

    Args:
        shape: profile on top of the focus; None for the hyperbolic lens.
        focus: what is imaged onto what.
        radius_um: of the aperture.

    Returns:
        Function of x (columns,) and y (rows,) in um to the phase (rows, columns).
    """

    focusing = not isinstance(shape, PhaseMap) or shape.add_focus
    samples = phase_map.read_phase_map(shape) if isinstance(shape, PhaseMap) else None

    def added(x: Array, y: Array) -> Array | float:
        if samples is not None:
            return phase_map.interpolate_phase(samples, x, y, radius_um=radius_um)
        if isinstance(shape, DoubleHelix):
            return profiles.vortex_phase(
                *(x, y[:, None]),
                radius_um=radius_um,
                zones=shape.zones,
                exponent=shape.exponent,
            )
        if isinstance(shape, Cubic):
            cubes = (x / radius_um) ** 3 + (y[:, None] / radius_um) ** 3
            return shape.strength_rad * cubes
        return 0.0

    def phase(x_um: Array, y_um: Array) -> Array:
        total = added(x_um, y_um)
        if focusing:
            total = total + profiles.hyperbolic_phase(x_um, y_um[:, None], focus)
        return np.asarray(total)

    return phase


def make(
    phase: PhaseOf,
    focus: Focus,
    *,
    aperture_um: float,
    cell: Cell,
    proxy: Proxy,
    limits: Limits | None = None,
    profile: str = "map",
    provenance: Provenance | None = None,
    accept_partial_turn: bool = False,
) -> tuple[Lens, DesignMetrics]:
    """Assign the pillar of the target phase to every site (paper Eq. 2 inverted).

    Args:
        phase: function of the sites' x (columns,) and y (rows,) in um to the target
            phase (rows, columns) in rad (:func:`phase_of`); called by blocks of rows.
        focus: what is imaged onto what.
        aperture_um: diameter; every pillar's centre lies half a pitch inside it.
        cell: unit cell of the pillars.
        proxy: phase and |t| over the diameter.
        limits: of the process; they narrow the proxy's domain.
        profile: name in the lens file.
        provenance: of the lens file.
        accept_partial_turn: take the nearest phase where the pillars cover less than a
            turn; the quality states the loss.

    Returns:
        The lens (float32 diameters: 2e-8 um, below 1e-6 rad) and its quality.

    Raises:
        LensError: the aperture holds no pillar, the printable diameters reach less than
            a full turn, or the phase has another shape.
    """
    limits = limits or Limits()
    wave = focus.wavelength_um
    span = printable_range_um(
        proxy, cell, limits, wave, accept_partial_turn=accept_partial_turn
    )
    gap: Literal["nearest", "refuse"] = "nearest" if accept_partial_turn else "refuse"

    def choose_sizes(targets: Array) -> tuple[list[Array], list[tuple[Array, Array]]]:
        sizes = proxy.diameter_um(targets[0], wave, within_um=span, gap=gap)
        sizes = sizes.astype(np.float32)
        return [sizes], [_response(proxy, sizes, wave)]

    sites = lattice_sites(cell, aperture_um, grid_nm=limits.grid_nm)
    maps, (sums,) = _fill_sites(sites, [phase], choose_sizes)
    lens = _make_lens(sites.map(maps[0]), cell, proxy, focus, profile, provenance)
    return lens, sums.quality(focus, sites, cell, _coverage(proxy, wave, span))


def assign_multi_wavelength(
    wavelength_targets: Sequence[WavelengthTarget],
    *,
    aperture_um: float,
    cell: Cell,
    proxy: Proxy,
    limits: Limits | None = None,
    profile: str = "map",
    provenance: Provenance | None = None,
) -> tuple[Lens, tuple[DesignMetrics, ...]]:
    """Assign pillars of least squared error over several wavelengths.

    Args:
        wavelength_targets: target at every wavelength, the design's own first.
        aperture_um, cell, limits, profile, provenance: see :func:`make`.
        proxy: phase and |t| over the diameter at all wavelengths.

    Returns:
        The lens (of the first wavelength; float32 diameters), and its quality at each.

    Raises:
        LensError: no wavelength, equal wavelengths, a weight that is not above 0, no
            printable pillar, or an aperture that holds none.
        DomainError: a wavelength that the proxy lacks.

    Accuracy:
        diameters lie within 1e-4 rad of the least sum for these pistons; the pistons
        are the best of 16 starts, another minimum may be lower.
    """
    waves = [target.focus.wavelength_um for target in wavelength_targets]
    weights = [target.weight for target in wavelength_targets]
    if not waves or len(set(waves)) < len(waves):
        raise LensError(
            f"wavelengths {', '.join(f'{w:g}' for w in waves)} um: "
            "need one or more, each once"
        )
    if not all(weight > 0 and math.isfinite(weight) for weight in weights):
        raise LensError(
            f"weights {', '.join(f'{w:g}' for w in weights)}: need all above 0"
        )
    limits = limits or Limits()
    for wave in waves:  # every wavelength is checked; the range is the same for all
        span = printable_range_um(proxy, cell, limits, wave, accept_partial_turn=True)
    tabulated = np.linspace(*span, _SIZES)
    responses = (_response(proxy, tabulated, wave) for wave in waves)
    t = [level * np.exp(1j * phase) for phase, level in responses]
    table = CandidateTable(np.stack(t), np.array(weights))

    def choose_sizes(targets: Array) -> tuple[list[Array], list[tuple[Array, Array]]]:
        chosen = span[0] + (tabulated[1] - tabulated[0]) * table.between(targets)
        chosen = chosen.astype(np.float32)
        return [chosen], [_response(proxy, chosen, wave) for wave in waves]

    sites = lattice_sites(cell, aperture_um, grid_nm=limits.grid_nm)
    phases = [target.phase for target in wavelength_targets]
    maps, channel_sums = _fill_sites(sites, phases, choose_sizes, table=table)
    first = wavelength_targets[0].focus
    lens = _make_lens(sites.map(maps[0]), cell, proxy, first, profile, provenance)
    return lens, tuple(
        sums.quality(target.focus, sites, cell, _coverage(proxy, wave, span))
        for sums, target, wave in zip(
            channel_sums, wavelength_targets, waves, strict=True
        )
    )


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
    """Assign two-size pillars for light polarised along x and along y.

    Where both phases are equal they share a piston, so that the lens keeps any
    polarisation.

    Args:
        phases: targets for light along x and along y; None: one phase for both.
        focuses: what each images onto what.
        library: response over the two sizes; its entries are the candidates.
        aperture_um, limits, profile, provenance: see :func:`make`.

    Returns:
        The lens (of light along x; ``lens.for_polarization("y")`` is that of light along y), and
        its quality for both.

    Raises:
        LensError: no printable pair of sizes within its error bar.
        DomainError: a wavelength that the library lacks.
    """
    limits = limits or Limits()
    cell = library.cell
    wave = library.at(focuses[0].wavelength_um)  # index along the wavelength axis
    printable = library.usable[wave] & _is_printable(library, limits)
    if not printable.any():
        x, y = library.x_um, library.y_um
        raise LensError(
            "no printable pair of sizes within its error bar: the library holds "
            f"{x[0]:.4g}-{x[-1]:.4g} um by {y[0]:.4g}-{y[-1]:.4g} um, the process "
            f"prints {limits.min_diameter_nm:g} nm and gaps of {limits.min_gap_nm:g} nm"
        )
    row, column = np.nonzero(printable)
    jones = library.t[wave, row, column]  # (candidates, 2, 2)
    t = np.stack([jones[:, 0, 0], jones[:, 1, 1]])
    sizes = np.array([library.x_um[row], library.y_um[column]], np.float32)
    table = CandidateTable(t, np.ones(2), common_piston=phases[1] is None)
    counts = np.zeros(t.shape[1], int)  # sites at which each candidate stands

    def choose_pairs(targets: Array) -> tuple[Array, list[tuple[Array, Array]]]:
        pick = table.nearest(targets)
        counts[:] += np.bincount(pick, minlength=len(counts))
        chosen = [(np.angle(t_pol), abs(t_pol)) for t_pol in t[:, pick]]
        return sizes[:, pick], chosen

    sites = lattice_sites(cell, aperture_um, grid_nm=limits.grid_nm)
    targets = phases[0], phases[1] or phases[0]
    maps, sums = _fill_sites(sites, targets, choose_pairs, table=table, maps=2)
    t_error = library.t_error[wave, row, column]
    relative_error = t_error / np.abs(t).min(axis=0).clip(1e-6)
    pairs = TwoSizeTable(
        library.wavelength_um,
        library.x_um,
        library.y_um,
        np.stack([library.t[..., 0, 0], library.t[..., 1, 1]], axis=-1),
        (focuses[1].sensor_distance_um, focuses[1].source_distance_um),
        math.sqrt(np.average(relative_error**2, weights=counts)),
    )
    diameters = sites.map(maps[0], length_um=maps[1])
    lens = _make_lens(
        diameters, cell, pairs.proxy, focuses[0], profile, provenance, pairs=pairs
    )
    quality = [
        channel.quality(focus, sites, cell, 1.0)
        for channel, focus in zip(sums, focuses, strict=True)
    ]
    mean = float(np.average(t_error, weights=counts))  # bounds the error of the peak
    errors = [2 * math.sqrt(q.wavefront_efficiency) * mean + mean**2 for q in quality]
    leaked = [
        float(np.average(np.abs(crossed) ** 2, weights=counts))
        for crossed in (jones[:, 1, 0], jones[:, 0, 1])
    ]
    return lens, PolarizationMetrics(
        quality[0], quality[1], tuple(errors), tuple(leaked)
    )


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
) -> tuple[Lens, DesignMetrics, ConversionMetrics]:
    """Rotate pillars of one size by half the target phase (Pancharatnam-Berry phase).

    Args:
        phase, focus, aperture_um, limits, profile, provenance: see :func:`make`.
        library: for circular light, with its proxy; all pillars take its best size.
        hand: of the incident light: right is x + iy, left x - iy.

    Returns:
        The lens (rotations in [0, pi), float32), the quality of the converted light,
        and the conversion.

    Raises:
        LensError: a library that is not for circular light, pillars that the process
            does not print or that may meet their neighbours when rotated, or no pillar
            in the aperture.
    """
    rotated, proxy, cell = library.turned, library.proxy, library.cell
    if rotated is None or proxy is None:
        raise LensError(
            "hand: the library holds no turned pillars; "
            "sweep it with light = 'circular'"
        )
    limits = limits or Limits()
    wave = focus.wavelength_um
    _check_rotated(cell, rotated, limits)
    slope = HANDS[hand]  # d phase / d rotation, +2 or -2
    start, level = _response(proxy, np.array([rotated.size_um]), wave)

    def choose_angles(targets: Array) -> tuple[list[Array], list[tuple[Array, Array]]]:
        angle = np.mod((targets[0] - start) / slope, np.pi).astype(np.float32)
        assigned = start + slope * angle.astype(float)
        size = np.full(len(angle), np.float32(rotated.size_um))
        return [size, angle], [(assigned, np.broadcast_to(level, assigned.shape))]

    sites = lattice_sites(cell, aperture_um, grid_nm=limits.grid_nm)
    maps, (sums,) = _fill_sites(sites, [phase], choose_angles, maps=2)
    diameters = sites.map(maps[0], maps[1])
    lens = _make_lens(diameters, cell, proxy, focus, profile, provenance, hand=hand)
    sign = float(np.sign(slope))
    conversion = ConversionMetrics(
        rotated.size_um,
        *rotated.efficiency(sign),
        *rotated.unconverted(sign),
        rotated.model_error,
    )
    return lens, sums.quality(focus, sites, cell, 1.0), conversion


def printable_range_um(
    proxy: Proxy,
    cell: Cell,
    limits: Limits,
    wavelength_um: float,
    *,
    accept_partial_turn: bool = False,
) -> tuple[float, float]:
    """(least, largest) diameter in um that the proxy holds and the process prints.

    Args:
        proxy: phase over the diameter.
        cell: unit cell of the pillars.
        limits: of the process.
        wavelength_um: at which the phase coverage is judged.
        accept_partial_turn: whether less than a full turn is allowed.

    Raises:
        LensError: no diameter, or less than a full turn of phase without leave.
    """
    thinnest, widest = _printable_sizes_um(cell, limits)
    low = max(proxy.domain_um[0], thinnest)
    high = min(proxy.domain_um[1], widest)
    if low >= high:
        raise LensError(
            f"no printable pillar: the library holds {proxy.domain_um[0]:.4f}-"
            f"{proxy.domain_um[1]:.4f} um, the process prints "
            f"{thinnest:.4f}-{widest:.4f} um"
        )
    turns = _coverage(proxy, wavelength_um, (low, high))
    if turns < 1 and not accept_partial_turn:
        raise LensError(
            f"printable diameters {low:.4f}-{high:.4f} um reach {turns:.3f} of a turn "
            f"at {wavelength_um:g} um, need 1; "
            f"{phase_coverage_hint(proxy, cell, limits, turns)}, or looser process "
            "limits, or accept the nearest pillar (accept_partial_turn) at the loss of "
            "efficiency that the design then states"
        )
    return low, high


def phase_coverage_hint(proxy: Proxy, cell: Cell, limits: Limits, turns: float) -> str:
    """Advice in words for pillars that cover less than a full turn of phase.

    Where the process bounds the diameters, a pillar of height h / turns covers a full
    turn. Where a resonance bounds them, the advice is a wider sweep or another pitch.

    Args:
        proxy: phase over the diameter.
        cell: unit cell of the pillars.
        limits: of the process.
        turns: phase coverage over 2 pi.
    """
    thinnest, widest = _printable_sizes_um(cell, limits)
    low, high = proxy.domain_um
    if low <= thinnest + EDGE_UM and high >= widest - EDGE_UM:
        return height_hint(cell.height_um, turns)
    return (
        f"the process prints {thinnest:.4f}-{widest:.4f} um, the library's curve holds "
        f"{low:.4f}-{high:.4f} um, to the next resonance or the ends of its sweep: "
        "sweep as far as is printed, and take another pitch, where resonances lie "
        "elsewhere (metalens study compares pitches and heights); none of the lattice's "
        f"own lies below {no_resonance_um(cell, proxy.wavelengths_um[0]):.3g} um"
    )


class _MetricSums:
    """Running sums over all pillars that :class:`DesignMetrics` is computed from."""

    def __init__(self) -> None:
        self.count = 0
        self.field = 0j  # sum of T exp(i error)
        self.level = self.power = self.square = self.worst = 0.0

    def add(self, target: Array, phase: Array, level: Array) -> None:
        """Add pillars to the sums.

        Args:
            target: (n,) target phase, rad.
            phase: (n,) assigned phase, rad.
            level: (n,) |T|.
        """
        error = np.remainder(phase - target + np.pi, 2 * np.pi) - np.pi
        self.count += error.size
        self.field += complex((level * np.exp(1j * error)).sum())
        self.level += float(level.sum())
        self.power += float((level**2).sum())
        self.square += float((error**2).sum())
        self.worst = max(self.worst, float(np.abs(error).max(initial=0)))

    def quality(
        self, focus: Focus, place: LatticeSites, cell: Cell, turns: float
    ) -> DesignMetrics:
        """Figures of all added pillars from the running sums.

        With N pillars, F = sum T exp(i error) and L = sum T: wave-front efficiency
        |F|² / N², Strehl ratio |F|² / L².

        Args:
            focus: source and sensor distances of the design.
            place: sites of the lattice and the aperture.
            cell: unit cell of the pillars.
            turns: phase coverage of the pillars over 2 pi.
        """
        peak = abs(self.field) ** 2
        radius = place.aperture_um / 2
        source, wave = focus.source_distance_um, focus.wavelength_um
        return DesignMetrics(
            pillars=self.count,
            numerical_aperture=focus.aperture(
                min(radius, focus.layers.footprint_um(source, wave))
            ),
            wavefront_efficiency=peak / self.count**2,
            transmission=self.power / self.count,
            strehl=peak / self.level**2,
            field_of_view_rad=2 * field_angle(focus, radius),
            max_phase_error_rad=self.worst,
            rms_phase_error_rad=math.sqrt(self.square / self.count),
            turns=turns,
            steepest=focus.aperture(radius) + radius / math.hypot(radius, source),
            sampled_aperture=wave / (2 * least_period_um(cell)),
        )


def _fill_sites(
    place: LatticeSites,
    phases: Sequence[PhaseOf],
    choose: _Choice,
    *,
    table: CandidateTable | None = None,
    maps: int = 1,
) -> tuple[Array, list[_MetricSums]]:
    """Maps of the chosen pillars and the metric sums of every channel, block by block.

    Args:
        place: sites of the lattice inside the aperture.
        phases: target phase of every channel.
        choose: pillars and their responses for (channels, sites) target phases, rad.
        table: candidates whose best pistons are added to the targets; None adds none.
        maps: quantities per pillar, 1 or 2.

    Returns:
        (maps, y, x) float32 maps, 0 without a pillar, and one sum for every channel.
    """
    pistons = None if table is None else table.pistons(place.sample(phases))
    filled = np.zeros((maps, *place.shape), np.float32)
    sums = [_MetricSums() for _ in phases]
    for rows, inside, targets in place.blocks(phases, pistons):
        chosen, responses = choose(targets)
        for array, values in zip(filled, chosen, strict=True):
            array[rows][inside] = values
        for channel, phase, response in zip(sums, targets, responses, strict=True):
            channel.add(phase, *response)
    return filled, sums


def _response(
    proxy: Proxy, size_um: Array, wavelength_um: float
) -> tuple[Array, Array]:
    """Phase in rad and |t| of pillars of given sizes by the proxy.

    Args:
        proxy: phase and |t| over the diameter.
        size_um: (n,) sizes, um; float32 rounding may leave the domain.
        wavelength_um: vacuum wavelength, um.
    """
    size_um = np.asarray(size_um, float).clip(*proxy.domain_um)
    phase = proxy.phase_rad(size_um, wavelength_um)
    return phase, proxy.transmission(size_um, wavelength_um)


def _make_lens(
    diameters: DiameterMap,
    cell: Cell,
    proxy: Proxy,
    focus: Focus,
    profile: str,
    provenance: Provenance | None,
    *,
    hand: Hand = "",
    pairs: TwoSizeTable | None = None,
) -> Lens:
    """The lens of these pillars with the distances and films of its focus.

    Args:
        diameters: map of the pillars.
        cell: unit cell of the pillars.
        proxy: phase and |t| over the diameter.
        focus: wavelength, distances and films of the design.
        profile: name in the lens file.
        provenance: of the lens file.
        hand: of the incident circular light; empty for other light.
        pairs: table of pillars of two sizes; None for one size.
    """
    return Lens(
        diameters=diameters,
        cell=cell,
        proxy=proxy,
        wavelength_um=focus.wavelength_um,
        sensor_distance_um=focus.sensor_distance_um,
        source_distance_um=focus.source_distance_um,
        profile=profile,
        provenance=provenance or Provenance(),
        layers=focus.layers,
        hand=hand,
        pairs=pairs,
    )


def _coverage(
    proxy: Proxy, wavelength_um: float, span_um: tuple[float, float]
) -> float:
    """Phase coverage over 2 pi of the diameters in a range, at a wavelength."""
    return proxy.coverage_rad(wavelength_um, within_um=span_um) / (2 * math.pi)


def _printable_sizes_um(cell: Cell, limits: Limits) -> tuple[float, float]:
    """(least, largest) size in um that a process prints."""
    gap_um = limits.min_gap_nm * 1e-3
    return cell.size_um(limits.min_diameter_nm * 1e-3, gap_um), cell.widest_um(gap_um)


def _is_printable(library: AxesLibrary, limits: Limits) -> Array:
    """(m, n) whether the process prints a pillar of sizes x, y next to an equal one.

    The gap is that between the boxes, along the axes, that hold two neighbours. It is
    exact for upright rectangles on a rectangular lattice, and a lower bound otherwise.

    Args:
        library: m sizes along x, n along y, and the cell.
        limits: least diameter and gap of the process.
    """
    x, y, cell = library.x_um[:, None], library.y_um, library.cell
    angle_rad = getattr(cell.shape, "angle_rad", 0.0)
    c, s = abs(math.cos(angle_rad)), abs(math.sin(angle_rad))
    width, height = c * x + s * y, s * x + c * y
    gaps = [
        np.maximum(abs(dx) - width, abs(dy) - height)
        for dx, dy in cell.lattice.steps_um(cell.pitch_um)
    ]
    wide = np.minimum(x, y) >= limits.min_diameter_nm * 1e-3 - 1e-9
    return np.asarray(wide & (np.min(gaps, axis=0) >= limits.min_gap_nm * 1e-3 - 1e-9))


def _check_rotated(cell: Cell, rotated: GeometricPhase, limits: Limits) -> None:
    """Refuse a pillar that the process does not print at every rotation.

    Args:
        cell: unit cell of the pillars.
        rotated: the solved rotated pillar, with its size.
        limits: of the process.

    Raises:
        LensError: a gap between rotated neighbours or a width below the limits.
    """
    outline = cell.outline(rotated.size_um)
    name = f"a {cell.shape.name} of "
    steps = cell.lattice.steps_um(cell.pitch_um)
    gap = min(np.hypot(*step) for step in steps) - 2 * outline.radius_um
    if gap < limits.min_gap_nm * 1e-3 - 1e-9:
        raise LensError(
            f"{name}{rotated.size_um:.4g} um leaves {1e3 * gap:.4g} nm to a neighbour "
            "when both are turned towards each other, the process prints "
            f"{limits.min_gap_nm:g} nm: take a larger pitch, or lower diameters_um of "
            "the library"
        )
    narrowest_um = outline.spans_um[0]
    if narrowest_um < limits.min_diameter_nm * 1e-3 - 1e-9:
        raise LensError(
            f"{name}{rotated.size_um:.4g} um is {1e3 * narrowest_um:.4g} nm wide, the "
            f"process prints {limits.min_diameter_nm:g} nm: take a ratio nearer to 1, "
            "or a longer pillar"
        )
