"""PSF stack of a lens file: pillars through the proxy at every wavelength and angle."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from metalens import propagate
from metalens.core.arrays import Array
from metalens.core.errors import PropagationError
from metalens.core.store import Provenance
from metalens.lens import Lens, response
from metalens.optics import media
from metalens.propagate import paths
from metalens.psf import neighbour_coupling
from metalens.psf import spectrum as spectra
from metalens.psf.budget import (
    RINGS,
    SPOKES,
    Polarisation,
    incidence_sine,
    neighbours_text,
    obliquity_variation,
    scalar_error,
    sine_aperture,
    with_model,
    worst_of_budgets,
)
from metalens.psf.extended import SourceExtent, source_image_reach
from metalens.psf.neighbour_coupling import NeighbourJonesFactors
from metalens.psf.record import PsfStack
from metalens.psf.spectrum import MeasuredSpectrum, Source, SpectralNodes
from metalens.psf.stack import psf_stack

PLACES = 9  # along each axis of the window, to which optical paths are computed
ROWS = 64  # rows of pillars whose delays are computed
NEARBY = 1e-4  # relative step of the wavelength for those delays
TRIES = 3  # at a spectrum: the PSFs of one give the paths for the next


@dataclass(frozen=True, slots=True)
class View:
    """Sources and window for which PSFs are computed.

    Attributes:
        depths_um: of the source from the lens, inf for a plane wave.
        angles_rad: (x, y) field angles, as in :func:`metalens.psf.psf_stack`.
        window_um: full width of the window about the chief ray, or a pair (x, y).
        samples: along the window, or a pair (x, y).
        offset_um: (x, y) from the chief ray to the window's centre.
        source: size and shape of a source that is no point.
    """

    depths_um: tuple[float, ...]
    angles_rad: tuple[tuple[float, float], ...] = ((0.0, 0.0),)
    window_um: float | tuple[float, float] = 72.0
    samples: int | tuple[int, int] = 96
    offset_um: tuple[float, float] = (0.0, 0.0)
    source: SourceExtent | None = None

    @property
    def arguments(self) -> dict[str, Any]:
        """Depths, window and source as arguments of :func:`metalens.psf.psf_stack`."""
        names = ("window_um", "samples", "offset_um", "source")
        return {"depths_um": np.array(self.depths_um)} | {
            name: getattr(self, name) for name in names
        }


def from_lens(
    lens: Lens,
    view: View,
    *,
    tolerance: float = 1e-4,
    spectrum: SpectralNodes | Source | MeasuredSpectrum | None = None,
    provenance: Provenance | None = None,
    polarisation: Polarisation = "scalar",
) -> PsfStack:
    """Point spread functions of a lens file, its pillars through their response table.

    As :func:`psf_stack` with the phase and transmission that the pillars have at each
    wavelength and angle; films, stop and solved neighbours of the lens are in it. Light
    is unpolarised: at an angle the table holds the mean of both polarisations. Where it
    has no angles, pillars respond as at normal incidence, and ``budget.angle`` is the
    error of that.

    Args:
        lens: diameters, response of the pillars, distances and films.
        view: depths, angles and window.
        tolerance: relative L2 error of the PSFs of one direction; float32 is returned
            from 1e-6 on.
        spectrum: wavelengths with weights, a diode, or measured curves, which get as
            few wavelengths as the tolerance needs; None for the design wavelength.
        provenance: settings and input files, kept in the record.
        polarisation: as for :func:`psf_stack`, or ``"auto"``: the scalar where its
            error is below the tolerance, else the flux.

    Returns:
        PsfStack: (angle, depth, y, x), with the error by cause.

    Raises:
        DomainError: a wavelength outside the response table.
        PropagationError: as :func:`psf_stack`; no angle; a spectrum that reaches beyond
            the table; ``"flux"`` or ``"vector"`` for pillars whose x and y responses
            differ.
    """
    if not 0 < tolerance < 1:
        raise PropagationError(
            f"tolerance is {tolerance}, need a relative error above 0 and below 1"
        )
    if not view.angles_rad:
        raise PropagationError("angles_rad is empty, need one direction (x, y) or more")
    how = tolerance, polarisation, provenance or Provenance()
    if isinstance(spectrum, Source | MeasuredSpectrum):
        return _over_spectrum(lens, view, spectrum, *how)
    nodes = spectrum or spectra.single_wavelength(lens.wavelength_um)
    return _at_wavelengths(lens, view, nodes, *how)


def _over_spectrum(
    lens: Lens,
    view: View,
    source: Source | MeasuredSpectrum,
    tolerance: float,
    polarisation: Polarisation,
    provenance: Provenance,
) -> PsfStack:
    """PSF stack of a spectrum, by as few wavelengths as the tolerance needs.

    The first rule of wavelengths follows from the paths to the middle of the window. If
    the PSFs show light where paths differ more, the rule is refined, ``TRIES`` times at
    most. The spectrum takes half of the tolerance.

    Args:
        lens: pillars, response, distances and films.
        view: depths, angles and window.
        source: a diode or measured curves.
        tolerance: relative L2 error of the PSFs.
        polarisation: as for :func:`from_lens`.
        provenance: settings and input files.
    """
    within = lens.proxy.wavelengths_um
    spans = [paths_um(lens, view, angle, source) for angle in view.angles_rad]
    shares: list[Array] = [np.zeros(span.shape) for span in spans]
    for share in shares:
        share[:, share.shape[1] // 2, share.shape[2] // 2] = 1
    for _ in range(TRIES):
        rules = [
            spectra.spectral_nodes(
                source,
                path_um=span.ravel(),
                light=share.ravel(),
                tolerance=tolerance / 2,
            )
            for span, share in zip(spans, shares, strict=True)
        ]
        longest = max(rules, key=lambda rule: len(rule.weights))
        nodes = spectra.nodes_inside_library(longest, source, within)
        stack = _at_wavelengths(lens, view, nodes, tolerance, polarisation, provenance)
        if stack.budget.spectrum <= tolerance / 2:
            break
        shares = [light_shares(light, spans[0].shape[1:]) for light in stack.intensity]
    return dataclasses.replace(
        stack, reason=stack.reason + spectra.outside_library_text(source, within)
    )


def paths_um(
    lens: Lens,
    view: View,
    angle_rad: tuple[float, float],
    source: Source | MeasuredSpectrum,
) -> Array:
    """(depth, y, x) range of optical paths through the pillars to places of the window.

    Rays are traced from each source through ``RINGS`` x ``SPOKES`` places of the
    aperture and the films. The range of the pillars' own delays is added, um. A source
    of finite size widens the window by the reach of its image.

    Args:
        lens: pillars, distances and films.
        view: depths, window and size of the source.
        angle_rad: field angles along x and y, rad.
        source: spectrum, over which the delays are computed.
    """
    geometry = view.arguments | lens.diameters.grid._asdict()
    del geometry["source"]
    case = propagate.make_case(
        lens.diameters.diameter_um.shape,
        angle_rad=angle_rad,
        wavelength_um=lens.wavelength_um,
        sensor_distance_um=lens.sensor_distance_um,
        layers=lens.layers.open,
        **geometry,
    )
    margin = (0, 0) if view.source is None else source_image_reach(case, view.source)
    radius = lens.diameters.radius_um * np.linspace(0, 1, RINGS)[:, None]
    turn = 2 * np.pi * np.arange(SPOKES) / SPOKES
    x = (radius * np.cos(turn)).ravel()
    y = (radius * np.sin(turn)).ravel()
    inverse = np.array(case.inverse_depths_per_um)[:, None]
    from_source = np.asarray(paths.from_source(case, x, y, case.tangents, inverse))
    rows, columns = (
        np.linspace(-1, 1, min(PLACES, n)) * ((n - 1) / 2 + extra) * case.step_um
        + centre
        for n, extra, centre in zip(
            case.samples, margin, case.centre_um[::-1], strict=True
        )
    )
    to_sensor = np.array(
        [
            [paths.to_sensor(case, x, y, (float(i), float(j))) for i in columns]
            for j in rows
        ]
    )
    total = from_source[:, None, None] + to_sensor
    return np.asarray(np.ptp(total, axis=-1) + _delay_um(lens, angle_rad, source))


def _delay_um(
    lens: Lens, angle_rad: tuple[float, float], source: Source | MeasuredSpectrum
) -> float:
    """Range of the pillars' delays d(phase)/dk, um, the largest at three wavelengths.

    The delay is the change of phase, in turns, over that of 1/λ between two
    wavelengths. It is computed at the 5 %, 50 % and 95 % points of the spectrum, over
    some ``ROWS`` rows. It is 0 where the library has one wavelength, or pairs of sizes.

    Args:
        lens: pillars and their response.
        angle_rad: field angles along x and y, rad.
        source: spectrum of the light.
    """
    low, high = lens.proxy.wavelengths_um
    if lens.pairs is not None or not high > low:
        return 0.0
    um, share = spectra.spectrum_points(source)
    rows = slice(None, None, max(1, len(lens.diameters.diameter_um) // ROWS))
    has_pillar = np.asarray(lens.diameters.diameter_um[rows]) > 0
    tilt = library_incidence(lens, angle_rad)
    points = um[np.searchsorted(np.cumsum(share), (0.05, 0.5, 0.95))]
    delays = []
    for middle in np.clip(points, low, high).tolist():
        ends = max(low, middle * (1 - NEARBY)), min(high, middle * (1 + NEARBY))
        first, last = (
            lens.phase_rad(wave, tilt, rows=rows)[has_pillar] / (2 * np.pi)
            for wave in ends
        )
        change = first - last
        delays.append(np.ptp(change - np.rint(change)) / (1 / ends[0] - 1 / ends[1]))
    return float(max(delays))


def light_shares(light: Array, places: tuple[int, ...]) -> Array:
    """(depth, y, x) share of Σ light² whose samples lie nearest to each place.

    Args:
        light: (depth, y, x) irradiance.
        places: numbers (y, x) of places at equal steps over the window, from edge to
            edge, as in :func:`paths_um`.
    """
    square = np.asarray(light, float) ** 2
    for axis, count in zip((1, 2), places, strict=True):
        borders = (np.arange(1, count) - 0.5) * (square.shape[axis] - 1)
        first = np.ceil(borders / max(count - 1, 1)).astype(int)
        square = np.add.reduceat(square, [0, *first], axis=axis)
    return np.asarray(square / square.sum())


def _at_wavelengths(
    lens: Lens,
    view: View,
    nodes: SpectralNodes,
    tolerance: float,
    polarisation: Polarisation,
    provenance: Provenance,
) -> PsfStack:
    """PSF stack at wavelengths with weights, direction by direction, with its error.

    Each direction is computed with the pillars' response at its angle. The model's
    errors are added to its budget, and the worst budget is that of the stack.

    Args:
        lens: pillars, response, distances and films.
        view: depths, angles and window.
        nodes: wavelengths in um with their weights.
        tolerance: relative L2 error of the PSFs of one direction.
        polarisation: ``"auto"``, ``"scalar"``, ``"flux"`` or ``"vector"``.
        provenance: settings and input files.
    """
    dtype = torch.float32 if tolerance >= 1e-6 else torch.float64
    psf_tolerance = math.sqrt(max(tolerance**2 - nodes.error**2, tolerance**2 / 4))
    budgets, parts = [], []
    mapped: tuple[float, bool] | None = None
    for angle in view.angles_rad:
        decided = _decided_polarisation(lens, angle, polarisation, tolerance)
        is_scalar = decided == "scalar"
        # without angles in the library all directions share the maps
        if mapped != (mapped := (library_incidence(lens, angle), is_scalar)):
            maps, fields = all_maps(lens, nodes, angle, dtype, scalar=is_scalar)
        part = psf_stack(
            maps[0],
            maps[1],
            **lens.diameters.grid._asdict(),
            wavelength_um=nodes.wavelengths_um.tolist(),
            weights=nodes.weights.tolist(),
            sensor_distance_um=lens.sensor_distance_um,
            angle_rad=[list(angle)],
            **view.arguments,
            tolerance=psf_tolerance,
            layers=lens.layers,
            polarisation=decided,
            neighbours=fields,
        ).numpy()
        parts.append(part)
        judged = nodes
        if nodes.source is not None:
            # rms over the window of the error at each place's range of paths
            span = paths_um(lens, view, angle, nodes.source)
            share = light_shares(part.intensity[0], span.shape[1:])
            rule = nodes.wavelengths_um, nodes.weights
            error = spectra.quadrature_error(
                nodes.source, rule, span.ravel(), share.ravel()
            )
            judged = dataclasses.replace(nodes, error=error)
        budgets.append(with_model(part.budget, lens, angle, judged, decided))
    budget = worst_of_budgets(budgets)
    worst = max(parts, key=lambda part: part.error)
    words = [
        worst.reason,
        "above the tolerance by its spectrum"
        if budget.computed > tolerance and worst.converged
        else "",
        f"of {lens.one_light}: these pillars respond to x and y separately"
        if lens.one_light
        else "",
        "pillars respond as at normal incidence: their library has no angles"
        if budget.angle
        else "",
        neighbours_text(lens.neighbours),
    ]
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in ("intensity", "energy_um2", "angles_rad", "centres_um")
    }
    return dataclasses.replace(
        worst,
        **joined,
        tolerance=tolerance,
        error=budget.computed,
        budget=budget,
        reason="; ".join(filter(None, words)),
        provenance=provenance,
    )


def mean_over_polarizations(x: PsfStack, y: PsfStack) -> PsfStack:
    """PSF stack of unpolarised light: the mean irradiance of two polarisations.

    Each PSF is of sum 1, so they are averaged with their energies as weights. The error
    and its budget are those of the worse stack.

    Args:
        x: stack of light polarised along x.
        y: the same along y.
    """
    energy = (x.energy_um2 + y.energy_um2) / 2
    shares = [
        (stack.energy_um2 / (2 * np.where(energy > 0, energy, 1.0)))[..., None, None]
        for stack in (x, y)
    ]
    intensity = (x.intensity * shares[0] + y.intensity * shares[1]).astype(
        x.intensity.dtype
    )
    worse = x if x.error >= y.error else y
    return dataclasses.replace(
        worse, intensity=intensity, energy_um2=energy.astype(x.energy_um2.dtype)
    )


def _decided_polarisation(
    lens: Lens, angle: tuple[float, float], polarisation: Polarisation, tolerance: float
) -> Polarisation:
    """The polarisation that is computed for one direction, ``"auto"`` resolved.

    Pillars of circular light, of two sizes or known for one polarisation are scalar.
    ``"auto"`` is the flux where the scalar's error is above the tolerance.

    Raises:
        PropagationError: flux or vector for pillars that only the scalar describes.
    """
    if lens.hand or lens.pairs is not None or lens.one_light:
        if polarisation in ("flux", "vector"):
            own = f"knows {lens.one_light} alone"
            if lens.hand or lens.pairs is not None:
                own = (
                    "is for circular light" if lens.hand else "has pillars of two sizes"
                )
            raise PropagationError(
                f"polarisation = {polarisation!r} is for pillars that treat x and y alike; this lens {own}: take "
                "'scalar'"
            )
        return "scalar"
    if polarisation != "auto":
        return polarisation
    aperture = sine_aperture(lens, angle)
    error = scalar_error(aperture, obliquity_variation(lens, angle))
    return "flux" if error > tolerance else "scalar"


def library_incidence(lens: Lens, angle_rad: tuple[float, float]) -> float:
    """Angle of incidence, rad, at which the pillars' response is looked up.

    It is 0 where the library has no angles.

    Args:
        lens: the lens.
        angle_rad: field angles along x and y, rad.
    """
    has_angles = lens.proxy.max_angle_rad > 0
    return math.asin(incidence_sine(angle_rad)) if has_angles else 0.0


def all_maps(
    lens: Lens,
    nodes: SpectralNodes,
    angle_rad: tuple[float, float],
    dtype: torch.dtype,
    *,
    scalar: bool,
) -> tuple[tuple[torch.Tensor, torch.Tensor], NeighbourJonesFactors | None]:
    """Phase and transmission of every pillar, (wavelength, y, x), for one direction.

    The coupling of unequal neighbours multiplies the scalar's maps. Otherwise its
    factors on both fields are returned as well; None without solved neighbours.

    Args:
        lens: pillars and their response.
        nodes: wavelengths in um with their weights.
        angle_rad: field angles along x and y, rad.
        dtype: of the maps.
        scalar: whether one scalar stands for both polarisations.
    """
    shape = len(nodes.weights), *lens.diameters.diameter_um.shape
    phase = torch.empty(shape, dtype=dtype)
    level = torch.empty(shape, dtype=dtype)
    for wave, phase_map, level_map in zip(
        nodes.wavelengths_um, phase.numpy(), level.numpy(), strict=True
    ):
        light = float(wave), library_incidence(lens, angle_rad)
        response.fill_response(lens, light, phase_map, level_map)
    if lens.neighbours is None:
        return (phase, level), None
    coupling = phase, level, lens.neighbours, lens.diameters.pitch_um
    if scalar:
        return neighbour_coupling.apply_scalar_coupling(*coupling), None
    return (phase, level), neighbour_coupling.apply_jones_coupling(*coupling)


def passed_um2(
    lens: Lens, angle_rad: tuple[float, float], depths_um: Sequence[float]
) -> Array:
    """(depths,) power behind the lens per unit irradiance from a direction, um².

    F Σ |T S|² a at the design wavelength: T the transmission of a pillar, S the shadow
    of a stop, a the area of a site, F the share that passes the faces behind it.

    Args:
        lens: the lens.
        angle_rad: field angles along x and y, rad.
        depths_um: source depths from the lens, um.
    """
    nodes = spectra.single_wavelength(lens.wavelength_um)
    level = all_maps(lens, nodes, angle_rad, torch.float64, scalar=True)[0][1][0]
    passed = [
        (np.abs(level.numpy() * lens_stop_shadow(lens, angle_rad, z)) ** 2).sum()
        for z in depths_um
    ]
    order = lens.layers.after(lens.sensor_distance_um, lens.wavelength_um).order
    faces = media.passed_at(order, incidence_sine(angle_rad) ** 2)
    return np.asarray(faces * lens.diameters.site_um2 * np.array(passed))


def lens_stop_shadow(
    lens: Lens, angle_rad: tuple[float, float], depth_um: float
) -> Array:
    """(y, x) complex factor of the aperture stop at every pillar; 1 without one.

    Args:
        lens: the lens.
        angle_rad: field angles along x and y, rad.
        depth_um: source depth from the lens, um.
    """
    if lens.layers.stop is None:
        return np.ones((1, 1))
    d = lens.diameters
    tangents = math.tan(angle_rad[0]), math.tan(angle_rad[1])
    places, width = (d.x_um, d.y_um[:, None]), math.sqrt(d.site_um2)
    shade = lens.layers.shadow(tangents, depth_um, lens.wavelength_um, places, width)
    return np.asarray(shade)
