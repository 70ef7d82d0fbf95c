"""From the intensity in front of the sensor to expected electrons: source size, blur, pixel area, gain, background."""

import functools
import math
from dataclasses import dataclass

import numpy as np
from scipy import fft, special

from metalens.ground.arrays import Array


@dataclass(frozen=True, slots=True)
class Grid:
    """Fine samples under the pixels of a window, with a margin that keeps blur from wrapping around.

    rows, columns: pixels of the window. oversample: fine samples per pixel side.
    margin: pixels on each side.
    """

    rows: int
    columns: int
    pixel_um: float
    oversample: int = 1
    margin: int = 2

    @property
    def fine_um(self) -> float:
        """Pitch of the fine samples."""
        return self.pixel_um / self.oversample

    def axes_um(self) -> tuple[Array, Array]:
        """(y, x) of the fine samples, 0 at pixel (rows // 2, columns // 2)."""
        return self._axis(self.rows), self._axis(self.columns)

    def _axis(self, pixels: int) -> Array:
        fine = np.arange((pixels + 2 * self.margin) * self.oversample)
        first = -(pixels // 2 + self.margin) * self.oversample - (self.oversample - 1) / 2
        return (fine + first) * self.fine_um

    def frequencies(self) -> tuple[Array, Array]:
        """Cycles/um of the fine grid: (y, 1) and (1, x / 2 + 1), as :func:`scipy.fft.rfft2` orders them."""
        rows, columns = ((p + 2 * self.margin) * self.oversample for p in (self.rows, self.columns))
        return fft.fftfreq(rows, self.fine_um)[:, None], fft.rfftfreq(columns, self.fine_um)[None]

    def sample(self, intensity: Array, transfer: Array) -> Array:
        """(..., rows, columns): ``intensity`` (..., y, x) on the fine grid through ``transfer``, at pixel centres."""
        shifted = transfer if self.oversample % 2 else transfer * _half_step(self)
        blurred = fft.irfft2(fft.rfft2(intensity) * shifted, s=intensity.shape[-2:])
        o, m = self.oversample, self.margin
        y, x = (slice(m * o + o // 2, (m + p) * o, o) for p in (self.rows, self.columns))
        return np.asarray(blurred[..., y, x])


@functools.lru_cache(maxsize=4)
def _half_step(grid: Grid) -> Array:
    """Transfer that moves the light by half a fine sample, where no fine sample sits at a pixel's centre."""
    fy, fx = grid.frequencies()
    return np.asarray(np.exp(-1j * np.pi * (fy + fx) * grid.fine_um))


def fine_enough(pixel_um: float, highest: float) -> int:
    """Least oversampling at which intensity of up to ``highest`` cycles/um is sampled at twice that or above."""
    return max(1, math.ceil(2 * highest * pixel_um * (1 - 1e-9)))


def pixel(fy: Array, fx: Array, pixel_um: float) -> Array:
    """Transfer of a square pixel: sinc(fx p) sinc(fy p)."""
    return np.asarray(np.sinc(fx * pixel_um) * np.sinc(fy * pixel_um))


def gauss(fy: Array, fx: Array, sigma_um: float) -> tuple[Array, Array]:
    """Transfer exp(-2 pi² f² sigma²) of a Gaussian blur, and its derivative by sigma."""
    q = 4 * np.pi**2 * (fx**2 + fy**2)
    value = np.exp(-q * sigma_um**2 / 2)
    return value, -q * sigma_um * value


def disc(fy: Array, fx: Array, diameter_um: float) -> tuple[Array, Array]:
    """Transfer 2 J1(u) / u, u = pi f D, of an evenly lit disc, and its derivative by D: -2 J2(u) / D."""
    u = np.pi * np.hypot(fx, fy) * diameter_um
    safe = np.maximum(u, 1e-6)
    slope = -2 * special.jv(2, safe) / max(abs(diameter_um), 1e-12)
    return np.where(u > 1e-6, 2 * special.j1(safe) / safe, 1.0), np.where(u > 1e-6, slope, 0.0)


def ball(fy: Array, fx: Array, diameter_um: float) -> Array:
    """Transfer 3 (sin u - u cos u) / u³, u = pi f D, of an evenly glowing ball seen in projection."""
    u = np.maximum(np.pi * np.hypot(fx, fy) * diameter_um, 1e-3)
    return np.asarray(3 * (np.sin(u) - u * np.cos(u)) / u**3)
