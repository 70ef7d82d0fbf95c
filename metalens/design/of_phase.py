"""A phase profile made of pillars: every site takes the diameter whose proxy phase is
the wanted one.
"""

import math
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from metalens.cell import Cell, no_resonance_um
from metalens.core.arrays import Array
from metalens.core.errors import ConfigError, LensError
from metalens.core.store import Provenance
from metalens.design import phase_map, profiles
from metalens.design.profiles import Cubic, DoubleHelix, Focus, PhaseMap
from metalens.design.sites import PhaseOf, lattice_sites, least_period_um
from metalens.lens import DiameterMap, Hand, Lens
from metalens.library import Proxy, height_hint

PLACES, SEARCHED = (
    61,
    121,
)  # across what is lit of a lens, and across all of it, where that is looked for
EDGE_UM = 2e-3  # a curve that ends so near a printable end is ended by it
LIT = 0.5  # of the light at angle 0, below which a stop's field ends


@dataclass(frozen=True, slots=True)
class Quality:
    """How well the pillars make the profile at the design wavelength.

    pillars: count.
    numerical_aperture: of the cone that leaves the lens towards the sensor.
    wavefront_efficiency: |sum T exp(i error)|² / N²: power on the aperture that leaves
    in the wanted wave front. The focusing efficiency is that of the PSF
    (:func:`metalens.design.focus_figures`).
    transmission: mean |T|², the light that passes.
    strehl: |sum T exp(i error)|² / (sum T)²: what the phase errors of the pillars leave
    of the peak.
    field_of_view_rad: full angle over which the hyperbolic lens of this focus keeps a
    Strehl ratio of 0.8 on its
        sensor, which is flat (Maréchal's criterion on the wave-front error).
    max_phase_error_rad: largest difference between wanted and made phase.
    rms_phase_error_rad: root mean square of it over the pillars.
    turns: of phase that the pillars cover; below 1 the nearest pillar stands in for the
    phases that none has.
    focuses: whether rays of the design source meet in one spot
    (:func:`metalens.design.focuses`); where they do not,
        aperture and field have no meaning.
    steepest: slope of the phase at the rim over the wave number, the bend in sines that
    it asks for (of the focus).
    sampled_aperture: bend that the lattice carries without aliases, wavelength / (2
    longest period); nan if not known.
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
    """What the process can print.

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
                f"min_diameter_nm = {self.min_diameter_nm}, min_gap_nm = {self.min_gap_nm}: need both above 0"
            )


def phase_of(
    shape: DoubleHelix | Cubic | PhaseMap | None, focus: Focus, *, radius_um: float
) -> PhaseOf:
    """The wanted phase as a function of position: ``shape`` on top of the focus, None
    for hyperbolic.

    Returns:
        A function of the positions x (columns,) and y (rows,) in um to the phase (rows,
        columns) in rad.
    """
    if isinstance(shape, PhaseMap):
        samples = phase_map.read_phase_map(shape)

        def mapped(x_um: Array, y_um: Array) -> Array:
            phase = phase_map.interpolate_phase(
                samples, x_um, y_um, radius_um=radius_um
            )
            return (
                phase + profiles.hyperbolic_phase(x_um, y_um[:, None], focus)
                if shape.add_focus
                else phase
            )

        return mapped
    if isinstance(shape, DoubleHelix):
        return lambda x, y: profiles.double_helix_phase(
            x, y[:, None], focus, shape, radius_um=radius_um
        )
    if isinstance(shape, Cubic):
        return lambda x, y: profiles.cubic_phase(
            x, y[:, None], focus, shape, radius_um=radius_um
        )
    return lambda x, y: profiles.hyperbolic_phase(x, y[:, None], focus)


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
) -> tuple[Lens, Quality]:
    """Fill a round aperture with pillars (paper Eq. 2 inverted).

    Args:
        phase: function of the sites' positions x (columns,) and y (rows,) in um to the
            wanted phase (rows, columns) in
            rad, of a block of rows at a time (:func:`phase_of`). On a hexagonal lattice
            the pillars stand on its sites.
        aperture_um: diameter of the aperture; every pillar's centre lies half a pitch
            inside it.
        limits: of the process; the proxy's domain is narrowed to them.
        profile: name kept in the lens.
        accept_partial_turn: where the pillars cover less than a turn, take the nearest
            phase that they have; the
            quality says what it costs.

    Returns:
        The lens (float32 diameters: 2e-8 um, below 1e-6 rad) and its quality.

    Raises:
        LensError: the aperture holds no pillar, the printable diameters reach less than
            a full turn, or the phase has
            another shape.
    """
    within = printable_range_um(
        proxy,
        cell,
        limits or Limits(),
        focus.wavelength_um,
        accept_partial_turn=accept_partial_turn,
    )
    gap: Literal["nearest", "refuse"] = "nearest" if accept_partial_turn else "refuse"
    place = lattice_sites(cell, aperture_um, grid_nm=(limits or Limits()).grid_nm)
    diameter, sums = np.zeros(place.shape, np.float32), MetricSums()
    for rows, inside, wanted in place.blocks(phase):
        diameter[rows][inside] = proxy.diameter_um(
            wanted, focus.wavelength_um, within_um=within, gap=gap
        )
        made = diameter[rows][inside].astype(float)
        phase_made = proxy.phase_rad(made, focus.wavelength_um)
        sums.add(wanted, phase_made, proxy.transmission(made, focus.wavelength_um))
    lens = lens_of(
        place.map(diameter), cell, proxy, focus, profile=profile, provenance=provenance
    )
    turns = proxy.coverage_rad(focus.wavelength_um, within_um=within) / (2 * math.pi)
    return lens, sums.quality(
        focus, aperture_um / 2, turns, period_um=least_period_um(cell)
    )


def lens_of(
    diameters: DiameterMap,
    cell: Cell,
    proxy: Proxy,
    focus: Focus,
    *,
    profile: str,
    provenance: Provenance | None = None,
    hand: Hand = "",
) -> Lens:
    """The lens of a map of pillars and what it images."""
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
    )


def printable_range_um(
    proxy: Proxy,
    cell: Cell,
    limits: Limits,
    wavelength_um: float,
    *,
    accept_partial_turn: bool = False,
) -> tuple[float, float]:
    """(least, largest) diameter in um that both the proxy holds and the process prints.

    Raises:
        LensError: they reach less than a full turn of phase, so some phases cannot be
            made, and that is not accepted.
    """
    thinnest, widest = _printed(cell, limits)
    low, high = max(proxy.domain_um[0], thinnest), min(proxy.domain_um[1], widest)
    if low >= high:
        raise LensError(
            f"no printable pillar: the library holds {proxy.domain_um[0]:.4f}-{proxy.domain_um[1]:.4f} um, the "
            f"process prints {thinnest:.4f}-{widest:.4f} um"
        )
    turns = proxy.coverage_rad(wavelength_um, within_um=(low, high)) / (2 * math.pi)
    if turns < 1 and not accept_partial_turn:
        raise LensError(
            f"printable diameters {low:.4f}-{high:.4f} um reach {turns:.3f} of a turn at {wavelength_um:g} um, need 1"
            f"; {phase_coverage_hint(proxy, cell, limits, turns)}, or looser process limits, or "
            "accept the nearest pillar (accept_partial_turn) at the loss of efficiency that the design then states"
        )
    return low, high


def phase_coverage_hint(proxy: Proxy, cell: Cell, limits: Limits, turns: float) -> str:
    """What would cover a turn where these pillars cover less (``turns``), for a person.

    Phase grows with the height as long as no resonance ends it: where the process ends
    the pillars, a height over the
    turns covers one. Where the library ends them sooner, taller pillars bring the
    resonance nearer.
    """
    thinnest, widest = _printed(cell, limits)
    if (
        proxy.domain_um[0] <= thinnest + EDGE_UM
        and proxy.domain_um[1] >= widest - EDGE_UM
    ):
        return height_hint(cell.height_um, turns)
    return (
        f"the process prints {thinnest:.4f}-{widest:.4f} um, the library's curve holds {proxy.domain_um[0]:.4f}-"
        f"{proxy.domain_um[1]:.4f} um, to the next resonance or the ends of its sweep: sweep as far as is printed, and "
        "take another pitch, where resonances lie elsewhere (metalens study compares pitches and heights); none of the "
        f"lattice's own lies below {no_resonance_um(cell, proxy.wavelengths_um[0]):.3g} um"
    )


def _printed(cell: Cell, limits: Limits) -> tuple[float, float]:
    """(least, largest) size in um that a process prints."""
    gap_um = limits.min_gap_nm * 1e-3
    return cell.size_um(limits.min_diameter_nm * 1e-3, gap_um), cell.widest_um(gap_um)


class MetricSums:
    """Running sums over all pillars that :class:`Quality` is made of."""

    def __init__(self) -> None:
        self.count, self.field, self.level, self.power, self.worst = (
            0,
            0j,
            0.0,
            0.0,
            0.0,
        )
        self.square = 0.0

    def add(self, wanted: Array, made: Array, level: Array) -> None:
        """Add pillars: wanted and made phase in rad, and |T|."""
        error = np.remainder(made - wanted + np.pi, 2 * np.pi) - np.pi
        self.count += error.size
        self.field += complex((level * np.exp(1j * error)).sum())
        self.level += float(level.sum())
        self.power += float((level**2).sum())
        self.square += float((error**2).sum())
        self.worst = max(self.worst, float(np.abs(error).max(initial=0)))

    def quality(
        self, focus: Focus, radius_um: float, turns: float, *, period_um: float
    ) -> Quality:
        """Of all pillars that were added; period_um: see
        :func:`metalens.design.sites.least_period_um`.
        """
        peak = abs(self.field) ** 2
        lit_um = min(
            radius_um,
            focus.layers.footprint_um(focus.source_distance_um, focus.wavelength_um),
        )
        return Quality(
            pillars=self.count,
            numerical_aperture=focus.aperture(lit_um),
            wavefront_efficiency=peak / self.count**2,
            transmission=self.power / self.count,
            strehl=peak / self.level**2,
            field_of_view_rad=2 * field_angle(focus, radius_um),
            max_phase_error_rad=self.worst,
            rms_phase_error_rad=math.sqrt(self.square / self.count),
            turns=turns,
            steepest=focus.aperture(radius_um)
            + radius_um / math.hypot(radius_um, focus.source_distance_um),
            sampled_aperture=focus.wavelength_um / (2 * period_um),
        )


def field_angle(focus: Focus, radius_um: float, *, strehl: float = 0.8) -> float:
    """Half field in rad at which coma, astigmatism and curvature of the field of the
    hyperbolic lens leave
    exp(-sigma²) = ``strehl`` on its sensor, which is flat.

    sigma is the wave-front error over the aperture (of the lens, what the stop lets
    light on), with piston and tilt
    taken out: at most 60 degrees. Behind a stop it ends where the light of less than
    half the pillars of angle 0 is
    left, whatever the rest does.
    """
    low, high = 0.0, np.pi / 3
    for _ in range(40):
        middle = (low + high) / 2
        if math.exp(-_wavefront_variance(focus, radius_um, middle)) >= strehl:
            low = middle
        else:
            high = middle
    return low


def _wavefront_variance(focus: Focus, radius_um: float, angle_rad: float) -> float:
    """The largest of light from four sides, by turns of a stop beside the axis; of one
    where all are alike.
    """
    stop, found = focus.layers.stop, []
    for _ in range(4 if stop is not None and not stop.centred else 1):
        found.append(
            _from_the_side(
                replace(focus, layers=replace(focus.layers, stop=stop)),
                radius_um,
                angle_rad,
            )
        )
        stop = stop and replace(stop, centre_um=(-stop.centre_um[1], stop.centre_um[0]))
    return max(found)


def _from_the_side(focus: Focus, radius_um: float, angle_rad: float) -> float:
    x, y, lit_um2 = _lit(focus, radius_um, math.tan(angle_rad))
    if lit_um2 <= 0 or lit_um2 < LIT * _lit(focus, radius_um, 0.0)[2]:
        return math.inf
    path = profiles.hyperbolic_phase(x, y, focus)
    for one in focus.paths_from(x, y, math.tan(angle_rad)):
        path = path + 2 * np.pi / focus.wavelength_um * one
    basis = np.stack([np.ones_like(x), x, y], axis=1)
    basis /= np.abs(basis).max(axis=0)
    residual = path - basis @ np.linalg.lstsq(basis, path, rcond=None)[0]
    return float((residual**2).mean())


def _lit(focus: Focus, radius_um: float, tangent: float) -> tuple[Array, Array, float]:
    """Places (x,) and (y,) of the lens that an angle's light falls on, ``PLACES``
    across, and their area in um².
    """
    middle, half = (0.0, 0.0), radius_um
    for look in (PLACES,) if focus.layers.stop is None else (SEARCHED, PLACES):
        unit, step = np.linspace(-half, half, look, retstep=True)
        x, y = np.meshgrid(middle[0] + unit, middle[1] + unit)
        there = np.hypot(x, y) <= radius_um * (1 + 1e-12)
        if focus.layers.stop is not None:
            source = (tangent, 0.0), focus.source_distance_um, focus.wavelength_um
            there &= focus.layers.lit(*source, (x, y), 1e-6 * radius_um) > 0
        x, y = x[there], y[there]
        if not x.size:
            break
        middle = (float(x.max() + x.min()) / 2, float(y.max() + y.min()) / 2)
        half = float(max(np.ptp(x), np.ptp(y)) / 2 + step)
    return x, y, x.size * float(step) ** 2
