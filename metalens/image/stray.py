"""Light of other diffraction orders of the zones: each a blurred disc on the sensor,
weak and wide.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy.fft
import torch
from torch import Tensor

from metalens.core.arrays import Array
from metalens.image.plan import Grid
from metalens.image.points import Optics
from metalens.image.waves import PillarWave

ORDERS = (-1, 0, 2, 3)


@dataclass(frozen=True, eq=False, slots=True)
class Stray:
    """Discs of other orders about every source.

    shares: of the light on the aperture in each order.
    transfers: (discs, Y, X // 2 + 1) their transforms, weighted by the shares, of size
        ``shape``.
    moves: of each disc matrices (rows, columns) that put light where its disc lies;
        empty where discs lie about the sources' own places.
    illumination: (y, x) of the frame, cos⁴ of the field angle, times what the lens
        takes in of the light of the stop.
    """

    shares: dict[int, float]
    transfers: Tensor
    moves: list[tuple[Tensor, Tensor]]
    shape: tuple[int, int]
    illumination: Tensor

    def to(self, device: torch.device | str) -> "Stray":
        """The same on a device."""
        moves = [(rows.to(device), columns.to(device)) for rows, columns in self.moves]
        return replace(
            self,
            transfers=self.transfers.to(device),
            moves=moves,
            illumination=self.illumination.to(device),
        )


class _Footprint(NamedTuple):
    """The part of the lens that sources illuminate: its radius; its middle (rows,
    columns), um, for every row and column of the frame, None where that is the lens's;
    illumination as in :class:`Stray`.
    """

    radius_um: float
    middle_um: tuple[Array, Array] | None
    illumination: Tensor


def stray_of(
    optics: Optics, grid: Grid, depth_um: float, middle_um: tuple[float, float]
) -> Stray | None:
    """Discs of the orders beside the image; None for a smooth phase, which has one
    order alone.

    Args:
        optics: lens, light and distances at the nodes.
        grid: samples, step, depths and margin of the image.
        depth_um: source depth from the lens, um.
        middle_um: (x, y) field point in the middle, um on the sensor.
    """
    wave = optics.wave
    if not isinstance(wave, PillarWave):
        return None
    focus, frame = wave.focus, grid.frame
    d = optics.layers.after(optics.distance_um, focus.wavelength_um).reduced_um
    depth, source = (_reduced(optics, z) for z in (depth_um, focus.source_distance_um))
    shares = wave.orders(focus.wavelength_um, ORDERS)
    shape = (
        scipy.fft.next_fast_len(2 * frame[0], real=True),
        scipy.fft.next_fast_len(2 * frame[1], real=True),
    )
    if optics.layers.stop is None:
        part = _whole_lens(wave.radius_um, grid, d, middle_um)
    else:
        part = _behind_stop(optics, grid, depth_um, middle_um)
    transfers, moves = [], []
    for m, share in shares.items():
        lands = 1 + d / depth - m * (1 + d / source)
        radius = max(part.radius_um * abs(lands), grid.step_um)
        disc = torch.from_numpy(share * _disc(radius, grid.step_um, shape)).float()
        transfers.append(torch.fft.rfft2(disc))
        if part.middle_um is not None:
            down, across = (_moved(a * lands / grid.step_um) for a in part.middle_um)
            moves.append((down, across))
    every = torch.stack(transfers)
    every = every if moves else every.sum(0, keepdim=True)
    return Stray(shares, every, moves, shape, part.illumination)


def _disc(radius_um: float, step_um: float, shape: tuple[int, int]) -> Array:
    """(y, x) light of sum 1 (at radii above a step) on samples about the first, which
    wraps.
    """
    y, x = (np.fft.fftfreq(n) * n * step_um for n in shape)
    inside = np.clip((radius_um - np.hypot(y[:, None], x)) / step_um + 0.5, 0, 1)
    return np.asarray(inside * step_um**2 / (math.pi * radius_um**2))


def _moved(samples: Array) -> Tensor:
    """(n, n) matrix that puts light of each sample so many samples on, shared by the
    two next to there.
    """
    place = np.arange(len(samples))
    return torch.from_numpy(
        np.clip(1 - np.abs(place[:, None] - (place + samples)), 0, 1)
    ).float()


def _whole_lens(
    radius_um: float, grid: Grid, reduced_um: float, middle_um: tuple[float, float]
) -> _Footprint:
    """Of a lens without a stop."""
    rows, columns = ((np.arange(n) - (n - 1) / 2) * grid.step_um for n in grid.frame)
    away2 = (rows[:, None] + middle_um[1]) ** 2 + (columns + middle_um[0]) ** 2
    cosine4 = torch.from_numpy(1 / (1 + away2 / reduced_um**2) ** 2).float()
    return _Footprint(radius_um, None, cosine4)


def _behind_stop(
    optics: Optics, grid: Grid, depth_um: float, middle_um: tuple[float, float]
) -> _Footprint:
    """What rays of 17 x 17 directions illuminate of 64 x 64 places of the lens, and
    between those directions by interpolation.
    """
    layers, wave, count = optics.layers, optics.wave, 17
    colour = wave.focus.wavelength_um  # type: ignore[attr-defined]
    reduced = layers.after(optics.distance_um, colour).reduced_um
    ends = [
        (m + np.linspace(-h, h, count)) / reduced
        for m, h in zip(middle_um[::-1], grid.half_um, strict=True)
    ]
    tangents = np.stack(np.meshgrid(*ends[::-1]), -1)
    cell = wave.radius_um / 32
    place = (np.arange(64) - 31.5) * cell
    x, y = np.meshgrid(place, place)
    there = np.hypot(x, y) <= wave.radius_um
    shown = [
        layers.stop_share((a, b), depth_um, colour, (x, y), cell) * there
        for a, b in tangents.reshape(-1, 2).tolist()
    ]
    light = np.stack(shown).reshape(count, count, -1)
    area = light.sum(-1) * cell**2
    middles = (
        _middle(light[:, count // 2], y, grid.frame[0]),
        _middle(light[count // 2], x, grid.frame[1]),
    )
    slope2 = (layers.through_middle(tangents, depth_um, colour) ** 2).sum(-1)
    stop_area = math.pi * layers.footprint_um(depth_um, colour) ** 2
    taken = torch.from_numpy(area / stop_area / (1 + slope2) ** 2)[None, None]
    whole = torch.nn.functional.interpolate(
        taken, size=grid.frame, mode="bilinear", align_corners=True
    )
    return _Footprint(math.sqrt(area.max() / math.pi), middles, whole[0, 0].float())


def _middle(light: Array, place_um: Array, count: int) -> Array:
    """(count,) middle of the light (n, places) of n directions at equal steps, between
    those that are not dark.
    """
    given = light.sum(-1)
    bright = np.flatnonzero(given > 0)
    if not len(bright):
        return np.zeros(count)
    found = light[bright] @ place_um.ravel() / given[bright]
    every = np.linspace(0, len(light) - 1, count)
    return np.asarray(np.interp(every, bright, found))


def _reduced(optics: Optics, depth_um: float) -> float:
    """Σ t/n from a source at this depth to the lens; inf for a collimated beam."""
    if math.isinf(depth_um):
        return depth_um
    return optics.layers.before(depth_um, optics.wave.focus.wavelength_um).reduced_um  # type: ignore[attr-defined]


def add_stray(image: Tensor, light: Tensor, stray: Stray, grid: Grid) -> Tensor:
    """The image with the discs of all sources added; ``light`` (frames, y, x) of all
    sheets.

    Args:
        grid: samples, step, depths and margin of the image.
    """
    light = light * stray.illumination.to(light)
    moved = [rows @ light @ columns.mT for rows, columns in stray.moves] or [light]
    spectrum = sum(
        torch.fft.rfft2(part, s=stray.shape) * transfer
        for part, transfer in zip(moved, stray.transfers, strict=True)
    )
    return image + grid.crop(torch.fft.irfft2(spectrum, s=stray.shape))
