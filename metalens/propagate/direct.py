"""The referee: direct Rayleigh-Sommerfeld sum over all pillars in float64, and the
light that meets the lens.

Beside it the angular spectrum as users know it: textbook zero-padded, and band-limited
(paper Eq. 3).
"""

from typing import Any

import numba
import numpy as np

from metalens.core.arrays import Array
from metalens.core.errors import PropagationError
from metalens.core.threads import run_split
from metalens.propagate.geometry import PropagationCase, check_aperture
from metalens.propagate.layered import add_rays, complex_product, media_arrays
from metalens.propagate.paths import from_source
from metalens.propagate.sincos import sincos_turns64


def field_exact(phase_rad: Array, transmission: Array, case: PropagationCase) -> Array:
    """Field on the window, every pillar a source of area p² (its cell; paper Eqs. 1-3
    in space, exp(-iωt)).

    U(X) = Σ p² T e^{iφ} U_in · d/(2πr²) (1/r - ik) e^{ikr}, with |U_in| = 1 and its
    phase zero at the lens centre.
    Through films the kernel is that of :mod:`metalens.propagate.paths`.

    Args:
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
    """
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
        light = sum_field(
            np.asarray(phase_rad[rows], float)[:, columns],
            level[:, columns],
            case,
            y[rows],
            x[columns],
        )
        _add_rows(light, (y[rows], x[columns]), points, case, out)
    return out


def _add_rows(
    light: Array,
    at_um: tuple[Array, Array],
    points: Array,
    case: PropagationCase,
    out: Array,
) -> None:
    """Add the light of pillar rows (depth, y, x) to ``out`` (depth, point)."""
    y, x = at_um
    real, imaginary = np.ascontiguousarray(light.real), np.ascontiguousarray(light.imag)
    numbers: Any = (case.wavenumber, case.sensor_distance_um, case.area_um2)
    kernel: Any = _accumulate
    if case.behind is not None:
        y_far, x_far = (
            np.abs(points[:, i]).max() + half
            for i, half in zip((1, 0), case.half_size_um, strict=True)
        )
        films = media_arrays(
            case.behind, case.wavenumber, float(np.hypot(y_far, x_far))
        )
        kernel, numbers = add_rays, (case.area_um2, (case.wavenumber, *films))

    def work(a: int, b: int) -> None:
        kernel(real, imaginary, x, y, points[a:b], numbers, out[:, a:b])

    run_split(len(points), work)


def sum_field(
    phase_rad: Array,
    transmission: Array,
    case: PropagationCase,
    y_um: Array,
    x_um: Array,
) -> Array:
    """Field leaving the pillars at rows ``y_um``, columns ``x_um``, for every depth:
    (depth, y, x) complex128.
    """
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
                c, s = sincos_turns64(t - np.rint(t))
                scale = distance * area / (2 * np.pi * r2)
                h_re[j] = scale * (c / r + k * s)
                h_im[j] = scale * (s / r - k * c)
            for z in range(depths):
                out[z, p] += complex_product(re[z, i], im[z, i], h_re, h_im)


def free_space_transfer(
    case: PropagationCase, count: tuple[int, int], *, band_limited: bool
) -> Array:
    """H(fy, fx) = exp(ik_z d) on the FFT grid of ``count`` (y, x) samples; evanescent
    waves decay.

    band_limited: drop frequencies whose phase the padded grid cannot sample (Matsushima
    and Shimobaba 2009).
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
