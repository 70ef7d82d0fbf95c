"""Direct Rayleigh-Sommerfeld sum over all pillars in float64: the reference of every
faster method; and the angular spectrum on the zero-padded pillar lattice.
"""

import functools
import math
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.polynomial import chebyshev

from metalens.core.arrays import Array
from metalens.core.errors import PropagationError
from metalens.core.threads import run_split
from metalens.optics import Media, media
from metalens.propagate.geometry import PropagationCase, check_aperture
from metalens.propagate.paths import from_source, ray_amplitude
from metalens.propagate.sincos import sincos_turns64

DEGREES = (8, 16, 32, 64)  # of the series of a point wave through films
ROUNDING = 1e-15  # of the largest coefficient, below which a series has converged


@dataclass(frozen=True, eq=False, slots=True)
class PointWave:
    """Field of a point of the lens at lateral distance ρ on the sensor, as series.

        h(ρ) = v² A(v) exp(ik [n D / v + P(v)]),    v = D / √(D² + ρ²)

    In one medium D is the distance, P = 0 and A = v / (2π D²) - ik / (2π D): that is
    d/(2πr²)(1/r - ik) exp(ikr) itself. Through films A and P are Chebyshev series.

    length_um: D. path_per_v_um: n D. wavenumber: k in rad/um.
    v_range: (middle, half) of the interval of v that the series map to [-1, 1].
    series: (degree, 3) Chebyshev coefficients of P, Re A and Im A.
    """

    length_um: float
    path_per_v_um: float
    wavenumber: float
    v_range: tuple[float, float]
    series: Array

    @property
    def numbers(self) -> tuple[Array, Array]:
        """Arguments of the compiled sum."""
        ranges = (self.length_um, self.path_per_v_um, self.wavenumber, *self.v_range)
        return np.array(ranges), self.series


def point_wave(case: PropagationCase, points_um: Array) -> PointWave:
    """Field of a point of the lens at sensor points (point, [x, y]).

    Args:
        case: lens, distance, wavelength and films behind the lens.
        points_um: whose farthest sets the range of the series.
    """
    if case.behind is None:
        d, k = case.sensor_distance_um, case.wavenumber
        series = np.array([[0, 0, -k / (2 * np.pi * d)], [0, 0.5 / (np.pi * d * d), 0]])
        return PointWave(d, d, k, (0.0, 1.0), series)
    far = np.abs(points_um).max(0) + case.half_size_um[::-1]
    return _films_wave(case.behind, case.wavenumber, math.hypot(*far))


@functools.lru_cache(maxsize=64)
def _films_wave(behind: Media, wavenumber: float, reach_um: float) -> PointWave:
    """Series of the ray's path and amplitude, doubled until their tails round off."""
    layers = behind.layers
    length = layers[0][0] * behind.reduced_um
    level = layers[0][0] * length
    low = length / math.hypot(length, reach_um)
    middle, half = (1 + low) / 2, (1 - low) / 2
    for count in DEGREES:
        u = chebyshev.chebpts1(count)
        v = middle + half * u
        w = media.solve_direction_square(layers, length**2 * (1 / v**2 - 1))
        path = np.asarray(media.whole_path(layers, w)) - level / v
        amplitude = ray_amplitude(behind, wavenumber, w, reach_um) / v**2
        values = np.stack([path, amplitude.real, amplitude.imag], -1)
        series = chebyshev.chebvander(u, count - 1).T @ values * (2 / count)
        series[0] /= 2
        scale = np.array([level, *[np.abs(amplitude).max()] * 2])
        tail = np.abs(series[-2:] / scale).max()
        if tail < ROUNDING:
            break
    kept = np.flatnonzero((np.abs(series / scale) > ROUNDING / 8).any(1))
    series = np.ascontiguousarray(series[: kept[-1] + 1])
    return PointWave(length, level, wavenumber, (middle, half), series)


@numba.njit(
    fastmath=True, nogil=True, error_model="numpy", cache=True, forceinline=True
)
def _complex_product(a_re, a_im, b_re, b_im):  # type: ignore[no-untyped-def]
    """Σ ab of complex rows given by their parts."""
    real, imaginary = 0.0, 0.0
    for j in range(a_re.size):
        real += a_re[j] * b_re[j] - a_im[j] * b_im[j]
        imaginary += a_re[j] * b_im[j] + a_im[j] * b_re[j]
    return complex(real, imaginary)


@numba.njit(
    fastmath=True, nogil=True, error_model="numpy", cache=True, forceinline=True
)
def _clenshaw(u, series, column, out, work):  # type: ignore[no-untyped-def]
    """Chebyshev series (degree, column) along a row of u in [-1, 1]."""
    before = work
    out[:], before[:] = series[series.shape[0] - 1, column], 0.0
    for n in range(series.shape[0] - 2, -1, -1):
        twice = 2.0 if n > 0 else 1.0
        for j in range(u.size):
            now = twice * u[j] * out[j] - before[j] + series[n, column]
            before[j], out[j] = out[j], now


@numba.njit(fastmath=True, nogil=True, error_model="numpy", cache=True)
def _add_point_waves(re, im, x, y, points, wave, out):  # type: ignore[no-untyped-def]
    """Add the light (depth, y, x) of pillars, times their waves, to (depth, point)."""
    (length, level, k, middle, half), series = wave
    columns = x.size
    v, u, work = np.empty(columns), np.empty(columns), np.empty(columns)
    path, h_re, h_im = np.empty(columns), np.empty(columns), np.empty(columns)
    for p in range(points.shape[0]):
        for i in range(y.size):
            across = (points[p, 1] - y[i]) ** 2 + length**2
            for j in range(columns):
                v[j] = length / np.sqrt((points[p, 0] - x[j]) ** 2 + across)
                u[j] = (v[j] - middle) / half
            if series.shape[0] == 2:  # one medium
                for j in range(columns):
                    path[j] = 0.0
                    h_re[j], h_im[j] = series[1, 1] * u[j], series[0, 2]
            else:
                _clenshaw(u, series, 0, path, work)
                _clenshaw(u, series, 1, h_re, work)
                _clenshaw(u, series, 2, h_im, work)
            for j in range(columns):
                turns = (level / v[j] + path[j]) * (k / (2 * np.pi))
                c, s = sincos_turns64(turns - np.rint(turns))
                a, b = v[j] * v[j] * h_re[j], v[j] * v[j] * h_im[j]
                h_re[j], h_im[j] = a * c - b * s, a * s + b * c
            for z in range(re.shape[0]):
                out[z, p] += _complex_product(re[z, i], im[z, i], h_re, h_im)


def add_point_waves(
    light: Array,
    at_um: tuple[Array, Array],
    points_um: Array,
    wave: PointWave,
    out: Array,
) -> None:
    """Add the field of points of the lens to ``out`` (depth, point), in float64.

    Args:
        light: (depth, y, x) complex amplitude of every point.
        at_um: (y,) and (x,) positions of the points on the lens.
        points_um: (point, [x, y]) of the sensor plane.
        wave: of :func:`point_wave`.
        out: (depth, point) complex128, changed in place.
    """
    y, x = at_um
    real, imaginary = (np.ascontiguousarray(p) for p in (light.real, light.imag))
    add: Any = _add_point_waves
    points = np.ascontiguousarray(points_um, float)

    def work(a: int, b: int) -> None:
        add(real, imaginary, x, y, points[a:b], wave.numbers, out[:, a:b])

    run_split(len(points), work)


def field_exact(phase_rad: Array, transmission: Array, case: PropagationCase) -> Array:
    """Field on the window, every pillar a source of area p² (its cell; paper Eqs. 1-3
    in space, exp(-iωt)).

    U(X) = Σ p² T e^{iφ} U_in · d/(2πr²) (1/r - ik) e^{ikr}, with |U_in| = 1 and its
    phase zero at the lens centre.
    Through films the kernel is that of :mod:`metalens.propagate.paths`.

    Args:
        case: geometry of the propagation.
        phase_rad, transmission: (y, x).

    Returns:
        (depth, y, x) complex128.

    Raises:
        PropagationError: maps that do not fit, are empty or hold NaN or infinity.

    Accuracy: rounding only, 1e-12 of the sum of the pillars' magnitudes for paths up to
    1 m; through films that and
    :func:`metalens.propagate.paths.films_error`, below rounding but for steep rays
    through some um.
    """
    y, x = case.window_um
    points = np.stack(
        np.meshgrid(x + case.centre_um[0], y + case.centre_um[1]), -1
    ).reshape(-1, 2)
    return field_at(phase_rad, transmission, case, points).reshape(-1, *case.samples)


def field_at(
    phase_rad: Array, transmission: Array, case: PropagationCase, points_um: Array
) -> Array:
    """As :func:`field_exact`, at (point, [x, y]) of the sensor plane; (depth, point)
    complex128.

    Args:
        phase_rad: (y, x) phase of every pillar.
        transmission: (y, x) magnitude |T| of every pillar.
        case: geometry of the propagation.
        points_um: (point, [x, y]) on the sensor plane.
    """
    check_aperture(phase_rad, transmission, case)
    y, x = case.pillars_um
    points = np.ascontiguousarray(points_um, float)
    wave = point_wave(case, points)
    out = np.zeros((len(case.inverse_depths_per_um), len(points)), complex)
    for start in range(0, case.shape[0], 16):
        rows = slice(start, start + 16)
        level = np.asarray(transmission[rows], float)
        open_ = np.nonzero(level.any(0))[0]
        if open_.size == 0:
            continue
        columns = slice(open_[0], open_[-1] + 1)
        light = sum_field(
            np.asarray(phase_rad[rows], float)[:, columns],
            level[:, columns],
            case,
            y[rows],
            x[columns],
        )
        add_point_waves(light, (y[rows], x[columns]), points, wave, out)
    return out * case.area_um2


def sum_field(
    phase_rad: Array,
    transmission: Array,
    case: PropagationCase,
    y_um: Array,
    x_um: Array,
) -> Array:
    """Field leaving the pillars at rows ``y_um``, columns ``x_um``, for every depth:
    (depth, y, x) complex128.

    Args:
        phase_rad: (y, x) phase of every pillar.
        transmission: (y, x) magnitude |T| of every pillar.
        case: geometry of the propagation.
    """
    inverse = np.array(case.inverse_depths_per_um)[:, None, None]
    path = from_source(case, x_um[None, :], y_um[:, None], case.tangents, inverse)
    return np.asarray(transmission * np.exp(1j * (phase_rad + case.wavenumber * path)))


def free_space_transfer(
    case: PropagationCase, count: tuple[int, int], *, band_limited: bool
) -> Array:
    """H(fy, fx) = exp(ik_z d) on the FFT grid of ``count`` (y, x) samples; evanescent
    waves decay.

    band_limited: drop frequencies whose phase the padded grid cannot sample (Matsushima
    and Shimobaba 2009).

    Args:
        case: geometry of the propagation.
    """
    fy, fx = (
        np.fft.fftfreq(n, step) for n, step in zip(count, case.steps_um, strict=True)
    )
    kz2 = case.wavelength_um**-2 - fx**2 - fy[:, None] ** 2
    kz = 2 * np.pi * np.sqrt(np.abs(kz2))
    d = case.sensor_distance_um
    h = np.exp(np.where(kz2 >= 0, 1j * kz, -kz) * d)
    if band_limited:
        for f, n, step in (
            (fy[:, None], count[0], case.steps_um[0]),
            (fx, count[1], case.steps_um[1]),
        ):
            limit = 1 / (case.wavelength_um * np.sqrt((2 * d / (n * step)) ** 2 + 1))
            h = np.where(np.abs(f) <= limit, h, 0)
    return h


def angular_spectrum(
    phase_rad: Array,
    transmission: Array,
    case: PropagationCase,
    *,
    pad: int = 2,
    band_limited: bool = False,
    single: bool = False,
) -> Array:
    """Field on the window by FFT, linear in time in the padded grid: (depth, y, x).

    The output lies on the pillars' own lattice; the window must too (step a multiple of
    the pitch, centre on it).

    Args:
        phase_rad: (y, x) phase of every pillar.
        transmission: (y, x) magnitude |T| of every pillar.
        case: geometry of the propagation.
        band_limited: drop frequencies that the padded grid cannot sample.
        pad: the grid is this many times as wide as the lens; below 2 light wraps
            around.
        single: complex64 instead of complex128.

    Raises:
        PropagationError: window off the lattice or beyond the padded grid; maps that do
            not fit or are empty.

    Accuracy: 4e-4 of the PSF for a 1 mm lens at 2 mm; worse where the window is near
    the edge of the padded grid.
    """
    check_aperture(phase_rad, transmission, case)
    if case.behind is not None:
        raise PropagationError(
            "the textbook angular spectrum knows no films; use propagate.exact"
        )
    columns, rows = _lattice(case, pad)
    count = (case.shape[0] * pad, case.shape[1] * pad)
    h = free_space_transfer(case, count, band_limited=band_limited)
    dtype = np.complex64 if single else np.complex128
    h = h.astype(dtype)
    y, x = case.pillars_um
    out = np.empty((len(case.inverse_depths_per_um), *case.samples), dtype)
    for z, inverse in enumerate(case.inverse_depths_per_um):
        one = PropagationCase(
            **{n: getattr(case, n) for n in case.__slots__}
            | {"inverse_depths_per_um": (inverse,)}
        )
        light = sum_field(phase_rad, transmission, one, y, x)[0].astype(dtype)
        field = np.fft.ifft2(np.fft.fft2(light, count) * h)
        out[z] = field[np.ix_(rows, columns)]
    return out


def _lattice(case: PropagationCase, pad: int) -> tuple[Array, Array]:
    """(x,), (y,) indices of the window samples in the padded grid, whose origin is the
    first pillar.
    """
    found = []
    steps = case.steps_um[::-1]
    for name, n, c, w, step in zip(
        "xy", case.shape[::-1], case.centre_um, case.window_um[::-1], steps, strict=True
    ):
        at = (c + w) / step + (n - 1) / 2
        index = np.rint(at).astype(int)
        if np.abs(at - index).max() > 1e-6:
            raise PropagationError(
                f"window samples along {name} lie off the pillars' lattice; use a step that is a multiple of the pitch "
                f"{step} um and a centre on the lattice, or another method"
            )
        if index.min() < -(n * pad - n) // 2 or index.max() >= n + (n * pad - n) // 2:
            raise PropagationError(
                f"window leaves the padded grid along {name}; raise pad above {pad}"
            )
        found.append(index % (n * pad))
    return found[0], found[1]
