"""Light of other diffraction orders of the zones: each a blurred disc on the sensor,
weak and wide.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from metalens.core.arrays import Array
from metalens.image.low_rank import fast_shape
from metalens.image.plan import Grid
from metalens.image.points import Optics
from metalens.image.scene import DeviceRecord
from metalens.image.waves import PillarWave

ORDERS = (-1, 0, 2, 3)


@dataclass(frozen=True, eq=False, slots=True)
class StrayLight(DeviceRecord):
    """Discs of other orders about every source.

    shares: of the light on the aperture in each order.
    transfers: (discs, Y, X // 2 + 1) their transforms, weighted by the shares, of size
        ``shape``.
    rows, columns: (discs, n, n) matrices that put light where each disc lies; None
        where discs lie about the sources' own places.
    illumination: (y, x) of the frame, cos⁴ of the field angle, times what the lens
        takes in of the light of the stop.
    """

    shares: dict[int, float]
    transfers: Tensor
    shape: tuple[int, int]
    illumination: Tensor
    rows: Tensor | None = None
    columns: Tensor | None = None


class _Footprint(NamedTuple):
    """The part of the lens that sources illuminate: its radius; its middle (rows,
    columns), um, for every row and column of the frame, None where that is the lens's;
    illumination as in :class:`StrayLight`.
    """

    radius_um: float
    middle_um: tuple[Array, Array] | None
    illumination: Tensor


def stray_of(
    optics: Optics, grid: Grid, depth_um: float, middle_um: tuple[float, float]
) -> StrayLight | None:
    """Stray light of the diffraction orders that do not focus; None for a smooth phase.

    Order m spreads over a disc on the sensor: the image of the aperture times
    1 + d/z - m (1 + d/s), with d the sensor distance, z the source's depth and s the
    design's.

    Args:
        optics: wave of the lens, layers and lens-sensor distance.
        grid: samples, step, depths and margin of the image.
        depth_um: source depth from the lens, um.
        middle_um: (x, y) field point in the middle, um on the sensor.
    """
    wave = optics.wave
    if not isinstance(wave, PillarWave):
        return None
    focus = wave.focus
    frame = grid.frame
    d = optics.layers.after(optics.distance_um, focus.wavelength_um).reduced_um
    depth, source = (
        optics.layers.before(z, focus.wavelength_um).reduced_um
        for z in (depth_um, focus.source_distance_um)
    )
    shares = wave.orders(focus.wavelength_um, ORDERS)
    shape = fast_shape((2 * frame[0], 2 * frame[1]))
    if optics.layers.stop is None:
        footprint = _whole_lens(wave.radius_um, grid, d, middle_um)
    else:
        footprint = _behind_stop(optics, grid, depth_um, middle_um)
    transfers, scales = [], []
    for m, share in shares.items():
        scales.append(1 + d / depth - m * (1 + d / source))
        radius = max(footprint.radius_um * abs(scales[-1]), grid.step_um)
        disc = torch.from_numpy(share * _disc(radius, grid.step_um, shape)).float()
        transfers.append(torch.fft.rfft2(disc))
    discs = torch.stack(transfers)
    if footprint.middle_um is None:
        discs = discs.sum(0, keepdim=True)
        return StrayLight(shares, discs, shape, footprint.illumination)
    rows, columns = (
        torch.stack([_shift_matrix(place * scale / grid.step_um) for scale in scales])
        for place in footprint.middle_um
    )
    return StrayLight(shares, discs, shape, footprint.illumination, rows, columns)


def _disc(radius_um: float, step_um: float, shape: tuple[int, int]) -> Array:
    """(y, x) uniform disc of sum 1 about the first sample, wrapped around.

    The edge is a linear ramp of one step. The sum is 1 for radii above a step.
    """
    y, x = (np.fft.fftfreq(n) * n * step_um for n in shape)
    inside = np.clip((radius_um - np.hypot(y[:, None], x)) / step_um + 0.5, 0, 1)
    return np.asarray(inside * step_um**2 / (math.pi * radius_um**2))


def _shift_matrix(samples: Array) -> Tensor:
    """(n, n) matrix that moves the light of each sample, by linear interpolation.

    Args:
        samples: (n,) distance of each move, in samples.
    """
    place = np.arange(len(samples))
    distance = np.abs(place[:, None] - (place + samples))
    return torch.from_numpy(np.clip(1 - distance, 0, 1)).float()


def _whole_lens(
    radius_um: float, grid: Grid, reduced_um: float, middle_um: tuple[float, float]
) -> _Footprint:
    """Footprint of a lens without a stop: the whole aperture, and cos⁴ of the angle.

    Args:
        reduced_um: lens-sensor distance, Σ t/n.
        middle_um: (x, y) field point in the middle.
    """
    rows, columns = ((np.arange(n) - (n - 1) / 2) * grid.step_um for n in grid.frame)
    away2 = (rows[:, None] + middle_um[1]) ** 2 + (columns + middle_um[0]) ** 2
    cosine4 = torch.from_numpy(1 / (1 + away2 / reduced_um**2) ** 2).float()
    return _Footprint(radius_um, None, cosine4)


def _behind_stop(
    optics: Optics, grid: Grid, depth_um: float, middle_um: tuple[float, float]
) -> _Footprint:
    """Footprint on the lens of light through the stop, over the field.

    Light through the stop is summed on 64 x 64 places of the lens for 17 x 17
    directions, and interpolated to the samples of the frame.

    Args:
        middle_um: (x, y) field point in the middle.
    """
    layers = optics.layers
    wave = optics.wave
    count = 17
    wavelength_um = wave.focus.wavelength_um  # type: ignore[attr-defined]
    reduced = layers.after(optics.distance_um, wavelength_um).reduced_um
    slopes = [
        (m + np.linspace(-h, h, count)) / reduced
        for m, h in zip(middle_um[::-1], grid.half_um, strict=True)
    ]
    tangents = np.stack(np.meshgrid(*slopes[::-1]), -1)
    cell = wave.radius_um / 32
    place = (np.arange(64) - 31.5) * cell
    x, y = np.meshgrid(place, place)
    inside = np.hypot(x, y) <= wave.radius_um
    shares = [
        layers.stop_share((a, b), depth_um, wavelength_um, (x, y), cell) * inside
        for a, b in tangents.reshape(-1, 2).tolist()
    ]
    light = np.stack(shares).reshape(count, count, -1)
    area = light.sum(-1) * cell**2
    middles = (
        _light_centroids(light[:, count // 2], y, grid.frame[0]),
        _light_centroids(light[count // 2], x, grid.frame[1]),
    )
    slope2 = (layers.through_middle(tangents, depth_um, wavelength_um) ** 2).sum(-1)
    stop_area = math.pi * layers.footprint_um(depth_um, wavelength_um) ** 2
    throughput = torch.from_numpy(area / stop_area / (1 + slope2) ** 2)[None, None]
    illumination = torch.nn.functional.interpolate(
        throughput, size=grid.frame, mode="bilinear", align_corners=True
    )
    return _Footprint(
        math.sqrt(area.max() / math.pi), middles, illumination[0, 0].float()
    )


def _light_centroids(light: Array, place_um: Array, count: int) -> Array:
    """(count,) centroid of the light on the lens, um, over directions at equal steps.

    Dark directions are interpolated from the others; 0 where all are dark.

    Args:
        light: (n, places) light of n directions.
        place_um: coordinate of the places.
        count: directions of the result.
    """
    total = light.sum(-1)
    bright = np.flatnonzero(total > 0)
    if not len(bright):
        return np.zeros(count)
    centroids = light[bright] @ place_um.ravel() / total[bright]
    directions = np.linspace(0, len(light) - 1, count)
    return np.asarray(np.interp(directions, bright, centroids))


def add_stray(image: Tensor, light: Tensor, stray: StrayLight, grid: Grid) -> Tensor:
    """(frames, y, x) image plus the discs of stray light of all sources.

    Args:
        image: (frames, y, x) on the samples of the grid.
        light: (frames, y, x) radiance of all sheets, on the whole frame.
        stray: discs of the orders.
        grid: samples, step, depths and margin of the image.
    """
    light = light * stray.illumination.to(light)
    parts = light[:, None]
    if stray.rows is not None and stray.columns is not None:
        parts = stray.rows @ parts @ stray.columns.mT
    spectrum = (torch.fft.rfft2(parts, s=stray.shape) * stray.transfers).sum(1)
    return image + grid.crop(torch.fft.irfft2(spectrum, s=stray.shape))
