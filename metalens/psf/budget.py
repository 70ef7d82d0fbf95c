"""Error budget of a PSF: errors of the computation, and of the model."""

import math
from dataclasses import dataclass, fields, replace
from typing import Literal

import numpy as np
from scipy.special import jv

from metalens.core.arrays import Array
from metalens.lens import CURVED, Lens, NeighbourRows
from metalens.optics import Media, media
from metalens.psf.spectrum import SpectralNodes

Polarisation = Literal["scalar", "flux", "vector", "auto"]
# coupling of unequal neighbours in solved rows of 12 and 8 pillars of the default cell:
# amplitude 0.986, -0.066 rad at sine 0.236, and 0.959, -0.100 rad at 0.354; that of
# another cell is metalens.design.neighbours.estimate_neighbour_coupling
NEIGHBOURS = (0.057 - 0.289j, -0.523 + 0.054j)
# change of t over sin² of the incidence: 0.29 at 20 degrees, the default cell's worst
# pillar off resonance
ANGLE = 2.5
# of an aperture over which obliquity is averaged: to rounding at NA 0.6, 25 degrees
RINGS, SPOKES = 8, 24
CURES = {  # of an error above the tolerance, by its largest part
    "numerical": "raise it or widen the window",
    "sampling": "give the window more samples",
    "spectrum": "raise it or narrow the spectrum",
    "source": "raise it or give a smaller source",
}


def neighbours_text(rows: NeighbourRows | None) -> str:
    """What the terms ``neighbours`` and ``angle`` of a lens's budget are of, in words.

    Args:
        rows: solved rows of the lens's own pillars; None for the constants of this
            module.
    """
    if rows is None:
        return (
            "neighbours and angle: of the default cell, rough "
            "(design --own-cell has a lens hold its own neighbours)"
        )
    return (
        f"unlike neighbours counted, by {len(rows.sine)} solved rows at "
        f"{rows.wavelength_um:g} um and normal incidence; angle: of the default cell, "
        "rough"
    )


@dataclass(frozen=True, slots=True)
class PsfErrorBudget:
    """Relative L2 errors of the PSFs by cause, the worst over angles; nan if unknown.

    numerical: of the propagation, measured on the result.
    sampling: of the integration over the cells of the window.
    spectrum: of the quadrature over wavelengths.
    source: of one PSF for all points of a finite source.
    polarisation: of one scalar for both polarisations. Of plain maps only that of
        films, which transmit s and p differently, measured on the light. Of both
        polarisations, that of rays to the window's middle for the whole window.
    neighbours: of pillars computed in a lattice of equal pillars; or of the coupling of
        solved rows where the lens has them.
    angle: of pillars that respond as at normal incidence.
    glass: of light reflected twice between two faces.
    stop: of the shadow of the aperture stop.
    proxy: of the response curve against the library, and of the library's solver; of
        pillars of two sizes the second alone.
    posterior: of a lens that was fitted to captures, by the spread of its parameters.
    outside: share of the light outside the window, worst over angles and depths. A PSF
        of sum 1 does not show it, so it is in no total.
    """

    numerical: float
    sampling: float = 0.0
    spectrum: float = 0.0
    source: float = 0.0
    polarisation: float = math.nan
    neighbours: float = math.nan
    angle: float = math.nan
    glass: float = math.nan
    stop: float = math.nan
    proxy: float = math.nan
    posterior: float = math.nan
    outside: float = math.nan

    @property
    def computed(self) -> float:
        """What the tolerance is about: numerical, sampling, spectrum and source
        together.
        """
        return math.hypot(self.numerical, self.sampling, self.spectrum, self.source)

    @property
    def largest(self) -> str:
        """Cause of the largest part of what is computed."""
        return max(CURES, key=lambda cause: getattr(self, cause))

    @property
    def cure(self) -> str:
        """What to do about the largest part of what is computed."""
        return CURES[self.largest]

    @property
    def model(self) -> float:
        """What the model leaves out, as far as it is known."""
        return _together(
            self.polarisation,
            self.neighbours,
            self.angle,
            self.glass,
            self.stop,
            self.proxy,
            self.posterior,
        )

    @property
    def total(self) -> float:
        """Error to expect of the PSF of the device."""
        return _together(self.computed, self.model)

    @property
    def text(self) -> str:
        """One line for a person."""
        terms = {f.name: getattr(self, f.name) for f in fields(self)}
        known = {name: term for name, term in terms.items() if not math.isnan(term)}
        outside = known.pop("outside", None)
        causes = [f"{n} {term:.1e}" if term else f"{n} 0" for n, term in known.items()]
        words = f"error by cause: {', '.join(causes)}; of the device {self.total:.1e}"
        if outside is None:
            return words
        return f"{words}; {outside:.1%} of the light falls outside the window"


def _together(*terms: float) -> float:
    return math.hypot(*(term for term in terms if not math.isnan(term)))


def worst_of_budgets(budgets: list[PsfErrorBudget]) -> PsfErrorBudget:
    """The largest of every term of ``budgets``."""

    def worst(name: str) -> float:
        known = [getattr(b, name) for b in budgets if not math.isnan(getattr(b, name))]
        return max(known, default=math.nan)

    return PsfErrorBudget(
        **{field.name: worst(field.name) for field in fields(PsfErrorBudget)}
    )


def with_model(
    budget: PsfErrorBudget,
    lens: Lens,
    angle_rad: tuple[float, float],
    nodes: SpectralNodes,
    polarisation: Polarisation,
) -> PsfErrorBudget:
    """The budget of one direction with the errors of spectrum and lens model added.

    Model errors are those of a perfect lens of the same aperture. ``proxy`` is the
    error of the response table, as a change of t with the diameter, and so with the
    phase. Its mean only dims the focus. The remainder leaves in other orders, which
    cross the focus as wide as the lens.

    Args:
        budget: errors of the computation.
        lens: aperture, response table, films.
        angle_rad: (x, y) field angle.
        nodes: wavelengths with weights, and the error of their quadrature.
        polarisation: that was computed.
    """
    aperture = sine_aperture(lens, angle_rad)
    wavelength_um = lens.wavelength_um
    slanted = min(1.0, ANGLE * incidence_sine(angle_rad) ** 2)
    area = lens.diameters.pillars * lens.diameters.site_um2 / wavelength_um**2
    pairs = lens.pairs
    curve = pairs.entry_error if pairs else lens.proxy.error(wavelength_um)
    mixing = budget.polarisation
    if polarisation == "scalar":
        variation = obliquity_variation(lens, angle_rad)
        mixing = _together(scalar_error(aperture, variation), mixing)
    return replace(
        budget,
        spectrum=nodes.error,
        polarisation=mixing,
        neighbours=_neighbours(
            aperture, lens.neighbours, polarisation, nodes, slanted, area
        ),
        angle=0.0 if lens.proxy.max_angle_rad > 0 else slanted,
        glass=lens.layers.ghost(wavelength_um),
        proxy=curve * min(2.0, 2 * _crossed(aperture, _scalar(aperture), area)),
    )


def incidence_sine(angle_rad: tuple[float, float]) -> float:
    """Sine of the angle of incidence in air.

    Args:
        angle_rad: (x, y) field angle.
    """
    slope = math.hypot(*map(math.tan, angle_rad))
    return slope / math.hypot(1.0, slope)


def _aperture(lens: Lens, angle_rad: tuple[float, float]) -> tuple[Media, float, float]:
    """Media behind a lens, lateral reach of the chief ray, and radius of the aperture."""
    after = lens.layers.after(lens.sensor_distance_um, lens.wavelength_um)
    centre = float(media.lateral_reach(after, incidence_sine(angle_rad)))
    return after, centre, lens.diameters.radius_um + lens.diameters.pitch_um / 2


def sine_aperture(lens: Lens, angle_rad: tuple[float, float]) -> float:
    """Numerical aperture on the sensor: half the range of sin θ of the rays to a point.

    The point is where the chief ray meets the sensor.

    Args:
        lens: aperture, distance and films.
        angle_rad: field angles along x and y, rad.
    """
    after, centre, radius = _aperture(lens, angle_rad)
    edges = centre + np.array([-1.0, 1.0]) * radius
    p = np.sign(edges) * media.ray_direction(after, np.abs(edges))
    return float((p[1] - p[0]) / 2 / after.order[-1])


def obliquity_variation(lens: Lens, angle_rad: tuple[float, float]) -> float:
    """Relative standard deviation over the aperture of 1/cos θ of the rays to a point.

    The point is where the chief ray meets the sensor. The aperture is integrated by
    Gauss's rule in r² and equal steps of azimuth.

    Args:
        lens: aperture, distance and films.
        angle_rad: field angles along x and y, rad.
    """
    after, centre, edge = _aperture(lens, angle_rad)
    node, share = np.polynomial.legendre.leggauss(RINGS)
    radius = edge * np.sqrt((node + 1) / 2)[:, None]
    turn = 2 * np.pi * (np.arange(SPOKES) + 0.5) / SPOKES
    reach = np.hypot(centre + radius * np.cos(turn), radius * np.sin(turn))
    sine = np.asarray(media.ray_direction(after, reach)) / after.order[-1]
    weight = 1 / np.sqrt(1 - sine**2)
    mean = share @ weight.mean(1) / 2
    return float(np.sqrt(share @ ((weight - mean) ** 2).mean(1) / 2) / mean)


def scalar_error(aperture: float, uneven: float = 0.0) -> float:
    """Relative L2 difference between the scalar PSF and the flux of both polarisations.

    A pixel counts the flux. Two terms add in quadrature: that of a perfect lens of this
    aperture in focus (7e-5 at NA 0.24, 4e-3 at 0.6), and that of oblique light. Two
    rays b, b' add up as (b_z + b'_z) / 2√(b_z b'_z), which differs from 1 by the
    squared variation of 1/cos θ. Of 36 random lenses (NA 0.1 to 0.6, up to 25 degrees,
    in focus, defocused, aberrated), all had 0.29 to 0.86 of this error.

    Args:
        aperture: numerical aperture on the sensor.
        uneven: relative standard deviation of 1/cos θ over the aperture
            (:func:`obliquity_variation`).
    """
    return math.hypot(_difference(_scalar(aperture), _flux(aperture)), uneven**2 / 2)


def _neighbours(
    aperture: float,
    model: NeighbourRows | None,
    polarisation: Polarisation,
    nodes: SpectralNodes,
    slanted: float,
    area: float,
) -> float:
    """Relative L2 error of a PSF by the coupling of unequal neighbours.

    ``NEIGHBOURS`` stands for a lens without solved rows: the error is then that of no
    coupling. With solved rows the errors are those of their truncation, of any row left
    out, of the change of zones, of other wavelengths, and of one scalar mean for both
    polarisations. Light that neighbours scatter is added in both cases.

    Args:
        aperture: numerical aperture on the sensor.
        model: solved rows; None for ``NEIGHBOURS``.
        polarisation: that was computed.
        nodes: wavelengths with weights.
        slanted: relative change of the coupling by oblique light.
        area: of the lens in squared wavelengths.
    """
    p, _, _ = _nodes(aperture)
    uncoupled = _scalar(aperture)
    if model is None:
        factor = 1 + NEIGHBOURS[0] * p + NEIGHBOURS[1] * p * p
        psf = _scalar(aperture, factor)
        scattered = _scattered(aperture, factor, psf, area)
        return math.hypot(_difference(psf, uncoupled), scattered)
    factor = model.mean(p)
    psf = _scalar(aperture, factor)

    def change(other: Array) -> float:
        return _difference(_scalar(aperture, other), psf)

    error = change(model.coarser.mean(p))
    error += max((change(other.mean(p)) for other in model.others), default=0.0)
    error += math.hypot(CURVED, slanted) * _difference(uncoupled, psf)
    for wave, weight in zip(nodes.wavelengths_um, nodes.weights, strict=True):
        dispersion = change(model.mean(p * (wave / model.wavelength_um)))
        error = math.hypot(error, math.sqrt(weight) * dispersion)
    error = math.hypot(error, _scattered(aperture, factor, psf, area))
    if polarisation != "scalar":
        return error
    along, across = (model.at(p) + model.at(p, math.pi / 4)) / 2
    crossed = _scalar(aperture, (along - across) / 2, order=2)
    return math.hypot(error, _difference(psf + crossed, psf))


def _scattered(aperture: float, factor: Array, psf: Array, area: float) -> float:
    """Relative L2 error of a PSF by light n that neighbours scatter, of any phase.

    It is the light 1 - |C|² that coupling takes from the focus. It crosses the focus as
    wide as the lens, like the order that goes straight on:

        |U + n|² - |U|² ≈ 2 Re U* n
        ‖2 Re U* n‖² = 2 <|n|²> ∫|U|²,  <|n|²> = P / area

    It is large for a lens of few wavelengths: 0.09 on a square of 7 um at NA 0.4, 5e-4
    for 1 mm.

    Args:
        aperture: numerical aperture on the sensor.
        factor: (p,) coupling C at the nodes.
        psf: (ρ,) |U|².
        area: of the lens in squared wavelengths.
    """
    p, weight, _ = _nodes(aperture)
    power = weight / (1 - p * p) ** 2
    focused = float(power @ np.abs(factor) ** 2 / power.sum())
    scattered = max(1 - focused, 0.0) / focused
    return math.sqrt(scattered) * _crossed(aperture, psf, area)


def _crossed(aperture: float, psf: Array, area: float) -> float:
    """Relative L2 change of a PSF |U|² by light of equal power, as wide as the lens.

    √(2 (∫|U|²)² / ∫|U|⁴ / area), with areas in squared wavelengths.
    """
    _, _, radius = _nodes(aperture)
    step = radius[1] / (2 * np.pi)
    ring = np.arange(len(psf)) * (2 * np.pi * step**2)
    return math.sqrt(2 * float(psf @ ring) ** 2 / float(psf**2 @ ring) / area)


def _nodes(aperture: float) -> tuple[Array, Array, Array]:
    """(p,) Gauss nodes of sin θ, (p,) weights p dp, (ρ,) k ρ over some ten rings."""
    t, w = np.polynomial.legendre.leggauss(64)
    edge = min(aperture, 0.999)
    p = edge * (t + 1) / 2
    return p, w * p * edge / 2, np.linspace(0, 30 / edge, 240)


def _scalar(aperture: float, factor: Array | float = 1.0, *, order: int = 0) -> Array:
    """(ρ,) |U|² of a perfect lens: U = ∫ factor J_m(k ρ p) p dp / (1 - p²).

    Args:
        aperture: numerical aperture on the sensor.
        factor: (p,) at the nodes.
        order: m, turns of the light's phase about the axis.
    """
    p, weight, radius = _nodes(aperture)
    level = weight / (1 - p * p) * factor
    return np.asarray(np.abs(level @ jv(order, np.outer(p, radius))) ** 2)


def _flux(aperture: float) -> Array:
    """(ρ,) I0² - I2² of Richards and Wolf: power through the plane, unpolarised."""
    p, weight, radius = _nodes(aperture)
    cosine = np.sqrt(1 - p * p)
    level = weight / (1 - p * p) / np.sqrt(cosine)
    x = np.outer(p, radius)
    return np.asarray(
        ((level * (1 + cosine)) @ jv(0, x)) ** 2
        - ((level * (1 - cosine)) @ jv(2, x)) ** 2
    )


def _difference(psf: Array, reference: Array) -> float:
    """Relative L2 distance over the plane of two radial PSFs (ρ,), each of sum 1."""
    ring = np.arange(len(psf))
    psf = psf / (psf @ ring)
    reference = reference / (reference @ ring)
    return float(np.sqrt((psf - reference) ** 2 @ ring / (reference**2 @ ring)))
