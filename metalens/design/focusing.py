"""Whether a phase brings light together at all: where the rays of the design source
meet the sensor.
"""

import math
from dataclasses import replace

import numpy as np

from metalens.core.arrays import Array
from metalens.design.profiles import Focus, hyperbolic_phase
from metalens.design.sites import PhaseOf
from metalens.lens import Lens
from metalens.optics import media

RAYS = 25  # along an axis
_APART = (
    0.98764321  # of the even spacing of rays: never in step with the samples of a map
)
# rms distance of the rays on the sensor, of that on the lens, up to which they are said
# to meet
SPREAD = 0.2
# of the peak of a perfect lens, below which the place where they meet is dark: a vortex
DARK = 1e-3
PLACES, SEARCHED = (
    61,
    121,
)  # points across the illuminated part of a lens, and to look for it
HALF_LIGHT = 0.5  # of the light at angle 0, below which the field behind a stop ends


def has_focus(
    phase: PhaseOf, focus: Focus, *, radius_um: float, pitch_um: float
) -> bool:
    """Whether rays from the design source meet in one bright spot of the sensor.

    An axicon, a hologram and a plain vortex scatter their rays, a vortex in a focus
    leaves the middle of its ring dark.

    Args:
        phase: function of x and y, um, to phase, rad.
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
    """As :func:`has_focus`, of the pillars of a lens: every place has the phase of the
    pillar next to it.
    """
    phase, focus, radius_um = _nearest(lens)
    pitch_um = lens.diameters.pitch_um
    return has_focus(phase, focus, radius_um=radius_um, pitch_um=pitch_um)


def lens_meeting_um(lens: Lens) -> tuple[float, float, float] | None:
    """As :func:`meeting_um`, of the pillars of a lens."""
    phase, focus, radius_um = _nearest(lens)
    pitch_um = lens.diameters.pitch_um
    return meeting_um(phase, focus, radius_um=radius_um, pitch_um=pitch_um)


def _nearest(lens: Lens) -> tuple[PhaseOf, Focus, float]:
    """The phase of the pillar next to every place, what the lens images onto what, and
    its radius in um.
    """
    d = lens.diameters

    def nearest(x_um: Array, y_um: Array) -> Array:
        rows, columns = (
            np.clip(np.rint(at / step + (n - 1) / 2).astype(int), 0, n - 1)
            for at, step, n in zip(
                (y_um, x_um), d.steps_um[::-1], d.diameter_um.shape, strict=True
            )
        )
        found = [lens.rows_phase_rad(slice(row, row + 1))[0] for row in rows.tolist()]
        return np.stack([row[columns] for row in found])

    distances = lens.sensor_distance_um, lens.source_distance_um
    focus = Focus(lens.wavelength_um, *distances, lens.layers)
    return nearest, focus, d.radius_um + d.pitch_um / 2


def meeting_um(
    phase: PhaseOf, focus: Focus, *, radius_um: float, pitch_um: float
) -> tuple[float, float, float] | None:
    """Place (x, y, z) behind the lens where rays from the design source pass closest to
    one another.

    Rays go from (x, y) along (p, q, sqrt(1 - p² - q²)); the sum of squared distances
    from their middle is least at
    z = -sum(x u + y v) / sum(u² + v²), u = p / sqrt(1 - p² - q²), v likewise, all less
    their means. Behind films: their middle on the sensor. None where they
    spread there as widely as on the lens (:data:`SPREAD`), or never meet in front of
    the lens.

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
    centred, turned = (a - a.mean(axis=1, keepdims=True) for a in (places, slopes))
    if len(focus.layers.after(z_um, focus.wavelength_um).layers) == 1:
        power = float((turned**2).sum())
        if power < 1e-18 * turned.size:  # parallel to rounding
            return None
        z_um = float(-(centred * turned).sum() / power)
    spread = np.linalg.norm(centred + z_um * turned) / np.linalg.norm(centred)
    if z_um <= 0 or spread > SPREAD:
        return None
    middle = (places + z_um * slopes).mean(axis=1)
    return float(middle[0]), float(middle[1]), z_um


def _grid(radius_um: float, pitch_um: float) -> tuple[Array, Array, Array, Array]:
    """Places of rays: (n,) axis, (n, n) x and y, and which lie on the lens."""
    axis = (np.arange(RAYS) - (RAYS - 1) / 2) * (2 * _APART * radius_um / RAYS)
    x, y = np.meshgrid(axis, axis)
    return axis, x, y, np.hypot(x, y) <= radius_um - pitch_um


def _trace_rays(
    phase: PhaseOf, focus: Focus, radius_um: float, pitch_um: float
) -> tuple[Array, Array]:
    """(2, n) places of rays on the lens and their lateral shifts to the sensor, by the
    local grating equation; evanescent ones are left out. The slope of the phase is its
    difference over one pitch, wrapped.
    """
    axis, x, y, inside = _grid(radius_um, pitch_um)
    half, k = pitch_um / 2, 2 * np.pi / focus.wavelength_um
    steps = [
        phase(axis + half, axis) - phase(axis - half, axis),
        phase(axis, axis + half) - phase(axis, axis - half),
    ]
    slope = [((s + np.pi) % (2 * np.pi) - np.pi) / pitch_um / k for s in steps]
    away = np.sqrt(x**2 + y**2 + focus.source_distance_um**2)
    p = np.stack([slope[0] + x / away, slope[1] + y / away])
    square = (p**2).sum(axis=0)
    after = focus.layers.after(focus.sensor_distance_um, focus.wavelength_um).layers
    inside &= square < 0.999 * after[0][0] ** 2
    reach = media.reach_per_direction(after, square[inside])
    return np.stack([x, y])[:, inside], p[:, inside] * reach


def field_angle(focus: Focus, radius_um: float, *, strehl: float = 0.8) -> float:
    """Half field in rad at which coma, astigmatism and curvature of the field of the
    hyperbolic lens leave
    exp(-sigma²) = ``strehl`` on its sensor, which is flat.

    sigma is the wave-front error over the aperture (of the lens, what the stop lets
    light on), with piston and tilt
    taken out: at most 60 degrees. Behind a stop it ends where the light of less than
    half the pillars of angle 0 is
    left, whatever the rest does.

    Args:
        focus: source and sensor distances of the design.
        radius_um: radius of the aperture, um.
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
    """The largest of light from four sides, by turns of a stop off the axis; of one
    where all are equal.
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
    x, y, lit_um2 = _illuminated_places(focus, radius_um, math.tan(angle_rad))
    if (
        lit_um2 <= 0
        or lit_um2 < HALF_LIGHT * _illuminated_places(focus, radius_um, 0.0)[2]
    ):
        return math.inf
    path = hyperbolic_phase(x, y, focus)
    for one in focus.paths_from(x, y, math.tan(angle_rad)):
        path = path + 2 * np.pi / focus.wavelength_um * one
    basis = np.stack([np.ones_like(x), x, y], axis=1)
    basis /= np.abs(basis).max(axis=0)
    residual = path - basis @ np.linalg.lstsq(basis, path, rcond=None)[0]
    return float((residual**2).mean())


def _illuminated_places(
    focus: Focus, radius_um: float, tangent: float
) -> tuple[Array, Array, float]:
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
            there &= focus.layers.stop_share(*source, (x, y), 1e-6 * radius_um) > 0
        x, y = x[there], y[there]
        if not x.size:
            break
        middle = (float(x.max() + x.min()) / 2, float(y.max() + y.min()) / 2)
        half = float(max(np.ptp(x), np.ptp(y)) / 2 + step)
    return x, y, x.size * float(step) ** 2
