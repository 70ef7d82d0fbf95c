"""Far field of a lens over direction cosines: beam deflectors, holograms, axicons."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import fft, sparse, special

from metalens.core.arrays import Array
from metalens.core.errors import PropagationError
from metalens.lens import Lens
from metalens.optics.paths import source_path
from metalens.psf.lens_psfs import library_incidence

MOST_SITES = 25_000_000  # 5000 x 5000: 1.5 GB
# radius of the circle that is counted as one beam, wavelength / aperture width: 98 % of
# an Airy pattern
BEAM = 10.0
WIDEST_BEAM = 0.05  # of that radius, direction cosine: small apertures
BEAMS, LEAST = 12, 0.01  # largest number of beams, and least share of the light of each
SPOT = 0.75  # of the light of a beam, within half the radius


@dataclass(frozen=True, slots=True)
class DiffractedBeam:
    """Light about one direction. sine_x, sine_y: its centre, direction cosines; share:
    of the transmitted light.
    """

    sine_x: float
    sine_y: float
    share: float

    @property
    def angle_deg(self) -> float:
        """From the axis, in air."""
        return math.degrees(math.asin(min(math.hypot(self.sine_x, self.sine_y), 1.0)))

    @property
    def azimuth_deg(self) -> float:
        """From +x to +y."""
        return math.degrees(math.atan2(self.sine_y, self.sine_x))


@dataclass(frozen=True, eq=False, slots=True)
class FarField:
    """Where the light of one direction of incidence goes.

    share: (y, x) share of the transmitted light in each square of direction cosines.
    sines: their middles, both axes.
    rings: share in rings about the axis as wide as the squares, from 0.
    beams: brightest directions, each with the light within ``beam_sine`` of it, of
    which an ideal round beam has
        ``beam_holds``. beyond: share in directions that do not leave into air (sine
        above 1).
    transmitted: of the light on the pillars, what goes through. steepest: largest sine
    that the lattice tells from
        its own diffraction, along x or y.
    """

    share: Array
    sines: Array
    rings: Array
    beams: tuple[DiffractedBeam, ...]
    beam_sine: float
    beam_holds: float
    beyond: float
    transmitted: float
    steepest: float

    def within_sine(self, part: float) -> float:
        """Direction cosine about the axis that holds this part of the transmitted
        light; nan where none does.
        """
        total = np.cumsum(self.rings)
        width = self.sines[1] - self.sines[0]
        return float(
            np.interp(part, total, width * np.arange(1, len(total) + 1), right=math.nan)
        )


def far_field(
    lens: Lens,
    *,
    angle_rad: tuple[float, float] = (0.0, 0.0),
    source_um: float = math.inf,
    wavelength_um: float | None = None,
    samples: int = 401,
) -> FarField:
    """Far field of a lens: shares of the light over direction cosines, and its beams.

    |FFT of the field behind the pillars|² is summed over squares of direction cosines,
    over rings about the axis, and over a circle about each beam.

    Args:
        lens: pillars, response and films.
        angle_rad: (x, y) arctangents of the light's slope; a plane wave at +x leaves
            flat pillars at +x.
        source_um: depth of the source, um; inf for a plane wave.
        wavelength_um: vacuum wavelength, um; None for the design's.
        samples: odd number of squares across all directions that the lattice resolves,
            at most sines of -1 to 1.

    Accuracy: 1e-5, by a transform in single precision. The model: pillars respond
        as in their library, equally for all directions that light leaves in, without
        neighbours; no reflections of films.

    Raises:
        PropagationError: more than 25 million sites, or fewer than 3 squares.
    """
    if lens.diameters.diameter_um.size > MOST_SITES or samples < 3:
        raise PropagationError(
            f"{lens.diameters.diameter_um.size:,} sites, {samples} samples: a far field takes at most {MOST_SITES:,} "
            "sites (1.5 mm at a pitch of 0.3 um) and 3 samples or more"
        )
    wave = lens.wavelength_um if wavelength_um is None else wavelength_um
    light = _behind(lens, angle_rad, source_um, wave)
    passed = float(np.sum(light.real**2 + light.imag**2, dtype=float))
    if passed == 0:
        raise PropagationError("no light passes the pillars")
    steps = lens.diameters.steps_um
    edge = min(1.0, max(wave / (2 * step) for step in steps))
    count = samples // 2 * 2 + 1
    square = 2 * edge / count
    p, power = _spectrum(light, steps, wave, square)
    orders = [(wave * u, wave * v) for u, v in _orders(lens)]
    total, beyond = _radiated(
        power, p, orders if lens.diameters.lattice.centred else []
    )
    radius, airy = _beam_sine(lens, wave)
    share, rings = _squares(power, p, square, count)
    return FarField(
        share / total,
        square * (np.arange(count) - samples // 2),
        rings / total,
        _beams((light, steps, wave), power, p, radius, total),
        radius,
        1
        - special.j0(math.pi * radius / airy) ** 2
        - special.j1(math.pi * radius / airy) ** 2,
        beyond / total,
        passed / np.count_nonzero(lens.diameters.diameter_um),
        min(1.0, *(math.hypot(*order) / 2 for order in orders)),
    )


def _behind(
    lens: Lens, angle_rad: tuple[float, float], source_um: float, wavelength_um: float
) -> Array:
    """(y, x) complex64 field behind every pillar: |t| S exp(i (φ + k path)).

    S is the shadow of a stop, and path that from the source.

    Args:
        lens: pillars, response and films.
        angle_rad: (x, y) field angle.
        source_um: depth of the source, inf for a plane wave.
        wavelength_um: in vacuum.
    """
    if lens.layers.front and math.isfinite(source_um):
        raise PropagationError(
            "films in front of the lens: its far field is of plane waves; give sources_mm = inf"
        )
    tilt = 0.0 if lens.pairs is not None else library_incidence(lens, angle_rad)
    d = lens.diameters
    k = 2 * math.pi / wavelength_um
    tangents = math.tan(angle_rad[0]), math.tan(angle_rad[1])
    places = d.x_um, d.y_um[:, None]
    phase = lens.phase_rad(wavelength_um, tilt)
    phase = phase + k * source_path(*places, tangents, 1 / source_um)
    light = lens.transmission(wavelength_um, tilt) * np.exp(1j * phase)
    shadow = lens.layers.shadow(tangents, source_um, wavelength_um, places, d.pitch_um)
    return np.asarray(light * shadow, np.complex64)


def _spectrum(
    light: Array, steps: tuple[float, float], wavelength_um: float, square: float
) -> tuple[tuple[Array, Array], Array]:
    """Direction cosines (x, y), ascending, and (y, x) |F|², the squared padded FFT.

    The padding gives two samples or more for each square of direction cosines.

    Args:
        light: (y, x) field behind the pillars.
        steps: of the lattice along x and y, um.
        wavelength_um: in vacuum.
        square: width of a square of direction cosines.
    """
    counts = [
        fft.next_fast_len(max(2 * n, math.ceil(2 * wavelength_um / (step * square))))
        for n, step in zip(light.shape[::-1], steps, strict=True)
    ]
    field = fft.fft2(light, s=counts[::-1], workers=-1)
    power = fft.fftshift(field.real**2 + field.imag**2)
    axes = [
        wavelength_um * fft.fftshift(fft.fftfreq(n, step))
        for n, step in zip(counts, steps, strict=True)
    ]
    return (axes[0], axes[1]), power


def _orders(lens: Lens) -> list[tuple[float, float]]:
    """Diffraction orders of the lattice next to the axis, one of each pair, 1/um."""
    x, y = lens.diameters.steps_um
    orders = [(0.0, 1 / y), (1 / x, 0.0)]
    if lens.diameters.lattice.centred:
        return [(0.5 / x, 0.5 / y), (0.5 / x, -0.5 / y), *orders]
    return orders


def _radiated(
    power: Array, p: tuple[Array, Array], orders: list[tuple[float, float]]
) -> tuple[float, float]:
    """Light of one period of the lattice, and its part of sine above 1.

    Samples of other periods and of sines above 1 are set to 0 in ``power``, in place.

    Args:
        power: (y, x) |F|² of the transform.
        p: (x, y) direction cosines of its samples.
        orders: diffraction orders that bound the period (Brillouin zone): a direction
            in it is nearer to the axis than to any of them. Empty where the transform
            has one period.
    """
    total = beyond = 0.0
    for line, y in zip(power, p[1], strict=True):
        for qx, qy in orders:
            line[np.abs(qx * p[0] + qy * y) > (qx * qx + qy * qy) / 2] = 0
        total += float(line.sum(dtype=float))
        outside = p[0] ** 2 > 1 - y * y
        beyond += float(line[outside].sum(dtype=float))
        line[outside] = 0
    return total, beyond


def _beam_sine(lens: Lens, wavelength_um: float) -> tuple[float, float]:
    """(radius of a beam's circle, wavelength over the width of the aperture)."""
    wide = wavelength_um / (2 * max(lens.diameters.radius_um, lens.diameters.pitch_um))
    return min(BEAM * wide, max(WIDEST_BEAM, 2 * wide)), wide


def _squares(
    power: Array, p: tuple[Array, Array], square: float, count: int
) -> tuple[Array, Array]:
    """(y, x) sums of ``power`` over squares, and (n,) sums over rings about the axis.

    A sample across the edge of a square counts by its area in it.

    Args:
        power: (y, x) |F|² of the transform.
        p: (x, y) direction cosines of its samples.
        square: width of squares and rings.
        count: squares along each axis.
    """
    along_x, along_y = (_overlap(axis, square, count) for axis in p)
    share = np.asarray((along_x @ (along_y @ power).T).T)
    rings = np.zeros(math.ceil(1 / square) + 1)
    for y, line in zip(p[1], power, strict=True):
        ring = np.minimum(np.hypot(p[0], y) / square, len(rings) - 1).astype(int)
        rings += np.bincount(ring, line.astype(float), len(rings))
    return share, rings


def _overlap(axis: Array, square: float, count: int) -> sparse.csr_array:
    """(squares, samples) share of each sample of the transform in each square.

    Args:
        axis: (samples,) direction cosines of the samples.
        square: width of a square, wider than a sample.
        count: squares, centred on 0.
    """
    step = axis[1] - axis[0]
    first = (axis - step / 2) / square + count / 2
    low = np.floor(first + 1e-9)
    beyond = np.clip((first + step / square - low - 1) * square / step, 0, 1)
    rows = np.concatenate([low, low + 1]).astype(int)
    columns = np.tile(np.arange(len(axis)), 2)
    shares = np.concatenate([1 - beyond, beyond])
    inside = (rows >= 0) & (rows < count)
    index = rows[inside], columns[inside]
    return sparse.csr_array(
        (shares[inside].astype(np.float32), index), shape=(count, len(axis))
    )


def _beams(
    lens: tuple[Array, tuple[float, float], float],
    power: Array,
    p: tuple[Array, Array],
    radius: float,
    total: float,
) -> tuple[DiffractedBeam, ...]:
    """Brightest beams in turn, the circle of each set to 0 before the next is searched.

    A beam has ``SPOT`` of its circle's light within half the radius, which rings and
    haze have not. The search ends at ``BEAMS`` circles, or at a circle of less than
    ``LEAST`` of the light.

    Args:
        lens: (y, x) light, steps in um and wavelength, for :func:`_plain_power`.
        power: (y, x) |F|² of the transform.
        p: (x, y) direction cosines of its samples.
        radius: of a circle, direction cosine.
        total: light in all directions.
    """
    power = power.copy()
    beams = []
    x, y = p
    for _ in range(BEAMS):
        i, j = np.unravel_index(int(power.argmax()), power.shape)
        rows = np.flatnonzero(np.abs(y - y[i]) <= radius)
        columns = np.flatnonzero(np.abs(x - x[j]) <= radius)
        window = np.ix_(rows, columns)
        distance = np.hypot(x[columns] - x[j], y[rows][:, None] - y[i])
        light, inner = (
            float(power[window][distance <= reach].sum(dtype=float))
            for reach in (radius, radius / 2)
        )
        if light < LEAST * total:
            break
        if inner >= SPOT * light:
            beams.append(DiffractedBeam(*_peak(lens, p, (i, j)), light / total))
        power[window] = np.where(distance <= radius, 0, power[window])
    return tuple(beams)


def _plain_power(
    lens: tuple[Array, tuple[float, float], float], sine_x: Array, sine_y: Array
) -> Array:
    """(y, x) |F|² of the plain sum over pillars, float64, at any direction cosines.

    Args:
        lens: (y, x) light, (x, y) steps and wavelength in um.
        sine_x, sine_y: direction cosines along each axis.
    """
    light, steps, wavelength_um = lens
    ex, ey = (
        np.exp(-2j * math.pi * step / wavelength_um * np.outer(np.arange(n), sines))
        for sines, step, n in zip(
            (sine_x, sine_y), steps, light.shape[::-1], strict=True
        )
    )
    return np.asarray(np.abs(ey.T @ (light @ ex)) ** 2)


def _peak(
    lens: tuple[Array, tuple[float, float], float],
    p: tuple[Array, Array],
    at: tuple[Any, Any],
) -> tuple[float, float]:
    """(x, y) direction cosines of the maximum of |F|² near a sample.

    A parabola along each axis, through the largest of sums at a quarter of the sample's
    step.

    Args:
        lens: as :func:`_plain_power`.
        p: (x, y) direction cosines of all samples.
        at: (row, column) of the sample.
    """
    offsets = np.arange(-4, 5) / 4
    x, y = (
        axis[i] + offsets * (axis[1] - axis[0])
        for axis, i in zip(p, at[::-1], strict=True)
    )
    power = _plain_power(lens, x, y)
    i, j = np.unravel_index(int(power[1:-1, 1:-1].argmax()), (7, 7))
    peaks = []
    for axis, first, line in ((x, j, power[i + 1]), (y, i, power[:, j + 1])):
        low, middle, high = line[first : first + 3]
        shift = 0.5 * (low - high) / min(low - 2 * middle + high, -1e-300)
        peaks.append(float(axis[first + 1] + shift * (axis[1] - axis[0])))
    return peaks[0], peaks[1]
