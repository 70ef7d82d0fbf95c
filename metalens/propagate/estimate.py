"""Posterior error of PSFs: direct sums over lens nodes at sampled points of the window.

The nodes are finer than the method's. Rounding at the pillars and the interpolation
inside their blocks is added as noise.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from metalens.core.arrays import Array
from metalens.propagate.direct import add_point_waves, point_wave
from metalens.propagate.geometry import PropagationCase
from metalens.propagate.moments import Pupils
from metalens.propagate.paths import to_sensor
from metalens.propagate.window import depth_factors

# least number of points, and pixels to a point in a large window
POINTS, EVERY = 128, 32
FEWEST, WORK = 48, 5e6  # least number of points where nodes times points exceed WORK
DEPTHS = 5  # largest number of depths that are sampled
SAFETY = 1.7  # on the root of a sum over sampled points
SCATTER = 1.5  # in addition, where fewer than a quarter of the pixels are sampled
RAYS = 32  # points at which a polarisation mixing of their own is formed


@dataclass(frozen=True, eq=False, slots=True)
class NodeLight:
    """Light of one wavelength on nodes of the lens, without its carrier.

    case: geometry of the window. weight: of the wavelength.
    light: (map, e, x) complex amplitudes. nodes_um: (e,), (x,) positions.
    noise: standard deviation of the field by rounding and interpolation at the pillars.
    pupils: (component,) signs and (component, map, e, x) factors on the light, whose
    squares add up; None for the light of one map.
    """

    case: PropagationCase
    weight: float
    light: Array
    nodes_um: tuple[Array, Array]
    noise: float
    pupils: tuple[Array, Array] | None = None


def relative_error(waves: list[NodeLight], intensity: Array) -> float:
    """Estimate of the relative L2 error of PSFs of sum 1, all depths together.

    Args:
        waves: light of every wavelength on the nodes.
        intensity: (depth, y, x), wavelengths added.

    Accuracy: 1 to 3 times the true error. An error confined to pixels that hold less
    than 1 / 128 of the light and of its root can be missed.
    """
    nodes = max(wave.light[0].size for wave in waves)
    pixels = intensity[0].size
    count = min(max(POINTS, pixels // EVERY), max(FEWEST, int(WORK / nodes)))
    light, energy, depths, points, chance = _sample(intensity, count, DEPTHS)
    direct = sum(_direct_intensity(wave, wave.pupils, depths, points) for wave in waves)
    difference = direct / energy[:, None] - light[:, points]
    noise = 2 * sum(abs(wave.weight) * wave.noise**2 for wave in waves)
    total = sampled_square_error(light[:, points], chance, difference)
    total += noise * float((1 / energy).sum())
    return _relative_root(total, light, len(points))


def pupil_error(
    waves: list[NodeLight],
    intensity: Array,
    pupils: Callable[[PropagationCase], Pupils],
) -> float:
    """Estimate of the relative L2 error of using one polarisation mixing, that of the
    window's middle, for all points.

    Args:
        waves, intensity: as :func:`relative_error`; light without ``pupils`` counts
            as |U|².
        pupils: mixing for the middle of a case's window.

    Accuracy: 1 to 2 times the true difference.
    """
    light, energy, depths, points, chance = _sample(intensity, RAYS, 2)
    changed = np.zeros((len(depths), len(points)))
    for wave in waves:
        y, x = wave.case.window_um
        for i, (row, column) in enumerate(zip(*np.divmod(points, len(x)), strict=True)):
            centre = wave.case.centre_um + np.array([x[column], y[row]])
            here = replace(wave.case, centre_um=tuple(centre.tolist()))
            own, applied = (
                _direct_intensity(wave, factors, depths, points[i : i + 1])
                for factors in (pupils(here)(*wave.nodes_um), wave.pupils)
            )
            changed[:, i] += (own - applied)[:, 0]
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


def draw_pixels(light: Array, count: int) -> tuple[Array, Array]:
    """Systematic sample of (n,) pixels, and the mean number of draws of each.

    The chance goes in equal shares by the light and by its root. All pixels are taken
    where ``count`` is not below their number.

    Args:
        light: (pixel,) of sum 1. count: of pixels to draw.
    """
    if len(light) <= count:
        return np.arange(len(light)), np.ones(len(light))
    root = np.sqrt(light)
    density = (light / light.sum() + root / root.sum()) / 2
    total = np.cumsum(density)
    picks = (np.arange(count) + 0.5) / count
    points = np.searchsorted(total / total[-1], picks)
    return points, count * density[points]


def _sample(
    intensity: Array, count: int, most_depths: int
) -> tuple[Array, Array, Array, Array, Array]:
    """Sample of depths and pixels at which the PSFs are computed directly.

    Args:
        intensity: (depth, y, x).
        count: of pixels. most_depths: largest number of depths.

    Returns:
        (depth, pixel) light of sum 1, (depth,) sums, indices of depths, and sampled
        pixels with their chances.
    """
    last = len(intensity) - 1
    depths = np.linspace(0, last, min(last + 1, most_depths)).round().astype(int)
    light = intensity[depths].astype(float)
    energy = light.sum((1, 2))
    light /= energy[:, None, None]
    light = light.reshape(len(light), -1)
    mean = np.maximum(light.mean(0), 0.0)  # a flux may run back where it is dark
    return light, energy, depths, *draw_pixels(mean, count)


def _direct_intensity(
    wave: NodeLight, pupils: tuple[Array, Array] | None, depths: Array, points: Array
) -> Array:
    """(depth, point) weighted intensity of pixels, Σ sign |U|² by sums over lens nodes.

    Args:
        wave: light of one wavelength on the nodes, with its geometry.
        pupils: (component,) signs and (component, map, e, x) factors; None for |U|².
        depths: indices. points: (point,) pixel numbers of the window.
    """
    case = wave.case
    e, x = wave.nodes_um
    signs, components = np.ones(1), wave.light
    if pupils is not None:
        signs, components = pupils[0], np.einsum("cmyx,myx->cyx", pupils[1], wave.light)
    inverse = np.array(case.inverse_depths_per_um)[depths, None, None]
    phase_rad = depth_factors(case, e[:, None], x, case.tangents, inverse)
    phase_rad = phase_rad - case.wavenumber * np.asarray(to_sensor(case, x, e[:, None]))
    light = components[:, None] * np.exp(1j * phase_rad)
    wy, wx = case.window_um
    row, column = np.divmod(points, len(wx))
    places = np.stack([wx[column], wy[row]], -1) + np.array(case.centre_um)
    fields = np.zeros((*light.shape[:2], len(places)), complex)
    sources = light.reshape(-1, *light.shape[2:])
    targets = fields.reshape(len(sources), -1)  # shares their memory
    add_point_waves(sources, (e, x), places, point_wave(case, places), targets)
    power = np.abs(fields * case.area_um2) ** 2
    return np.asarray(wave.weight * np.tensordot(signs, power, 1))
