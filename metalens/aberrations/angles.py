"""What an optical designer looks at first, over field angles: distortion, foci,
vignetting, illumination, MTF.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from metalens.aberrations.chief import ChiefRay, chief_ray, middle_um, source_at
from metalens.aberrations.waves import (
    FieldPlaneWaves,
    line_mtf,
    plane_waves_of_source,
    sharpness_per_um,
)
from metalens.core.arrays import Array
from metalens.core.errors import PropagationError
from metalens.lens import Lens, reach
from metalens.optics import media
from metalens.psf import passed_um2

SHARES = 0.125, 0.25, 0.5  # of 2 NA / wavelength: frequencies where none are given
# depths of focus on either side of the foci of close rays where the sharpest line is
# looked for
BEYOND = 4.0
STEPS = 2.0  # of a depth of focus, wavelength index / NA²
MOST_STEPS = 400
CONVERGED = 1e-3  # of a depth of focus
PATCHES = 512  # along an axis, over what a stop lights


@dataclass(frozen=True, eq=False, slots=True)
class OverField:
    """Aberrations of a lens at its design wavelength; NaN where ``left_out`` says why
    there is no number.

    angles_deg: (n,) field angles along x. depth_um: of the source. sensor_distance_um:
    of the lens.
    chief_um: (n, 2) where the chief ray meets the sensor, [x, y] from the axis.
    distortion: (n,) by how much farther it lies from that of angle 0 than the linear
    image about angle 0 has it, along
        the latter: (X - X0)·u / |M s| - 1, u = M s / |M s|, s the source from the one at angle 0.
    close_um: (n, 2) tangential and sagittal focus of rays close to the chief ray,
    behind the sensor (+) or before it.
    close_error_um: (n, 2) one sigma of these.
    sharpest_um: (n, 2) the same of the whole aperture: where the line image along x
    (tangential) and along y
        (sagittal) is sharpest, largest ∫ L² / (∫ L)².
    vignetting: (n,) share of the light through the stop's hole that misses the pillars;
    0 where the lens is its own.
    illumination: (n,) irradiance in the image of an evenly bright (Lambertian) plane,
    over that at angle 0.
    frequencies_per_mm: (m,). mtf: (n, 2, m) modulation along x (tangential) and y
    (sagittal), of all light that passes
        the lens. held: (n,) share of it in the waves about the rays, beyond which is
        light without detail.
    left_out: what has no number, and why; one line each.
    """

    angles_deg: Array
    depth_um: float
    sensor_distance_um: float
    chief_um: Array
    distortion: Array
    close_um: Array
    close_error_um: Array
    sharpest_um: Array
    vignetting: Array
    illumination: Array
    frequencies_per_mm: Array
    mtf: Array
    held: Array
    left_out: tuple[str, ...]


def frequencies_per_mm(lens: Lens) -> tuple[float, ...]:
    """An eighth, a quarter and a half of where a perfect lens of this aperture ends, 2
    NA / wavelength; 2 digits.
    """
    return tuple(
        float(f"{2e3 * share / reach.diffraction_um(lens):.2g}") for share in SHARES
    )


def over_field(
    lens: Lens,
    angles_deg: tuple[float, ...],
    *,
    depth_um: float | None = None,
    frequencies: tuple[float, ...] | None = None,
) -> OverField:
    """Distortion, field curvature, vignetting, relative illumination and MTF of a lens
    over field angles along x.

    Args:
        angles_deg: of the rays to the middle of the lens, in air; either sign.
        depth_um: of the sources, a plane; left out, the depth of best focus that the
            lens was made for.
        frequencies: in periods per mm on the sensor; left out,
            :func:`frequencies_per_mm`.

    Raises:
        PropagationError: no angle, one of 85 degrees or more, a frequency or depth that
            is not above 0, a source behind
            the stop or in the films, light beyond a critical angle; DomainError: an
            angle outside the lens's library.

    Accuracy: MTF 1e-3 (waves beyond those in the directions of the rays); the sharpest
    line to a thousandth of a depth
        of focus, wavelength / NA²; vignetting 1e-4; rays as in
        :func:`metalens.aberrations.chief_ray`.
    """
    depth = lens.source_distance_um if depth_um is None else float(depth_um)
    wanted = np.array(
        frequencies_per_mm(lens) if frequencies is None else frequencies, float
    )
    _check(angles_deg, depth, wanted)
    failures: list[str] = []
    origin = _chief(lens, 0.0, depth, failures)
    base = math.nan
    if origin is not None:
        base = _brightness(lens, 0.0, depth, origin) * float(
            passed_um2(lens, (0.0, 0.0), (depth,))[0]
        )
    rows = []
    for angle in angles_deg:
        chief = origin if angle == 0 else _chief(lens, angle, depth, failures)
        rows.append(_aberrations_at(lens, angle, depth, (origin, chief), wanted / 1e3))
        rows[-1]["illumination"] = rows[-1]["illumination"] / base
        if np.isnan(rows[-1]["sharpest_um"]).any():
            failures.append(f"no sharpest line about the sensor at {angle:g} degrees")
    columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    return OverField(
        np.array(angles_deg, float), depth, lens.sensor_distance_um, frequencies_per_mm=wanted,
        left_out=tuple(dict.fromkeys(failures)), **columns,
    )  # fmt: skip


def _check(angles_deg: tuple[float, ...], depth_um: float, frequencies: Array) -> None:
    if not angles_deg or not np.all(np.abs(angles_deg) < 85):
        raise PropagationError(
            f"angles_deg = {tuple(angles_deg)}: need one field angle or more, between -85 and 85"
        )
    if not (
        frequencies.size and np.isfinite(frequencies).all() and frequencies.min() > 0
    ):
        raise PropagationError(
            f"frequencies_per_mm = {frequencies.tolist()}: need one or more, all above 0"
        )
    if not depth_um > 0:
        raise PropagationError(
            f"depth of the sources: {depth_um} um; need one above 0, or inf"
        )


def _chief(
    lens: Lens, angle_deg: float, depth_um: float, failures: list[str]
) -> ChiefRay | None:
    try:
        return chief_ray(lens, (math.radians(angle_deg), 0.0), depth_um)
    except PropagationError as error:
        failures.append(str(error))
        return None


def _aberrations_at(
    lens: Lens,
    angle_deg: float,
    depth_um: float,
    rays: tuple[ChiefRay | None, ChiefRay | None],
    per_um: Array,
) -> dict[str, Array | float]:
    """Columns of :class:`OverField` at one field angle.

    Args:
        lens: the lens.
        angle_deg: along x.
        depth_um: of the source.
        rays: chief rays of angle 0 and of this angle.
        per_um: (m,) frequencies of the MTF.
    """
    angle, chief = (math.radians(angle_deg), 0.0), rays[1]
    none = np.full(2, math.nan)
    light = plane_waves_of_source(lens, angle, depth_um)
    here = light.at(lens.sensor_distance_um)
    close = none if chief is None else chief.focus_um - lens.sensor_distance_um
    return {
        "chief_um": none if chief is None else chief.meets_um,
        "distortion": _distortion(*rays),
        "close_um": close,
        "close_error_um": none if chief is None else chief.focus_error_um,
        "sharpest_um": _sharpest(lens, light, angle[0], close)
        - lens.sensor_distance_um,
        "illumination": math.nan
        if chief is None
        else light.passed_um2 * _brightness(lens, angle_deg, depth_um, chief),
        "vignetting": vignetted_share(lens, angle, depth_um),
        "mtf": np.stack([line_mtf(light, here, axis, per_um) for axis in (0, 1)]),
        "held": min(light.held, 1.0),
    }


def _distortion(origin: ChiefRay | None, chief: ChiefRay | None) -> float:
    if origin is None or chief is None:
        return math.nan
    linear = origin.moves @ (chief.source - origin.source)
    size2 = float(linear @ linear)
    return (
        float((chief.meets_um - origin.meets_um) @ linear / size2 - 1)
        if size2 > 0
        else 0.0
    )


def _brightness(
    lens: Lens, angle_deg: float, depth_um: float, chief: ChiefRay
) -> float:
    """Irradiance in the image of a Lambertian plane, over the light through the lens
    for unit irradiance on it.

    Irradiance on the lens by an element of the plane (by its tangents at infinity),
    cos⁴ or 1 / spread of the media
    before, over the area of the element's image; of an arbitrary unit.
    """
    tangents = np.array([math.tan(math.radians(angle_deg)), 0.0])
    slope = float(
        np.hypot(*lens.layers.through_middle(tangents, depth_um, lens.wavelength_um))
    )
    p = slope / math.hypot(1, slope)
    if math.isinf(depth_um):
        falls = (1 - p * p) ** 2
    else:
        falls = 1 / float(
            media.area_spreading(lens.layers.before(depth_um, lens.wavelength_um), p)
        )
    return falls / abs(float(np.linalg.det(chief.moves)))


def vignetted_share(
    lens: Lens, angle_rad: tuple[float, float], depth_um: float
) -> float:
    """Share of the light through the stop's hole that misses the pillars; 0
    without a stop.

    Shares of patches of the pillars' plane that the hole lights
    (:meth:`metalens.optics.Layers.stop_share`); the light is taken
    as even there, as PSFs take it.

    Accuracy: 1e-4, and that of sites at the rim of the lens.

    Args:
        angle_rad: field angles along x and y, rad.
        depth_um: source depth from the lens, um.
    """
    if lens.layers.stop is None:
        return 0.0
    tangents = (math.tan(angle_rad[0]), math.tan(angle_rad[1]))
    wave = lens.wavelength_um
    d = lens.diameters
    middle = middle_um(lens, source_at(lens, angle_rad, depth_um), depth_um)
    half = 1.5 * max(
        lens.layers.footprint_um(depth_um, wave), lens.layers.stop.radius_um
    )
    place, step = np.linspace(-half, half, PATCHES, retstep=True)
    there = middle[0] + place, (middle[1] + place)[:, None]
    hole = (
        float(
            np.sum(lens.layers.stop_share(tangents, depth_um, wave, there, float(step)))
        )
        * float(step) ** 2
    )
    sites = d.x_um, d.y_um[:, None]
    share = lens.layers.stop_share(
        tangents, depth_um, wave, sites, math.sqrt(d.site_um2)
    ) * (np.asarray(d.diameter_um) > 0)
    return max(0.0, 1 - float(share.sum()) * d.site_um2 / hole)


def _sharpest(
    lens: Lens, light: FieldPlaneWaves, angle_rad: float, close_um: Array
) -> Array:
    """(2,) distance behind the pillars where the line images along x and along y are
    sharpest; NaN at an end.
    """
    sensor = lens.sensor_distance_um
    flat = lens.layers.after(lens.sensor_distance_um, lens.wavelength_um)
    aperture = max(min(light.aperture), 1e-6)
    deep = lens.wavelength_um * flat.index[0] / aperture**2
    close = sensor + close_um[np.abs(close_um) < sensor]
    known = [*close, sensor, sensor * math.cos(angle_rad) ** 3]
    films = sum(flat.thickness_um[1:])
    low = max(min(known) - BEYOND * deep, films + 0.05 * (sensor - films))
    high = max(known) + BEYOND * deep
    count = min(max(math.ceil((high - low) / deep * STEPS), 8), MOST_STEPS)
    places, step = np.linspace(low, high, count, retstep=True)
    field = light.at(float(places[0]))
    ahead = light.at(float(step), np.ones_like(field))
    found = np.empty((count, 2))
    for row in found:
        row[:] = [sharpness_per_um(light, field, axis) for axis in (0, 1)]
        field = field * ahead
    return np.array(
        [_refine_maximum(light, places, found[:, axis], axis, deep) for axis in (0, 1)]
    )


def _refine_maximum(
    light: FieldPlaneWaves, places: Array, sharp: Array, axis: int, deep: float
) -> float:
    """The best of a scan, refined between its neighbours."""
    best = int(np.argmax(sharp))
    if best in (0, len(places) - 1):
        return math.nan
    ends = float(places[best - 1]), float(places[best + 1])
    less = minimize_scalar(
        lambda z: -sharpness_per_um(light, light.at(float(z)), axis),
        bounds=ends, method="bounded", options={"xatol": CONVERGED * deep},
    )  # fmt: skip
    return float(less.x)
