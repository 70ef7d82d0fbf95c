"""The referee: direct Rayleigh-Sommerfeld sum over all pillars in float64, and the light that meets the lens."""

from typing import Any

import numba
import numpy as np

from metalens.ground.arrays import Array
from metalens.ground.threads import split
from metalens.propagate.geometry import Case, check_aperture
from metalens.propagate.layered import add_rays, media_arrays
from metalens.propagate.paths import from_source
from metalens.propagate.sincos import turns64


def field_exact(phase_rad: Array, transmission: Array, case: Case) -> Array:
    """Field on the window, every pillar a source of area p² (its cell; paper Eqs. 1-3 in space, exp(-iωt)).

    U(X) = Σ p² T e^{iφ} U_in · d/(2πr²) (1/r - ik) e^{ikr}, with |U_in| = 1 and its phase zero at the lens centre.
    Through films the kernel is that of :mod:`metalens.propagate.paths`.

    Args:
        phase_rad, transmission: (y, x).

    Returns:
        (depth, y, x) complex128.

    Raises:
        PropagationError: maps that do not fit, are empty or hold NaN or infinity.

    Accuracy: rounding only, 1e-12 of the sum of the pillars' magnitudes for paths up to 1 m.
    """
    y, x = case.window_um
    points = np.stack(np.meshgrid(x + case.centre_um[0], y + case.centre_um[1]), -1).reshape(-1, 2)
    return field_at(phase_rad, transmission, case, points).reshape(-1, *case.samples)


def field_at(phase_rad: Array, transmission: Array, case: Case, points_um: Array) -> Array:
    """As :func:`field_exact`, at (point, [x, y]) of the sensor plane; (depth, point) complex128."""
    check_aperture(phase_rad, transmission, case)
    y, x = case.pillars_um
    points = np.ascontiguousarray(points_um, float)
    out = np.zeros((len(case.inverse_depths_per_um), len(points)), complex)
    for start in range(0, case.shape[0], 16):
        rows = slice(start, start + 16)
        level = np.asarray(transmission[rows], float)
        open_ = np.nonzero(level.any(0))[0]
        if open_.size == 0:
            continue
        columns = slice(open_[0], open_[-1] + 1)
        light = leaving(np.asarray(phase_rad[rows], float)[:, columns], level[:, columns], case, y[rows], x[columns])
        _add_rows(light, (y[rows], x[columns]), points, case, out)
    return out


def _add_rows(light: Array, at_um: tuple[Array, Array], points: Array, case: Case, out: Array) -> None:
    """Add the light of pillar rows (depth, y, x) to ``out`` (depth, point)."""
    y, x = at_um
    real, imaginary = np.ascontiguousarray(light.real), np.ascontiguousarray(light.imag)
    numbers: Any = (case.wavenumber, case.sensor_distance_um, case.area_um2)
    kernel: Any = _accumulate
    if case.behind is not None:
        kernel, numbers = add_rays, (case.wavenumber, case.area_um2, *media_arrays(case.behind))

    def work(a: int, b: int) -> None:
        kernel(real, imaginary, x, y, points[a:b], numbers, out[:, a:b])

    split(len(points), work)


def leaving(phase_rad: Array, transmission: Array, case: Case, y_um: Array, x_um: Array) -> Array:
    """Field leaving the pillars at rows ``y_um``, columns ``x_um``, for every depth: (depth, y, x) complex128."""
    inverse = np.array(case.inverse_depths_per_um)[:, None, None]
    path = from_source(case, x_um[None, :], y_um[:, None], case.tangents, inverse)
    return np.asarray(transmission * np.exp(1j * (phase_rad + case.wavenumber * path)))


@numba.njit(fastmath=True, nogil=True, error_model="numpy", cache=True)
def _accumulate(re, im, x, y, points, numbers, out):  # type: ignore[no-untyped-def]
    """Add the light of a block of rows to ``out`` (depth, point)."""
    k, distance, area = numbers
    depths, rows, columns = re.shape
    h_re, h_im = np.empty(columns), np.empty(columns)
    for p in range(points.shape[0]):
        for i in range(rows):
            across = (points[p, 1] - y[i]) ** 2 + distance**2
            for j in range(columns):
                r2 = (points[p, 0] - x[j]) ** 2 + across
                r = np.sqrt(r2)
                t = r * (k / (2 * np.pi))
                c, s = turns64(t - np.rint(t))
                scale = distance * area / (2 * np.pi * r2)
                h_re[j] = scale * (c / r + k * s)
                h_im[j] = scale * (s / r - k * c)
            for z in range(depths):
                sum_re, sum_im = 0.0, 0.0
                for j in range(columns):
                    sum_re += re[z, i, j] * h_re[j] - im[z, i, j] * h_im[j]
                    sum_im += re[z, i, j] * h_im[j] + im[z, i, j] * h_re[j]
                out[z, p] += complex(sum_re, sum_im)
