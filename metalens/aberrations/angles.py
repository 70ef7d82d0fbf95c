"""What an optical designer looks at first, over field angles: distortion, foci,
vignetting, illumination, MTF.
"""

import math
from dataclasses import dataclass

import numpy as np

from metalens.aberrations.chief import ChiefRay, chief_ray, middle_um, source_at
from metalens.core.arrays import Array
from metalens.core.errors import PropagationError
from metalens.lens import Lens, reach
from metalens.optics import media
from metalens.psf import View, from_lens, mtf, passed_um2

SHARES = 0.125, 0.25, 0.5  # of 2 NA / wavelength: frequencies where none are given
EXACT = 1e-3  # of the MTF: last change with a window twice as wide
AIRY = 20.0  # width of the first window in wavelength / NA
WINDOWS = 5  # at most
PATCHES = 512  # along an axis, over the light of a stop in the pillars' plane


@dataclass(frozen=True, eq=False, slots=True)
class OverField:
    """Aberrations of a lens at its design wavelength, over n field angles.

    Numbers that do not exist are nan; ``left_out`` says why.

    angles_deg: (n,) field angles along x.
    depth_um: of the source.
    sensor_distance_um: of the lens.
    chief_um: (n, 2) where the chief ray meets the sensor, [x, y] from the axis.
    distortion: (n,) (X - X0)·u / |M s| - 1 against the linear image around angle 0:
        u = M s / |M s|, s the source from that of angle 0.
    close_um: (n, 2) tangential and sagittal focus of rays close to the chief ray,
        behind the sensor (+) or before it.
    close_error_um: (n, 2) one sigma of these.
    vignetting: (n,) share of the light through the stop's hole that misses the pillars;
        0 without a stop.
    illumination: (n,) irradiance in the image of an evenly bright (Lambertian) plane,
        over that at angle 0.
    frequencies_per_mm: (m,) of the MTF.
    mtf: (n, 2, m) modulation along x (tangential) and y (sagittal), of all light that
        passes the lens.
    window_share: (n,) share of it in the window of the PSF; the other light has no detail.
    left_out: what has no number, and why; one line each.
    """

    angles_deg: Array
    depth_um: float
    sensor_distance_um: float
    chief_um: Array
    distortion: Array
    close_um: Array
    close_error_um: Array
    vignetting: Array
    illumination: Array
    frequencies_per_mm: Array
    mtf: Array
    window_share: Array
    left_out: tuple[str, ...]


def frequencies_per_mm(lens: Lens) -> tuple[float, ...]:
    """Default frequencies: 1/8, 1/4 and 1/2 of the cut-off 2 NA / wavelength, to 2
    digits.

    Args:
        lens: the lens.
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
    """Distortion, field curvature, vignetting, illumination and MTF over field angles.

    Args:
        lens: the lens.
        angles_deg: of the rays to the middle of the lens along x, in air; either sign.
        depth_um: of the sources, a plane; by default the depth of best focus of the
            lens.
        frequencies: (m,) in periods per mm on the sensor; by default
            :func:`frequencies_per_mm`.

    Raises:
        PropagationError: no angle, one of 85 degrees or more, a frequency or depth that
            is not above 0, a source behind the stop or in the films, light beyond a
            critical angle.
        DomainError: an angle outside the lens's library.

    Accuracy: MTF 1e-3 (last change with the window of the PSF); vignetting 1e-4; rays
        as in :func:`metalens.aberrations.chief_ray`.
    """
    depth = lens.source_distance_um if depth_um is None else float(depth_um)
    per_mm = np.array(
        frequencies_per_mm(lens) if frequencies is None else frequencies, float
    )
    _check(angles_deg, depth, per_mm)
    failures: list[str] = []
    origin = _chief_or_note(lens, 0.0, depth, failures)
    base = math.nan
    if origin is not None:
        passed = float(passed_um2(lens, (0.0, 0.0), (depth,))[0])
        base = _brightness(lens, 0.0, depth, origin) * passed
    rows = []
    for angle in angles_deg:
        chief = origin if angle == 0 else _chief_or_note(lens, angle, depth, failures)
        rows.append(_aberrations_at(lens, angle, depth, (origin, chief), per_mm / 1e3))
        rows[-1]["illumination"] = rows[-1]["illumination"] / base
    columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    return OverField(
        np.array(angles_deg, float), depth, lens.sensor_distance_um, frequencies_per_mm=per_mm,
        left_out=tuple(dict.fromkeys(failures)), **columns,
    )  # fmt: skip


def _check(angles_deg: tuple[float, ...], depth_um: float, frequencies: Array) -> None:
    """Refuse field angles, depth or frequencies out of range.

    Args:
        angles_deg: field angles, within 85 degrees.
        frequencies: per mm, above 0.

    Raises:
        PropagationError: naming the argument.
    """
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


def _chief_or_note(
    lens: Lens, angle_deg: float, depth_um: float, failures: list[str]
) -> ChiefRay | None:
    """Chief ray of a field angle along x; None with a note in ``failures`` if none."""
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
        rays: chief rays of angle 0 and of this angle.
        per_um: (m,) frequencies of the MTF.
    """
    angle, chief = (math.radians(angle_deg), 0.0), rays[1]
    unknown = np.full(2, math.nan)
    passed = float(passed_um2(lens, angle, (depth_um,))[0])
    transfer, window_share = _transfer(lens, angle, depth_um, per_um, passed)
    close = unknown
    illumination = math.nan
    if chief is not None:
        close = chief.focus_um - lens.sensor_distance_um
        brightness = _brightness(lens, angle_deg, depth_um, chief)
        illumination = passed * brightness
    return {
        "chief_um": unknown if chief is None else chief.meets_um,
        "distortion": _distortion(*rays),
        "close_um": close,
        "close_error_um": unknown if chief is None else chief.focus_error_um,
        "illumination": illumination,
        "vignetting": vignetted_share(lens, angle, depth_um),
        "mtf": transfer,
        "window_share": min(window_share, 1.0),
    }


def _transfer(
    lens: Lens,
    angle_rad: tuple[float, float],
    depth_um: float,
    per_um: Array,
    passed_um2: float,
) -> tuple[Array, float]:
    """(2, m) MTF along x and y of all light through the lens, and the share of it in
    the window.

    The window of the PSF is doubled until the MTF changes by :data:`EXACT` at most.
    """
    # below half of 1 / (2 NA / wavelength), NA that of the whole lens
    slope = lens.diameters.radius_um / reach.sensor_reach_um(lens)
    sample_um = lens.wavelength_um * math.hypot(1, 1 / slope) / 5
    window_um = reach.window_um(lens, (depth_um,), airy=AIRY)
    last = np.full((2, len(per_um)), np.inf)
    for _ in range(WINDOWS):
        samples = math.ceil(window_um / sample_um)
        view = View((depth_um,), (angle_rad,), window_um, samples)
        try:
            stack = from_lens(lens, view, tolerance=EXACT)
        except PropagationError:  # a window wider than is computed
            if np.isinf(last).any():
                raise
            break
        window_share = float(stack.energy_um2[0, 0]) / passed_um2
        transfer = window_share * mtf(stack, frequencies_per_um=per_um)[0, 0]
        if np.abs(transfer - last).max() < EXACT:
            break
        last, window_um = transfer, 2 * window_um
    return transfer, window_share


def _distortion(origin: ChiefRay | None, chief: ChiefRay | None) -> float:
    """Distortion (X - X0)·u / |M s| - 1 of a chief ray against the linear image.

    u = M s / |M s|, s the source from that of angle 0, M = ∂X / ∂source at angle 0. nan
    without a ray, 0 at angle 0.

    Args:
        origin: chief ray of angle 0.
        chief: chief ray of the field angle.
    """
    if origin is None or chief is None:
        return math.nan
    linear = origin.moves @ (chief.source - origin.source)
    size2 = float(linear @ linear)
    if not size2 > 0:
        return 0.0
    return float((chief.meets_um - origin.meets_um) @ linear / size2 - 1)


def _brightness(
    lens: Lens, angle_deg: float, depth_um: float, chief: ChiefRay
) -> float:
    """Irradiance in the image of a Lambertian plane, over the light through the lens.

    The light is that for unit irradiance on the lens. Irradiance on the lens by an
    element of the plane (cos⁴, or 1 / spread of the media before) over the area of the
    element's image |det M|; of an arbitrary unit.

    Args:
        chief: chief ray of the angle.
    """
    tangents = np.array([math.tan(math.radians(angle_deg)), 0.0])
    slope = float(
        np.hypot(*lens.layers.through_middle(tangents, depth_um, lens.wavelength_um))
    )
    p = slope / math.hypot(1, slope)
    if math.isinf(depth_um):
        irradiance = (1 - p * p) ** 2
    else:
        irradiance = 1 / float(
            media.area_spreading(
                lens.layers.before(depth_um, lens.wavelength_um).layers, p * p
            )
        )
    return irradiance / abs(float(np.linalg.det(chief.moves)))


def vignetted_share(
    lens: Lens, angle_rad: tuple[float, float], depth_um: float
) -> float:
    """Share of the light through the stop's hole that misses the pillars; 0 without a
    stop.

    1 - sum over pillars of (share of the site in the light × its area) / area of the
    light in the pillars' plane. Shares come from
    :meth:`metalens.optics.Layers.stop_share`; the light is even there, as PSFs take it.

    Accuracy: 1e-4, and that of sites at the rim of the lens.

    Args:
        lens: the lens.
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
    patches = middle[0] + place, (middle[1] + place)[:, None]
    shares = lens.layers.stop_share(tangents, depth_um, wave, patches, float(step))
    hole_um2 = float(np.sum(shares)) * float(step) ** 2
    sites = d.x_um, d.y_um[:, None]
    share = lens.layers.stop_share(
        tangents, depth_um, wave, sites, math.sqrt(d.site_um2)
    ) * (np.asarray(d.diameter_um) > 0)
    return max(0.0, 1 - float(share.sum()) * d.site_um2 / hole_um2)
