"""What a pillar of any shape exposes around itself: its Fourier factor times that of
the Gaussian, on pixels.

Exact but for copies of the shape five ranges away. The correction, whose doses this
judges, integrates along lines.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from layout.process import compiled
from layout.shapes.moments import Contours, moments
from metalens.ground.arrays import Array

_BESIDE = 5.0  # ranges around the shape: exp(-25)
_HIGHEST = 9.5  # of wave number times range: exp(-22)
_PIXEL = 1 / 10  # ranges
_LEVELS = 48  # of the table of areas


@dataclass(frozen=True, eq=False, slots=True)
class Image:
    """(n, n) exposure at unit dose on pixels, the middle one at the middle of the
    pillar.
    """

    value: Array
    pixel_um: float

    @property
    def axis_um(self) -> Array:
        """(n,) places of the pixels, along either axis."""
        n = len(self.value)
        return (np.arange(n) - n // 2) * self.pixel_um


def reach_um(contours: Contours) -> float:
    """Half the side of a square about the middle that holds the shape."""
    return float(max(np.abs(c).max() for c in contours))


def image(contours: Contours, range_um: float) -> Image:
    """Exposure by one Gaussian."""
    from metalens.cell.shapes import Loop

    side = 2 * (reach_um(contours) + _BESIDE * range_um)
    step = 2 * np.pi / side
    most = int(np.ceil(_HIGHEST / range_um / step))
    gx, gy = step * np.arange(most + 1), step * np.arange(-most, most + 1)[:, None]
    factor = sum(
        np.sign(moments([c])[0]) * Loop(tuple(map(tuple, c.tolist()))).fourier(gx, gy)
        for c in contours
    )
    factor = factor * np.exp(-(gx**2 + gy**2) * range_um**2 / 4)
    count = (
        int(np.ceil(side / (_PIXEL * range_um))) | 1
    )  # odd: a pixel in the middle; above 2 most + 1
    spectrum = np.zeros((count, count // 2 + 1), complex)
    spectrum[np.arange(-most, most + 1), : most + 1] = factor
    found = np.fft.irfft2(spectrum, (count, count)) * (count / side) ** 2
    return Image(np.fft.fftshift(found), side / count)


def own_levels(
    contours: Contours, terms: Sequence[tuple[float, float]], radius_um: Array
) -> Array:
    """(n,) levels that the exposure of a shape by itself exceeds on the area of circles
    of these radii (rising).

    terms: (range, weight) of the Gaussians. To 5e-4 of itself at the edge, 1e-3 within
    a range of it.
    """
    from scipy.interpolate import PchipInterpolator, RectBivariateSpline

    (core, share), *wider = sorted(terms)
    fine = image(contours, core)
    total = share * fine.value
    for range_um, weight in wider:
        coarse = image(contours, range_um)
        total += weight * RectBivariateSpline(
            coarse.axis_um, coarse.axis_um, coarse.value
        )(fine.axis_um, fine.axis_um)
    levels = np.linspace(float(total.max()), 0.02 * float(total.max()), _LEVELS)
    area = _areas(total, levels) * fine.pixel_um**2
    rising = np.maximum.accumulate(area + 1e-12 * np.arange(_LEVELS))
    return np.asarray(
        PchipInterpolator(rising, levels)(
            np.clip(np.pi * radius_um**2, rising[0], rising[-1])
        )
    )


@compiled
def _areas(value: Array, level: Array) -> Array:
    """(levels,) squares between pixels on which a picture is above each level
    (falling), straight over two triangles.

    Exact for straight edges of any turn.
    """
    count = len(level)
    area, whole, rising = np.zeros(count), np.zeros(count), level[::-1].copy()
    for row in range(value.shape[0] - 1):
        for column in range(value.shape[1] - 1):
            for half in range(2):
                a, b, c = (
                    value[row, column + 1],
                    value[row + 1, column],
                    value[row + half, column + half],
                )
                low, high = min(a, b, c), max(a, b, c)
                middle = max(min(a, b), min(max(a, b), c))
                for k in range(
                    count - np.searchsorted(rising, high, side="right"), count
                ):  # levels above are none's
                    v = level[k]
                    if v <= low:
                        whole[k] += 0.5
                        break
                    if v >= high:
                        continue
                    if v >= middle:
                        area[k] += (
                            0.5 * (high - v) ** 2 / ((high - low) * (high - middle))
                        )
                    else:
                        area[k] += 0.5 - 0.5 * (v - low) ** 2 / (
                            (high - low) * (middle - low)
                        )
    return area + np.cumsum(whole)
