"""Light of other diffraction orders of the zones: each a blurred disc on the sensor,
weak and wide.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import scipy.fft
import torch
from torch import Tensor

from metalens.core.arrays import Array
from metalens.image.plan import Grid
from metalens.image.points import Optics
from metalens.image.waves import PillarWave

ORDERS = (-1, 0, 2, 3)
NODES = 17  # directions along an axis whose light on the lens behind a stop is traced
PLACES = 64  # of the lens along an axis, of which each is lit or dark there


@dataclass(frozen=True, eq=False, slots=True)
class Disc:
    """Discs about places of the frame: their transfer, and matrices (rows, columns)
    that put light at those places;
    None where they lie about the sources' own."""

    transfer: Tensor
    places: tuple[Tensor, Tensor] | None = None

    def spectrum(self, light: Tensor, shape: tuple[int, int]) -> Tensor:
        """Transform of the discs of light (…, y, x)."""
        if self.places is not None:
            rows, columns = self.places
            light = rows @ light @ columns.mT
        found: Tensor = torch.fft.rfft2(light, s=shape) * self.transfer
        return found

    def to(self, device: torch.device | str) -> "Disc":
        """The same on a device."""
        places = (
            None
            if self.places is None
            else (self.places[0].to(device), self.places[1].to(device))
        )
        return Disc(self.transfer.to(device), places)


@dataclass(frozen=True, eq=False, slots=True)
class Stray:
    """shares: of the light on the aperture in each order. discs: weighted by them;
    shape of their transforms.

    illumination: (y, x) of the frame, cos⁴ of the field angle, times what the lens
    takes in of the light of the stop.
    """

    shares: dict[int, float]
    discs: list[Disc]
    shape: tuple[int, int]
    illumination: Tensor

    def to(self, device: torch.device | str) -> "Stray":
        """The same on a device."""
        discs = [disc.to(device) for disc in self.discs]
        return replace(self, discs=discs, illumination=self.illumination.to(device))


@dataclass(frozen=True, eq=False, slots=True)
class _Lit:
    """The part of the lens that sources light: its radius; its middle (rows, columns),
    um, for every row and column of
    the frame, None where that is the lens's; illumination as in :class:`Stray`."""

    radius_um: float
    aside_um: tuple[Array, Array] | None
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
        lit = _all(wave.radius_um, grid, d, middle_um)
    else:
        lit = _behind_stop(optics, grid, depth_um, middle_um)
    discs = []
    for m, share in shares.items():
        lands = 1 + d / depth - m * (1 + d / source)
        radius = max(lit.radius_um * abs(lands), grid.step_um)
        transfer = torch.fft.rfft2(
            torch.from_numpy(share * _disc(radius, grid.step_um, shape)).float()
        )
        if lit.aside_um is None:
            discs.append(Disc(transfer))
        else:
            down, across = lit.aside_um
            to_step = lands / grid.step_um
            discs.append(
                Disc(transfer, (_moved(down * to_step), _moved(across * to_step)))
            )
    if lit.aside_um is None:
        discs = [Disc(torch.stack([disc.transfer for disc in discs]).sum(0))]
    return Stray(shares, discs, shape, lit.illumination)


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


def _all(
    radius_um: float, grid: Grid, reduced_um: float, middle_um: tuple[float, float]
) -> _Lit:
    """Of a lens without a stop."""
    rows, columns = ((np.arange(n) - (n - 1) / 2) * grid.step_um for n in grid.frame)
    tangent2 = (
        (rows[:, None] + middle_um[1]) ** 2 + (columns + middle_um[0]) ** 2
    ) / reduced_um**2
    return _Lit(radius_um, None, torch.from_numpy(1 / (1 + tangent2) ** 2).float())


def _behind_stop(
    optics: Optics, grid: Grid, depth_um: float, middle_um: tuple[float, float]
) -> _Lit:
    """What rays of some directions light of a lens behind a stop, and for all of them
    between those.
    """
    layers, wave = optics.layers, optics.wave
    colour = wave.focus.wavelength_um  # type: ignore[attr-defined]
    reduced = layers.after(optics.distance_um, colour).reduced_um
    ends = [
        (m + np.linspace(-h, h, NODES)) / reduced
        for m, h in zip(middle_um[::-1], grid.half_um, strict=True)
    ]
    tangents = np.stack(np.meshgrid(*ends[::-1]), -1)
    place = (np.arange(PLACES) - (PLACES - 1) / 2) * (2 * wave.radius_um / PLACES)
    x, y = np.meshgrid(place, place)
    there = np.hypot(x, y) <= wave.radius_um
    cell = float(place[1] - place[0])
    shown = [
        layers.stop_share((a, b), depth_um, colour, (x, y), cell) * there
        for a, b in tangents.reshape(-1, 2).tolist()
    ]
    light = np.stack(shown).reshape(NODES, NODES, -1)
    area = light.sum(-1) * cell**2
    row, column = light[:, NODES // 2], light[NODES // 2]
    aside = (
        _between(_middle(row, y), grid.frame[0]),
        _between(_middle(column, x), grid.frame[1]),
    )
    cosine4 = (
        1 / (1 + (layers.through_middle(tangents, depth_um, colour) ** 2).sum(-1)) ** 2
    )
    taken = torch.from_numpy(
        cosine4 * area / (math.pi * layers.footprint_um(depth_um, colour) ** 2)
    )
    whole = torch.nn.functional.interpolate(
        taken[None, None], size=grid.frame, mode="bilinear", align_corners=True
    )
    return _Lit(math.sqrt(area.max() / math.pi), aside, whole[0, 0].float())


def _middle(light: Array, place_um: Array) -> Array:
    """(n,) middle of the light (n, places) of n directions; of dark ones that of the
    next that are lit.
    """
    given = light.sum(-1)
    lit = given > 0
    if not lit.any():
        return np.zeros(len(light))
    found = light[lit] @ place_um.ravel() / given[lit]
    return np.asarray(np.interp(np.arange(len(light)), np.flatnonzero(lit), found))


def _between(values: Array, count: int) -> Array:
    """(count,) values between those of directions at equal steps."""
    return np.asarray(
        np.interp(
            np.linspace(0, len(values) - 1, count), np.arange(len(values)), values
        )
    )


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
    spectrum = torch.stack(
        [disc.spectrum(light, stray.shape) for disc in stray.discs]
    ).sum(0)
    edge = grid.margin + grid.spare
    rows, columns = (slice(edge, edge + n) for n in grid.samples)
    haze: Tensor = torch.fft.irfft2(spectrum, s=stray.shape)[..., rows, columns]
    return image + haze
