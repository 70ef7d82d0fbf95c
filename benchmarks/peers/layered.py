"""Other ways to one image: layer by layer, by the formula as published, and with
kernels trimmed to the frames.
"""

from dataclasses import replace

import scipy.fft
import torch
from torch import Tensor

from metalens.image import scene


def trimmed(
    psf: scene.PsfBasis,
    frames: scene.Frames,
    *,
    tolerance: float = 1e-3,
    margin: int = 0,
) -> scene.PsfBasis:
    """The fewest kernels of a basis that image frames like these within ``tolerance``;
    often half of them.

    A basis answers for a 1/f texture at its worst depth; eyes are smoother and lie at
    fewer depths. ``error`` of the
    result is measured on these frames: the relative L2 difference (worst frame) from
    the image with all kernels, plus
    the error of the basis. Trim with frames other than those that are imaged.
    """
    size = (int(frames.radiance.shape[-2]), int(frames.radiance.shape[-1]))
    whole = scene.image(
        frames, scene.uniform_imager(psf, size, margin=margin), margin=margin
    )
    stack = psf.weights.flatten(0, 2) @ psf.kernels.flatten(1)
    for rank in range(1, len(psf.kernels)):
        few = replace(psf, kernels=psf.kernels[:rank], weights=psf.weights[..., :rank])
        missing = (
            scene.image(
                frames, scene.uniform_imager(few, size, margin=margin), margin=margin
            )
            - whole
        )
        error = float(
            (missing.norm(dim=(1, 2)) / whole.norm(dim=(1, 2)).clamp_min(1e-30)).max()
        )
        if error + psf.error <= tolerance:
            lost = stack - few.weights.flatten(0, 2) @ few.kernels.flatten(1)
            bound = float((lost.abs().sum(1) / stack.sum(1).abs()).max())
            return replace(few, error=error + psf.error, bound=bound + psf.bound)
    return psf


def image_layers(layers: scene.Layers, psfs: Tensor, *, margin: int = 0) -> Tensor:
    """The same image, layer by layer with the PSF of each layer (layers, h, w): slow,
    no approximation of the PSFs.
    """
    size = layers.radiance.shape[-2:]
    reach = max(psfs.shape[-2:]) // 2
    spare = 2 * max(reach - margin, 0)
    shape = tuple(scipy.fft.next_fast_len(n + spare, real=True) for n in size)
    transfer = scene._transfer(psfs, (shape[0], shape[1]))
    sheets = []
    for kind in (layers.radiance, layers.coverage):
        padded = scene.pad_borders(kind, (shape[0], shape[1]))
        blurred = torch.stack(
            [
                torch.fft.irfft2(torch.fft.rfft2(padded[:, k]) * transfer[k], s=shape)
                for k in range(len(layers.depth_um))
            ],
            1,
        )
        blurred = blurred[..., margin : size[0] - margin, margin : size[1] - margin]
        sheets.append(
            torch.stack(
                [blurred[:, layers.near].sum(1), blurred[:, ~layers.near].sum(1)], 1
            )
        )
    return scene._over(sheets[0], sheets[1])


def published(layers: scene.Layers, psfs: Tensor, *, epsilon: float = 1e-3) -> Tensor:
    """The occlusion formula as published (Ikoma et al., ICCP 2021), for comparison;
    layers sorted near to far.

    Every layer hides those behind it; blurred layers are divided by the blurred
    coverage of all layers at or behind
    them plus ``epsilon``. Where a near layer is blurred more than the far one reaches,
    no layer has weight and light
    is lost: up to 26 % at edges.
    """
    shape = tuple(
        scipy.fft.next_fast_len(n + max(psfs.shape[-2:]), real=True)
        for n in layers.radiance.shape[-2:]
    )
    transfer = scene._transfer(psfs, (shape[0], shape[1]))
    size = layers.radiance.shape[-2:]

    def blur(kind: Tensor) -> Tensor:
        spectrum = torch.fft.rfft2(scene.pad_borders(kind, (shape[0], shape[1])))
        blurred: Tensor = torch.fft.irfft2(spectrum * transfer, s=shape)[
            ..., : size[0], : size[1]
        ]
        return blurred

    behind = blur(layers.coverage.flip(1).cumsum(1).flip(1)) + epsilon
    light, cover = blur(layers.radiance) / behind, blur(layers.coverage) / behind
    passed = torch.cumprod(1 - cover, 1)
    passed = torch.cat([torch.ones_like(passed[:, :1]), passed[:, :-1]], 1)
    total: Tensor = (passed * light).sum(1)
    return total
