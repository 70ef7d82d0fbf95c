"""Other ways to one image: layer by layer, and by the formula as published."""

import scipy.fft
import torch
from torch import Tensor
from torch.nn.functional import pad

from metalens.image import scene
from metalens.image.forming import occlude
from metalens.image.low_rank import transfer_functions


def image_layers(layers: scene.Layers, psfs: Tensor) -> Tensor:
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


def published(layers: scene.Layers, psfs: Tensor, *, epsilon: float = 1e-3) -> Tensor:
    """The occlusion formula as published (Ikoma et al., ICCP 2021), for comparison;
    layers sorted near to far.

    Every layer hides those behind it; blurred layers are divided by the blurred
    coverage of all layers at or behind
    them plus ``epsilon``. Where a near layer is blurred more than the far one reaches,
    no layer has weight and light
    is lost: up to 26 % at edges.
    """
    behind = _blurred(layers.coverage.flip(1).cumsum(1).flip(1), psfs) + epsilon
    light = _blurred(layers.radiance, psfs)
    cover = _blurred(layers.coverage, psfs)
    light, cover = light / behind, cover / behind
    passed = torch.cumprod(1 - cover, 1)
    passed = torch.cat([torch.ones_like(passed[:, :1]), passed[:, :-1]], 1)
    total: Tensor = (passed * light).sum(1)
    return total
