"""Focus of a lens for its design source: place, Strehl ratio and figures of its PSF."""

import math
from dataclasses import dataclass

import numpy as np

from metalens import psf
from metalens.design.focusing import lens_meeting_um
from metalens.design.own_cell import power_error
from metalens.design.profiles import lens_focus
from metalens.lens import Lens
from metalens.psf import FocusMetrics

_FRESNEL_ZONES = 5  # of fewer, the brightest point lies before the focus
# (width in wavelength / (2 NA), samples) of the windows that are tried
_WINDOWS = ((16, 128), (64, 512))


@dataclass(frozen=True, slots=True)
class FocusCheck:
    """Where the light of the design source meets, and how sharp it is.

    figures: FWHM, Strehl ratio, MTF50 and efficiency of the PSF, with their errors.
    x_um, y_um: of the brightest point of the sensor plane; the target is (0, 0).
    z_um: distance of the plane of the highest peak from the sensor; nan where it was
        not computed.
    resolution_um: wavelength / (2 NA).
    depth_um: wavelength / NA².
    expected: Strehl ratio that the stop leaves, and the pillars' phase errors where
        they are a compromise.
    """

    figures: FocusMetrics
    x_um: float
    y_um: float
    z_um: float
    resolution_um: float
    depth_um: float
    expected: float = 1.0

    @property
    def placed(self) -> bool:
        """Brightest within a quarter of the resolution and of the depth of focus."""
        return (
            max(abs(self.x_um), abs(self.y_um)) <= self.resolution_um / 4
            and not abs(self.z_um) > self.depth_um / 4
        )

    @property
    def passed(self) -> bool:
        """In its place, at 0.8 of the expected Strehl ratio or more."""
        return self.placed and self.figures.strehl >= 0.8 * self.expected


def check_focus(lens: Lens, *, axial: bool = True, expected: float = 1.0) -> FocusCheck:
    """Place of the focus and figures of the PSF of the design source.

    The PSF (:func:`metalens.psf.from_lens`) is centred where the rays meet. It includes
    films, stop, losses of the pillars and solved neighbours. The window is 8 wavelength
    / NA; four times that for a spot without a finite FWHM in it. Along the axis the
    highest peak of :func:`metalens.psf.focus_scan` counts.

    Args:
        lens: the lens.
        axial: also scan along the axis. Lenses of fewer than five Fresnel zones
            (R² / (wavelength × distance)) are left out: their brightest point lies
            before the focus.
        expected: Strehl ratio that the phase errors of the pillars leave; what the stop
            leaves is counted here.

    Accuracy: figures carry their errors; places are within 1 % of the resolution, along
    the axis within 3 % of the depth of focus.
    """
    meets = lens_meeting_um(lens)
    offset = (0.0, 0.0) if meets is None else (meets[0], meets[1])
    airy = lens.wavelength_um / (2 * psf.sine_aperture(lens, (0.0, 0.0)))
    for width, samples in _WINDOWS:
        view = psf.View(
            (lens.source_distance_um,),
            window_um=width * airy,
            samples=samples,
            offset_um=offset,
        )
        stack = psf.from_lens(lens, view, tolerance=1e-3)
        (figures,) = psf.focus_metrics(stack, lens, power_error=power_error(lens))
        if math.isfinite(figures.fwhm_um):
            break
    row, column, _ = psf.find_peak(stack.numpy().intensity.reshape(samples, samples))
    x, y = (
        middle + (place - (samples - 1) / 2) * stack.step_um
        for middle, place in zip(offset, (column, row), strict=True)
    )
    d = lens.diameters
    after = lens.layers.after(lens.sensor_distance_um, lens.wavelength_um)
    radius = min(
        d.radius_um + d.pitch_um / 2,
        lens.layers.footprint_um(lens.source_distance_um, lens.wavelength_um),
    )
    aperture = lens_focus(lens).aperture(radius)
    depth = after.index[0] * lens.wavelength_um / aperture**2
    zones = radius**2 / (lens.wavelength_um * after.reduced_um)
    scanned = axial and zones >= _FRESNEL_ZONES and after.thickness_um[0] > depth / 2
    return FocusCheck(
        figures=figures,
        x_um=x,
        y_um=y,
        z_um=psf.focus_scan(lens, offset_um=offset).best_um if scanned else math.nan,
        resolution_um=lens.wavelength_um / (2 * aperture),
        depth_um=depth,
        expected=expected * _stop_strehl(lens),
    )


def _stop_strehl(lens: Lens) -> float:
    """Strehl ratio that diffraction by the stop leaves: |Σ S|² / (Σ |S|)².

    S is the wave behind the stop at the pillars; 1 without a stop.
    """
    if lens.layers.stop is None:
        return 1.0
    shadow = psf.lens_stop_shadow(lens, (0.0, 0.0), lens.source_distance_um)
    wave = shadow[np.asarray(lens.diameters.diameter_um) > 0]
    return float(abs(wave.sum()) ** 2 / np.abs(wave).sum() ** 2)
