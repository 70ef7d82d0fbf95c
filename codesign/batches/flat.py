"""Frames as one surface of varying depth in three bytes a pixel, and their image: what training affords.

The two sheets of :mod:`metalens.image.scene` blur separately, with their coverage, because lids hide the eye. Where
both lie at similar depths (as at a lid's margin) the light of both may be added without division: one channel in place
of four. The error is that of occlusion edges alone, measured in the tests and in ``python -m benchmarks codesign``.
"""

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from metalens.ground.arrays import Array
from metalens.ground.errors import SceneError
from metalens.image import CODES, Frames, Imager, UniformImager, image, weight_maps


@dataclass(frozen=True, eq=False, slots=True)
class Flat:
    """Opaque frames: every pixel has one radiance and one depth.

    light: (n, y, x) uint8, radiance 1 is 255. depth_um: (n, y, x) uint16, at unit scale.
    scale: (n,) factor of the depths of each frame.
    """

    light: Array
    depth_um: Array
    scale: Array

    def __post_init__(self) -> None:
        if self.light.shape != self.depth_um.shape or self.light.ndim != 3 or len(self.scale) != len(self.light):
            found = self.light.shape, self.depth_um.shape, self.scale.shape
            raise SceneError(f"light, depth, scale have shapes {found}, need (n, y, x) twice and (n,)")


def flattened(frames: Frames, scale: Tensor) -> Flat:
    """Both sheets as one: their light added, the depth of the sheet that covers more of the pixel.

    Args:
        frames: with depths that hold the scale already. scale: (n,) that they hold; it is kept apart.

    Accuracy: light to 1/510 of radiance 1, above which it is cut; depth to 0.5 um below 65 mm.
    """
    light = (frames.radiance.sum(1).clamp(0, 1) * 255 + 0.5).to(torch.uint8)
    depth = torch.where(frames.coverage[:, 1] > 0.5, frames.depth_um[:, 1], frames.depth_um[:, 0])
    plain = (depth / scale.to(depth)[:, None, None]).clamp(0, 65535).round()
    return Flat(light.numpy(), plain.numpy().astype(np.uint16), scale.numpy().astype(np.float32))


def samples(frames: Frames | Flat) -> int:
    """Samples along a side, margin included."""
    return int((frames.light if isinstance(frames, Flat) else frames.radiance).shape[-1])


def depth_um(frames: Frames | Flat, *, margin: int = 0) -> Tensor:
    """(n, y, x) depth of what is seen at every sample without the margin: of the sheet that covers more of it."""
    if isinstance(frames, Flat):
        made = torch.from_numpy(frames.depth_um.astype(np.float32) * frames.scale.astype(np.float32)[:, None, None])
    else:
        made = torch.where(frames.coverage[:, 1] > 0.5, frames.depth_um[:, 1], frames.depth_um[:, 0])
    inside = slice(margin, made.shape[-1] - margin)
    return made[:, inside, inside].clamp_min(1.0)


def sheets(frames: Frames | Flat) -> Frames:
    """Flat frames as a far sheet that covers all; frames of two sheets as they are."""
    if isinstance(frames, Frames):
        return frames
    cover = torch.zeros(len(frames.light), 2, *frames.light.shape[-2:])
    cover[:, 1] = 1
    light = torch.from_numpy(frames.light.astype(np.float32) * np.float32(1 / 255))[:, None]
    return Frames(light * cover, cover, depth_um(frames)[:, None].expand_as(cover).contiguous())


def irradiance(frames: Frames | Flat, optics: UniformImager | Imager, *, margin: int) -> Tensor:
    """(n, y - 2 margin, x - 2 margin) light on the sensor grid; differentiable in the kernels of ``optics``."""
    if isinstance(optics, Imager):
        return optics(sheets(frames))
    if isinstance(frames, Frames):
        return image(frames, optics, margin=margin)
    table = _table(optics)
    near, far = 1 / float(optics.psf.depths_um[0]), 1 / float(optics.psf.depths_um[-1])
    size = frames.light.shape[-2:]
    out = []
    for start in range(0, len(frames.light), 4):  # a few frames stay in the processor's cache
        part = slice(start, start + 4)
        scale = frames.scale[part].astype(np.float32)
        sources = np.empty((len(scale), table.shape[1], *optics.shape), np.float32)
        _weigh(frames.light[part], frames.depth_um[part], scale, table, np.float32(near), np.float32(far), sources)
        spectrum = torch.fft.rfft2(torch.from_numpy(sources))
        blurred = torch.fft.irfft2((spectrum * optics.transfer).sum(1), s=optics.shape)
        out.append(blurred[:, margin : size[0] - margin, margin : size[1] - margin])
    return torch.cat(out)


def _table(optics: UniformImager) -> Array:
    """(codes, rank) weights of the kernels at depths at equal steps of 1/z.

    Raises:
        SceneError: the PSF varies over the image.
    """
    psf = optics.psf
    if psf.weights.shape[:2] != (1, 1):
        raise SceneError("flat frames take one PSF for the whole image; give two-sheet frames for a field of PSFs")
    near, far = 1 / float(psf.depths_um[0]), 1 / float(psf.depths_um[-1])
    depths = 1 / torch.linspace(near, far, CODES, dtype=torch.float64)
    maps = weight_maps(psf, depths[None])[:, 0]
    return np.ascontiguousarray(maps.detach().float().numpy().T)


@numba.njit(cache=True, fastmath=True, nogil=True)
def _weigh(light: Array, depth: Array, scale: Array, table: Array, near: Any, far: Any, out: Array) -> None:
    """out (n, rank, Y, X) = table[code of depth, rank] light; spare rows and columns continue the border."""
    height, width = light.shape[1:]
    rows, columns = out.shape[2:]
    top = np.float32(table.shape[0] - 1)
    unit = top / (near - far)
    for n in range(light.shape[0]):
        inverse = np.float32(1) / scale[n]
        for row in range(rows):
            y = row if row < height else (height - 1 if row < height + (rows - height + 1) // 2 else 0)
            for column in range(columns):
                x = column if column < width else (width - 1 if column < width + (columns - width + 1) // 2 else 0)
                vergence = inverse / max(np.float32(depth[n, y, x]), np.float32(1))
                code = int(min(max((near - vergence) * unit + np.float32(0.5), np.float32(0)), top))
                value = np.float32(light[n, y, x]) * np.float32(1 / 255)
                for k in range(table.shape[1]):
                    out[n, k, row, column] = table[code, k] * value
