"""Exposure by everything around a shape through wide Gaussians, on pixels.

Masses go to the nine pixels around them by a quadratic B-spline, a separable Gaussian
blurs the pixels, and values come
from nine pixels by the same spline. Both splines widen the Gaussian by one squared
pixel: the kernel is narrower by as
much. None of this is shared with the correction, whose doses it judges.
"""

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np

from layout.process import compiled
from metalens.ground.arrays import Array

_PIXELS = 4  # along the range of a wide Gaussian
_CUT = 4.0  # ranges at which its kernel ends: exp(-16)
_THREADS = 2


@dataclass(frozen=True, slots=True)
class Raster:
    """Pixels for a Gaussian of 1/e radius ``range_um``: (rows, columns), the first
    one's middle at (left, bottom).
    """

    range_um: float
    left_um: float
    bottom_um: float
    rows: int
    columns: int

    @classmethod
    def over(
        cls, box_um: tuple[float, float, float, float], range_um: float
    ) -> "Raster":
        """Pixels around everything between left, bottom, right and top."""
        pixel = range_um / _PIXELS
        left, bottom, right, top = box_um
        rows, columns = (
            int((high - low) / pixel) + 5
            for low, high in ((bottom, top), (left, right))
        )
        return cls(range_um, left - 2 * pixel, bottom - 2 * pixel, rows, columns)

    @property
    def pixel_um(self) -> float:
        """Side of a pixel."""
        return self.range_um / _PIXELS

    @property
    def halo_um(self) -> float:
        """How far beyond its rows a band must be known."""
        return (_CUT + 3 / _PIXELS) * self.range_um

    def between(self, low_um: float, high_um: float) -> "Raster":
        """Those rows that hold everything between two heights and as far around as the
        kernel reaches.
        """
        first = max(
            0, int((low_um - self.halo_um - self.bottom_um) / self.pixel_um) - 2
        )
        end = min(
            self.rows,
            int((high_um + self.halo_um - self.bottom_um) / self.pixel_um) + 3,
        )
        bottom = self.bottom_um + first * self.pixel_um
        return Raster(
            self.range_um, self.left_um, bottom, max(end - first, 3), self.columns
        )

    def put(self, x_um: Array, y_um: Array, mass: Array, image: Array) -> None:
        """Add masses (n,) to the pixels; what lies off them is passed over."""
        _put(x_um, y_um, mass, self.left_um, self.bottom_um, self.pixel_um, image)

    def blurred(self, image: Array) -> Array:
        """(rows, columns) exposure on the pixels by the masses in ``image``."""
        reach = int(_CUT * _PIXELS)
        narrow = _PIXELS**2 - 1
        kernel = np.exp(-(np.arange(-reach, reach + 1) ** 2) / narrow)
        kernel *= 1 / (math.sqrt(math.pi * narrow) * self.pixel_um)
        out = np.empty_like(image)
        edges = np.linspace(0, self.rows, _THREADS + 1).astype(int).tolist()
        with ThreadPoolExecutor(_THREADS) as pool:
            list(
                pool.map(
                    partial(_blur, image, kernel.astype(image.dtype), out),
                    edges[:-1],
                    edges[1:],
                )
            )
        return out

    def take(self, x_um: Array, y_um: Array, image: Array) -> Array:
        """(n,) values at places on the pixels."""
        out = np.empty(len(x_um))
        _take(x_um, y_um, self.left_um, self.bottom_um, self.pixel_um, image, out)
        return out


@compiled
def _spline(off: float) -> tuple[float, float, float]:
    """Weights of the quadratic B-spline on three pixels, the middle one's centre
    ``off`` pixels before the place.
    """
    return 0.5 * (0.5 - off) ** 2, 0.75 - off * off, 0.5 * (0.5 + off) ** 2


@compiled
def _put(
    x: Array,
    y: Array,
    mass: Array,
    left: float,
    bottom: float,
    pixel: float,
    image: Array,
) -> None:
    rows, columns = image.shape
    for n in range(x.shape[0]):
        u, v = (x[n] - left) / pixel, (y[n] - bottom) / pixel
        i, j = int(np.floor(u + 0.5)), int(np.floor(v + 0.5))
        if i < 1 or j < 1 or i > columns - 2 or j > rows - 2:
            continue
        a, b = u - i, v - j
        wx, wy = _spline(a), _spline(b)
        for q in range(3):
            for p in range(3):
                image[j - 1 + q, i - 1 + p] += mass[n] * wy[q] * wx[p]


@compiled
def _take(
    x: Array,
    y: Array,
    left: float,
    bottom: float,
    pixel: float,
    image: Array,
    out: Array,
) -> None:
    for n in range(x.shape[0]):
        u, v = (x[n] - left) / pixel, (y[n] - bottom) / pixel
        i = min(max(int(np.floor(u + 0.5)), 1), image.shape[1] - 2)
        j = min(max(int(np.floor(v + 0.5)), 1), image.shape[0] - 2)
        a, b = u - i, v - j
        wx, wy = _spline(a), _spline(b)
        total = 0.0
        for q in range(3):
            for p in range(3):
                total += image[j - 1 + q, i - 1 + p] * wy[q] * wx[p]
        out[n] = total


@compiled
def _blur(image: Array, kernel: Array, out: Array, first: int, end: int) -> None:
    """Rows ``first`` to ``end`` of ``out``: along the rows, then across a ring of
    blurred rows; zero outside.
    """
    rows, columns = image.shape
    taps = kernel.shape[0]
    reach = taps // 2
    ring = np.zeros((taps, columns), image.dtype)
    padded = np.zeros(columns + 2 * reach, image.dtype)
    for row in range(max(0, first - reach), min(rows, end) + reach):
        if row < rows:
            padded[reach : reach + columns] = image[row]
            line = ring[row % taps]
            line[:] = 0
            for k in range(0, taps - 2, 3):
                one, two, three = kernel[k], kernel[k + 1], kernel[k + 2]
                for c in range(columns):
                    line[c] += (
                        one * padded[c + k]
                        + two * padded[c + k + 1]
                        + three * padded[c + k + 2]
                    )
            for k in range(taps - taps % 3, taps):
                for c in range(columns):
                    line[c] += kernel[k] * padded[c + k]
        done = row - reach
        if done < first:
            continue
        target = out[done]
        target[:] = 0
        for other in range(max(0, done - reach), min(rows, done + reach + 1)):
            weight, line = kernel[other - done + reach], ring[other % taps]
            for c in range(columns):
                target[c] += weight * line[c]
