"""Light far behind a lens, over direction cosines: beam deflectors, holograms, axicons."""

import math
from dataclasses import dataclass

import numpy as np
from scipy import fft, sparse, special

from metalens.core.arrays import Array
from metalens.core.errors import PropagationError
from metalens.lens import Lens
from metalens.optics.paths import source_path
from metalens.psf.of_lens import library_incidence

MOST_SITES = 25_000_000  # 5000 x 5000: 1.5 GB
# radius of the circle that is counted as one beam, wavelength / aperture width: 98 % of
# an Airy pattern
BEAM = 10.0
WIDEST_BEAM = 0.05  # of that radius, direction cosine: small apertures
BEAMS, LEAST = 12, 0.01  # that are looked for; share of the light below which none is
SPOT = 0.75  # of the light of a beam, within half the radius
DRAWN = 24  # directions of the check by a plain sum
_ROWS = 256


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
    error: relative L2 of dP/d²p against a plain float64 sum at directions drawn where
    the light goes.
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
    error: float

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
    """Directions of the light of a source at ``source_um`` (inf: a plane wave) in a
    field angle, as for a PSF.

    Args:
        lens: the lens.
        wavelength_um: vacuum wavelength, um.
        angle_rad: (x, y) arctangents of the light's slope; a plane wave at +x leaves
            flat pillars at +x.
        samples: odd number of squares across all directions that the lattice tells, at
            most sines of -1 to 1.

    Accuracy: ``error``, 1e-5 or better in single precision; of the model: pillars
    answer as in their library, alike for
        all directions that light leaves in, without neighbours; no reflections of
        films.

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
    square = 2 * edge / (samples // 2 * 2 + 1)
    p, power = _spectrum(light, steps, wave, square)
    orders = [(wave * u, wave * v) for u, v in _orders(lens)]
    held, beyond = _radiated(power, p, orders if lens.diameters.lattice.centred else [])
    radius, wide = _beam_sine(lens, wave)
    sines = square * (np.arange(samples // 2 * 2 + 1) - samples // 2)
    plain = _Sum(light, steps, wave)
    share, rings = _squares(power, p, square, len(sines))
    return FarField(
        share / held,
        sines,
        rings / held,
        _beams(plain, power, p, radius, held),
        radius,
        1
        - special.j0(math.pi * radius / wide) ** 2
        - special.j1(math.pi * radius / wide) ** 2,
        beyond / held,
        passed / np.count_nonzero(lens.diameters.diameter_um),
        min(1.0, *(math.hypot(*order) / 2 for order in orders)),
        _error(plain, p, power),
    )


def _behind(
    lens: Lens, angle_rad: tuple[float, float], source_um: float, wavelength_um: float
) -> Array:
    """(y, x) complex64 light behind every pillar; phases in float64 before the cast."""
    if lens.layers.front and math.isfinite(source_um):
        raise PropagationError(
            "films in front of the lens: its far field is of plane waves; give sources_mm = inf"
        )
    seen = 0.0 if lens.pairs is not None else library_incidence(lens, angle_rad)
    d, k = lens.diameters, 2 * math.pi / wavelength_um
    tangents = tuple(math.tan(a) for a in angle_rad)
    level = lens.transmission(wavelength_um, seen)
    found = np.empty(level.shape, np.complex64)
    for start in range(0, len(level), _ROWS):
        rows = slice(start, start + _ROWS)
        path = source_path(d.x_um, d.y_um[rows][:, None], tangents, 1 / source_um)
        phase = np.remainder(
            lens.rows_phase_rad(rows, wavelength_um, seen) + k * path, 2 * math.pi
        )
        places = d.x_um, d.y_um[rows][:, None]
        shadow = lens.layers.shadow(
            (tangents[0], tangents[1]), source_um, wavelength_um, places, d.pitch_um
        )
        found[rows] = level[rows] * shadow * np.exp(1j * phase)
    return found


def _spectrum(
    light: Array, steps: tuple[float, float], wavelength_um: float, square: float
) -> tuple[tuple[Array, Array], Array]:
    """((x, y) direction cosines, ascending), and (y, x) |F|² at them up to a factor,
    finely enough for its sums.
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
    beside = (
        [(0.5 / x, 0.5 / y), (0.5 / x, -0.5 / y)]
        if lens.diameters.lattice.centred
        else []
    )
    return [*beside, (0.0, 1 / y), (1 / x, 0.0)]


def _radiated(
    power: Array, p: tuple[Array, Array], orders: list[tuple[float, float]]
) -> tuple[float, float]:
    """(light of one period of the lattice, that of it whose sine is above 1); both are
    taken out of ``power``.

    orders: where the transform holds several periods, those that a direction must be
    farther from than from the axis.
    """
    held = beyond = 0.0
    for line, y in zip(power, p[1], strict=True):
        for qx, qy in orders:
            line[np.abs(qx * p[0] + qy * y) > (qx * qx + qy * qy) / 2] = 0
        held += float(line.sum(dtype=float))
        outside = p[0] ** 2 > 1 - y * y
        beyond += float(line[outside].sum(dtype=float))
        line[outside] = 0
    return held, beyond


def _beam_sine(lens: Lens, wavelength_um: float) -> tuple[float, float]:
    """(radius of a beam's circle, wavelength over the width of the aperture)."""
    wide = wavelength_um / (2 * max(lens.diameters.radius_um, lens.diameters.pitch_um))
    return min(BEAM * wide, max(WIDEST_BEAM, 2 * wide)), wide


def _squares(
    power: Array, p: tuple[Array, Array], square: float, count: int
) -> tuple[Array, Array]:
    """Sums over squares (y, x), samples at their edges shared out by area, and over
    rings about the axis.
    """
    across, down = (_overlap(axis, square, count) for axis in p)
    share = np.asarray((across @ (down @ power).T).T)
    rings = np.zeros(math.ceil(1 / square) + 1)
    for y, line in zip(p[1], power, strict=True):
        ring = np.minimum(np.hypot(p[0], y) / square, len(rings) - 1).astype(int)
        rings += np.bincount(ring, line.astype(float), len(rings))
    return share, rings


def _overlap(axis: Array, square: float, count: int) -> sparse.csr_array:
    """(squares, samples) share of each sample of the transform that lies in a square."""
    step = axis[1] - axis[0]
    first = (axis - step / 2) / square + count / 2
    low = np.floor(first + 1e-9)
    beyond = np.clip((first + step / square - low - 1) * square / step, 0, 1)
    rows = np.concatenate([low, low + 1]).astype(int)
    columns = np.tile(np.arange(len(axis)), 2)
    shares = np.concatenate([1 - beyond, beyond])
    held = (rows >= 0) & (rows < count)
    where = rows[held], columns[held]
    return sparse.csr_array(
        (shares[held].astype(np.float32), where), shape=(count, len(axis))
    )


def _beams(
    plain: "_Sum", power: Array, p: tuple[Array, Array], radius: float, held: float
) -> tuple[DiffractedBeam, ...]:
    """Brightest spots one after the other, the circle of each taken out before the next
    is looked for.

    A spot has three quarters of its circle's light within half the radius: rings and
    haze have not.
    """
    left, found = power.copy(), []
    for _ in range(BEAMS):
        i, j = np.unravel_index(int(left.argmax()), left.shape)
        rows, columns = (
            np.flatnonzero(np.abs(a - a[at]) <= radius)
            for a, at in ((p[1], i), (p[0], j))
        )
        here = np.ix_(rows, columns)
        off = np.hypot(p[0][columns] - p[0][j], p[1][rows][:, None] - p[1][i])
        total, inner = (
            float(left[here][off <= reach].sum(dtype=float))
            for reach in (radius, radius / 2)
        )
        if total < LEAST * held:
            break
        if inner >= SPOT * total:
            found.append(
                DiffractedBeam(
                    *plain.peak(p[0][j], p[1][i], p[0][1] - p[0][0], p[1][1] - p[1][0]),
                    total / held,
                )
            )
        left[here] = np.where(off <= radius, 0, left[here])
    return tuple(found)


@dataclass(frozen=True, eq=False, slots=True)
class _Sum:
    """The plain sum over pillars, float64, at any directions."""

    light: Array
    steps: tuple[float, float]
    wavelength_um: float

    def power(self, sine_x: Array, sine_y: Array) -> Array:
        """(y, x) |F|² up to the factor of the transform."""
        ex, ey = (
            np.exp(
                -2j
                * math.pi
                * step
                / self.wavelength_um
                * np.outer(np.arange(n), sines)
            )
            for sines, step, n in zip(
                (sine_x, sine_y), self.steps, self.light.shape[::-1], strict=True
            )
        )
        total = np.zeros((len(sine_y), len(sine_x)), complex)
        for start in range(0, len(self.light), _ROWS):
            rows = slice(start, start + _ROWS)
            total += ey[rows].T @ (self.light[rows].astype(complex) @ ex)
        return np.asarray(np.abs(total) ** 2)

    def peak(
        self, sine_x: float, sine_y: float, step_x: float, step_y: float
    ) -> tuple[float, float]:
        """The brightest direction next to a sample of the transform: a parabola through
        sums a quarter as far apart.
        """
        offsets = np.arange(-4, 5) / 4
        seen = self.power(sine_x + offsets * step_x, sine_y + offsets * step_y)
        i, j = (
            int(v) for v in np.unravel_index(int(seen[1:-1, 1:-1].argmax()), (7, 7))
        )
        column, row = seen[i : i + 3, j + 1], seen[i + 1, j : j + 3]
        dx, dy = (
            0.5 * (v[0] - v[2]) / min(v[0] - 2 * v[1] + v[2], -1e-300)
            for v in (row, column)
        )
        return sine_x + (offsets[j + 1] + dx / 4) * step_x, sine_y + (
            offsets[i + 1] + dy / 4
        ) * step_y


def _error(plain: _Sum, p: tuple[Array, Array], power: Array) -> float:
    """Relative L2 of |F|² at directions drawn by their light, against plain sums."""
    rows = np.cumsum(power.sum(1, dtype=float))
    generator = np.random.default_rng(5)
    found, exact = [], []
    for low, high in generator.random((DRAWN, 2)):
        i = min(int(np.searchsorted(rows, low * rows[-1])), len(rows) - 1)
        along = np.cumsum(power[i], dtype=float)
        j = min(int(np.searchsorted(along, high * along[-1])), len(along) - 1)
        found.append(float(power[i, j]))
        exact.append(float(plain.power(p[0][j : j + 1], p[1][i : i + 1])[0, 0]))
    wrong = np.array(found) - np.array(exact)
    return float(np.sqrt((wrong**2).sum() / (np.array(exact) ** 2).sum()))
