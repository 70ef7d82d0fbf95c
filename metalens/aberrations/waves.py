"""The plane waves of the light behind a lens, and transfer functions at any distance
from them.
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

BAND = 1.05  # half width of the computed directions over that of the rays
FRINGES = 14  # diffraction fringes of the aperture on either side of that band
ROOM = 1.05  # least period of the field over the width of the map
MOST_ROOM = 8.0  # largest such period
AIRY = 80.0  # period of the field in wavelength / NA, within these two bounds
ROWS = 256  # of the map at a time
PIECES = 48  # of the map along an axis, whose phase slopes are ray directions
TOGETHER = 0.5  # least coherence |sum| / sum|.| of a piece with one slope
DARK = 0.05  # least power of a piece over the brightest piece
STEEPEST = 0.999  # largest sine over the index


@dataclass(frozen=True, eq=False, slots=True)
class FieldPlaneWaves:
    """Plane waves of one field angle behind a lens at the design wavelength.

    amplitude: (y, x) complex128, √T A.
    p_x, p_y: (x,), (y,) n sin θ along each axis.
    spacing: (x, y) steps of them.
    light: power behind the pillars that passes the faces, on the scale of Σ
        |amplitude|².
    passed_um2: the same power for unit irradiance on the lens.
    wavelength_um: vacuum wavelength.
    after: media behind the pillars, at the lens's own sensor.
    """

    amplitude: Array
    p_x: Array
    p_y: Array
    spacing: tuple[float, float]
    light: float
    passed_um2: float
    wavelength_um: float
    after: Media

    @property
    def held(self) -> float:
        """Share of the light that these waves are."""
        return float((np.abs(self.amplitude) ** 2).sum()) / self.light

    def at(self, distance_um: float) -> Array:
        """Plane-wave amplitudes (y, x) at a distance behind the pillars.

        amplitude exp(i k sum_layers t sqrt(n² - p_x² - p_y²)), films as they are and
        the gap before them changed.

        Args:
            distance_um: from the pillars.
        """
        cover, *films = zip(self.after.index, self.after.thickness_um, strict=True)
        pairs = [(cover[0], distance_um - sum(t for _, t in films)), *films]
        p_square = self.p_x**2 + self.p_y[:, None] ** 2
        path = sum(
            t * np.sqrt(np.maximum(n * n - p_square, 0.0)) for n, t in pairs if t
        )
        turns = path / self.wavelength_um
        return np.asarray(self.amplitude * np.exp(2j * np.pi * turns))


def plane_waves_of_source(
    lens: Lens, angle_rad: tuple[float, float], depth_um: float
) -> FieldPlaneWaves:
    """Plane waves behind the pillars of a source's light at the design wavelength.

    The field at the pillars is transformed to n sin θ in the band of the rays'
    directions, with margins for diffraction. Amplitudes include the transmission of the
    faces.

    Args:
        lens: the lens.
        angle_rad: field angles along x and y, as in :func:`metalens.psf.psf_stack`.
        depth_um: source depth from the lens, um.

    Raises:
        DomainError: an angle outside the lens's library.
        PropagationError: films thicker than their gap, a source behind the stop.
    """
    wave = lens.wavelength_um
    d = lens.diameters
    after = lens.layers.after(lens.sensor_distance_um, wave)
    light_rows = _field_at_pillars(lens, angle_rad, depth_um)
    low, high = _directions(lens, light_rows)
    grids = []  # along x and y: length of the transform, step of p, indices of p
    for n, step, least_p, largest_p in zip(
        d.diameter_um.shape[::-1], d.steps_um, low, high, strict=True
    ):
        centre = (least_p + largest_p) / 2
        half = (largest_p - least_p) / 2
        period = max(
            ROOM * n * step, min(AIRY * wave / max(half, 1e-9), MOST_ROOM * n * step)
        )
        count = scipy.fft.next_fast_len(math.ceil(period / step))
        spacing = wave / (count * step)
        reach = min(
            math.ceil(BAND * half / spacing + FRINGES * count / n), (count - 1) // 2
        )
        orders = round(centre / spacing) + np.arange(-reach, reach + 1)
        grids.append((count, spacing, orders))
    (nx, dx, orders_x), (ny, dy, orders_y) = grids
    rows, power = _row_transforms(light_rows, d.diameter_um.shape[0], nx, orders_x % nx)
    amplitude = scipy.fft.fft(rows, ny, axis=0)[orders_y % ny]
    p_x = orders_x * dx
    p_y = orders_y * dy
    p_square = p_x**2 + p_y[:, None] ** 2
    travels = p_square < (STEEPEST * min(after.order)) ** 2
    passed = media.passed_at(after.order, np.where(travels, p_square, 0.0))
    amplitude = amplitude * np.sqrt(np.where(travels, passed, 0.0))
    middle_square = min(float(((low + high) ** 2).sum()) / 4, STEEPEST**2)
    faces = float(media.passed_at(after.order, middle_square))
    light = nx * ny * power * faces
    passed_um2 = d.site_um2 * power * faces
    return FieldPlaneWaves(
        amplitude, p_x, p_y, (dx, dy), light, passed_um2, wave, after
    )


def _field_at_pillars(
    lens: Lens, angle_rad: tuple[float, float], depth_um: float
) -> Callable[[Array], Array]:
    """The complex field behind the pillars, as a function of row numbers to (rows, x).

    |t| exp(i (phase + k path from the source)) times the shadow of the stop.
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
    k = 2 * np.pi / wave
    width = math.sqrt(d.site_um2)
    y = d.y_um

    def light(rows: Array) -> Array:
        places = d.x_um[None, :], y[rows, None]
        path = paths.from_source(
            case, *places, case.tangents, case.inverse_depths_per_um[0]
        )
        total = phase[0].numpy()[rows] + k * path
        field = level[0].numpy()[rows] * np.exp(1j * total)
        return np.asarray(
            field * lens.layers.shadow(tangents, depth_um, wave, places, width)
        )

    return light


def _directions(
    lens: Lens, light_rows: Callable[[Array], Array]
) -> tuple[Array, Array]:
    """(2,) least and (2,) largest n sin θ along x and y behind the pillars.

    They are slopes of the phase, phase steps between neighbours averaged over short
    pieces of 48 rows. Pieces that are dark or whose pillars have no common slope are
    left out.
    """
    d = lens.diameters
    hop = 2 if d.lattice.centred else 1
    ny, nx = d.diameter_um.shape
    rows = np.unique(np.linspace(0, max(ny - 1 - hop, 0), PIECES).astype(int))
    field = light_rows(rows)
    next_y = light_rows(np.minimum(rows + hop, ny - 1))
    starts = np.arange(0, nx, max(1, nx // PIECES))
    low, high = np.zeros(2), np.zeros(2)
    next_x = np.concatenate([field[:, hop:], np.zeros((len(rows), hop))], axis=1)
    for axis, other in enumerate((next_x, next_y)):
        product = other * field.conj()
        total = np.add.reduceat(product, starts, axis=1)
        power = np.add.reduceat(np.abs(product), starts, axis=1)
        bright = (np.abs(total) > TOGETHER * power) & (power > DARK * power.max())
        step_rad = np.angle(total[bright])
        slope = step_rad * lens.wavelength_um / (2 * np.pi * hop * d.steps_um[axis])
        low[axis] = slope.min() if slope.size else -STEEPEST
        high[axis] = slope.max() if slope.size else STEEPEST
    return low, high


def _row_transforms(
    light_rows: Callable[[Array], Array], ny: int, count: int, orders: Array
) -> tuple[Array, float]:
    """(y, orders) transforms along x of the light behind the pillars, and sum |light|².

    Args:
        ny: rows of the map.
        count: length of the transforms, padded with zeros.
        orders: indices of the frequencies that are returned.
    """
    out = np.empty((ny, len(orders)), complex)
    power = 0.0
    for start in range(0, ny, ROWS):
        rows = np.arange(start, min(start + ROWS, ny))
        light = light_rows(rows)
        power += float((np.abs(light) ** 2).sum())
        out[rows] = scipy.fft.fft(light, count, axis=1)[:, orders]
    return out, power


def line_mtf(
    waves: FieldPlaneWaves, field: Array, axis: int, frequencies_per_um: Array
) -> Array:
    """(frequencies,) modulation transfer along an axis, of all light through the lens.

    |sum L exp(-2 pi i f x)| of the line image L, the light over x (0) or y (1) summed
    over the other. Just above frequency 0 it is :attr:`FieldPlaneWaves.held`.

    Args:
        waves: plane waves behind the lens.
        field: (y, x) amplitudes on the plane (:meth:`FieldPlaneWaves.at`).
        axis: 0: along x; 1: along y.
        frequencies_per_um: spatial frequencies, cycles per um.
    """
    along = field if axis == 0 else field.T
    count = scipy.fft.next_fast_len(2 * along.shape[1])
    line = (np.abs(scipy.fft.ifft(along, count, axis=1)) ** 2).sum(0)
    shifted = np.roll(line, len(line) // 2 - int(np.argmax(line)))
    step_um = waves.wavelength_um / (count * waves.spacing[axis])
    x = (np.arange(count) - count // 2) * step_um
    turns = np.outer(frequencies_per_um, x)
    return np.asarray(
        np.abs(np.exp(-2j * np.pi * turns) @ shifted) * (count / waves.light)
    )
