"""Light of other diffraction orders of the zones: each a blurred disc on the sensor, weak and wide.

A ray that leaves the lens at r is turned by order m as a lens of m times the power would: on the sensor it lands at
r (1 + d/z - m (1 + d/s)) from its chief ray (source depth z, focus s, sensor distance d, each reduced: Σ t/n of the
media on the way). Order 1 is the image.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import scipy.fft
import torch
from torch import Tensor

from metalens.field.plan import Grid
from metalens.field.points import Optics
from metalens.field.waves import PillarWave
from metalens.image.scene import Frames

ORDERS = (-1, 0, 2, 3)


@dataclass(frozen=True, eq=False, slots=True)
class Stray:
    """shares: of the light on the aperture in each order. transfer: of the discs together, weighted; shape of it.

    illumination: (y, x) of the frame, cos⁴ of the field angle.
    """

    shares: dict[int, float]
    transfer: Tensor
    shape: tuple[int, int]
    illumination: Tensor

    def to(self, device: torch.device | str) -> "Stray":
        """The same on a device."""
        return replace(self, transfer=self.transfer.to(device), illumination=self.illumination.to(device))


def stray_of(optics: Optics, grid: Grid, depth_um: float, middle_um: tuple[float, float]) -> Stray | None:
    """Discs of the orders beside the image; None for a smooth phase, which has one order alone."""
    wave = optics.wave
    if not isinstance(wave, PillarWave):
        return None
    focus = wave.focus
    d = optics.layers.after(optics.distance_um, focus.wavelength_um).reduced_um
    depth, source = (_reduced(optics, z) for z in (depth_um, focus.source_distance_um))
    shares = wave.orders(focus.wavelength_um, ORDERS)
    frame = grid.frame
    shape = (scipy.fft.next_fast_len(2 * frame[0], real=True), scipy.fft.next_fast_len(2 * frame[1], real=True))
    y, x = (np.fft.fftfreq(n) * n * grid.step_um for n in shape)
    away = np.hypot(y[:, None], x)
    disc = np.zeros(shape)
    for m, share in shares.items():
        radius = wave.radius_um * abs(1 + d / depth - m * (1 + d / source))
        radius = max(radius, grid.step_um)
        inside = np.clip((radius - away) / grid.step_um + 0.5, 0, 1)
        disc += share * inside * grid.step_um**2 / (math.pi * radius**2)
    rows, columns = ((np.arange(n) - (n - 1) / 2) * grid.step_um for n in frame)
    cosine2 = 1 / (1 + ((rows[:, None] + middle_um[1]) ** 2 + (columns + middle_um[0]) ** 2) / d**2)
    return Stray(shares, torch.fft.rfft2(torch.from_numpy(disc).float()), shape, torch.from_numpy(cosine2**2).float())


def _reduced(optics: Optics, depth_um: float) -> float:
    """Σ t/n from a source at this depth to the lens; inf for a collimated beam."""
    if math.isinf(depth_um):
        return depth_um
    return optics.layers.before(depth_um, optics.wave.focus.wavelength_um).reduced_um  # type: ignore[attr-defined]


def add_stray(image: Tensor, frames: Frames, stray: Stray, grid: Grid) -> Tensor:
    """The image with the discs of all sources added."""
    light = frames.radiance.sum(1) * stray.illumination.to(frames.radiance)
    spectrum = torch.fft.rfft2(light, s=stray.shape) * stray.transfer
    edge = grid.margin + grid.spare
    rows, columns = (slice(edge, edge + n) for n in grid.samples)
    haze: Tensor = torch.fft.irfft2(spectrum, s=stray.shape)[..., rows, columns]
    return image + haze
