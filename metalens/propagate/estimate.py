"""Posterior error of PSFs: direct sums over lens nodes at sampled points of the window.

The nodes are finer than those the method uses. Rounding at the pillars and the
interpolation inside their blocks is added as noise of the pillars.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import uniform_filter

from metalens.core import legendre
from metalens.core.arrays import Array
from metalens.propagate.direct import add_point_waves, point_wave
from metalens.propagate.geometry import PropagationCase
from metalens.propagate.moments import Pupils
from metalens.propagate.paths import rayleigh_sommerfeld_kernel, to_sensor
from metalens.propagate.window import depth_factors

# least number of points, and pixels to a point in a large window
POINTS, EVERY = 128, 32
FEWEST, WORK = 48, 5e6  # least number of points where nodes times points exceed WORK
DEPTHS = 8  # largest number of depths that are sampled
SAFETY = 1.7  # on the root of a sum over sampled points
SCATTER = 1.5  # in addition, where fewer than a quarter of the pixels are sampled
NEAR = 9  # pixels along a side of the neighbourhood of a pixel
RAYS = 12  # points at which a polarisation mixing of their own is formed
FACTORS = 12  # nodes along an axis of the lens on which it is formed


@dataclass(frozen=True, eq=False, slots=True)
class NodeLight:
    """Light of one wavelength on nodes of the lens, without its carrier.

    case: geometry of the window. weight: of the wavelength.
    light: (map, e, x) complex amplitudes. nodes_um: (e,), (x,) positions.
    noise: standard deviation of the field by rounding and interpolation at the pillars.
    parts: tiles along each axis of the window.
    pupils: (component,) signs and (component, map, e, x) factors on the light, whose
    squares add up; None for the light of one map.
    """

    case: PropagationCase
    weight: float
    light: Array
    nodes_um: tuple[Array, Array]
    noise: float
    parts: int = 1
    pupils: tuple[Array, Array] | None = None

    @property
    def components(self) -> tuple[Array, Array]:
        """(component,) signs and (component, e, x) light."""
        if self.pupils is None:
            return np.ones(1), self.light
        signs, factors = self.pupils
        return signs, np.einsum("cmyx,myx->cyx", factors, self.light)


def relative_error(windows: list[list[NodeLight]], intensity: list[Array]) -> float:
    """Estimate of the relative L2 error of PSFs of sum 1, all depths together.

    Args:
        windows: parts of one window that were computed separately; each a list of
            wavelengths.
        intensity: (depth, y, x) of each part, wavelengths added.

    Accuracy: 1 to 3 times the true error. An error confined to pixels that hold less
    than 1 / 128 of the light and of its root can be missed.
    """
    nodes = max(part[0].light[0].size for part in windows)
    pixels = sum(math.prod(part[0].case.samples) for part in windows)
    count = min(max(POINTS, pixels // EVERY), max(FEWEST, int(WORK / nodes)))
    is_limited = count * nodes > WORK / 2
    light, energy, depths, points, chance = _sample(
        windows, intensity, count, DEPTHS // 2 if is_limited else DEPTHS
    )
    direct = np.zeros((len(depths), len(points)))
    for part, in_part, (row, column) in _by_part(windows, points):
        for wavelength_light in part:
            signs, components = wavelength_light.components
            field = _direct_fields(wavelength_light, components, depths, row, column)
            direct[:, in_part] += wavelength_light.weight * np.einsum(
                "c,czp->zp", signs, np.abs(field) ** 2
            )
    difference = direct / energy[:, None] - light[:, points]
    noise = sum(
        2 * abs(first.weight) * first.noise**2 * (1 / energy).sum()
        for first in windows[0]
    )
    total = sampled_square_error(light[:, points], chance, difference) + float(noise)
    return _relative_root(total, light, len(points))


def pupil_error(
    windows: list[list[NodeLight]],
    intensity: list[Array],
    pupils: Callable[[PropagationCase], Pupils],
) -> float:
    """Estimate of the relative L2 error of using one polarisation mixing, that of the
    window's middle, for all points.

    Args:
        windows, intensity: as :func:`relative_error`; light without ``pupils`` counts
            as |U|².
        pupils: mixing for the middle of a case's window.

    Accuracy: 1 to 2 times the true difference.
    """
    light, energy, depths, points, chance = _sample(windows, intensity, RAYS, 2)
    changed = np.zeros((len(depths), len(points)))
    for part, in_part, pixels in _by_part(windows, points):
        for i, row, column in zip(np.flatnonzero(in_part), *pixels, strict=True):
            for wavelength_light in part:
                changed[:, i] += wavelength_light.weight * _own_mixing(
                    wavelength_light, depths, (row, column), pupils
                )
    total = sampled_square_error(light[:, points], chance, changed / energy[:, None])
    return _relative_root(total, light, len(points))


def _relative_root(total: float, light: Array, count: int) -> float:
    """Root of a sampled square error over that of ``light`` (depth, pixel), with the
    safety factor of ``count`` points."""
    safety = SAFETY if 4 * count >= light.shape[1] else SCATTER * SAFETY
    return safety * math.sqrt(total / float((light**2).sum()))


def sampled_square_error(light: Array, chance: Array, difference: Array) -> float:
    """Σ (δ/S - (I/S) Σδ/S)² over depths and pixels, from sampled pixels.

    Args:
        light, difference: (depth, point) I/S and δ/S of an intensity I of sum S.
        chance: (point,) or (depth, point) mean number of draws of a pixel.
    """
    gain = (difference / chance).sum(-1, keepdims=True)
    return float(((difference - light * gain) ** 2 / chance).sum())


def draw_pixels(
    light: Array, count: int, others: Sequence[Array] = ()
) -> tuple[Array, Array]:
    """Systematic sample of (n,) pixels, and the mean number of draws of each.

    The chance goes in equal shares by the light and by other densities, its root by
    default. All pixels are taken where ``count`` is not below their number.

    Args:
        light: (pixel,) of sum 1. count: of pixels to draw.
        others: (pixel,) densities of any sum.
    """
    if len(light) <= count:
        return np.arange(len(light)), np.ones(len(light))
    shares = [light, *(others or (np.sqrt(light),))]
    density = np.sum([share / share.sum() for share in shares], axis=0) / len(shares)
    total = np.cumsum(density)
    picks = (np.arange(count) + 0.5) / count
    points = np.searchsorted(total / total[-1], picks)
    return points, count * density[points]


def _sample(
    windows: list[list[NodeLight]], intensity: list[Array], count: int, most_depths: int
) -> tuple[Array, Array, Array, Array, Array]:
    """Sample of depths and pixels at which the PSFs are computed directly.

    Pixels are drawn by the light, by its root (more at the ends of tiles), and by the
    smoothed light.

    Args:
        windows, intensity: as :func:`relative_error`.
        count: of pixels. most_depths: largest number of depths.

    Returns:
        (depth, pixel) light of sum 1, (depth,) sums, indices of depths, and sampled
        pixels with their chances.
    """
    depth_count = len(intensity[0])
    depths = (
        np.linspace(0, depth_count - 1, min(depth_count, most_depths))
        .round()
        .astype(int)
    )
    parts = [part.reshape(depth_count, -1)[depths] for part in intensity]
    light = np.concatenate(parts, axis=1, dtype=float)
    energy = light.sum(1)
    light /= energy[:, None]
    mean = np.maximum(light.mean(0), 0.0)  # a flux may run back where it is dark
    edges, smoothed, first = [], [], 0
    for part in windows:
        rows, columns = part[0].case.samples
        part_mean = mean[first : first + rows * columns].reshape(rows, columns)
        smoothed.append(uniform_filter(part_mean, NEAR).ravel())
        y, x = (_tile_position(n, part[0].parts) for n in part_mean.shape)
        edges.append((1 + 9 * np.maximum(np.abs(x), np.abs(y)[:, None]) ** 8).ravel())
        first += rows * columns
    others = np.sqrt(mean) * np.concatenate(edges), np.concatenate(smoothed)
    points, chance = draw_pixels(mean, count, others)
    return light, energy, depths, points, chance


def _tile_position(count: int, parts: int) -> Array:
    """(count,) positions of pixels within their tile, -1 to 1: truncated series err
    most at its ends."""
    if count == 1:
        return np.zeros(1)
    place = (np.arange(count) + 0.5) / count * min(parts, count)
    return np.asarray(2 * (place % 1) - 1)


def _by_part(
    windows: list[list[NodeLight]], points: Array
) -> list[tuple[list[NodeLight], Array, tuple[Array, Array]]]:
    """For each part: its light, a mask of the points in it, and their (row, column).

    Args:
        windows: parts, each a list of wavelengths.
        points: (point,) pixel numbers, counted through all parts.
    """
    parts, first = [], 0
    for part in windows:
        rows, columns = part[0].case.samples
        in_part = (points >= first) & (points < first + rows * columns)
        row, column = np.divmod(points[in_part] - first, columns)
        parts.append((part, in_part, (row, column)))
        first += rows * columns
    return parts


def _direct_fields(
    node_light: NodeLight, components: Array, depths: Array, row: Array, column: Array
) -> Array:
    """(component, depth, point) fields at window pixels, summed over lens nodes.

    Args:
        node_light: light of one wavelength on the nodes, with its geometry.
        components: (component, e, x) complex light.
        depths: indices. row, column: (point,) pixels of the window.
    """
    case = node_light.case
    e, x = node_light.nodes_um
    inverse = np.array(case.inverse_depths_per_um)[depths, None, None]
    phase_rad = depth_factors(case, e[:, None], x, case.tangents, inverse)
    phase_rad = phase_rad - case.wavenumber * np.asarray(to_sensor(case, x, e[:, None]))
    light = components[:, None] * np.exp(1j * phase_rad)
    wy, wx = case.window_um
    points = np.stack([wx[column], wy[row]], -1) + np.array(case.centre_um)
    fields = np.zeros((len(components) * len(depths), len(points)), complex)
    wave = point_wave(case, points)
    add_point_waves(light.reshape(-1, len(e), len(x)), (e, x), points, wave, fields)
    return (fields * case.area_um2).reshape(len(components), len(depths), -1)


def _own_mixing(
    node_light: NodeLight,
    depths: Array,
    pixel: tuple[int, int],
    pupils: Callable[[PropagationCase], Pupils],
) -> Array:
    """(depth,) intensity of a pixel with its own polarisation mixing, less that with
    the window's.

    The mixing is smooth over the lens. It is formed on few nodes, to which the waves of
    the fine nodes are interpolated.

    Args:
        node_light: light of one wavelength on the nodes.
        depths: indices. pixel: (row, column) of the window.
        pupils: mixing for the middle of a case's window.
    """
    case = node_light.case
    e, x = node_light.nodes_um
    Y, X = (
        float(positions[index])
        for positions, index in zip(case.window_um, pixel, strict=True)
    )
    inverse = np.array(case.inverse_depths_per_um)[depths, None, None]
    kernel = rayleigh_sommerfeld_kernel(case, x, e[:, None], X, Y, inverse)
    few_e, weights_e = _fewer_nodes(e)
    few_x, weights_x = _fewer_nodes(x)
    waves = weights_e @ (node_light.light[:, None] * kernel) @ weights_x.T

    def intensity(centre: PropagationCase) -> Array:
        signs, factors = pupils(centre)(few_e, few_x)
        return np.asarray(
            signs @ np.abs(np.einsum("cmyx,mzyx->cz", factors, waves)) ** 2
        )

    centred = replace(case, centre_um=(case.centre_um[0] + X, case.centre_um[1] + Y))
    scalar = node_light.pupils is None
    applied = np.abs(waves[0].sum((-1, -2))) ** 2 if scalar else intensity(case)
    return (intensity(centred) - applied) * case.area_um2**2


def _fewer_nodes(places_um: Array) -> tuple[Array, Array]:
    """(n,) few nodes over places of the lens, and (n, place) interpolation weights."""
    low, high = float(places_um.min()), float(places_um.max())
    if len(places_um) <= FACTORS or not high > low:
        return places_um, np.eye(len(places_um))
    relative = (2 * places_um - low - high) / (high - low)
    nodes = legendre.mapped_nodes(FACTORS, low, high)
    return np.asarray(nodes), legendre.interpolation_matrix(FACTORS, relative).T
