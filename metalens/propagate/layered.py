"""Compiled sums of the kernel of :mod:`metalens.propagate.paths`, by pillars or by nodes, also through films."""

import numba
import numpy as np

from metalens.ground.arrays import Array
from metalens.lens import Media, saddle
from metalens.propagate.sincos import turns64


def media_arrays(media: Media, wavenumber: float, reach_um: float) -> tuple[Array, Array, Array, Array]:
    """(squared indices, thicknesses) of the layers, the rarest first, the indices that the faces lie between, and C of
    :mod:`metalens.lens.waves` up to a reach: (middle, half) of s, then (real, imaginary) coefficients."""
    layers, made = media.layers, saddle(media, wavenumber, reach_um)
    series = np.stack([[made.middle, *made.real], [made.half, *made.imaginary]], -1)
    return np.array([n * n for n, _ in layers]), np.array([t for _, t in layers], float), np.array(media.order), series


@numba.njit(inline="always")
def ray(reach2, n2, t):  # type: ignore[no-untyped-def]
    """w = p² of the ray of this reach², Newton's method as in :func:`metalens.lens.media.square`."""
    s = 0.0
    for _ in range(14):
        w = n2[0] * s / (1 + s)
        g, h = 0.0, 0.0
        for i in range(n2.size):
            near = 1 / np.sqrt(n2[i] - w)
            g += t[i] * near
            h += t[i] * near * near * near
        step = (reach2 - w * g * g) * (1 + s) ** 2 / ((g * g + w * g * h) * n2[0])
        s += step
        if abs(step) <= 1e-15 * s:
            break
    return n2[0] * s / (1 + s)


@numba.njit(inline="always")
def length(w, n2, t):  # type: ignore[no-untyped-def]
    """Optical path of the ray."""
    total = 0.0
    for i in range(n2.size):
        total += n2[i] * t[i] / np.sqrt(n2[i] - w)
    return total


@numba.njit(inline="always")
def level(w, n2, t, order):  # type: ignore[no-untyped-def]
    """√(passed / spread) of the ray."""
    g, along = 0.0, 0.0
    for i in range(n2.size):
        near = 1 / np.sqrt(n2[i] - w)
        g += t[i] * near
        along += t[i] * n2[i] * near * near * near
    in_s, in_p = 1.0, 1.0
    for i in range(order.size - 1):
        a, b = order[i], order[i + 1]
        ca, cb = np.sqrt(1 - w / (a * a)), np.sqrt(1 - w / (b * b))
        in_s *= 1 - ((a * ca - b * cb) / (a * ca + b * cb)) ** 2
        in_p *= 1 - ((b * ca - a * cb) / (b * ca + a * cb)) ** 2
    return np.sqrt((in_s + in_p) / 2 / (g * along))


@numba.njit(inline="always")
def beside(w, far, k, n2, series):  # type: ignore[no-untyped-def]
    """-i(1 + iC/(kL)) of the ray, its optical path being ``far``."""
    u = (np.sqrt(n2[0] - w) - series[0, 0]) / series[0, 1]
    ahead, aside = 0.0, 0.0
    for i in range(series.shape[0] - 1, 0, -1):
        ahead, aside = ahead * u + series[i, 0], aside * u + series[i, 1]
    return complex(ahead / (k * far), aside / (k * far) - 1)


@numba.njit(nogil=True, error_model="numpy", cache=True)
def add_rays(re, im, x, y, points, numbers, out):  # type: ignore[no-untyped-def]
    """Add the light of a block of pillar rows (depth, row, column) to ``out`` (depth, point)."""
    k, area, n2, t, order, series = numbers
    for p in range(points.shape[0]):
        for i in range(y.size):
            down = (points[p, 1] - y[i]) ** 2
            for j in range(x.size):
                w = ray((points[p, 0] - x[j]) ** 2 + down, n2, t)
                far = length(w, n2, t)
                turn = far * (k / (2 * np.pi))
                c, s = turns64(turn - np.rint(turn))
                scale = k / (2 * np.pi) * area * level(w, n2, t, order)
                h = scale * complex(c, s) * beside(w, far, k, n2, series)
                for z in range(re.shape[0]):
                    out[z, p] += complex(re[z, i, j], im[z, i, j]) * h


@numba.njit(nogil=True, error_model="numpy", cache=True)
def sum_rays(re, im, e, x, points, numbers, out):  # type: ignore[no-untyped-def]
    """Add light (row, depth, column) on lens nodes, its path to the window's centre taken off, to ``out`` (depth,
    point) at window offsets (point, [X, Y])."""
    k, cx, cy, n2, t, order, series = numbers
    middle = np.empty(x.size)
    for i in range(e.size):
        for j in range(x.size):
            middle[j] = length(ray((cx - x[j]) ** 2 + (cy - e[i]) ** 2, n2, t), n2, t)
        for p in range(points.shape[0]):
            down = (cy + points[p, 1] - e[i]) ** 2
            for j in range(x.size):
                w = ray((cx + points[p, 0] - x[j]) ** 2 + down, n2, t)
                far = length(w, n2, t)
                turn = (far - middle[j]) * (k / (2 * np.pi))
                c, s = turns64(turn - np.rint(turn))
                scale = k / (2 * np.pi) * level(w, n2, t, order)
                h = scale * complex(c, s) * beside(w, far, k, n2, series)
                for z in range(re.shape[1]):
                    out[z, p] += complex(re[i, z, j], im[i, z, j]) * h


@numba.njit(inline="always")
def _source(x, y, numbers, inverse):  # type: ignore[no-untyped-def]
    tilt = 2 * (x * numbers[0] + y * numbers[1])
    s2 = 1 + numbers[0] ** 2 + numbers[1] ** 2
    top = (x * x + y * y) * inverse + tilt
    return top / (np.sqrt(top * inverse + s2) + np.sqrt(s2))


@numba.njit(fastmath=True, nogil=True, error_model="numpy", cache=True)
def curved(light, e, x, numbers, inverse, re, im):  # type: ignore[no-untyped-def]
    """Light on the nodes (row, column) with the phase of every depth less the reference's, to (row, depth, column)."""
    for i in range(e.size):
        for z in range(inverse.size):
            for j in range(x.size):
                path = _source(x[j], e[i], numbers, inverse[z]) - _source(x[j], e[i], numbers, numbers[2])
                t = path / numbers[6]
                c, s = turns64(t - np.rint(t))
                a, b = light[i, j].real, light[i, j].imag
                re[i, z, j], im[i, z, j] = a * c - b * s, a * s + b * c


@numba.njit(fastmath=True, nogil=True, error_model="numpy", cache=True, forceinline=True)
def _kernel_row(X, Y, dy, x, numbers, re, im):  # type: ignore[no-untyped-def]
    """Kernel of :mod:`metalens.propagate.paths` from a row of lens nodes to the window offset (X, Y)."""
    distance, wavelength = numbers[5], numbers[6]
    k = 2 * np.pi / wavelength
    for j in range(x.size):
        dx = numbers[3] - x[j]
        w2 = dx * dx + dy * dy + distance * distance
        q = X * X + Y * Y + 2 * (X * dx + Y * dy)
        r = np.sqrt(w2 + q)
        t = q / ((r + np.sqrt(w2)) * wavelength)
        c, s = turns64(t - np.rint(t))
        near = 1 / r
        scale = distance / (2 * np.pi) * near * near
        re[j], im[j] = scale * (c * near + k * s), scale * (s * near - k * c)


@numba.njit(fastmath=True, nogil=True, error_model="numpy", cache=True)
def sum_nodes(re, im, e, x, points, numbers, out):  # type: ignore[no-untyped-def]
    """Add light (row, depth, column) times the kernel to ``out`` (depth, point) at window offsets (point, [X, Y])."""
    h_re, h_im = np.empty(x.size), np.empty(x.size)
    for p in range(points.shape[0]):
        for i in range(e.size):
            _kernel_row(points[p, 0], points[p, 1], numbers[4] - e[i], x, numbers, h_re, h_im)
            for z in range(re.shape[1]):
                total_re, total_im = 0.0, 0.0
                for j in range(x.size):
                    total_re += re[i, z, j] * h_re[j] - im[i, z, j] * h_im[j]
                    total_im += re[i, z, j] * h_im[j] + im[i, z, j] * h_re[j]
                out[z, p] += complex(total_re, total_im)
