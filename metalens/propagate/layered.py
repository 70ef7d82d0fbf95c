"""Compiled rays through films: the kernel of :mod:`metalens.propagate.paths` pillar by pillar."""

import numba
import numpy as np

from metalens.ground.arrays import Array
from metalens.lens import Media
from metalens.propagate.sincos import turns64


def media_arrays(media: Media) -> tuple[Array, Array, Array]:
    """(squared indices, thicknesses) of the layers, the rarest first, and the indices that the faces lie between."""
    layers = media.layers
    return np.array([n * n for n, _ in layers]), np.array([t for _, t in layers], float), np.array(media.order)


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


@numba.njit(nogil=True, error_model="numpy", cache=True)
def add_rays(re, im, x, y, points, numbers, out):  # type: ignore[no-untyped-def]
    """Add the light of a block of pillar rows (depth, row, column) to ``out`` (depth, point)."""
    k, area, n2, t, order = numbers
    for p in range(points.shape[0]):
        for i in range(y.size):
            down = (points[p, 1] - y[i]) ** 2
            for j in range(x.size):
                w = ray((points[p, 0] - x[j]) ** 2 + down, n2, t)
                far = length(w, n2, t)
                turn = far * (k / (2 * np.pi))
                c, s = turns64(turn - np.rint(turn))
                scale = k / (2 * np.pi) * area * level(w, n2, t, order)
                h = scale * complex(s + c / (k * far), s / (k * far) - c)
                for z in range(re.shape[0]):
                    out[z, p] += complex(re[z, i, j], im[z, i, j]) * h


@numba.njit(nogil=True, error_model="numpy", cache=True)
def sum_rays(re, im, e, x, points, numbers, out):  # type: ignore[no-untyped-def]
    """Add light (row, depth, column) on lens nodes, its path to the window's centre taken off, to ``out`` (depth,
    point) at window offsets (point, [X, Y])."""
    k, cx, cy, n2, t, order = numbers
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
                h = scale * complex(s + c / (k * far), s / (k * far) - c)
                for z in range(re.shape[1]):
                    out[z, p] += complex(re[i, z, j], im[i, z, j]) * h
