"""Quality of a PSF or an edge as numbers: MTF, Strehl ratio, encircled energy, ISO
11146 width, efficiency.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy import fft, ndimage, stats

from metalens.core.arrays import Array
from metalens.core.errors import CaptureError
from metalens.psf import encircled_power, find_peak, fwhm


@dataclass(frozen=True, eq=False, slots=True)
class EdgeMtf:
    """Modulation transfer function along one direction.

    frequency_per_um: (f,) from 0. modulation: (f,), 1 at frequency 0.
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
        pair = [int(below[0]), int(below[0]) - 1]
        return float(np.interp(0.5, self.modulation[pair], self.frequency_per_um[pair]))


@dataclass(frozen=True, slots=True)
class SpotMetrics:
    """Width numbers of one PSF.

    fwhm_um: full width at half maximum of the radial mean about the peak.
    ee80_um: radius about the centroid that holds 80 % of the light in the window.
    d4sigma_um: (major, minor) beam widths of ISO 11146-1, window iterated to three
    times the width.
    centroid_um: (x, y) from the window's centre.

    Accuracy: light is uniform over a pixel, a second blur. Of an Airy disc, by where it
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
    """MTF across a slanted edge (ISO 12233).

    The edge is a line through the centroids of each row's derivative. Pixels are binned
    by their distance from it; the profile's derivative, times a Hann window, is
    Fourier transformed.

    Args:
        image: (y, x) one straight edge, tilted 2 to 20 degrees from rows or columns.
        pixel_um: pitch of the pixels, um.
        oversample: bins of the edge profile a pixel.

    Accuracy: the finite difference and the bins are divided out; 1-2 % on noise-free
    edges to 0.7 Nyquist.

    Raises:
        CaptureError: no edge, or a tilt that leaves the phases of the pixels uncovered.
    """
    pixels = np.asarray(image, float)
    gy, gx = np.gradient(pixels)
    pixels = pixels if np.abs(gx).sum() >= np.abs(gy).sum() else pixels.T
    slope, offset = _edge_line(pixels)
    angle = math.atan(slope)
    if not 1.5 <= math.degrees(abs(angle)) <= 25:
        raise CaptureError(
            f"edge tilted by {math.degrees(abs(angle)):.1f} degrees; need 2 to 20 to "
            "sample between the pixels"
        )
    row, column = np.indices(pixels.shape)
    distance = (column - slope * row - offset) * math.cos(angle)
    reach = int(min(distance.max(), -distance.min())) * oversample
    edges = (np.arange(-reach, reach + 2) - 0.5) / oversample
    profile = stats.binned_statistic(distance.ravel(), pixels.ravel(), bins=edges)[0]
    hit = np.flatnonzero(np.isfinite(profile))
    profile = np.interp(np.arange(len(profile)), hit, profile[hit])
    line_spread = np.diff(profile)
    peak = int(np.argmax(np.abs(ndimage.gaussian_filter1d(line_spread, oversample))))
    half_width = min(peak, len(line_spread) - 1 - peak)
    line_spread = (
        line_spread[peak - half_width : peak + half_width + 1]
        * np.hanning(2 * half_width + 3)[1:-1]
    )
    spectrum = np.abs(fft.rfft(line_spread, 8 * len(line_spread)))
    frequency = fft.rfftfreq(8 * len(line_spread), pixel_um / oversample)
    attenuation = (
        np.sinc(frequency * pixel_um / oversample) ** 2
    )  # difference of neighbours, and bins
    passed = frequency <= 1 / pixel_um
    return EdgeMtf(
        frequency[passed],
        (spectrum / spectrum[0] / np.maximum(attenuation, 0.1))[passed],
    )


def strehl_ratio(psf: Array, ideal: Array) -> float:
    """Strehl ratio: peak of a PSF over that of the ideal PSF, both of sum 1.

    Peaks come from a quintic spline through the samples, so that their place under the
    grid does not matter.

    Args:
        psf: (y, x) light, background taken off.
        ideal: (y, x) ideal PSF on the same samples.
    """
    peaks = (find_peak(light)[2] / np.sum(light) for light in (psf, ideal))
    return float(next(peaks) / next(peaks))


def measure_spot(psf: Array, *, step_um: float) -> SpotMetrics:
    """FWHM, EE80 radius, ISO 11146 widths and centroid of a PSF, um.

    Args:
        psf: (y, x) light, background taken off.
        step_um: side of a sample, um.

    Raises:
        CaptureError: no light.
    """
    light = np.asarray(psf, float)
    if not light.sum() > 0:
        raise CaptureError("a PSF without light; take off less background")
    (major, minor), (row, column) = _second_moments(light)
    middle_row, middle_column = ((size - 1) / 2 for size in light.shape)
    return SpotMetrics(
        fwhm(light, step_um),
        _encircled_radius(light, (row, column), 0.8) * step_um,
        (major * step_um, minor * step_um),
        ((column - middle_column) * step_um, (row - middle_row) * step_um),
    )


def encircled_energy(psf: Array, *, step_um: float, radius_um: Array) -> Array:
    """(r,) share of the window's light within radii about the centroid; pixels on the
    circle count by their part inside.

    Negative pixels count as they are: cut off, the noise would add light.

    Args:
        psf: (y, x) light, background taken off.
        step_um: side of a sample, um.
        radius_um: (r,) radii, um.
    """
    light = np.asarray(psf, float)
    _, place = _second_moments(light)
    radii = np.asarray(radius_um, float) / step_um
    power = [encircled_power(light, place, radius) for radius in radii.tolist()]
    return np.asarray(power / light.sum())


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


def _second_moments(light: Array) -> tuple[tuple[float, float], tuple[float, float]]:
    """((major, minor) widths 4 sigma along the principal axes, (row, column) centroid)
    of ISO 11146-1, in pixels; the window is iterated to three widths.

    4 sigma = 4 sqrt(v) of the eigenvalues v of the second moments.

    Args:
        light: (y, x) light.
    """
    places = np.indices(light.shape)
    centre = (np.array(light.shape) - 1) / 2
    width = 2.0 * max(light.shape)
    for _ in range(30):
        offset = places - centre[:, None, None]
        weighted = light * (np.abs(offset) <= 1.5 * width).all(0)
        weighted = weighted / weighted.sum()
        centre = (places * weighted).sum((1, 2))
        offset = places - centre[:, None, None]
        moments = np.einsum("iyx,jyx,yx->ij", offset, offset, weighted)
        minor, major = 4 * np.sqrt(np.maximum(np.linalg.eigvalsh(moments), 0))
        if abs(major - width) < 1e-6 * width:
            break
        width = max(major, 1.0)
    return (float(major), float(minor)), (float(centre[0]), float(centre[1]))


def _encircled_radius(light: Array, place: tuple[float, float], share: float) -> float:
    """Radius about a place, in pixels, that holds a share of all light: first crossing,
    to a fraction of a pixel.
    """
    target = share * light.sum()
    y, x = np.indices(light.shape)
    distance = np.hypot(y - place[0], x - place[1]).ravel()
    order = np.argsort(distance, kind="stable")
    rough = distance[order[np.argmax(np.cumsum(light.ravel()[order]) >= target)]]
    radii = np.maximum(rough + np.linspace(-2, 2, 17), 0)
    power = [encircled_power(light, place, radius) for radius in radii.tolist()]
    k = max(int(np.argmax(np.array(power) >= target)), 1)
    return float(np.interp(target, power[k - 1 : k + 1], radii[k - 1 : k + 1]))


def _edge_line(pixels: Array) -> tuple[float, float]:
    """Slope and offset of an edge, column = slope * row + offset, in pixels.

    A line through the centroid of each row's squared derivative, fitted four times;
    later fits weight pixels by a Gaussian about the line before.
    """
    slope, offset = 0.0, pixels.shape[1] / 2
    derivative = np.abs(ndimage.gaussian_filter1d(pixels, 1.0, axis=1, order=1))
    steepness = np.maximum(derivative - np.median(derivative), 0) ** 2
    row, column = np.indices(pixels.shape)
    for width in (math.inf, 12.0, 8.0, 6.0):
        distance = column - slope * row - offset
        weight = steepness * np.exp(-0.5 * (distance / width) ** 2)
        total = weight.sum(1)
        if not total.max() > 0:
            raise CaptureError("no edge in the image")
        strong = total > 0.1 * np.median(total)
        centre = (weight * column).sum(1)[strong] / total[strong]
        slope, offset = np.polyfit(np.flatnonzero(strong), centre, 1).tolist()
    return slope, offset
