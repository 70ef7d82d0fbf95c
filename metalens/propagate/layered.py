"""Compiled sums of the kernel of :mod:`metalens.propagate.paths`, by pillars or by
nodes, also through films.
"""

import numba
import numpy as np

from metalens.core.arrays import Array
from metalens.lens import Media, saddle_correction
from metalens.lens.media import NEWTON as STEPS
from metalens.propagate.sincos import sincos_turns64

SETTLED = 1e-9  # a step of Newton's method, relative, after which its square is left


def media_arrays(
    media: Media, wavenumber: float, reach_um: float
) -> tuple[Array, Array, Array, Array]:
    """(squared indices, thicknesses) of the layers, the rarest first, the indices that
    the faces lie between, and C of
    :mod:`metalens.lens.waves` up to a reach: (middle, half) of s, then (real,
    imaginary) coefficients."""
    layers, made = media.layers, saddle_correction(media, wavenumber, reach_um)
    series = np.stack([[made.middle, *made.real], [made.half, *made.imaginary]], -1)
    return (
        np.array([n * n for n, _ in layers]),
        np.array([t for _, t in layers], float),
        np.array(media.order),
        series,
    )


@numba.njit(
    fastmath=True, nogil=True, error_model="numpy", cache=True, forceinline=True
)
def complex_product(a_re, a_im, b_re, b_im):  # type: ignore[no-untyped-def]
    """Σ ab of complex rows given by their parts."""
    real, imaginary = 0.0, 0.0
    for j in range(a_re.size):
        real += a_re[j] * b_re[j] - a_im[j] * b_im[j]
        imaginary += a_re[j] * b_im[j] + a_im[j] * b_re[j]
    return complex(real, imaginary)


@numba.njit(
    fastmath=True, nogil=True, error_model="numpy", cache=True, forceinline=True
)
def solve_rays(reach2, n2, t, s, work):  # type: ignore[no-untyped-def]
    """w = p² to ``work[0]`` of the rays of a row of reach², by Newton's method as in
    :func:`metalens.lens.media.square` from tan² ``s`` in the rarest medium, which is
    put right.

    Reach² is concave in s: a step from beyond a ray falls short of it, at worst below
    none (0)."""
    w, g, h = work[0], work[1], work[2]
    for _ in range(STEPS):
        for j in range(s.size):
            w[j], g[j], h[j] = n2[0] * s[j] / (1 + s[j]), 0.0, 0.0
        for i in range(n2.size):
            for j in range(s.size):
                near = 1 / np.sqrt(n2[i] - w[j])
                g[j] += t[i] * near
                h[j] += t[i] * near * near * near
        worst = 0.0
        for j in range(s.size):
            step = (
                (reach2[j] - w[j] * g[j] * g[j])
                * (1 + s[j]) ** 2
                / ((g[j] * g[j] + w[j] * g[j] * h[j]) * n2[0])
            )
            s[j] = max(s[j] + step, 0.0)
            worst = max(worst, abs(step) - SETTLED * s[j])
        if worst <= 0:
            break
    for j in range(s.size):
        w[j] = n2[0] * s[j] / (1 + s[j])


@numba.njit(
    fastmath=True, nogil=True, error_model="numpy", cache=True, forceinline=True
)
def ray_path_lengths(w, n2, t, far):  # type: ignore[no-untyped-def]
    """Optical paths of a row of rays."""
    far[:] = 0.0
    for i in range(n2.size):
        for j in range(w.size):
            far[j] += n2[i] * t[i] / np.sqrt(n2[i] - w[j])


@numba.njit(
    fastmath=True, nogil=True, error_model="numpy", cache=True, forceinline=True
)
def ray_amplitudes(w, n2, t, order, out, work):  # type: ignore[no-untyped-def]
    """√(passed / spread) of a row of rays."""
    g, along, in_s, in_p = out, work[1], work[2], work[3]
    g[:], along[:], in_s[:], in_p[:] = 0.0, 0.0, 1.0, 1.0
    for i in range(n2.size):
        for j in range(w.size):
            near = 1 / np.sqrt(n2[i] - w[j])
            g[j] += t[i] * near
            along[j] += t[i] * n2[i] * near * near * near
    for i in range(order.size - 1):
        a, b = order[i], order[i + 1]
        for j in range(w.size):
            ca, cb = np.sqrt(1 - w[j] / (a * a)), np.sqrt(1 - w[j] / (b * b))
            in_s[j] *= 1 - ((a * ca - b * cb) / (a * ca + b * cb)) ** 2
            in_p[j] *= 1 - ((b * ca - a * cb) / (b * ca + a * cb)) ** 2
    for j in range(w.size):
        out[j] = np.sqrt((in_s[j] + in_p[j]) / 2 / (g[j] * along[j]))


@numba.njit(
    fastmath=True, nogil=True, error_model="numpy", cache=True, forceinline=True
)
def ray_corrections(w, n2, series, work):  # type: ignore[no-untyped-def]
    """Real and imaginary part of C of a row of rays, to ``work[1]`` and ``work[2]``."""
    real, imaginary, u = work[1], work[2], work[3]
    real[:], imaginary[:] = 0.0, 0.0
    for j in range(w.size):
        u[j] = (np.sqrt(n2[0] - w[j]) - series[0, 0]) / series[0, 1]
    for i in range(series.shape[0] - 1, 0, -1):
        for j in range(w.size):
            real[j], imaginary[j] = (
                real[j] * u[j] + series[i, 0],
                imaginary[j] * u[j] + series[i, 1],
            )


@numba.njit(
    fastmath=True, nogil=True, error_model="numpy", cache=True, forceinline=True
)
def _film_row(reach2, less, numbers, s, work, re, im):  # type: ignore[no-untyped-def]
    """Kernel of :mod:`metalens.propagate.paths` through films to one point, along a row
    of reach²; its paths less
    ``less``."""
    k, n2, t, order, series = numbers
    w, level, far = work[0], work[4], work[5]
    solve_rays(reach2, n2, t, s, work)
    ray_path_lengths(w, n2, t, far)
    ray_amplitudes(w, n2, t, order, level, work)
    ray_corrections(w, n2, series, work)
    for j in range(w.size):
        turn = (far[j] - less[j]) * (k / (2 * np.pi))
        cosine, sine = sincos_turns64(turn - np.rint(turn))
        near = k / (2 * np.pi) * level[j]
        ahead, aside = (
            near * work[1, j] / (k * far[j]),
            near * (work[2, j] / (k * far[j]) - 1),
        )
        re[j], im[j] = ahead * cosine - aside * sine, ahead * sine + aside * cosine


@numba.njit(fastmath=True, nogil=True, error_model="numpy", cache=True)
def add_rays(re, im, x, y, points, numbers, out):  # type: ignore[no-untyped-def]
    """Add the light of a block of pillar rows (depth, row, column) to ``out`` (depth,
    point).
    """
    area, films = numbers
    nothing, work = np.zeros(x.size), np.empty((6, x.size))
    s, reach2, h_re, h_im = (
        np.zeros(x.size),
        np.empty(x.size),
        np.empty(x.size),
        np.empty(x.size),
    )
    for p in range(points.shape[0]):
        for i in range(y.size):
            reach2[:] = (points[p, 0] - x) ** 2 + (points[p, 1] - y[i]) ** 2
            _film_row(reach2, nothing, films, s, work, h_re, h_im)
            for z in range(re.shape[0]):
                out[z, p] += area * complex_product(re[z, i], im[z, i], h_re, h_im)


@numba.njit(fastmath=True, nogil=True, error_model="numpy", cache=True)
def sum_rays(re, im, e, x, points, numbers, out):  # type: ignore[no-untyped-def]
    """Add light (row, depth, column) on lens nodes, its path to the window's centre
    taken off, to ``out`` (depth,
    point) at window offsets (point, [X, Y])."""
    cx, cy, films = numbers
    middle, work = np.empty((e.size, x.size)), np.empty((6, x.size))
    s, reach2, h_re, h_im = (
        np.zeros(x.size),
        np.empty(x.size),
        np.empty(x.size),
        np.empty(x.size),
    )
    for i in range(e.size):
        reach2[:] = (cx - x) ** 2 + (cy - e[i]) ** 2
        solve_rays(reach2, films[1], films[2], s, work)
        ray_path_lengths(work[0], films[1], films[2], middle[i])
    for p in range(points.shape[0]):
        for i in range(e.size):
            reach2[:] = (cx + points[p, 0] - x) ** 2 + (cy + points[p, 1] - e[i]) ** 2
            _film_row(reach2, middle[i], films, s, work, h_re, h_im)
            for z in range(re.shape[1]):
                out[z, p] += complex_product(re[i, z], im[i, z], h_re, h_im)


@numba.njit(inline="always")
def _source(x, y, numbers, inverse):  # type: ignore[no-untyped-def]
    tilt = 2 * (x * numbers[0] + y * numbers[1])
    s2 = 1 + numbers[0] ** 2 + numbers[1] ** 2
    top = (x * x + y * y) * inverse + tilt
    return top / (np.sqrt(top * inverse + s2) + np.sqrt(s2))


@numba.njit(fastmath=True, nogil=True, error_model="numpy", cache=True)
def node_phases(light, e, x, numbers, inverse, spans, re, im):  # type: ignore[no-untyped-def]
    """Light on the nodes (row, column) with the phase of every depth less the
    reference's, to (row, depth, column);
    of each row the columns spans[row, 0] to spans[row, 1], where there is light."""
    near = np.empty(x.size)
    for i in range(e.size):
        for j in range(spans[i, 0], spans[i, 1]):
            near[j] = _source(x[j], e[i], numbers, numbers[2])
        for z in range(inverse.size):
            for j in range(spans[i, 0], spans[i, 1]):
                t = (_source(x[j], e[i], numbers, inverse[z]) - near[j]) / numbers[6]
                c, s = sincos_turns64(t - np.rint(t))
                a, b = light[i, j].real, light[i, j].imag
                re[i, z, j], im[i, z, j] = a * c - b * s, a * s + b * c


@numba.njit(
    fastmath=True, nogil=True, error_model="numpy", cache=True, forceinline=True
)
def _kernel_row(X, Y, dx, dy, w, numbers, re, im):  # type: ignore[no-untyped-def]
    """Kernel of :mod:`metalens.propagate.paths` from a row of lens nodes, ``w`` from
    the window's centre, to the window
    offset (X, Y)."""
    distance, wavelength = numbers[5], numbers[6]
    k = 2 * np.pi / wavelength
    for j in range(dx.size):
        q = X * X + Y * Y + 2 * (X * dx[j] + Y * dy)
        r = np.sqrt(w[j] * w[j] + q)
        both = 1 / (r * (r + w[j]))
        t = q * both * r / wavelength
        c, s = sincos_turns64(t - np.rint(t))
        near = both * (r + w[j])
        scale = distance / (2 * np.pi) * near * near
        re[j], im[j] = scale * (c * near + k * s), scale * (s * near - k * c)


@numba.njit(fastmath=True, nogil=True, error_model="numpy", cache=True)
def sum_nodes(re, im, e, x, points, numbers, spans, out):  # type: ignore[no-untyped-def]
    """Add light (row, depth, column) times the kernel to ``out`` (depth, point) at
    window offsets (point, [X, Y]); of
    each row the columns spans[row, 0] to spans[row, 1]. A row serves all points while
    it is near."""
    w, dx, h_re, h_im = (
        np.empty(x.size),
        numbers[3] - x,
        np.empty(x.size),
        np.empty(x.size),
    )
    for i in range(e.size):
        a, b = spans[i, 0], spans[i, 1]
        dy = numbers[4] - e[i]
        for j in range(a, b):
            w[j] = np.sqrt(dx[j] * dx[j] + dy * dy + numbers[5] * numbers[5])
        for p in range(points.shape[0]):
            _kernel_row(
                points[p, 0],
                points[p, 1],
                dx[a:b],
                dy,
                w[a:b],
                numbers,
                h_re[a:b],
                h_im[a:b],
            )
            for z in range(re.shape[1]):
                out[z, p] += complex_product(
                    re[i, z, a:b], im[i, z, a:b], h_re[a:b], h_im[a:b]
                )
