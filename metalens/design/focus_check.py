"""Whether the pillars focus where they should, by the direct Rayleigh-Sommerfeld sum on
a small window.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from metalens import propagate, psf
from metalens.core.arrays import Array
from metalens.design.focusing import lens_meeting_um
from metalens.design.own_cell import power_error
from metalens.design.profiles import Focus
from metalens.lens import Lens
from metalens.propagate import PropagationCase, field_at, rayleigh_sommerfeld_kernel
from metalens.psf import FocusMetrics

# arms of the cross of points, in units of wavelength / (2 NA)
_ARM = np.linspace(-1.2, 1.2, 9)
# shifts of the sensor, in units of wavelength / NA²
_SHIFTS = np.array([-0.5, -0.25, 0.0, 0.25, 0.5])
_AXIS = np.zeros((1, 2))  # the point x = y = 0


@dataclass(frozen=True, slots=True)
class FocusCheck:
    """Where the light of the design source meets, and how bright it is.

    x_um, y_um: of the brightest point of the sensor plane; the target is (0, 0).
    z_um: distance of the brightest point of the axis from the sensor plane; nan where
        it was not computed.
    strehl: peak intensity over that of all pillars in phase.
    resolution_um: wavelength / (2 NA).
    depth_um: wavelength / NA².
    expected: Strehl ratio that the pillars' phase errors leave, where they are a
        compromise.
    """

    x_um: float
    y_um: float
    z_um: float
    strehl: float
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
        return self.placed and self.strehl >= 0.8 * self.expected


def check_focus(lens: Lens, *, axial: bool = True, expected: float = 1.0) -> FocusCheck:
    """Place and Strehl ratio of the focus by the direct Rayleigh-Sommerfeld sum.

    All pillars are summed on a cross of 9 + 9 points around the axis of the sensor, and
    at 5 points along the axis.

    Args:
        lens: the lens.
        axial: also sum at points along the axis, five more sums over the lens. Lenses
            of fewer than five Fresnel zones (R² / (wavelength × distance)) are left
            out: their brightest point lies before the focus.
        expected: Strehl ratio that the phase errors of the pillars leave.

    Accuracy:
        the sum is exact to rounding; the peak is the vertex of a parabola through the
        three brightest points of a line, within 2 % of the resolution.
    """
    d = lens.diameters
    focus = Focus(
        lens.wavelength_um,
        lens.sensor_distance_um,
        lens.source_distance_um,
        lens.layers,
    )
    after = lens.layers.after(lens.sensor_distance_um, lens.wavelength_um)
    radius = min(
        d.radius_um + d.pitch_um / 2,
        lens.layers.footprint_um(lens.source_distance_um, lens.wavelength_um),
    )
    aperture = focus.aperture(radius)
    resolution = lens.wavelength_um / (2 * aperture)
    depth = after.index[0] * lens.wavelength_um / aperture**2
    zones = radius**2 / (lens.wavelength_um * after.reduced_um)
    phase = lens.phase_rad()
    level = lens.transmission() * _illumination(lens)
    case = _case(lens, resolution, 0.0)
    axial = axial and after.thickness_um[0] > depth / 2
    arm, zero = _ARM * resolution, np.zeros_like(_ARM)
    cross = np.concatenate([np.stack([arm, zero], 1), np.stack([zero, arm], 1)])
    power = np.abs(field_at(phase, level, case, cross)[0]) ** 2
    along_x, along_y = power[: len(arm)], power[len(arm) :]
    return FocusCheck(
        x_um=_vertex(arm, along_x),
        y_um=_vertex(arm, along_y),
        z_um=_axial_peak(lens, (phase, level), resolution, depth)
        if axial and zones >= 5
        else math.nan,
        strehl=float(max(along_x.max(), along_y.max())) / _ideal_peak(level, case) ** 2,
        resolution_um=resolution,
        depth_um=depth,
        expected=expected,
    )


def focus_figures(lens: Lens) -> FocusMetrics:
    """FWHM, Strehl ratio, MTF50 and focusing efficiency of the PSF of the design
    source.

    The PSF (:func:`metalens.psf.from_lens`) is centred where the rays meet. It includes
    films, stop, losses of the pillars and solved neighbours. The window is 8 wavelength
    / NA; four times that for a spot without a finite FWHM in it.

    Args:
        lens: the lens.
    """
    meets = lens_meeting_um(lens)
    offset = (0.0, 0.0) if meets is None else (meets[0], meets[1])
    airy = lens.wavelength_um / (2 * psf.sine_aperture(lens, (0.0, 0.0)))
    for width, samples in ((16, 128), (64, 512)):
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
    return figures


def _illumination(lens: Lens) -> Any:
    """(y, x) share of the design source's light that passes the stop in front of every
    pillar; 1 without one.
    """
    d = lens.diameters
    places = d.x_um, d.y_um[:, None]
    return lens.layers.stop_share(
        (0.0, 0.0), lens.source_distance_um, lens.wavelength_um, places, d.pitch_um
    )


def _case(lens: Lens, step_um: float, shift_um: float) -> PropagationCase:
    """Propagation case of one sample on the axis.

    Args:
        lens: the lens.
        step_um: width of the sample.
        shift_um: of the sensor away from the lens, in the cover.
    """
    return propagate.make_case(
        lens.diameters.diameter_um.shape,
        **lens.diameters.grid._asdict(),
        wavelength_um=lens.wavelength_um,
        sensor_distance_um=lens.sensor_distance_um + shift_um,
        depths_um=lens.source_distance_um,
        window_um=step_um,
        samples=1,
        layers=lens.layers.open,
    )


def _axial_peak(
    lens: Lens, maps: tuple[Array, Array], step_um: float, depth_um: float
) -> float:
    """Distance in um of the brightest of 5 points of the axis from the sensor, by a
    parabola.

    Args:
        lens: the lens.
        maps: (y, x) phase in rad and magnitude of the pillars.
        step_um: resolution, for the sampling of the case.
        depth_um: depth of focus.
    """
    shifts = _SHIFTS * depth_um
    fields = [
        field_at(*maps, _case(lens, step_um, float(s)), _AXIS)[0, 0] for s in shifts
    ]
    return _vertex(shifts, np.abs(np.array(fields)) ** 2)


def _ideal_peak(level: Array, case: PropagationCase) -> float:
    """Magnitude at the focus of all pillars in phase: sum p² T d / (2 pi r²) |1/r -
    ik|.

    Args:
        level: (y, x) |T| times the illumination.
        case: of one point on the axis.
    """
    y, x = case.pillars_um
    total = sum(
        float(
            (row * np.abs(rayleigh_sommerfeld_kernel(case, x, at, 0.0, 0.0, 0.0))).sum()
        )
        for row, at in zip(level, y, strict=True)
    )
    return total * case.area_um2


def _vertex(position: Array, value: Array) -> float:
    """Position of the vertex of the parabola through the largest value and its
    neighbours.

    The end itself where it is the largest.

    Args:
        position: (n,) even positions.
        value: (n,) values there.
    """
    i = int(value.argmax())
    if i in (0, len(value) - 1):
        return float(position[i])
    before, here, after = value[i - 1 : i + 2]
    step = position[1] - position[0]
    curvature = before - 2 * here + after
    return float(position[i] + step * (before - after) / (2 * curvature))
