"""Scan of the focus along the axis behind the lens: the PSF on planes before and behind
the sensor.
"""

from dataclasses import dataclass

import numpy as np
import torch

from metalens import propagate
from metalens.core.arrays import Array
from metalens.lens import Lens
from metalens.psf.budget import sine_aperture
from metalens.psf.lens_psfs import all_maps, lens_stop_shadow
from metalens.psf.metrics import Point, fwhm
from metalens.psf.spectrum import SpectralNodes, single_wavelength

PLANES = 21
RIM_WAVES = 1.75  # defocus at the rim of the first and last plane
WIDTH = 28.0  # of the window, in wavelength / NA
SAMPLES = 192  # along x and y of every plane


@dataclass(frozen=True, eq=False, slots=True)
class FocusScan:
    """PSFs on planes behind the lens, of the design's source on the axis.

    shift_um: (n,) of the plane from the sensor's, positive away from the lens.
    slices: (n, x) irradiance along x through the window's middle, for unit irradiance
    of the lens; x_um: its places.
    peak: (n,) largest irradiance of the plane. fwhm_um: (n,) full width at half
    maximum.
    """

    shift_um: Array
    x_um: Array
    slices: Array
    peak: Array
    fwhm_um: Array

    @property
    def best_um(self) -> float:
        """Shift of the plane with the highest peak: vertex of the parabola through the
        highest three.
        """
        i = int(self.peak.argmax())
        if i in (0, len(self.peak) - 1):
            return float(self.shift_um[i])
        before, peak, after = self.peak[i - 1 : i + 2]
        step = float(self.shift_um[1] - self.shift_um[0])
        curvature = before - 2 * peak + after
        return float(self.shift_um[i] + step * (before - after) / (2 * curvature))


def focus_scan(
    lens: Lens,
    *,
    offset_um: Point = (0.0, 0.0),
    nodes: SpectralNodes | None = None,
    tolerance: float = 1e-3,
) -> FocusScan:
    """PSFs on 21 planes through focus, by the angular spectrum of the field.

    Planes lie within ± 3.5 wavelength n / NA² of the sensor, 1.75 waves of defocus at
    the rim, and no farther than half way to the lens. The field on a window of
    28 wavelength / NA is multiplied by exp(i kz shift) in frequency (Goodman,
    Introduction to Fourier Optics, eq. 3-74).

    Args:
        lens: with its design source, on the axis.
        offset_um: (x, y) of the window's middle on the sensor.
        nodes: wavelengths and weights; without them the design wavelength.
        tolerance: relative error of the field on the sensor.

    Accuracy: the tolerance, and 1e-3 of the peak by light outside the window (1 % of an
    Airy pattern), which is not propagated.
    """
    waves = nodes or single_wavelength(lens.wavelength_um)
    maps, _ = all_maps(lens, waves, (0.0, 0.0), torch.float64, scalar=True)
    shade = lens_stop_shadow(lens, (0.0, 0.0), lens.source_distance_um)
    stop_phase = torch.from_numpy(np.angle(shade))
    stop_level = torch.from_numpy(np.abs(shade))
    after = lens.layers.after(lens.sensor_distance_um, lens.wavelength_um)
    sine = sine_aperture(lens, (0.0, 0.0))
    focal_depth = after.index[0] * lens.wavelength_um / sine**2
    range_um = min(2 * RIM_WAVES * focal_depth, after.thickness_um[0] / 2)
    shifts = np.linspace(-range_um, range_um, PLANES)
    window = WIDTH * lens.wavelength_um / sine
    step = window / SAMPLES
    light = np.zeros((PLANES, SAMPLES, SAMPLES))
    for phase, level, wave, weight in zip(
        *maps, waves.wavelengths_um, waves.weights, strict=True
    ):
        field = propagate.windowed(
            phase + stop_phase,
            level * stop_level,
            **lens.diameters.grid._asdict(),
            wavelength_um=float(wave),
            sensor_distance_um=lens.sensor_distance_um,
            depths_um=lens.source_distance_um,
            window_um=window,
            samples=SAMPLES,
            offset_um=offset_um,
            layers=lens.layers.open,
            tolerance=tolerance,
        )[0].numpy()
        index = lens.layers.after(lens.sensor_distance_um, float(wave)).index[0]
        light += weight * np.abs(_shifted(field, step, index / wave, shifts)) ** 2
    return FocusScan(
        shifts,
        propagate.axis_positions(SAMPLES, step),
        light[:, SAMPLES // 2],
        light.max((-1, -2)),
        np.array([fwhm(plane, step) for plane in light]),
    )


def _shifted(field: Array, step_um: float, frequency: float, shifts_um: Array) -> Array:
    """(shift, y, x) field on shifted planes: F⁻¹[exp(i kz shift) F[U]].

    Args:
        field: (y, x) field U on the sensor.
        step_um: of its samples.
        frequency: index / wavelength, 1/um; waves above it do not propagate.
        shifts_um: (n,) along the axis, away from the lens.
    """
    f = np.fft.fftfreq(len(field), step_um)
    fz2 = frequency**2 - f**2 - f[:, None] ** 2
    kz = 2 * np.pi * np.sqrt(np.maximum(fz2, 0))
    spectrum = np.where(fz2 > 0, np.fft.fft2(field), 0)
    shifted = spectrum * np.exp(1j * kz * shifts_um[:, None, None])
    return np.asarray(np.fft.ifft2(shifted))
