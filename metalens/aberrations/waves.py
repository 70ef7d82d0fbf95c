"""The plane waves of the light behind a lens, and line images and transfer functions at
any distance from them.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.fft
import torch

from metalens import propagate
from metalens.core.arrays import Array
from metalens.lens import Lens
from metalens.optics import media
from metalens.optics.media import Media
from metalens.propagate import paths
from metalens.psf import SpectralNodes, all_maps

BAND = 1.05  # of the directions of the rays, with FRINGES of diffraction on either side
FRINGES = 14
ROOM, MOST_ROOM = (
    1.05,
    8.0,
)  # period of the field over the width of the map; AIRY wavelengths over NA at least
AIRY = 80.0
ROWS = 256  # of the map at a time
PIECES = 48  # of the map along an axis, whose slopes tell the directions of the rays
TOGETHER, DARK = (
    0.5,
    0.05,
)  # of a piece's light that has one slope, and of the brightest piece
STEEPEST = 0.999


@dataclass(frozen=True, eq=False, slots=True)
class FieldPlaneWaves:
    """Plane waves of one field angle at the design wavelength.

    amplitude: (y, x) complex128, √T A. p_x, p_y: (x,), (y,) n sin θ along each axis.
    spacing: (x, y) of them.
    light: what leaves the pillars and passes the faces, on the scale of Σ |amplitude|²;
    passed_um2: the same for unit
        irradiance on the lens. aperture: half the width (x, y) of the directions of the
        rim's rays, the NA on axis.
    after: media behind the pillars, at the lens's own sensor.
    """

    amplitude: Array
    p_x: Array
    p_y: Array
    spacing: tuple[float, float]
    light: float
    passed_um2: float
    aperture: tuple[float, float]
    wavelength_um: float
    after: Media

    @property
    def held(self) -> float:
        """Share of the light that these waves are."""
        return float((np.abs(self.amplitude) ** 2).sum()) / self.light

    def at(self, distance_um: float, like: Array | None = None) -> Array:
        """The waves at a distance behind the pillars, the films kept; or ``like`` (y,
        x) moved so much farther.
        """
        cover = self.after.index[0]
        films = list(
            zip(self.after.index[1:], self.after.thickness_um[1:], strict=True)
        )
        gap = distance_um - (sum(t for _, t in films) if like is None else 0.0)
        w = self.p_x**2 + self.p_y[:, None] ** 2
        pairs = [(cover, gap), *(films if like is None else [])]
        way = sum(t * np.sqrt(np.maximum(n * n - w, 0.0)) for n, t in pairs if t)
        return np.asarray(
            (self.amplitude if like is None else like)
            * np.exp(2j * np.pi / self.wavelength_um * way)
        )


def plane_waves_of_source(
    lens: Lens, angle_rad: tuple[float, float], depth_um: float
) -> FieldPlaneWaves:
    """Plane waves of a source's light at the design wavelength.

    Args:
        angle_rad, depth_um: of the source, as in :func:`metalens.psf.psf_stack`.

    Raises:
        DomainError: an angle outside the lens's library; PropagationError: films
            thicker than their gap, a source
            behind the stop.
    """
    wave, d = lens.wavelength_um, lens.diameters
    after = lens.layers.after(lens.sensor_distance_um, wave)
    light_rows = _lighting(lens, angle_rad, depth_um)
    low, high = _directions(lens, light_rows)
    found = []
    for n, step, ends in zip(
        d.diameter_um.shape[::-1], d.steps_um, zip(low, high, strict=True), strict=True
    ):
        centre, wide = (ends[0] + ends[1]) / 2, (ends[1] - ends[0]) / 2
        least = max(
            ROOM * n * step, min(AIRY * wave / max(wide, 1e-9), MOST_ROOM * n * step)
        )
        count = scipy.fft.next_fast_len(math.ceil(least / step))
        spacing = wave / (count * step)
        reach = min(
            math.ceil(BAND * wide / spacing + FRINGES * count / n), (count - 1) // 2
        )
        found.append(
            (count, spacing, round(centre / spacing) + np.arange(-reach, reach + 1))
        )
    (nx, dx, at_x), (ny, dy, at_y) = found
    rows, power = _rows(light_rows, d.diameter_um.shape[0], nx, at_x % nx)
    amplitude = scipy.fft.fft(rows, ny, axis=0)[at_y % ny]
    p_x, p_y = at_x * dx, at_y * dy
    w = p_x**2 + p_y[:, None] ** 2
    goes = w < (STEEPEST * min(after.order)) ** 2
    amplitude = amplitude * np.sqrt(
        np.where(goes, media.passed_at(after.order, np.where(goes, w, 0.0)), 0.0)
    )
    faces = float(
        media.passed_at(
            after.order, min(float(((low + high) ** 2).sum()) / 4, STEEPEST**2)
        )
    )
    light = nx * ny * power * faces, d.site_um2 * power * faces
    aperture = float(high[0] - low[0]) / 2, float(high[1] - low[1]) / 2
    return FieldPlaneWaves(amplitude, p_x, p_y, (dx, dy), *light, aperture, wave, after)


def _lighting(
    lens: Lens, angle_rad: tuple[float, float], depth_um: float
) -> Callable[[Array], Array]:
    """(rows, x) complex light behind the pillars of some rows of the map, as a function
    of their numbers.
    """
    d = lens.diameters
    wave = lens.wavelength_um
    tangents = (math.tan(angle_rad[0]), math.tan(angle_rad[1]))
    nodes = SpectralNodes(np.array([wave]), np.ones(1), 0.0)
    (phase, level), _ = all_maps(lens, nodes, angle_rad, torch.float64, scalar=True)
    case = propagate.make_case(
        d.diameter_um.shape, **d.grid._asdict(), wavelength_um=wave, sensor_distance_um=lens.sensor_distance_um,
        depths_um=depth_um, angle_rad=angle_rad, window_um=1.0, samples=1, layers=lens.layers.open,
    )  # fmt: skip
    k, width, y = 2 * np.pi / wave, math.sqrt(d.site_um2), d.y_um

    def light(rows: Array) -> Array:
        places = d.x_um[None, :], y[rows, None]
        way = paths.from_source(
            case, *places, case.tangents, case.inverse_depths_per_um[0]
        )
        field = level[0].numpy()[rows] * np.exp(1j * (phase[0].numpy()[rows] + k * way))
        return np.asarray(
            field * lens.layers.shadow(tangents, depth_um, wave, places, width)
        )

    return light


def _directions(
    lens: Lens, light_rows: Callable[[Array], Array]
) -> tuple[Array, Array]:
    """Least and largest n sin θ along x and y behind the pillars, (2,) each: slopes of
    the phase over short pieces of
    some rows; pieces where pillars do not go together, and those in the dark, are
    passed over."""
    d, hop = lens.diameters, 2 if lens.diameters.lattice.centred else 1
    ny, nx = d.diameter_um.shape
    rows = np.unique(np.linspace(0, max(ny - 1 - hop, 0), PIECES).astype(int))
    near = light_rows(rows)
    far = light_rows(np.minimum(rows + hop, ny - 1))
    first = np.arange(0, nx, max(1, nx // PIECES))
    low, high = np.zeros(2), np.zeros(2)
    next_x = np.concatenate([near[:, hop:], np.zeros((len(rows), hop))], axis=1)
    for axis, other in enumerate((next_x, far)):
        product = other * near.conj()
        total = np.add.reduceat(product, first, axis=1)
        power = np.add.reduceat(np.abs(product), first, axis=1)
        kept = (np.abs(total) > TOGETHER * power) & (power > DARK * power.max())
        slope = (
            np.angle(total[kept])
            * lens.wavelength_um
            / (2 * np.pi * hop * d.steps_um[axis])
        )
        low[axis], high[axis] = (
            (slope.min(), slope.max()) if slope.size else (-STEEPEST, STEEPEST)
        )
    return low, high


def _rows(
    light_rows: Callable[[Array], Array], ny: int, count: int, kept: Array
) -> tuple[Array, float]:
    """(y, kept) transforms of the rows of the light behind the pillars, and Σ |light|²
    over the map.
    """
    out, power = np.empty((ny, len(kept)), complex), 0.0
    for start in range(0, ny, ROWS):
        rows = np.arange(start, min(start + ROWS, ny))
        light = light_rows(rows)
        power += float((np.abs(light) ** 2).sum())
        out[rows] = scipy.fft.fft(light, count, axis=1)[:, kept]
    return out, power


def line_image(waves: FieldPlaneWaves, field: Array, axis: int) -> tuple[Array, float]:
    """Line image along x (0) or y (1) of waves on a plane (:meth:`Waves.at`), of sum 1
    where all light is in it, and
    the step of its samples in um; it repeats beyond its ends.

    Args:
        field: sampled field or PSFs.
        axis: 0: lines along y; 1: along x.
    """
    along = field if axis == 0 else field.T
    count = scipy.fft.next_fast_len(2 * along.shape[1])
    line = (np.abs(scipy.fft.ifft(along, count, axis=1)) ** 2).sum(0) * (
        count / waves.light
    )
    return np.asarray(line), waves.wavelength_um / (count * waves.spacing[axis])


def sharpness_per_um(waves: FieldPlaneWaves, field: Array, axis: int) -> float:
    """∫ L² over (∫ L)² of the line image along an axis: one over how wide it is; a bar
    of width b gives 1 / b.

    Args:
        waves: plane waves behind the lens.
        field: sampled field or PSFs.
    """
    line, step = line_image(waves, field, axis)
    return float((line**2).sum() / line.sum() ** 2 / step)


def line_mtf(
    waves: FieldPlaneWaves, field: Array, axis: int, frequencies_per_um: Array
) -> Array:
    """(frequencies,) modulation transfer along an axis, of all light through the lens:
    its value just above frequency 0
    is :attr:`Waves.held`.

    Args:
        waves: plane waves behind the lens.
        field: sampled field or PSFs.
        frequencies_per_um: spatial frequencies, cycles per um.
    """
    line, step = line_image(waves, field, axis)
    shifted = np.roll(line, len(line) // 2 - int(np.argmax(line)))
    x = (np.arange(len(line)) - len(line) // 2) * step
    return np.asarray(
        np.abs(np.exp(-2j * np.pi * np.outer(frequencies_per_um, x)) @ shifted)
    )
