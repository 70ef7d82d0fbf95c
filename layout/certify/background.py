"""Exposure by everything around a shape: wide Gaussians on pixels by FFT, narrower ones by a sum over neighbours.

None of this is shared with the correction, whose doses it judges.
"""

import math

import numpy as np

from layout.process import compiled
from metalens.ground.arrays import Array

_PIXELS = 8  # along the range of a wide Gaussian
_REACH = 4.0  # ranges at which a neighbour no longer counts: exp(-16)


def wide(x_um: Array, y_um: Array, mass: Array, at: tuple[Array, Array], range_um: float) -> Array:
    """(m,) exposure at places by masses (area times dose) at others, through a Gaussian of 1/e radius ``range_um``.

    Masses go to the four pixels around them and values come from four, which widens the Gaussian by 2/3 of a squared
    pixel: the kernel is narrower by as much.
    """
    from scipy import fft

    pixel = range_um / _PIXELS
    left, bottom = (min(a.min(), b.min()) - 2 * pixel for a, b in ((x_um, at[0]), (y_um, at[1])))
    right, top = (max(a.max(), b.max()) + 2 * pixel for a, b in ((x_um, at[0]), (y_um, at[1])))
    shape = int((top - bottom) / pixel) + 2, int((right - left) / pixel) + 2
    image = np.zeros(shape)
    _put(x_um, y_um, mass, left, bottom, pixel, image)
    size = [fft.next_fast_len(n + 5 * _PIXELS, real=True) for n in shape]
    fy, fx = fft.fftfreq(size[0], pixel), fft.rfftfreq(size[1], pixel)
    narrow = range_um**2 - 2 / 3 * pixel**2
    kernel = np.exp(-(math.pi**2) * narrow * (fy[:, None] ** 2 + fx**2)) / pixel**2
    field = fft.irfft2(fft.rfft2(image, size) * kernel, size)[: shape[0], : shape[1]]
    out = np.empty(len(at[0]))
    _take(*at, left, bottom, pixel, np.ascontiguousarray(field), out)
    return out


def beside(x_um: Array, y_um: Array, mass: Array, radius_um: Array, range_um: float) -> Array:
    """(n,) exposure of each rim by the other shapes within four ranges; discs as Gaussians of their second moment."""
    bin_um = _REACH * range_um
    column, row = ((v - v.min()) // bin_um for v in (x_um, y_um))
    columns = int(column.max()) + 1
    cell = (row * columns + column).astype(np.int64)
    order = np.argsort(cell, kind="stable")
    starts = np.searchsorted(cell[order], np.arange((int(row.max()) + 1) * columns + 1))
    out = np.zeros(len(x_um))
    args = (x_um[order], y_um[order], mass[order], radius_um[order], range_um)
    _neighbours(*args, starts, columns, cell[order], out)
    back = np.empty_like(out)
    back[order] = out
    return back


@compiled
def _put(x: Array, y: Array, mass: Array, left: float, bottom: float, pixel: float, image: Array) -> None:
    for n in range(x.shape[0]):
        u, v = (x[n] - left) / pixel, (y[n] - bottom) / pixel
        i, j = int(u), int(v)
        a, b = u - i, v - j
        image[j, i] += mass[n] * (1 - a) * (1 - b)
        image[j, i + 1] += mass[n] * a * (1 - b)
        image[j + 1, i] += mass[n] * (1 - a) * b
        image[j + 1, i + 1] += mass[n] * a * b


@compiled
def _take(x: Array, y: Array, left: float, bottom: float, pixel: float, image: Array, out: Array) -> None:
    for n in range(x.shape[0]):
        u, v = (x[n] - left) / pixel, (y[n] - bottom) / pixel
        i, j = int(u), int(v)
        a, b = u - i, v - j
        low = image[j, i] * (1 - a) + image[j, i + 1] * a
        out[n] = low * (1 - b) + (image[j + 1, i] * (1 - a) + image[j + 1, i + 1] * a) * b


@compiled
def _neighbours(
    x: Array, y: Array, mass: Array, radius: Array, reach: float, starts: Array, columns: int, cell: Array, out: Array
) -> None:
    rows = (starts.shape[0] - 1) // columns
    for n in range(x.shape[0]):
        row, column = cell[n] // columns, cell[n] % columns
        for r in range(max(row - 1, 0), min(row + 2, rows)):
            for c in range(max(column - 1, 0), min(column + 2, columns)):
                for k in range(starts[r * columns + c], starts[r * columns + c + 1]):
                    if k != n:
                        square = reach**2 + radius[k] ** 2 / 2 + radius[n] ** 2
                        away = (x[k] - x[n]) ** 2 + (y[k] - y[n]) ** 2
                        if away < 16 * square:
                            out[n] += mass[k] * np.exp(-away / square) / (np.pi * square)
