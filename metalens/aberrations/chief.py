"""The chief ray of a field angle by the local grating equation, and the rays close to
it.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from metalens.core.arrays import Array
from metalens.core.errors import PropagationError
from metalens.lens import Lens
from metalens.optics import media
from metalens.optics.media import Media
from metalens.psf import library_incidence

ZONES = 2.0  # radius of the fitted patch of pillars, in √(wavelength focal length)
LEAST = 60  # pillars of a patch at least, for 15 terms
SPARSE = 0.3  # least share of occupied sites; with fewer the ray misses the lens
# rad rms of the phase about its polynomial above which there is no wave front; a
# uniformly random phase has 1.81
ROUGH = 0.6
POWERS = [(i, j) for i in range(5) for j in range(5 - i)]  # terms x^i y^j
TURNS = 4  # iterations of the polynomial fit
PARALLEL = 1e-16  # (d lateral shift / d distance)² below which rays are parallel
STEP = 1e-4  # of differences, in tangents or depths


@dataclass(frozen=True, eq=False, slots=True)
class ChiefRay:
    """The chief ray of a source, and the rays close to it; vectors are [x, y].

    at_um: (2,) on the pillars.
    p: (2,) n sin θ behind them.
    meets_um: (2,) on the sensor.
    focus_um: (2,) distance behind the pillars where close rays spread least along x and
        along y of the sensor, films fixed and the gap before them changed. Below 0 for
        a virtual focus, inf for parallel rays.
    focus_error_um: (2,) one sigma of it, by the scatter of the pillars' phases about
        their polynomial.
    source: (2,) place of the source from the axis, um; its tangents for collimated
        light.
    moves: (2, 2) ∂ meets_um / ∂ source.
    """

    at_um: Array
    p: Array
    meets_um: Array
    focus_um: Array
    focus_error_um: Array
    source: Array
    moves: Array


def chief_ray(
    lens: Lens, angle_rad: tuple[float, float] = (0.0, 0.0), depth_um: float = math.inf
) -> ChiefRay:
    """Chief ray of a field angle at the design wavelength, with the foci of close rays.

    It passes through the middle of the stop, or of the pillars without one. The pillars
    deflect it by the local grating equation: p = p_incident + grad(phase) / k.

    Args:
        lens: the lens.
        angle_rad: (x, y) field angle, arctangents of the slopes in air of the ray to
            the middle of the lens.
        depth_um: of the source, inf for collimated light.

    Raises:
        PropagationError: the ray misses the pillars, or is totally reflected; the phase
            about it is no wave front (a vortex, a hologram).
        DomainError: an angle outside the lens's library.

    Accuracy: landing and foci to ``focus_error_um`` where pillars err at random; of a
        smooth phase 2e-6 of the distance and a twentieth of a wavelength. The factor of
        non-identical neighbours (``lens.neighbours``) is left out.
    """
    source = source_at(lens, angle_rad, depth_um)
    at = middle_um(lens, source, depth_um)
    slope, curvature, deviations = _wave_front(lens, at, angle_rad)
    p = _incident_direction(lens, at, source, depth_um) + slope
    after = lens.layers.after(lens.sensor_distance_um, lens.wavelength_um)
    p_square = float(p @ p)
    if p_square >= 0.999 * after.layers[0][0] ** 2:
        why = f"leaves with n sin θ = {math.sqrt(p_square):.3f}, beyond the media"
        raise PropagationError(_failure_text(lens, angle_rad, why))
    q = curvature + _jacobian(
        lambda x: _incident_direction(lens, x, source, depth_um), at, 1.0
    )
    focus = _foci(after, p, q)
    finite = np.isfinite(focus)
    about = np.where(finite, focus, 0)
    variance = sum((_foci(after, p, q + d) - about) ** 2 for d in deviations)
    error = np.where(finite, np.sqrt(variance), np.inf)
    step = STEP if math.isinf(depth_um) else STEP * depth_um
    p_by_source = _jacobian(
        lambda s: _incident_direction(lens, at, s, depth_um), source, step
    )
    place_by_source = _jacobian(lambda s: middle_um(lens, s, depth_um), source, step)
    reach_by_p = _reach_derivative(after, p)
    moves = reach_by_p @ p_by_source + (np.eye(2) + reach_by_p @ q) @ place_by_source
    return ChiefRay(
        at,
        p,
        at + media.reach_per_direction(after.layers, p_square) * p,
        focus,
        np.asarray(error),
        source,
        moves,
    )


def _failure_text(lens: Lens, angle_rad: tuple[float, float], why: str) -> str:
    angle = ", ".join(f"{math.degrees(a):g}" for a in angle_rad)
    through = "its stop" if lens.layers.stop is not None else "the lens"
    return f"the chief ray of ({angle}) degrees, through the middle of {through}, {why}"


def source_at(lens: Lens, angle_rad: tuple[float, float], depth_um: float) -> Array:
    """(2,) place of the source of a field angle from the axis in um; its tangents at
    infinity.

    Args:
        lens: the lens.
        angle_rad: field angles along x and y, rad.
        depth_um: source depth from the lens, um.
    """
    tangents: Array = np.tan(np.asarray(angle_rad, float))
    slope = float(np.hypot(*tangents))
    if math.isinf(depth_um) or slope == 0:
        return tangents
    p = slope / math.hypot(1, slope)
    return np.asarray(
        -media.lateral_reach(lens.layers.before(depth_um, lens.wavelength_um), p)
        / slope
        * tangents
    )


def _incident_direction(lens: Lens, x: Array, source: Array, depth_um: float) -> Array:
    """(2,) n sin θ of the light of a source at a place of the pillars.

    Args:
        x: (2,) place on the pillars, um.
        source: (2,) place of the source in um; its tangents for collimated light.
    """
    if math.isinf(depth_um):
        return np.asarray(source / math.sqrt(1 + float(source @ source)))
    layers = lens.layers.before(depth_um, lens.wavelength_um).layers
    offset = x - source
    return np.asarray(
        offset
        / media.reach_per_direction(
            layers, media.solve_direction_square(layers, offset @ offset)
        )
    )


def middle_um(lens: Lens, source: Array, depth_um: float) -> Array:
    """(2,) place in um where the ray through the middle of the stop meets the pillars.

    Without a stop it is the centre of mass of the pillars.

    Args:
        lens: the lens.
        source: (2,) place of the source in um; its tangents for collimated light.
        depth_um: source depth from the lens, um.
    """
    stop = lens.layers.stop
    between = lens.layers.from_stop(lens.wavelength_um)
    if stop is None:
        occupied = lens.diameters.diameter_um > 0
        weights = occupied.sum(0), occupied.sum(1)
        axes = lens.diameters.x_um, lens.diameters.y_um
        return np.array([a @ w / w.sum() for a, w in zip(axes, weights, strict=True)])
    if between is None:
        return np.array(stop.centre_um)
    p = _incident_direction(lens, np.zeros(2), source, depth_um)
    slopes = lens.layers.through_middle(
        p / math.sqrt(1 - float(p @ p)), depth_um, lens.wavelength_um
    )
    p = slopes / math.sqrt(1 + float(slopes @ slopes))
    return np.asarray(
        stop.centre_um + media.reach_per_direction(between.layers, float(p @ p)) * p
    )


def _jacobian(function: Callable[[Array], Array], x: Array, step: float) -> Array:
    """(2, 2) ∂function_i / ∂x_j by central differences."""
    columns = [
        (function(x + e) - function(x - e)) / (2 * step) for e in np.eye(2) * step
    ]
    return np.stack(columns, axis=1)


def _reach_derivative(after: Media, p: Array) -> Array:
    """(2, 2) ∂ (lateral shift from the pillars to the sensor) / ∂ p, in um."""
    w, outer = float(p @ p), np.outer(p, p)
    return np.asarray(
        sum(
            t * (np.eye(2) / (n * n - w) ** 0.5 + outer / (n * n - w) ** 1.5)
            for n, t in after.layers
        )
    )


def _foci(after: Media, p: Array, q: Array) -> Array:
    """(2,) distances behind the pillars where close rays spread least along x and along
    y.

    A bundle spreads by S + z C, with S the identity plus the lateral shift by place; it
    is least at z = -sum(S C) / sum(C²) behind the sensor. inf for parallel rays.

    Args:
        p: (2,) n sin θ of the chief ray.
        q: (2, 2) ∂p / ∂ place on the pillars, per um.
    """
    p_z_square = after.index[0] ** 2 - float(p @ p)
    slopes = np.eye(2) / p_z_square**0.5 + np.outer(p, p) / p_z_square**1.5
    spread = np.eye(2) + _reach_derivative(after, p) @ q
    change = slopes @ q
    power = (change**2).sum(1)
    behind = np.divide(
        -(spread * change).sum(1),
        power,
        out=np.full(2, np.inf),
        where=power > PARALLEL / sum(after.thickness_um) ** 2,
    )
    return np.asarray(sum(after.thickness_um) + behind)


def _wave_front(
    lens: Lens, at: Array, angle_rad: tuple[float, float]
) -> tuple[Array, Array, list[Array]]:
    """Slope and curvature of the pillars' phase over k around a place, with errors.

    A polynomial of 4th order is fitted to the phases of a patch of pillars. Its scatter
    and the fit's covariance give the errors.

    Args:
        at: (2,) place on the pillars, um.
        angle_rad: (x, y) field angle, rad.

    Returns:
        (2,) slope, (2, 2) curvature per um, and changes of the curvature whose squares
        add up to its variance.

    Raises:
        PropagationError: too few pillars around the place, or a phase that is no wave
            front.
    """
    focal = 1 / (1 / lens.reduced_um + 1 / lens.source_distance_um)
    k = 2 * math.pi / lens.wavelength_um
    site = lens.diameters.site_um2
    radius = max(
        ZONES * math.sqrt(lens.wavelength_um * focal),
        math.sqrt(2 * LEAST * site / math.pi),
    )
    x, y, phase, inside = _patch(lens, at, radius, library_incidence(lens, angle_rad))
    sites = SPARSE * min(math.pi * radius**2 / site, lens.diameters.pillars)
    least = max(sites, LEAST)
    count = np.count_nonzero(inside)
    if count < least:
        why = (
            f"comes to the pillars' plane at ({at[0]:.1f}, {at[1]:.1f}) um, where the "
            f"lens has {count} pillars; need {least:.0f} about it"
        )
        raise PropagationError(_failure_text(lens, angle_rad, why))
    phasors = np.where(inside, np.exp(1j * phase), 0.0)
    powers = np.stack(
        [(x / radius) ** i * (y[:, None] / radius) ** j for i, j in POWERS], -1
    )
    # on a hexagonal lattice every other place is a site
    guess = _unwrapped_polynomial(
        powers, phasors, 2 if lens.diameters.lattice.centred else 1
    )
    terms = powers[inside]
    series, scatter = _fit_polynomial(terms, phasors[inside], guess)
    if scatter > ROUGH:
        why = f"meets no wave front: phases scatter by {scatter:.2f} rad rms"
        raise PropagationError(_failure_text(lens, angle_rad, why))
    slope = series[[POWERS.index((1, 0)), POWERS.index((0, 1))]] / (k * radius)
    columns = np.linalg.cholesky(np.linalg.inv(terms.T @ terms)) * scatter / k
    deviations = [_curvature(column, radius) for column in columns.T]
    return slope, _curvature(series / k, radius), deviations


def _curvature(series: Array, radius: float) -> Array:
    """(2, 2) second derivatives at 0 of a polynomial in place / radius, per um²."""
    by_power = dict(zip(POWERS, series, strict=True))
    xx, xy, yy = by_power[2, 0], by_power[1, 1], by_power[0, 2]
    return np.array([[2 * xx, xy], [xy, 2 * yy]]) / radius**2


def _patch(
    lens: Lens, at: Array, radius: float, tilt_rad: float
) -> tuple[Array, Array, Array, Array]:
    """Pillars within a radius of a place: coordinates, phases, and a mask.

    Args:
        at: (2,) place, um.
        tilt_rad: angle of incidence for the library.

    Returns:
        x (x,) and y (y,) from the place in um, phase (y, x) in rad, and (y, x) which
        sites hold a pillar inside the radius.
    """
    diameters = lens.diameters
    columns, rows = (
        np.flatnonzero(abs(a - c) <= radius)
        for a, c in zip((diameters.x_um, diameters.y_um), at, strict=True)
    )
    if not (columns.size and rows.size):
        return np.zeros(0), np.zeros(0), np.zeros((0, 0)), np.zeros((0, 0), bool)
    across = slice(columns[0], columns[-1] + 1)
    down = slice(rows[0], rows[-1] + 1)
    x, y = diameters.x_um[across] - at[0], diameters.y_um[down] - at[1]
    inside = (x * x + y[:, None] ** 2 <= radius**2) & (
        np.asarray(diameters.diameter_um[down, across]) > 0
    )
    return (
        x,
        y,
        lens.phase_rad(lens.wavelength_um, tilt_rad, rows=down)[:, across],
        inside,
    )


def _unwrapped_polynomial(powers: Array, phasors: Array, hop: int) -> Array:
    """(terms,) coefficients, rad, of the least-squares polynomial of phase steps.

    Steps are wrapped differences between neighbours about their mean (Hudgin 1977).

    Args:
        powers: (y, x, terms) powers of the place.
        phasors: (y, x) exp(i phase), 0 where there is no pillar.
        hop: places from a site to the next.
    """
    changes, steps = [], []
    for axis in (0, 1):
        field, terms = (np.moveaxis(part, axis, 0) for part in (phasors, powers))
        turn = field[hop:] * field[:-hop].conj()
        mean = np.angle(turn.sum())
        known = turn != 0
        changes.append((terms[hop:] - terms[:-hop])[known])
        steps.append(mean + np.angle(turn[known] * np.exp(-1j * mean)))
    fit = np.linalg.lstsq(np.concatenate(changes), np.concatenate(steps), rcond=None)
    return np.asarray(fit[0])


def _fit_polynomial(terms: Array, turn: Array, series: Array) -> tuple[Array, float]:
    """Least-squares polynomial of a wrapped phase, by iterated wrapped residuals.

    Args:
        terms: (pillars, terms) powers of the place.
        turn: (pillars,) phasors exp(i phase).
        series: (terms,) guess of the coefficients.

    Returns:
        (terms,) coefficients in rad, and the rms residual in rad.
    """
    inverse = np.linalg.pinv(terms)
    for _ in range(TURNS):
        residual = turn * np.exp(-1j * (terms @ series))
        middle = np.angle(residual.sum())
        series = series + inverse @ np.angle(residual * np.exp(-1j * middle))
        series[0] += middle
    residual = np.angle(turn * np.exp(-1j * (terms @ series)))
    return series, float(np.sqrt((residual**2).sum() / max(len(turn) - len(POWERS), 1)))
