"""What the error of a PSF is made of: what was computed, and what the model leaves out."""

import math
from dataclasses import dataclass, fields, replace
from typing import Literal

import numpy as np
from scipy.special import jv

from metalens.core.arrays import Array
from metalens.lens import CURVED, Lens, NeighbourRows
from metalens.optics import media
from metalens.psf.spectrum import SpectralNodes

Polarisation = Literal["scalar", "flux", "vector", "auto"]
# pillars among unlike neighbours, solved rows of 12 and 8 of the default cell:
# amplitude 0.986, -0.066 rad at sine
# 0.236, and 0.959, -0.100 rad at 0.354; another cell's own factor is
# metalens.design.neighbours.estimate_neighbour_coupling
NEIGHBOURS = (0.057 - 0.289j, -0.523 + 0.054j)
# change of t over sin² of the incidence: 0.29 at 20 degrees, the default cell's worst
# pillar off resonance
ANGLE = 2.5
RINGS, SPOKES = (
    8,
    24,
)  # of an aperture over which obliquity is averaged: to rounding at NA 0.6 and 25 degrees
HOW = "the default cell, rough (design --own-cell has a lens hold its own neighbours)"


CURES = {  # of an error above the tolerance, by its largest part
    "numerical": "raise it or widen the window",
    "sampling": "give the window more samples",
    "spectrum": "raise it or narrow the spectrum",
    "source": "raise it or give a smaller source",
}


@dataclass(frozen=True, slots=True)
class LeftOut:
    """What is known of pillars that the model of a lens leaves out; by default rough,
    of another cell.

    neighbours: rows of the lens's own pillars, whose factor its PSFs hold (at the rows'
    wavelength and at normal
        incidence; what other light changes is counted); or (a, b) of the factor 1 + a s
        + b s² on
        light that unlike neighbours turn by the sine s, which they lack.
    angle: relative change of t over sin² of the incidence. of: whose numbers they are.
    """

    neighbours: NeighbourRows | tuple[complex, complex] = NEIGHBOURS
    angle: float = ANGLE
    of: str = ""

    @property
    def words(self) -> str:
        """For a person."""
        if isinstance(self.neighbours, tuple):
            return f"neighbours and angle: of {self.of or HOW}"
        angle = "" if self.of else "; angle: of the default cell, rough"
        at = f"at {self.neighbours.wavelength_um:g} um and normal incidence"
        return f"unlike neighbours counted, by {len(self.neighbours.sine)} solved rows {at}{angle}"


@dataclass(frozen=True, slots=True)
class Budget:
    """Relative L2 errors of the PSFs by cause, the worst over angles; nan where it is
    not known.

    numerical: of the propagation, measured on the result. sampling: of the integration
    over the cells of the window.
    spectrum: of the quadrature over wavelengths. source: of a source of finite size,
    whose points are taken as alike.
    polarisation: of one scalar in place of both polarisations (of plain maps only that
    of films, which let s and p
        through unlike, measured on the light); of both, of rays whose fields are those
        on their way to the window's
        middle. neighbours: of pillars taken as if each stood among its like, or of the
        factor of solved rows where the
        lens holds them. angle: of pillars that answer as at normal incidence. glass: of
        light that goes twice between
        two faces. proxy: of pillars that answer by a curve, which follows those of
        their library to some error, and of
        what their solver knows of them; of two sizes that alone. posterior: of a lens
        that
    was fitted to captures, what its parameters leave open.
    outside: share of the light that falls beside the window, worst over angles and
    depths; a PSF of sum 1 does not
        show it, so it is in no total.
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
    def cure(self) -> str:
        """What to do about the largest part of what is computed."""
        return CURES[max(CURES, key=lambda cause: getattr(self, cause))]

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
        terms = [
            (f.name, getattr(self, f.name)) for f in fields(self) if f.name != "outside"
        ]
        known = [
            f"{name} {value:.1e}" if value else f"{name} 0"
            for name, value in terms
            if not math.isnan(value)
        ]
        lost = (
            ""
            if math.isnan(self.outside)
            else f"; {self.outside:.1%} of the light falls beside the window"
        )
        return (
            f"error by cause: {', '.join(known)}; of the device {self.total:.1e}{lost}"
        )


def _together(*terms: float) -> float:
    return math.hypot(*(term for term in terms if not math.isnan(term)))


def worst_of_budgets(budgets: list[Budget]) -> Budget:
    """The largest of every term."""
    names = [f.name for f in fields(Budget)]
    return Budget(**{n: _largest([getattr(b, n) for b in budgets]) for n in names})


def _largest(values: list[float]) -> float:
    known = [v for v in values if not math.isnan(v)]
    return max(known) if known else math.nan


def with_model(
    budget: Budget,
    lens: Lens,
    angle_rad: tuple[float, float],
    nodes: SpectralNodes,
    polarisation: Polarisation,
    left_out: LeftOut,
) -> Budget:
    """The budget of one direction with the spectrum, and what the model of a lens
    leaves out: terms of a perfect lens of the same aperture.

    The term of the response curve is that of pillars off by at most this much of t, a
    function of the diameter and so of the phase: its mean only dims the focus; the rest
    leaves for other orders, which cross the focus as broad as the lens.

    Args:
        budget: of what was computed.
        lens: aperture, response table, films.
        angle_rad: (x, y) field angle.
        nodes: wavelengths with weights, and the error of their quadrature.
        polarisation: that was computed.
        left_out: what is known of neighbours and angles.
    """
    aperture = sine_aperture(lens, angle_rad)
    wavelength_um = lens.wavelength_um
    slanted = min(1.0, left_out.angle * incidence_sine(angle_rad) ** 2)
    area = lens.diameters.pillars * lens.diameters.site_um2 / wavelength_um**2
    pairs = lens.pairs
    curve = pairs.entry_error if pairs else lens.proxy.error(wavelength_um)
    rays = budget.polarisation
    if polarisation == "scalar":
        uneven = obliquity_variation(lens, angle_rad)
        rays = _together(scalar_error(aperture, uneven), rays)
    return replace(
        budget,
        spectrum=nodes.error,
        polarisation=rays,
        neighbours=_neighbours(
            aperture, left_out.neighbours, polarisation, nodes, slanted, area
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


def sine_aperture(lens: Lens, angle_rad: tuple[float, float]) -> float:
    """Half the spread in sin θ of the rays from the lens to the chief ray's place on
    the sensor.

    Args:
        angle_rad: field angles along x and y, rad.
    """
    after = lens.layers.after(lens.sensor_distance_um, lens.wavelength_um)
    centre = float(media.lateral_reach(after, incidence_sine(angle_rad)))
    edges = centre + np.array([-1.0, 1.0]) * (
        lens.diameters.radius_um + lens.diameters.pitch_um / 2
    )
    p = np.sign(edges) * media.ray_direction(after, np.abs(edges))
    return float((p[1] - p[0]) / 2 / after.order[-1])


def obliquity_variation(lens: Lens, angle_rad: tuple[float, float]) -> float:
    """Standard deviation over its mean of 1/cos θ of the rays from the lens to the
    chief ray's place on the sensor.

    Args:
        angle_rad: field angles along x and y, rad.
    """
    after = lens.layers.after(lens.sensor_distance_um, lens.wavelength_um)
    centre = float(media.lateral_reach(after, incidence_sine(angle_rad)))
    node, share = np.polynomial.legendre.leggauss(RINGS)
    radius = (lens.diameters.radius_um + lens.diameters.pitch_um / 2) * np.sqrt(
        (node + 1) / 2
    )[:, None]
    turn = 2 * np.pi * (np.arange(SPOKES) + 0.5) / SPOKES
    p = media.ray_direction(
        after, np.hypot(centre + radius * np.cos(turn), radius * np.sin(turn))
    )
    weight = 1 / np.sqrt(1 - (np.asarray(p) / after.order[-1]) ** 2)
    mean = share @ weight.mean(1) / 2
    return float(np.sqrt(share @ ((weight - mean) ** 2).mean(1) / 2) / mean)


def scalar_error(aperture: float, uneven: float = 0.0) -> float:
    """Relative L2 difference between the scalar PSF and the flux of both polarisations,
    which a pixel counts.

    That of a perfect lens of this aperture in focus (7e-5 at NA 0.24, 4e-3 at 0.6), and
    of light from the side: two
    rays b, b' of it add up as (b_z + b'_z) / 2√(b_z b'_z), which is 1 but for squares
    of how uneven 1/cos θ is. Of 36
    lenses drawn (NA 0.1 to 0.6, up to 25 degrees, in focus, out of it, aberrated) 36
    lie below, at 0.29 to 0.86 of it.

    Args:
        uneven: standard deviation of 1/cos θ over the aperture, over its mean
            (:func:`metalens.psf.of_lens.uneven`).
    """
    return math.hypot(_difference(_scalar(aperture), _flux(aperture)), uneven**2 / 2)


def _neighbours(
    aperture: float,
    known: NeighbourRows | tuple[complex, complex],
    polarisation: Polarisation,
    nodes: SpectralNodes,
    slanted: float,
    area: float,
) -> float:
    """Of pillars taken one by one; or of the factor of rows: another truncation, any
    row left out, zones that get shorter from one to the next, other light than the
    rows', and for the scalar one mean of fields along and across the slope. And of the
    light that they scatter.

    slanted: share of the change that light from the side may change, as t of a pillar
    does. area: of the lens in squared wavelengths.
    """
    p, _, _ = _nodes(aperture)
    if isinstance(known, tuple):
        factor = 1 + known[0] * p + known[1] * p * p
        used = _scalar(aperture, factor)
        changed = _difference(used, _scalar(aperture))
        return math.hypot(changed, _scattered(aperture, factor, used, area))
    factor = known.mean(p)
    used = _scalar(aperture, factor)

    def change(other: Array) -> float:
        return _difference(_scalar(aperture, other), used)

    left = change(known.coarser.mean(p))
    left += max((change(other.mean(p)) for other in known.others), default=0.0)
    left += math.hypot(CURVED, slanted) * _difference(_scalar(aperture), used)
    for wave, weight in zip(nodes.wavelengths_um, nodes.weights, strict=True):
        away = change(known.mean(p * (wave / known.wavelength_um)))
        left = math.hypot(left, math.sqrt(weight) * away)
    left = math.hypot(left, _scattered(aperture, factor, used, area))
    if polarisation != "scalar":
        return left
    along, across = (known.at(p) + known.at(p, math.pi / 4)) / 2
    turned = _scalar(aperture, (along - across) / 2, order=2)
    return math.hypot(left, _difference(used + turned, used))


def _scattered(aperture: float, factor: Array, used: Array, area: float) -> float:
    """Of the light that neighbours take from the focus (1 - |C|²) and that meets it
    again with any phase, spread over
    the shadow of the lens, as the order that goes straight on:

        |U + n|² - |U|² ≈ 2 Re U* n,   ‖2 Re U* n‖² = 2 <|n|²> ∫|U|²,   <|n|²> = P / area

    A lens of few wavelengths has few places for it: 0.09 on a square of 7 um at NA 0.4,
    5e-4 for 1 mm.
    """
    p, weight, _ = _nodes(aperture)
    power = weight / (1 - p * p) ** 2
    kept = float(power @ np.abs(factor) ** 2 / power.sum())
    return math.sqrt(max(1 - kept, 0.0) / kept) * _crossed(aperture, used, area)


def _crossed(aperture: float, used: Array, area: float) -> float:
    """√(2 (∫|U|²)² / ∫|U|⁴ / area): what light of the same power, as broad as the lens, does to a PSF |U|²."""
    _, _, radius = _nodes(aperture)
    ring = np.arange(len(used)) * (
        2 * np.pi * (radius[1] / (2 * np.pi)) ** 2
    )  # in squared wavelengths
    return math.sqrt(2 * float(used @ ring) ** 2 / float(used**2 @ ring) / area)


def _nodes(aperture: float) -> tuple[Array, Array, Array]:
    """(p,) nodes, (p,) weights p dp, (ρ,) k ρ up to some ten rings."""
    t, w = np.polynomial.legendre.leggauss(64)
    edge = min(aperture, 0.999)
    p = edge * (t + 1) / 2
    return p, w * p * edge / 2, np.linspace(0, 30 / edge, 240)


def _scalar(aperture: float, factor: Array | float = 1.0, *, order: int = 0) -> Array:
    """(ρ,) |U|² through a factor at the nodes, of light that turns ``order`` times
    about the axis.
    """
    p, weight, at = _nodes(aperture)
    level = weight / (1 - p * p) * factor
    return np.asarray(np.abs(level @ jv(order, np.outer(p, at))) ** 2)


def _flux(aperture: float) -> Array:
    """(ρ,) I0² - I2² of Richards and Wolf: power through the plane, unpolarised."""
    p, weight, at = _nodes(aperture)
    cosine = np.sqrt(1 - p * p)
    level, x = weight / (1 - p * p) / np.sqrt(cosine), np.outer(p, at)
    return np.asarray(
        ((level * (1 + cosine)) @ jv(0, x)) ** 2
        - ((level * (1 - cosine)) @ jv(2, x)) ** 2
    )


def _difference(one: Array, other: Array) -> float:
    """Relative L2 distance over the plane of two radial PSFs of sum 1."""
    ring = np.arange(len(one))
    one, other = one / (one @ ring), other / (other @ ring)
    return float(np.sqrt((one - other) ** 2 @ ring / (other**2 @ ring)))
