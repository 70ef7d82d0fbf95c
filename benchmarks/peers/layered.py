"""The image of two sheets layer by layer: the plain way to what the imager does."""

from dataclasses import dataclass

import scipy.fft
import torch
from torch import Tensor
from torch.nn.functional import pad

from metalens.image import Frames
from metalens.image.forming import occlude
from metalens.image.low_rank import transfer_functions


@dataclass(frozen=True, eq=False)
class Layers:
    """Frames cut into depth layers.

    radiance, coverage: (frames, layers, y, x); radiance multiplied by the coverage.
    depth_um: (layers,).
    near: (layers,) True where the layer belongs to the near sheet.
    """

    radiance: Tensor
    coverage: Tensor
    depth_um: Tensor
    near: Tensor


def cut_layers(frames: Frames, depths_um: Tensor) -> Layers:
    """Layers of frames at fixed depths, those of the near sheet first.

    A source between two depths is split between both, linearly in 1/z.

    Args:
        frames: sheets with their depths.
        depths_um: (layers,) ascending, um.
    """
    vergence = 1 / depths_um.to(frames.depth_um)
    position = 1 / frames.depth_um.clamp(float(depths_um[0]), float(depths_um[-1]))
    count = len(vergence)
    radiance, coverage = [], []
    for sheet in (0, 1):
        for k, node in enumerate(vergence):
            offset = position[:, sheet] - node
            below = (vergence[max(k - 1, 0)] - node).clamp_min(1e-12)
            above = (node - vergence[min(k + 1, count - 1)]).clamp_min(1e-12)
            share = 1 - torch.where(offset > 0, offset / below, -offset / above)
            radiance.append(share.clamp(0, 1) * frames.radiance[:, sheet])
            coverage.append(share.clamp(0, 1) * frames.coverage[:, sheet])
    return Layers(
        torch.stack(radiance, 1),
        torch.stack(coverage, 1),
        depths_um.repeat(2),
        torch.arange(2 * count) < count,
    )


def image_layers(layers: Layers, psfs: Tensor) -> Tensor:
    """The image layer by layer, with the PSF of each layer (layers, h, w): slow, no
    approximation of the PSFs.
    """
    sheets = []
    for kind in (layers.radiance, layers.coverage):
        blurred = _blurred(kind, psfs)
        both = [blurred[:, sheet].sum(1) for sheet in (layers.near, ~layers.near)]
        sheets.append(torch.stack(both, 1))
    return occlude(sheets[0], sheets[1])


def _blurred(content: Tensor, psfs: Tensor) -> Tensor:
    """(frames, layers, y, x) each layer through its PSF, borders continued."""
    reach = max(psfs.shape[-2:]) // 2
    wide = pad(content, (reach,) * 4, mode="replicate")
    y, x = (int(scipy.fft.next_fast_len(n, real=True)) for n in wide.shape[-2:])
    transfer = transfer_functions(psfs, (y, x))
    whole = torch.fft.irfft2(torch.fft.rfft2(wide, s=(y, x)) * transfer, s=(y, x))
    rows, columns = (slice(reach, reach + n) for n in content.shape[-2:])
    return whole[..., rows, columns]
