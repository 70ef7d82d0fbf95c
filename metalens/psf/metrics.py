"""What a PSF stack is worth: modulation transfer, width, and the figures of a focus."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage, optimize, special

from metalens.core.arrays import Array
from metalens.psf.record import PsfStack

Point = tuple[float, float]

# Airy pattern (2 J1(v)/v)², v = 2 pi NA r / wavelength: half maximum at v = 1.61634
AIRY_FWHM = 2 * 1.6163399561 / (2 * math.pi)
# MTF of a round aperture without aberrations is 1/2 at this part of its cut-off
AIRY_MTF50 = 0.4039728
SPOT_FWHM = 3.0  # diameter of the circle that counts as the focus, in FWHM


def mtf(stack: PsfStack, *, frequencies_per_um: Array) -> Array:
    """Modulation transfer along x and y: (…, depth, 2, frequency), 1 at frequency 0.

    |Σ PSF exp(-2πi f x)| of the PSF summed over the other axis (sagittal and tangential
    for a field along x).
    Light outside the window does not count.

    Args:
        stack: PSFs over angle, depth and wavelength.
        frequencies_per_um: spatial frequencies, cycles per um.
    """
    psf = stack.numpy().intensity
    along_x, along_y = (
        np.exp(-2j * np.pi * np.outer(a, frequencies_per_um))
        for a in (stack.x_um, stack.y_um)
    )
    lines = psf.sum(-2) @ along_x, psf.sum(-1) @ along_y
    return np.asarray(np.abs(np.stack(lines, axis=-2)))


def blur_um(light: Array, step_um: float, window_share: Array | float = 1.0) -> Array:
    """(…,) radius of the uniform disc of equal spread, um, by quartiles along x and y.

    The middle half of a disc of radius b lies within 0.404 b of its middle along an
    axis. The radius is at most √(area / (π window_share)), that of a disc of the window's mean
    brightness, and equal to it where less than half of the light is in the window.

    Args:
        light: (…, y, x) irradiance.
        step_um: step of the samples.
        window_share: (…,) share of all light that falls in the window. Half of the light
            outside counts on either side.
    """
    window_share = np.clip(window_share, 1e-6, 1.0)
    widths = []
    for axis in (-1, -2):
        total = np.cumsum(light.sum(axis), -1)
        parts = [
            np.clip(0.5 + side / window_share, 0, 1)[..., None]
            for side in (-0.25, 0.25)
        ]
        quarters = [(total < part * total[..., -1:]).sum(-1) for part in parts]
        widths.append((quarters[1] - quarters[0] + 1) / 2 * step_um)
    largest = step_um * np.sqrt(
        light.shape[-1] * light.shape[-2] / (math.pi * window_share)
    )
    radius = np.hypot(*widths) / (0.404 * math.sqrt(2))
    return np.asarray(
        np.where(window_share < 0.5, largest, np.minimum(radius, largest))
    )


@dataclass(frozen=True, slots=True)
class DiffractionLimit:
    """Airy pattern of a round aperture without aberrations or losses.

    fwhm_um: 1.029 wavelength / (2 NA). mtf50_per_um: frequency of half modulation.
    cutoff_per_um: 2 NA / wavelength, beyond which the MTF is 0.
    efficiency: share of the pattern within a circle of three FWHM, 0.855.
    """

    fwhm_um: float
    mtf50_per_um: float
    cutoff_per_um: float
    efficiency: float


@dataclass(frozen=True, slots=True)
class FocusMetrics:
    """Figures of one PSF. Errors are standard errors of the device, one sigma.

    angle_rad: (x, y) of the field. depth_um: of the source, inf for a plane wave.
    fwhm_um: full width at half maximum of the mean over directions about the peak.
    strehl: peak irradiance over that of the same light with all pillars in phase.
    mtf50_per_um: (x, y) lowest frequency at which the modulation is 1/2.
    efficiency: power within a circle of three FWHM about the peak over the power that
    falls on the aperture (focusing efficiency).
    window_share: share of the light behind the pillars that falls in the window.
    """

    angle_rad: Point
    depth_um: float
    fwhm_um: float
    fwhm_error_um: float
    strehl: float
    strehl_error: float
    mtf50_per_um: Point
    mtf50_error_per_um: Point
    efficiency: float
    efficiency_error: float
    window_share: float
    limit: DiffractionLimit


def diffraction_limit(
    numerical_aperture: float, wavelength_um: float
) -> DiffractionLimit:
    """Airy pattern of a numerical aperture (Born and Wolf, Principles of Optics,
    8.5.2).

    Args:
        numerical_aperture: n sin θ of the image side.
        wavelength_um: in vacuum.
    """
    v = math.pi * AIRY_FWHM * SPOT_FWHM
    cutoff = 2 * numerical_aperture / wavelength_um
    return DiffractionLimit(
        AIRY_FWHM * wavelength_um / numerical_aperture,
        AIRY_MTF50 * cutoff,
        cutoff,
        float(1 - special.j0(v) ** 2 - special.j1(v) ** 2),
    )


def find_peak(light: Array) -> tuple[float, float, float]:
    """(row, column, value) of the peak of a quintic spline through samples.

    It is searched within one sample of the brightest.

    Args:
        light: (y, x) irradiance.
    """
    spline = ndimage.spline_filter(np.asarray(light, float), 5, mode="mirror")
    start = np.array(np.unravel_index(int(light.argmax()), light.shape), float)
    bounds = [
        (max(c - 1, 0), min(c + 1, n - 1))
        for c, n in zip(start, light.shape, strict=True)
    ]
    scale = float(light.max())
    optimum = optimize.minimize(
        lambda at: -_at(spline, at[0], at[1]).item() / scale, start, bounds=bounds
    )
    row, column = (float(c) for c in optimum.x)
    return row, column, float(-optimum.fun) * scale


def fwhm(light: Array, step_um: float) -> float:
    """Full width at half maximum of (y, x) samples about their peak, um.

    Of the mean over all directions about the peak; nan where it does not fall to one
    half within the window.

    Args:
        light: (..., y, x) irradiance.
        step_um: step of the samples, um.
    """
    return half_maximum(light, find_peak(light))[0] * step_um


def half_maximum(light: Array, peak: tuple[float, float, float]) -> tuple[float, float]:
    """FWHM of the azimuthal mean in samples, and its slope at half maximum.

    The slope is the fall per sample over the peak. Both are nan where the mean stays
    above one half within the window.

    Args:
        light: (y, x) irradiance.
        peak: row, column and value of the peak.
    """
    row, column, top = peak
    spline = ndimage.spline_filter(np.asarray(light, float), 5, mode="mirror")
    azimuth = 2 * np.pi * np.arange(72) / 72

    def above(radius: float) -> float:
        ring = _at(
            spline, row + radius * np.sin(azimuth), column + radius * np.cos(azimuth)
        )
        return float(ring.mean()) / top - 0.5

    widest = min(row, column, light.shape[0] - 1 - row, light.shape[1] - 1 - column)
    half, slope = _half_crossing(above, np.arange(0.0, max(widest, 0.0), 0.25))
    return 2 * half, slope


def _half_crossing(
    above: Callable[[float], float], steps: Array
) -> tuple[float, float]:
    """First zero of a function along ascending steps, and its fall per unit there; nan
    where there is none.
    """
    below = next((i for i, at in enumerate(steps) if above(float(at)) < 0), None)
    if below is None:
        return math.nan, math.nan
    zero = float(optimize.brentq(above, steps[max(below - 1, 0)], steps[below]))
    return zero, (above(0.95 * zero) - above(1.05 * zero)) / (0.1 * zero)


def _at(spline: Array, row: Array | float, column: Array | float) -> Array:
    """Values of a quintic spline at rows and columns."""
    at = np.stack(np.broadcast_arrays(np.atleast_1d(row), np.atleast_1d(column)))
    return np.asarray(
        ndimage.map_coordinates(spline, at, order=5, prefilter=False, mode="mirror")
    )


def encircled_power(light: Array, at: Sequence[float], radius: float) -> float:
    """Sum of the samples within a circle; nan for a radius that is not finite.

    Light is uniform over the cell of a sample. Cells that the circle cuts count by
    their area in it, by 16 x 16 points each (to 1e-3 of a cell).

    Args:
        light: (y, x) irradiance.
        at: (row, column) of the circle's centre.
        radius: of the circle, in samples.
    """
    if not math.isfinite(radius):
        return math.nan
    rows, columns = (np.arange(n) - c for n, c in zip(light.shape, at, strict=False))
    distance = np.hypot(rows[:, None], columns)
    inside = distance <= radius - math.sqrt(0.5)
    total = float(np.asarray(light, float)[inside].sum())
    fine = (np.arange(16) + 0.5) / 16 - 0.5
    for i, j in np.argwhere(~inside & (distance < radius + math.sqrt(0.5))).tolist():
        part = np.hypot((rows[i] + fine)[:, None], columns[j] + fine) <= radius
        total += float(light[i, j]) * float(part.mean())
    return total


def half_modulation(
    line: Array, step_um: float, cutoff_per_um: float
) -> tuple[float, float]:
    """Lowest frequency of modulation 1/2, and its change per unit of modulation, 1/um.

    Both are nan where the modulation stays above 1/2 up to the cut-off.

    Args:
        line: (n,) line spread function.
        step_um: step of the samples, um.
        cutoff_per_um: largest frequency that is searched, at most Nyquist's.
    """
    total = float(line.sum())
    x = np.arange(len(line)) * step_um

    def above(frequency: float) -> float:
        return abs(complex(line @ np.exp(-2j * np.pi * frequency * x))) / total - 0.5

    steps = np.linspace(0, min(cutoff_per_um, 0.5 / step_um), 201)
    frequency_50, fall = _half_crossing(above, steps)
    return frequency_50, 1 / fall
