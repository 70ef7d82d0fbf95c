"""Whether a phase brings light together at all: where the rays of the design source
meet the sensor.
"""

import math

import numpy as np

from metalens.core.arrays import Array
from metalens.design.profiles import Focus, hyperbolic_phase, lens_focus
from metalens.design.sites import PhaseOf
from metalens.lens import Lens
from metalens.optics import media

RAYS = 25  # along an axis
_SCALE = 0.98764321  # of the even ray spacing: incommensurate with a map's samples
SPREAD = 0.2  # largest rms width of rays that meet, over their rms width on the lens
DARK = 1e-3  # of a perfect lens's peak; a darker meeting point is a vortex


def has_focus(phase: PhaseOf, focus: Focus, radius_um: float, pitch_um: float) -> bool:
    """Whether rays from the design source meet in one bright spot of the sensor.

    They meet where their rms width on the sensor is at most 0.2 of that on the lens. An
    axicon, a hologram and a plain vortex scatter their rays. A vortex in a focus leaves
    the middle of its ring dark: mean of exp(i error) below 1e-3 in power.

    Args:
        phase: function of x and y, um, to phase, rad.
        focus: source and sensor distances of the design.
        radius_um: radius of the aperture, um.
        pitch_um: lattice constant, um.
    """
    axis, x, y, inside = _grid(radius_um, pitch_um)
    count = inside.sum()
    if count < RAYS:
        return True  # a few pillars: every phase is a lens
    places, shifts = _trace_rays(phase, focus, radius_um, pitch_um)
    if places.shape[1] < (1 - SPREAD) * count:
        return False
    meets = places + shifts
    spread = np.linalg.norm(meets.std(axis=1)) / np.linalg.norm(places.std(axis=1))
    if spread > SPREAD:
        return False
    k = 2 * np.pi / focus.wavelength_um
    middle_um = np.linalg.norm(meets.mean(axis=1))
    if middle_um * radius_um * k / focus.sensor_distance_um >= 1:
        return True
    errors = phase(axis, axis) + k * focus.path_um(x**2 + y**2)
    light = np.exp(1j * errors[np.hypot(x, y) <= radius_um]).mean()
    return bool(abs(light) ** 2 > DARK)


def lens_has_focus(lens: Lens) -> bool:
    """Whether the rays of a lens meet, as :func:`has_focus`, by its nearest pillars."""
    return has_focus(*_lens_rays(lens))


def lens_meeting_um(lens: Lens) -> tuple[float, float, float] | None:
    """As :func:`meeting_um`, of the pillars of a lens."""
    return meeting_um(*_lens_rays(lens))


def _lens_rays(lens: Lens) -> tuple[PhaseOf, Focus, float, float]:
    """Phase of the pillar nearest to a place, design focus, radius and pitch in um."""
    d = lens.diameters

    def nearest(x_um: Array, y_um: Array) -> Array:
        rows, columns = (
            np.clip(np.rint(places / step + (n - 1) / 2).astype(int), 0, n - 1)
            for places, step, n in zip(
                (y_um, x_um), d.steps_um[::-1], d.diameter_um.shape, strict=True
            )
        )
        ranges = (slice(row, row + 1) for row in rows.tolist())
        return np.concatenate([lens.phase_rad(rows=row)[:, columns] for row in ranges])

    return nearest, lens_focus(lens), d.radius_um + d.pitch_um / 2, d.pitch_um


def meeting_um(
    phase: PhaseOf, focus: Focus, radius_um: float, pitch_um: float
) -> tuple[float, float, float] | None:
    """Place (x, y, z) in um behind the lens where rays of the design source pass
    closest.

    Rays go from (x, y) along (p, q, sqrt(1 - p² - q²)). The sum of squared distances
    from their mean is least at z = -sum(x u + y v) / sum(u² + v²), with
    u = p / sqrt(1 - p² - q²), v likewise, all less their means. Behind films the place
    is their mean on the sensor. None where their width there is above 0.2 of that on
    the lens, or where z is negative.

    Args:
        phase: function of x and y, um, to phase, rad.
        focus: source and sensor distances of the design.
        radius_um: radius of the aperture, um.
        pitch_um: lattice constant, um.
    """
    places, shifts = _trace_rays(phase, focus, radius_um, pitch_um)
    if places.shape[1] < RAYS:
        return None
    z_um = focus.sensor_distance_um
    slopes = shifts / z_um
    centred_places, centred_slopes = (
        a - a.mean(axis=1, keepdims=True) for a in (places, slopes)
    )
    if len(focus.layers.after(z_um, focus.wavelength_um).layers) == 1:
        power = float((centred_slopes**2).sum())
        if power < 1e-18 * centred_slopes.size:  # parallel to rounding
            return None
        z_um = float(-(centred_places * centred_slopes).sum() / power)
    spread = np.linalg.norm(centred_places + z_um * centred_slopes) / np.linalg.norm(
        centred_places
    )
    if z_um <= 0 or spread > SPREAD:
        return None
    middle = (places + z_um * slopes).mean(axis=1)
    return float(middle[0]), float(middle[1]), z_um


def _grid(radius_um: float, pitch_um: float) -> tuple[Array, Array, Array, Array]:
    """Places of rays: (n,) axis, (n, n) x and y, and which lie on the lens."""
    axis = (np.arange(RAYS) - (RAYS - 1) / 2) * (2 * _SCALE * radius_um / RAYS)
    x, y = np.meshgrid(axis, axis)
    return axis, x, y, np.hypot(x, y) <= radius_um - pitch_um


def _trace_rays(
    phase: PhaseOf, focus: Focus, radius_um: float, pitch_um: float
) -> tuple[Array, Array]:
    """(2, n) places of rays on the lens and lateral shifts to the sensor, um.

    Local grating equation p = p_source + grad(phase) / k, the gradient a wrapped
    difference over one pitch. Evanescent rays are left out.

    Args:
        phase: function of x and y, um, to phase, rad.
        focus: source and sensor distances of the design.
        radius_um: radius of the aperture, um.
        pitch_um: lattice constant, um.
    """
    axis, x, y, inside = _grid(radius_um, pitch_um)
    half = pitch_um / 2
    k = 2 * np.pi / focus.wavelength_um
    steps = [
        phase(axis + half, axis) - phase(axis - half, axis),
        phase(axis, axis + half) - phase(axis, axis - half),
    ]
    slope = [((s + np.pi) % (2 * np.pi) - np.pi) / pitch_um / k for s in steps]
    distance = np.sqrt(x**2 + y**2 + focus.source_distance_um**2)
    p = np.stack([slope[0] + x / distance, slope[1] + y / distance])
    square = (p**2).sum(axis=0)
    after = focus.layers.after(focus.sensor_distance_um, focus.wavelength_um).layers
    inside &= square < 0.999 * after[0][0] ** 2
    reach = media.reach_per_direction(after, square[inside])
    return np.stack([x, y])[:, inside], p[:, inside] * reach


def field_angle(focus: Focus, radius_um: float, *, strehl: float = 0.8) -> float:
    """Half field in rad along x within which the hyperbolic lens keeps a Strehl ratio
    on its sensor.

    exp(-sigma²) = ``strehl``, sigma in rad the rms wave-front error over the
    illuminated aperture with piston and tilt removed (coma, astigmatism, field
    curvature on a flat sensor). By bisection up to 60 degrees. Behind a stop the field
    also ends where the illuminated area falls below half of that at angle 0.

    Args:
        focus: source and sensor distances of the design.
        radius_um: radius of the aperture, um.
        strehl: Strehl ratio at the end of the field.
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
    """Wave-front variance in rad² at a field angle along x, piston and tilt removed.

    inf where less than half of the illuminated area of angle 0 is left.

    Args:
        focus: source and sensor distances, films and stop.
        radius_um: radius of the aperture.
        angle_rad: field angle.
    """
    tangent = math.tan(angle_rad)
    x, y = _illuminated_places(focus, radius_um, tangent)
    if not x.size or 2 * x.size < _illuminated_places(focus, radius_um, 0.0)[0].size:
        return math.inf
    phase = hyperbolic_phase(x, y, focus)
    for path_um in focus.paths_from(x, y, tangent):
        phase = phase + 2 * np.pi / focus.wavelength_um * path_um
    basis = np.stack([np.ones_like(x), x, y], axis=1) / [1.0, radius_um, radius_um]
    residual = phase - basis @ np.linalg.lstsq(basis, phase, rcond=None)[0]
    return float((residual**2).mean())


def _illuminated_places(
    focus: Focus, radius_um: float, tangent: float
) -> tuple[Array, Array]:
    """(n,) x and y in um of an even grid over the illuminated part of the lens.

    Args:
        focus: source and sensor distances of the design.
        radius_um: radius of the aperture, um.
        tangent: of the field angle along x.
    """
    axis = np.linspace(-radius_um, radius_um, 121)
    x, y = np.meshgrid(axis, axis)
    illuminated = np.hypot(x, y) <= radius_um * (1 + 1e-12)
    source = (tangent, 0.0), focus.source_distance_um, focus.wavelength_um
    illuminated &= focus.layers.stop_share(*source, (x, y), 1e-6 * radius_um) > 0
    return x[illuminated], y[illuminated]
