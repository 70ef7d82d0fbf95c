"""Quality of a PSF or an edge as numbers: MTF, Strehl ratio, encircled energy, ISO
11146 width, efficiency.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy import fft, ndimage, optimize

from metalens.core.arrays import Array
from metalens.core.errors import CaptureError
from metalens.psf import encircled_power, find_peak, fwhm


@dataclass(frozen=True, eq=False, slots=True)
class EdgeMtf:
    """Modulation against spatial frequency along one direction; 1 at zero.

    frequency_per_um: (f,) from 0. modulation: (f,).
    """

    frequency_per_um: Array
    modulation: Array

    @property
    def mtf50_per_um(self) -> float:
        """Lowest frequency at which the modulation falls through 1/2; nan where it does
        not.
        """
        below = np.flatnonzero(self.modulation < 0.5)
        if len(below) == 0 or below[0] == 0:
            return math.nan
        i = int(below[0])
        high, low = self.modulation[i - 1], self.modulation[i]
        share = (high - 0.5) / (high - low)
        return float(
            self.frequency_per_um[i - 1]
            + share * (self.frequency_per_um[i] - self.frequency_per_um[i - 1])
        )


@dataclass(frozen=True, slots=True)
class SpotMetrics:
    """Width numbers of one PSF.

    fwhm_um: full width at half maximum of the radial mean about the peak.
    ee80_um: radius about the centroid that holds 80 % of the light in the window.
    d4sigma_um: (major, minor) beam widths of ISO 11146-1, window iterated to three
    times the width.
    centroid_um: (x, y) from the window's centre.

    Accuracy: pixels count as evenly lit, a second blur. Of an Airy disc, by where it
    lies on its pixels, FWHM and EE80
    are up to 6 and 9 % wider than on the sensor at 2.3 pixels a FWHM, 0.4 and 2 % at
    4.6.
    """

    fwhm_um: float
    ee80_um: float
    d4sigma_um: tuple[float, float]
    centroid_um: tuple[float, float]


def mtf_of_psf(psf: Array, *, step_um: float, axis: str = "x") -> EdgeMtf:
    """MTF along x or y of a sampled PSF (background taken off): |FFT of the line
    spread| / its zero frequency.

    Args:
        psf: (y, x) light, background taken off.
        step_um: side of a sample, um.
        axis: x or y.

    Raises:
        CaptureError: no light.
    """
    line = np.asarray(psf, float).sum(0 if axis == "x" else 1)
    if not line.sum() > 0:
        raise CaptureError("MTF of a PSF without light; take off less background")
    size = 8 * len(line)
    spectrum = np.abs(fft.rfft(line, size))
    return EdgeMtf(fft.rfftfreq(size, step_um), spectrum / spectrum[0])


def mtf_of_edge(image: Array, *, pixel_um: float, oversample: int = 4) -> EdgeMtf:
    """Slanted-edge MTF (ISO 12233): edge found by line centroids, profile oversampled,
    derivative windowed.

    Args:
        pixel_um: pitch of the pixels, um.
        oversample: bins of the edge profile a pixel.
        image: one straight edge, tilted 2 to 20 degrees from the rows or columns.

    Accuracy: the finite difference and the bins are divided out; 1-2 % on noise-free
    edges to 0.7 Nyquist.

    Raises:
        CaptureError: no edge, or a tilt that leaves the phases of the pixels uncovered.
    """
    pixels = np.asarray(image, float)
    gy, gx = np.gradient(pixels)
    pixels = pixels if np.abs(gx).sum() >= np.abs(gy).sum() else pixels.T
    rows = np.arange(len(pixels))
    slope, offset = _edge_line(pixels, rows)
    angle = math.degrees(math.atan(abs(slope)))
    if not 1.5 <= angle <= 25:
        raise CaptureError(
            f"edge tilted by {angle:.1f} degrees; need 2 to 20 to sample between the pixels"
        )
    distance = (
        np.arange(pixels.shape[1])[None] - (slope * rows + offset)[:, None]
    ) * math.cos(math.atan(slope))
    reach = int(min(distance.max(), -distance.min()))
    place = np.round(distance * oversample).astype(int) + reach * oversample
    keep = (place >= 0) & (place <= 2 * reach * oversample)
    count = np.bincount(place[keep], minlength=2 * reach * oversample + 1)
    total = np.bincount(place[keep], pixels[keep], minlength=2 * reach * oversample + 1)
    profile = np.interp(
        np.arange(len(count)),
        np.flatnonzero(count),
        total[count > 0] / count[count > 0],
    )
    spread = np.diff(profile)
    peak = int(np.argmax(np.abs(ndimage.gaussian_filter1d(spread, oversample))))
    half = min(peak, len(spread) - 1 - peak)
    spread = spread[peak - half : peak + half + 1] * np.hanning(2 * half + 3)[1:-1]
    spectrum = np.abs(fft.rfft(spread, 8 * len(spread)))
    frequency = fft.rfftfreq(8 * len(spread), pixel_um / oversample)
    fold = (
        np.sinc(frequency * pixel_um / oversample) ** 2
    )  # difference of neighbours, and bins
    keep_f = frequency <= 1 / pixel_um
    return EdgeMtf(
        frequency[keep_f], (spectrum / spectrum[0] / np.maximum(fold, 0.1))[keep_f]
    )


def strehl_ratio(psf: Array, ideal: Array) -> float:
    """Peak of a PSF over that of the ideal one of equal light: both of sum 1, sampled
    alike.

    Peaks come from a quintic spline through the samples, so that their place under the
    grid does not matter.

    Args:
        psf: (y, x) light, background taken off.
    """
    peaks = (find_peak(light)[2] / np.sum(light) for light in (psf, ideal))
    return float(next(peaks) / next(peaks))


def measure_spot(psf: Array, *, step_um: float) -> SpotMetrics:
    """Widths of a PSF whose background is taken off.

    Args:
        psf: (y, x) light, background taken off.
        step_um: side of a sample, um.

    Raises:
        CaptureError: no light.
    """
    light = np.asarray(psf, float)
    if not light.sum() > 0:
        raise CaptureError("a PSF without light; take off less background")
    y, x = (np.arange(n) - (n - 1) / 2 for n in light.shape)
    widths, (cx, cy) = _second_moments(light, x, y)
    return SpotMetrics(
        fwhm(light, step_um),
        _encircled(light, x - cx, y - cy, 0.8) * step_um,
        (widths[0] * step_um, widths[1] * step_um),
        (cx * step_um, cy * step_um),
    )


def encircled_energy(psf: Array, *, step_um: float, radius_um: Array) -> Array:
    """Share of the window's light within radii about the centroid; pixels cut by the
    circle count by their part.

    Noise below the background counts as it is, below 0: cut off, that above would be
    light of its own.

    Args:
        psf: (y, x) light, background taken off.
        step_um: side of a sample, um.
        radius_um: (r,) radii, um.
    """
    light = np.asarray(psf, float)
    y, x = (np.arange(n) - (n - 1) / 2 for n in light.shape)
    _, (cx, cy) = _second_moments(light, x, y)
    radii = np.asarray(radius_um, float) / step_um
    return np.asarray(
        [_within(light, x - cx, y - cy, float(r)) for r in radii] / light.sum()
    )


def focusing_efficiency(
    image_e: Array,
    reference_e: Array | float,
    *,
    step_um: float,
    aperture_um: float,
    exposure_ratio: float = 1.0,
) -> float:
    """Light within a stated circle about the peak over the light through an open
    aperture of the lens's size: as :class:`metalens.psf.FocusMetrics`, measured.

    Args:
        step_um: side of a sample, um.
        image_e, reference_e: electrons, background taken off; the reference is a frame
            of the same beam through an
            empty aperture, whole on the sensor, or the sum of it.
        aperture_um: diameter of the circle (often three times the FWHM): always state
            it with the number.
        exposure_ratio: exposure of the image over that of the reference.
    """
    light = np.asarray(image_e, float)
    row, column, _ = find_peak(light)
    power = encircled_power(light, (row, column), aperture_um / 2 / step_um)
    return float(power / np.sum(reference_e) / exposure_ratio)


def _second_moments(
    light: Array, x: Array, y: Array
) -> tuple[tuple[float, float], tuple[float, float]]:
    """ISO 11146-1: widths 4 sigma along the principal axes, over a window three widths
    wide, iterated.
    """
    cx = cy = 0.0
    width = 2.0 * max(light.shape)
    major = minor = 0.0
    for _ in range(30):
        mask = (np.abs(x[None] - cx) <= 1.5 * width) & (
            np.abs(y[:, None] - cy) <= 1.5 * width
        )
        w = light * mask
        total = w.sum()
        cx = float((w * x[None]).sum() / total)
        cy = float((w * y[:, None]).sum() / total)
        dx, dy = x[None] - cx, y[:, None] - cy
        xx, yy, xy = ((w * m).sum() / total for m in (dx * dx, dy * dy, dx * dy))
        root = math.hypot(xx - yy, 2 * xy)
        major, minor = (
            4 * math.sqrt(max((xx + yy + s * root) / 2, 0)) for s in (1, -1)
        )
        if abs(major - width) < 1e-6 * width:
            break
        width = max(major, 1.0)
    return (major, minor), (cx, cy)


def _encircled(light: Array, x: Array, y: Array, share: float) -> float:
    """Least radius about (0, 0), in pixels, that holds a share of all light."""
    wanted = share * light.sum()
    distance = np.hypot(x[None], y[:, None]).ravel()
    order = np.argsort(distance, kind="stable")
    first = int(np.argmax(np.cumsum(light.ravel()[order]) >= wanted))
    about = float(distance[order[first]])
    radii = np.linspace(max(about - 2, 0), about + 2, 41)
    held = np.array([_within(light, x, y, float(r)) for r in radii]) - wanted
    k = max(int(np.argmax(held >= 0)), 1)
    return float(
        optimize.brentq(
            lambda r: _within(light, x, y, r) - wanted, radii[k - 1], radii[k]
        )
    )


def _within(light: Array, x: Array, y: Array, radius: float) -> float:
    """Light within a circle about (0, 0) of square pixels of side 1 at (x, y), even
    over each pixel.

    A pixel that the rim crosses counts by the chords of 16 lines across it: to 0.2 % of
    a pixel.
    """
    distance = np.hypot(x[None], y[:, None])
    whole = float(light[distance <= radius - math.sqrt(0.5)].sum())
    row, column = np.nonzero(np.abs(distance - radius) < math.sqrt(0.5))
    lines = y[row, None] + (np.arange(16) - 7.5) / 16
    chord = np.sqrt(np.maximum(radius**2 - lines**2, 0))
    low = np.maximum(x[column, None] - 0.5, -chord)
    high = np.minimum(x[column, None] + 0.5, chord)
    return whole + float((light[row, column] * np.maximum(high - low, 0).mean(1)).sum())


def _edge_line(pixels: Array, rows: Array) -> tuple[float, float]:
    """Slope and offset of the edge from the centroids of each row's derivative, fitted
    twice about the line.
    """
    slope, offset = 0.0, pixels.shape[1] / 2
    derivative = np.abs(ndimage.gaussian_filter1d(pixels, 1.0, axis=1, order=1))
    columns = np.arange(pixels.shape[1])
    near = np.ones_like(derivative)
    for reach in (None, 12.0, 8.0, 6.0):
        if reach is not None:
            near = np.exp(
                -0.5 * ((columns[None] - (slope * rows + offset)[:, None]) / reach) ** 2
            )
        weight = near * np.maximum(derivative - np.median(derivative), 0) ** 2
        total = weight.sum(1)
        if not total.max() > 0:
            raise CaptureError("no edge in the image")
        good = total > 0.1 * np.median(total)
        center = (weight * columns).sum(1)[good] / total[good]
        slope, offset = (float(v) for v in np.polyfit(rows[good], center, 1))
    return slope, offset
