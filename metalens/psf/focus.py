"""FWHM, Strehl ratio, MTF50 and focusing efficiency of the PSFs of a lens, each with
its error.
"""

import math
from dataclasses import replace

import numpy as np
import torch

from metalens import propagate
from metalens.core.arrays import Array
from metalens.lens import Lens
from metalens.psf.budget import sine_aperture
from metalens.psf.lens_psfs import all_maps, lens_stop_shadow, passed_um2
from metalens.psf.metrics import (
    SPOT_FWHM,
    FocusMetrics,
    Point,
    diffraction_limit,
    encircled_power,
    find_peak,
    half_maximum,
    half_modulation,
)
from metalens.psf.record import PsfStack
from metalens.psf.spectrum import SpectralNodes

BLOCK = 8  # pillars along a side over which the distance to the focus counts as one


def focus_metrics(
    stack: PsfStack, lens: Lens, *, power_error: float = 0.0
) -> tuple[FocusMetrics, ...]:
    """Figures of the sharpest depth of every field angle, with their errors.

    The efficiency is the field's: power within a circle of three FWHM, from the PSF,
    over the power that falls on the aperture. Losses of the pillars (other orders,
    reflection, absorption) count through |T|, those of neighbours where the lens holds
    solved rows.

    Args:
        stack: PSFs (angle, depth, y, x) of the lens.
        lens: the lens, for its aperture and |T|; for a lens that was fitted, its
            design.
        power_error: relative error of the power behind the pillars.

    Returns:
        One record for each field angle, of the depth with the highest peak irradiance.

    Accuracy: the relative error e of the PSF's budget counts as an error e of the peak;
    that of a width is e of the peak over the slope at half maximum. Interpolation of
    samples by quintic splines: 5e-4 at the coarsest sampling without aliases.
    """
    plain = stack.numpy()
    shape = len(plain.angles_rad), len(plain.depths_um), *plain.intensity.shape[-2:]
    light = plain.intensity.reshape(shape)
    energy = np.asarray(plain.energy_um2).reshape(shape[:2])
    figures = []
    for i, (x, y) in enumerate(plain.angles_rad.tolist()):
        best = int((light[i].max((-1, -2)) * energy[i]).argmax())
        figures.append(
            _point_metrics(
                plain,
                lens,
                (light[i, best], float(energy[i, best])),
                ((x, y), float(plain.depths_um[best])),
                power_error,
            )
        )
    return tuple(figures)


def _point_metrics(
    stack: PsfStack,
    lens: Lens,
    psf: tuple[Array, float],
    at: tuple[Point, float],
    power_error: float,
) -> FocusMetrics:
    """Width, Strehl ratio, MTF50 and efficiency of one PSF, with their errors.

    Args:
        stack: wavelengths, step and error budget.
        lens: aperture and |T|.
        psf: (y, x) PSF of sum 1, and its energy in um².
        at: (x, y) field angle in rad, and depth in um.
        power_error: relative error of the power behind the pillars.
    """
    light, energy_um2 = psf
    angle, depth_um = at
    error = _error_at(stack, angle)
    step = stack.step_um
    area_um2 = incident_um2(lens, angle, depth_um)
    d = lens.diameters
    # a round aperture of the same area as the cells that the light reaches
    fill = math.sqrt(area_um2 / math.pi) / (d.radius_um + d.pitch_um / 2)
    sine = min(fill, 1.0) * sine_aperture(lens, angle)
    limit = diffraction_limit(sine, float(stack.weights @ stack.wavelengths_um))
    peak = find_peak(light)
    width, slope = half_maximum(light, peak)
    fwhm_um = width * step
    power = energy_um2 / area_um2
    share = encircled_power(light, peak, SPOT_FWHM / 2 * width)
    in_phase = in_phase_irradiance(lens, angle, depth_um, stack)
    strehl = peak[2] * energy_um2 / step**2 / in_phase
    ends = [
        half_modulation(light.sum(axis), step, limit.cutoff_per_um) for axis in (0, 1)
    ]
    return FocusMetrics(
        angle_rad=angle,
        depth_um=depth_um,
        fwhm_um=fwhm_um,
        fwhm_error_um=2 * error * step / slope,
        strehl=strehl,
        strehl_error=error * strehl,
        mtf50_per_um=(ends[0][0], ends[1][0]),
        mtf50_error_per_um=(error * ends[0][1], error * ends[1][1]),
        efficiency=share * power,
        efficiency_error=math.hypot(error, power_error) * share * power,
        window_share=energy_um2 / float(passed_um2(lens, angle, (depth_um,))[0]),
        limit=limit,
    )


def _error_at(stack: PsfStack, angle_rad: Point) -> float:
    """Relative L2 error of the device at a field angle, from the stack's budget.

    The budget's term ``angle`` is scaled by sin² of this angle over the largest sin².
    """
    steep = (np.tan(stack.angles_rad) ** 2).sum(-1)
    squares = steep / (1 + steep)
    own = math.tan(angle_rad[0]) ** 2 + math.tan(angle_rad[1]) ** 2
    part = own / (1 + own) / max(float(squares.max()), 1e-300)
    return replace(stack.budget, angle=part * stack.budget.angle).total


def incident_um2(lens: Lens, angle_rad: Point, depth_um: float) -> float:
    """Power on the aperture per unit irradiance, um²: a Σ |S|² over the pillars.

    a is the area of a site, S the shadow of a stop for this angle and depth.

    Args:
        lens: pillars and stop.
        angle_rad: field angles along x and y, rad.
        depth_um: source depth from the lens, um.
    """
    d = lens.diameters
    has_pillar = np.asarray(d.diameter_um) > 0
    shadow = np.abs(lens_stop_shadow(lens, angle_rad, depth_um))
    return float(d.site_um2 * ((has_pillar * shadow) ** 2).sum())


def in_phase_irradiance(
    lens: Lens, angle_rad: Point, depth_um: float, stack: PsfStack
) -> float:
    """Peak irradiance of the lens without aberrations, per unit irradiance of the lens.

    (Σ |T| a |h|)² at the chief ray's place, with h the Rayleigh-Sommerfeld kernel: the
    light of all pillars in phase. It is the reference of the Strehl ratio.

    Accuracy: the distance to the focus is taken as one over 8 x 8 pillars: 1e-4.

    Args:
        angle_rad: field angles along x and y, rad.
        depth_um: source depth from the lens, um.
        stack: PSFs over angle, depth and wavelength.
    """
    nodes = SpectralNodes(
        np.asarray(stack.wavelengths_um), np.asarray(stack.weights), 0.0
    )
    level = all_maps(lens, nodes, angle_rad, torch.float32, scalar=True)[0][1].numpy()
    d = lens.diameters
    level = level * np.abs(lens_stop_shadow(lens, angle_rad, depth_um))
    total = 0.0
    for transmission, wave, weight in zip(
        level, nodes.wavelengths_um.tolist(), nodes.weights.tolist(), strict=True
    ):
        case = propagate.make_case(
            transmission.shape,
            **d.grid._asdict(),
            wavelength_um=wave,
            sensor_distance_um=lens.sensor_distance_um,
            depths_um=lens.source_distance_um,
            angle_rad=angle_rad,
            window_um=stack.step_um,
            samples=1,
            layers=lens.layers.open,
        )
        sums = _blocks(transmission)
        y, x = (
            _blocks(a[None])[0] / _blocks(np.ones((1, len(a))))[0]
            for a in case.pillars_um
        )
        strength, _ = propagate.paths.ray_to_offset(case, x, y[:, None], 0.0, 0.0)
        total += weight * (case.area_um2 * float((sums * np.abs(strength)).sum())) ** 2
    return total


def _blocks(values: Array) -> Array:
    """Sums of (y, x) values over blocks of 8 x 8; one row stays one row."""
    rows = np.arange(0, values.shape[0], BLOCK)
    columns = np.arange(0, values.shape[1], BLOCK)
    wide = np.add.reduceat(np.asarray(values, float), columns, axis=1)
    return np.asarray(np.add.reduceat(wide, rows, axis=0))
