"""Direct Rayleigh-Sommerfeld sum over all pillars in float64: the reference of every
faster method.
"""

import functools
import math
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.polynomial import chebyshev

from metalens.core.arrays import Array
from metalens.core.threads import run_split
from metalens.optics import Media, media
from metalens.propagate.geometry import PropagationCase, check_aperture, make_case
from metalens.propagate.paths import from_source, ray_amplitude
from metalens.propagate.sincos import sincos_turns64


def exact(phase_rad: Array, transmission: Array, **geometry: Any) -> Array:
    """Field on a window by direct Rayleigh-Sommerfeld summation over all pillars.

        U(X) = Σ p² T exp(iφ) U_in d / (2π r²) (1/r - ik) exp(ikr)

    in float64, |U_in| = 1 with phase 0 at the lens centre (Goodman, Introduction to
    Fourier Optics, eq. 3-43, time factor exp(-iωt)). Through films d/(2πr²)(1/r - ik)
    exp(ikr) becomes the stationary phase of the plane waves along the refracted ray.
    The
    reference for every faster method; its time grows as pillars times samples.

    Args:
        phase_rad: (y, x) phase of every pillar.
        transmission: (y, x) magnitude |T| of every pillar.
        geometry: pitch, wavelength, distances, angle and window by name, as
            :func:`make_case`.

    Returns:
        (depth, y, x) complex128 field; its square is the irradiance for unit irradiance
        of the lens.

    Raises:
        PropagationError: empty aperture, NaN, or maps and geometry that do not fit.

    Accuracy: rounding, 1e-12 of the sum of the pillars' magnitudes.

    >>> one_pillar = np.ones((1, 1))
    >>> u = exact(0 * one_pillar, one_pillar, pitch_um=0.4, wavelength_um=0.85,
    ...           sensor_distance_um=50.0, depths_um=np.inf, window_um=1.0, samples=1)
    >>> round(float(abs(u[0, 0, 0])), 6)  # p² / (wavelength d)
    0.003765
    """
    phase, level = np.asarray(phase_rad), np.asarray(transmission)
    return field_exact(phase, level, make_case(phase.shape, **geometry))


DEGREES = (8, 16, 32, 64)  # coefficients of the series of a point wave through films
ROUNDING = 1e-15  # of the largest coefficient: a tail below it has converged


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
    lateral_um = np.abs(points_um).max(0) + case.half_size_um[::-1]
    return _films_wave(case.behind, case.wavenumber, math.hypot(*lateral_um))


@functools.lru_cache(maxsize=64)
def _films_wave(behind: Media, wavenumber: float, reach_um: float) -> PointWave:
    """Chebyshev series of path and amplitude of a point wave through films.

    The degree is doubled until the last two coefficients are below rounding.

    Args:
        behind: media from lens to sensor.
        wavenumber: k in vacuum, rad/um.
        reach_um: largest lateral distance.
    """
    layers = behind.layers
    reduced_um = layers[0][0] * behind.reduced_um
    path_per_v = layers[0][0] * reduced_um
    low = reduced_um / math.hypot(reduced_um, reach_um)
    middle, half_range = (1 + low) / 2, (1 - low) / 2
    for count in DEGREES:
        u = chebyshev.chebpts1(count)
        v = middle + half_range * u
        w = media.solve_direction_square(layers, reduced_um**2 * (1 / v**2 - 1))
        path = np.asarray(media.whole_path(layers, w)) - path_per_v / v
        amplitude = ray_amplitude(behind, wavenumber, w, reach_um) / v**2
        values = np.stack([path, amplitude.real, amplitude.imag], -1)
        series = chebyshev.chebvander(u, count - 1).T @ values * (2 / count)
        series[0] /= 2
        scale = np.array([path_per_v, *[np.abs(amplitude).max()] * 2])
        tail = np.abs(series[-2:] / scale).max()
        if tail < ROUNDING:
            break
    significant = np.flatnonzero((np.abs(series / scale) > ROUNDING / 8).any(1))
    series = np.ascontiguousarray(series[: significant[-1] + 1])
    return PointWave(reduced_um, path_per_v, wavenumber, (middle, half_range), series)


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
def _clenshaw(u, series, column, out, before):  # type: ignore[no-untyped-def]
    """Chebyshev series (degree, column) along a row of u in [-1, 1], by Clenshaw's
    recurrence.

    out: (u,) result. before: (u,) working memory.
    """
    out[:], before[:] = series[series.shape[0] - 1, column], 0.0
    for n in range(series.shape[0] - 2, -1, -1):
        factor = 2.0 if n > 0 else 1.0
        for j in range(u.size):
            new = factor * u[j] * out[j] - before[j] + series[n, column]
            before[j], out[j] = out[j], new


@numba.njit(fastmath=True, nogil=True, error_model="numpy", cache=True)
def _add_point_waves(re, im, x, y, points, wave, out):  # type: ignore[no-untyped-def]
    """Add the waves of all pillars to out (depth, point): out += Σ (re + i im) h(ρ).

    re, im: (depth, y, x) light. x, y: pillar positions, um. points: (point, [x, y]).
    wave: ``numbers`` of a :class:`PointWave`.
    """
    (length, path_per_v, k, middle, half_range), series = wave
    columns = x.size
    v, u, work = np.empty(columns), np.empty(columns), np.empty(columns)
    path = np.empty(columns)
    h_re = np.empty(columns)
    h_im = np.empty(columns)
    for p in range(points.shape[0]):
        for i in range(y.size):
            row_square = (points[p, 1] - y[i]) ** 2 + length**2
            for j in range(columns):
                v[j] = length / np.sqrt((points[p, 0] - x[j]) ** 2 + row_square)
                u[j] = (v[j] - middle) / half_range
            if series.shape[0] == 2:  # one medium
                for j in range(columns):
                    path[j] = 0.0
                    h_re[j], h_im[j] = series[1, 1] * u[j], series[0, 2]
            else:
                _clenshaw(u, series, 0, path, work)
                _clenshaw(u, series, 1, h_re, work)
                _clenshaw(u, series, 2, h_im, work)
            for j in range(columns):
                turns = (path_per_v / v[j] + path[j]) * (k / (2 * np.pi))
                cosine, sine = sincos_turns64(turns - np.rint(turns))
                real, imaginary = v[j] * v[j] * h_re[j], v[j] * v[j] * h_im[j]
                h_re[j], h_im[j] = (
                    real * cosine - imaginary * sine,
                    real * sine + imaginary * cosine,
                )
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
    real, imaginary = (np.ascontiguousarray(part) for part in (light.real, light.imag))
    compiled_loop: Any = _add_point_waves
    points = np.ascontiguousarray(points_um, float)

    def work(start: int, stop: int) -> None:
        compiled_loop(
            real, imaginary, x, y, points[start:stop], wave.numbers, out[:, start:stop]
        )

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
    inverse = np.array(case.inverse_depths_per_um)[:, None, None]
    for start in range(0, case.shape[0], 16):
        rows = slice(start, start + 16)
        path = from_source(case, x, y[rows, None], case.tangents, inverse)
        phase = np.asarray(phase_rad[rows], float) + case.wavenumber * path
        light = np.asarray(transmission[rows], float) * np.exp(1j * phase)
        if light.any():
            add_point_waves(light, (y[rows], x), points, wave, out)
    return out * case.area_um2
