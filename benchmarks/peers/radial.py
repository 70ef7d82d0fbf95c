"""Radially symmetric lenses on the axis: two Hankel transforms instead of a plane of
pillars.

U(ρ) = 2π ∫ f J0(2πfρ) e^{ik_z d} [2π ∫ r J0(2πfr) T e^{iφ} U_in dr] df: the angular
spectrum of a continuous lens. A
pixelated lens differs by its staircase rim; the light of that difference is summed over
the cells that the rim cuts.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.special import j0

from metalens.core import legendre
from metalens.core.arrays import Array
from metalens.core.errors import PropagationError
from metalens.optics.paths import source_path
from metalens.propagate import PropagationCase
from metalens.propagate.estimate import SAFETY, draw_pixels, sampled_square_error


@dataclass(frozen=True, eq=False, slots=True)
class Radial:
    """A lens known by its radial profile: phase in rad and transmission as functions of
    the radius in um.
    """

    phase_rad: Callable[[Array], Array]
    transmission: Callable[[Array], Array]
    radius_um: float

    def maps(self, shape: tuple[int, int], pitch_um: float) -> tuple[Array, Array]:
        """(phase, transmission) of the pixelated lens, (y, x); open where the pillar's
        centre lies inside.
        """
        y, x = ((np.arange(n) - (n - 1) / 2) * pitch_um for n in shape)
        r = np.hypot(y[:, None], x)
        return self.phase_rad(r), np.where(r <= self.radius_um, self.transmission(r), 0)


@dataclass(frozen=True, eq=False, slots=True)
class RadialField:
    """field: (depth, y, x) complex128; error: relative L2 estimate of the PSFs against
    the pixelated lens.
    """

    field: Array
    error: float


def field_radial(lens: Radial, case: PropagationCase, tolerance: float) -> RadialField:
    """Field of a radial lens on the window, for sources and window on the axis.

    Raises:
        PropagationError: an oblique case or a window off the axis.

    Accuracy: ``error``; dominated by the rim of the pixelated lens, 1e-5 for a 1 mm
    lens of 0.4 um pitch.
    """
    if any(case.tangents) or any(case.centre_um):
        raise PropagationError(
            "a radial lens is fast on its axis only; give angle 0 and a centred window, or use windowed"
        )
    y, x = case.window_um
    rho = np.hypot(y[:, None], x)
    values, wave = _converged(lens, case, float(rho.max()), tolerance / 4)
    grid = np.linspace(0, max(float(rho.max()), 1e-9), values.shape[1])
    field = CubicSpline(grid, values, axis=1)(rho)
    return RadialField(
        np.asarray(field), _rim_error(lens, case, np.asarray(field)) + wave
    )


def _converged(
    lens: Radial, case: PropagationCase, reach: float, tolerance: float
) -> tuple[Array, float]:
    """(depth, ρ) field on an even grid, and its own error; nodes are doubled until two
    results agree.
    """
    band = _band(lens, case, reach)
    radii = int(
        32
        + 2.2 * (case.wavenumber * band * case.wavelength_um * lens.radius_um) / np.pi
    )
    count, before = max(64, int(8 * band * reach * 2) + 32), None
    for _ in range(6):
        values = _hankel(lens, case, (radii, radii), (max(reach, 1e-9), count), band)
        if before is not None:
            error = float(
                np.linalg.norm(values[:, ::2] - before) / np.linalg.norm(before)
            )
            if error <= tolerance:
                return values, error
        before, radii, count = values, int(1.5 * radii), 2 * count - 1
    raise PropagationError(
        "the radial profile is too rough for the Hankel path at this tolerance; use windowed"
    )


def _band(lens: Radial, case: PropagationCase, reach: float) -> float:
    """Twice the largest spatial frequency of rays to the window, cycles per um: what a
    hard rim scatters further out is
    felt where the band ends."""
    sine = (lens.radius_um + reach) / np.hypot(
        lens.radius_um + reach, case.sensor_distance_um
    )
    return float(min(2 * sine + 0.02, 1.0) / case.wavelength_um)


def _hankel(
    lens: Radial,
    case: PropagationCase,
    counts: tuple[int, int],
    rho: tuple[float, int],
    band: float,
) -> Array:
    """(depth, ρ) by Gauss-Legendre quadrature of both transforms; ρ runs evenly from 0
    in (reach, count).
    """
    (t, w), (s, v) = (
        legendre.gauss_legendre_nodes(counts[0]),
        legendre.gauss_legendre_nodes(counts[1]),
    )
    r, f = (t + 1) / 2 * lens.radius_um, (s + 1) / 2 * band
    inverse = np.array(case.inverse_depths_per_um)[:, None]
    path = source_path(r, 0.0, (0.0, 0.0), inverse)
    light = lens.transmission(r) * np.exp(
        1j * (lens.phase_rad(r) + case.wavenumber * path)
    )
    there, back = _bessel(lens.radius_um, band, counts, rho)
    spectrum = (light * (2 * np.pi * r * w * lens.radius_um / 2)) @ there
    kz = 2 * np.pi * np.sqrt(np.clip(case.wavelength_um**-2 - f**2, 0, None))
    taper = np.clip((band - f) / (0.1 * band), 0, 1)
    spectrum = (
        spectrum
        * np.exp(1j * kz * case.sensor_distance_um)
        * taper**2
        * (3 - 2 * taper)
    )
    return np.asarray((spectrum * (2 * np.pi * f * v * band / 2)) @ back)


@functools.lru_cache(maxsize=4)
def _bessel(
    radius: float, band: float, counts: tuple[int, int], rho: tuple[float, int]
) -> tuple[Array, Array]:
    """J0 of both transforms, (r, f) and (f, ρ); the last few are kept."""
    r = (legendre.gauss_legendre_nodes(counts[0])[0] + 1) / 2 * radius
    f = (legendre.gauss_legendre_nodes(counts[1])[0] + 1) / 2 * band
    return j0(2 * np.pi * r[:, None] * f), j0(
        2 * np.pi * f[:, None] * np.linspace(0, *rho)
    )


def _rim_error(lens: Radial, case: PropagationCase, field: Array) -> float:
    """Relative L2 of the PSFs from the staircase rim: light of every cut cell's missing
    or surplus area, at points
    that all depths share."""
    depths = np.unique(
        np.linspace(0, len(field) - 1, min(len(field), 8)).round().astype(int)
    )
    power = np.abs(field[depths]).reshape(len(depths), -1) ** 2
    energy = power.sum(1, keepdims=True)
    normalised = power / energy
    points, chance = draw_pixels(normalised.mean(0), 160)
    value = field[depths].reshape(power.shape)[:, points]
    y, x = case.window_um
    at = np.stack([x[points % len(x)], y[points // len(x)]], -1)
    surplus = _surplus(lens, case, np.array(case.inverse_depths_per_um)[depths], at)
    difference = (np.abs(value + surplus) ** 2 - np.abs(value) ** 2) / energy
    square = sampled_square_error(normalised[:, points], chance, difference)
    return float(SAFETY * np.sqrt(square / (normalised**2).sum()))


def _surplus(
    lens: Radial, case: PropagationCase, inverse: Array, points: Array
) -> Array:
    """(depth, point) field of the pixelated rim less the round one; ``points`` are
    (point, [x, y]).
    """
    R, p = lens.radius_um, case.pitch_um
    y, x = case.pillars_um
    r = np.hypot(y[:, None], x)
    rows, columns = np.nonzero(np.abs(r - R) < p)
    cy, cx, cr = y[rows], x[columns], r[rows, columns]
    inside = ((np.arange(12) + 0.5) / 12 - 0.5) * p
    covered = np.mean(
        [np.hypot(cx + a, cy + b) <= R for a in inside for b in inside], axis=0
    )
    area = ((cr <= R) - covered) * p * p
    path = source_path(cx, cy, (0.0, 0.0), inverse[:, None])
    light = (
        area
        * lens.transmission(cr)
        * np.exp(1j * (lens.phase_rad(cr) + case.wavenumber * path))
    )
    d, k = case.sensor_distance_um, case.wavenumber
    out = np.empty((len(inverse), len(points)), complex)
    for start in range(0, len(points), 16):
        some = slice(start, start + 16)
        distance = np.sqrt(
            (points[some, :1] - cx) ** 2 + (points[some, 1:] - cy) ** 2 + d * d
        )
        wave = (
            d
            / (2 * np.pi * distance**2)
            * (1 / distance - 1j * k)
            * np.exp(1j * k * distance)
        )
        out[:, some] = light @ wave.T
    return out
