"""Frames as one surface of varying depth in three bytes a pixel, and their image: what
training affords.
"""

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from metalens.core.arrays import Array
from metalens.core.errors import SceneError
from metalens.image import (
    CODES,
    Frames,
    Imager,
    UniformImager,
    image,
    scene,
    weight_maps,
)


@dataclass(frozen=True, eq=False, slots=True)
class SingleSurfaceFrames:
    """Opaque frames: every pixel has one radiance and one depth.

    light: (n, y, x) uint8, radiance 1 is 255. depth_um: (n, y, x) uint16, at unit
    scale.
    scale: (n,) factor of the depths of each frame.
    """

    light: Array
    depth_um: Array
    scale: Array

    def __post_init__(self) -> None:
        if (
            self.light.shape != self.depth_um.shape
            or self.light.ndim != 3
            or len(self.scale) != len(self.light)
        ):
            found = self.light.shape, self.depth_um.shape, self.scale.shape
            raise SceneError(
                f"light, depth, scale have shapes {found}, need (n, y, x) twice and (n,)"
            )


def flatten_layers(frames: Frames, scale: Tensor) -> SingleSurfaceFrames:
    """Both sheets as one: their light added, the depth of the sheet that covers more of
    the pixel.

    Args:
        frames: with depths that hold the scale already. scale: (n,) that they hold; it
            is kept apart.

    Accuracy: light to 1/510 of radiance 1, above which it is cut; depth to 0.5 um below
    65 mm.
    """
    light = (frames.radiance.sum(1).clamp(0, 1) * 255 + 0.5).to(torch.uint8)
    depth = torch.where(
        frames.coverage[:, 1] > 0.5, frames.depth_um[:, 1], frames.depth_um[:, 0]
    )
    plain = (depth / scale.to(depth)[:, None, None]).clamp(0, 65535).round()
    return SingleSurfaceFrames(
        light.numpy(), plain.numpy().astype(np.uint16), scale.numpy().astype(np.float32)
    )


def frame_samples(frames: Frames | SingleSurfaceFrames) -> int:
    """Samples along a side, margin included.

    Args:
        frames: rendered frames of two layers or of one.
    """
    return int(
        (
            frames.light if isinstance(frames, SingleSurfaceFrames) else frames.radiance
        ).shape[-1]
    )


def depth_um(
    frames: Frames | SingleSurfaceFrames,
    *,
    margin: int = 0,
    device: torch.device | str = "cpu",
) -> Tensor:
    """(n, y, x) depth of the visible surface at each sample without the margin: that of
    the layer with more coverage.

    Args:
        frames: rendered frames of two layers or of one.
        device: where the depth is wanted.
    """
    if isinstance(
        frames, SingleSurfaceFrames
    ):  # no more than the frames' own bytes travel to a device
        scale = torch.from_numpy(frames.scale.astype(np.float32)).to(device)
        whole = (
            torch.from_numpy(frames.depth_um.view(np.int16)).to(device).int() & 0xFFFF
        )
        made = whole.float() * scale[:, None, None]
    else:
        few = frames.to(device)
        made = torch.where(
            few.coverage[:, 1] > 0.5, few.depth_um[:, 1], few.depth_um[:, 0]
        )
    return made[:, *_inside(made.shape[-2:], margin)].clamp_min(1.0)


def _inside(shape: tuple[int, ...], margin: int) -> list[slice]:
    """Rows and columns without the margin."""
    return [slice(margin, n - margin) for n in shape]


def _radiance(frames: SingleSurfaceFrames, device: torch.device | str) -> Tensor:
    return torch.from_numpy(frames.light).to(device).float() * (1 / 255)


def sensor_irradiance(
    frames: Frames | SingleSurfaceFrames, optics: UniformImager | Imager, *, margin: int
) -> Tensor:
    """(n, y - 2 margin, x - 2 margin) light on the sensor grid; differentiable in the
    kernels of ``optics``.

    Args:
        frames: rendered frames of two layers or of one.
    """
    device = (
        optics.stack.device if isinstance(optics, Imager) else optics.transfer.device
    )
    if isinstance(optics, Imager):
        if isinstance(frames, Frames):
            return optics(frames.to(device))
        return optics.surface(
            _radiance(frames, device), depth_um(frames, device=device)
        )
    if isinstance(frames, Frames):
        return image(frames.to(device), optics, margin=margin)
    if device.type != "cpu":
        return _elsewhere(frames, optics, margin=margin)
    table = _table(optics)
    near, far = 1 / float(optics.psf.depths_um[0]), 1 / float(optics.psf.depths_um[-1])
    inside, out = _inside(frames.light.shape[-2:], margin), []
    for start in range(
        0, len(frames.light), 4
    ):  # a few frames stay in the processor's cache
        part = slice(start, start + 4)
        scale = frames.scale[part].astype(np.float32)
        sources = np.empty((len(scale), table.shape[1], *optics.shape), np.float32)
        _weigh(
            frames.light[part],
            frames.depth_um[part],
            scale,
            table,
            np.float32(near),
            np.float32(far),
            sources,
        )
        spectrum = torch.fft.rfft2(torch.from_numpy(sources))
        blurred = torch.fft.irfft2((spectrum * optics.transfer).sum(1), s=optics.shape)
        out.append(blurred[:, *inside])
    return torch.cat(out)


def _elsewhere(
    frames: SingleSurfaceFrames, optics: UniformImager, *, margin: int
) -> Tensor:
    """As :func:`sensor_irradiance` of flat frames, all at once on another device than
    the
    processor.
    """
    light, depth = (
        part(frames, device=optics.transfer.device) for part in (_radiance, depth_um)
    )
    table = torch.from_numpy(_table(optics)).to(light.device)
    near, far = 1 / float(optics.psf.depths_um[0]), 1 / float(optics.psf.depths_um[-1])
    code = (
        ((near - 1 / depth) * ((len(table) - 1) / (near - far)) + 0.5)
        .clamp(0, len(table) - 1)
        .long()
    )
    sources = scene.pad_borders(table[code].movedim(-1, 0) * light, optics.shape)
    blurred: Tensor = torch.fft.irfft2(
        (torch.fft.rfft2(sources) * optics.transfer[:, None]).sum(0), s=optics.shape
    )
    return blurred[:, *_inside(light.shape[-2:], margin)]


def _table(optics: UniformImager) -> Array:
    """(codes, rank) weights of the kernels at depths at equal steps of 1/z.

    Raises:
        SceneError: the PSF varies over the image.
    """
    psf = optics.psf
    if psf.weights.shape[:2] != (1, 1):
        raise SceneError(
            "flat frames take one PSF for the whole image; give two-sheet frames for a field of PSFs"
        )
    near, far = 1 / float(psf.depths_um[0]), 1 / float(psf.depths_um[-1])
    depths = 1 / torch.linspace(near, far, CODES, dtype=torch.float64)
    maps = weight_maps(psf, depths[None].to(psf.weights.device))[:, 0]
    return np.ascontiguousarray(maps.detach().float().cpu().numpy().T)


@numba.njit(cache=True, fastmath=True, nogil=True)
def _weigh(
    light: Array,
    depth: Array,
    scale: Array,
    table: Array,
    near: Any,
    far: Any,
    out: Array,
) -> None:
    """out (n, rank, Y, X) = table[code of depth, rank] light; spare rows and columns
    continue the border.
    """
    height, width = light.shape[1:]
    rows, columns = out.shape[2:]
    top = np.float32(table.shape[0] - 1)
    unit = top / (near - far)
    for n in range(light.shape[0]):
        inverse = np.float32(1) / scale[n]
        for row in range(rows):
            y = (
                row
                if row < height
                else (height - 1 if row < height + (rows - height + 1) // 2 else 0)
            )
            for column in range(columns):
                x = (
                    column
                    if column < width
                    else (
                        width - 1 if column < width + (columns - width + 1) // 2 else 0
                    )
                )
                vergence = inverse / max(np.float32(depth[n, y, x]), np.float32(1))
                code = int(
                    min(
                        max((near - vergence) * unit + np.float32(0.5), np.float32(0)),
                        top,
                    )
                )
                value = np.float32(light[n, y, x]) * np.float32(1 / 255)
                for k in range(table.shape[1]):
                    out[n, k, row, column] = table[code, k] * value
