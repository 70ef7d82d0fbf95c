"""Frames through many patches at once: what ``forming`` does patch by patch, for
devices that each call costs dear.

A GPU is done with a patch of a few frames before it is told of the next. Patches of one
size are therefore stacked,
kernels that some of them lack being zeros, and go through every transform together, as
many as the memory affords.
"""

from collections import defaultdict
from collections.abc import Iterator

import torch
from torch import Tensor

from metalens.field.patches import Patch, lagrange

BYTES = 2 << 30  # of the spectra that are held at once


def through(
    given: tuple[Tensor, Tensor, Tensor],
    patches: list[Patch],
    transfer: list[Tensor],
    shapes: list[tuple[int, int]],
    out: Tensor,
    held_bytes: int = BYTES,
) -> None:
    """Add the light (and coverage, where ``out`` has two kinds) of frames through every
    patch; differentiable.

    Args:
        given: (frames, sheets, y, x) light, coverage, and depth in units of the depth
            nodes.
        transfer: of each patch, (rank, Y, X // 2 + 1), with its (Y, X) in ``shapes``.
        out: (frames, kinds, sheets, y, x), half a window larger at each side than the
            frames.
        held_bytes: of spectra at once.
    """
    beyond = out.shape[-1] - given[0].shape[-1]
    each = (
        8 * given[0].shape[0] * given[0].shape[1]
    )  # bytes of a spectrum of all sheets, a point
    for some in _alike(patches, transfer, held_bytes // each):
        few = [patches[i] for i in some]
        kernels, shape = _stacked([transfer[i] for i in some]), shapes[some[0]]
        for kind, source in enumerate(_sources(few, given, out.shape[1])):
            spectrum = torch.fft.rfft2(source, s=shape)
            mixed = (spectrum * kernels[:, : source.shape[1], None, None]).sum(1)
            high, wide = (b - a + beyond for a, b in (few[0].rows, few[0].columns))
            seen = torch.fft.irfft2(mixed, s=shape)[..., :high, :wide]
            for patch, one in zip(few, seen, strict=True):
                (top, below), (left, right) = patch.rows, patch.columns
                place = out[:, kind, :, top : below + beyond, left : right + beyond]
                place += one


def _alike(
    patches: list[Patch], transfer: list[Tensor], points: int
) -> Iterator[list[int]]:
    """Numbers of patches of one size, as many together as have so many points of
    transforms, or one.
    """
    sizes = defaultdict(list)
    for i, patch in enumerate(patches):
        sizes[
            patch.rows[1] - patch.rows[0], patch.columns[1] - patch.columns[0]
        ].append(i)
    for same in sizes.values():
        same.sort(
            key=lambda i: len(transfer[i])
        )  # kernels that are zeros cost as much as others
        count = max(1, points // max(transfer[i].numel() for i in same))
        yield from (same[k : k + count] for k in range(0, len(same), count))


def _stacked(parts: list[Tensor]) -> Tensor:
    """(patches, most kernels, …) of (kernels, …) each; zeros where there are fewer."""
    most = max(len(part) for part in parts)
    spare = [part.new_zeros(most - len(part), *part.shape[1:]) for part in parts]
    return torch.stack([torch.cat(pair) for pair in zip(parts, spare, strict=True)])


def _sources(
    few: list[Patch], given: tuple[Tensor, Tensor, Tensor], kinds: int
) -> list[Tensor]:
    """(patches, kernels, frames, sheets, y, x) light, and with two kinds coverage,
    weighted for their kernels.
    """
    light, cover, place = (
        torch.stack(
            [part[..., slice(*patch.rows), slice(*patch.columns)] for patch in few]
        )
        for part in given
    )
    weights, level = _at_depth(few, place)
    out = [weights * (light * level)[:, None]]
    return out if kinds == 1 else [*out, _covering(few, weights) * cover[:, None]]


def _covering(few: list[Patch], weights: Tensor) -> Tensor:
    """The weights of the kernels that coverage takes of each patch."""
    counts = torch.tensor([patch.coverage for patch in few], device=weights.device)
    most = max(patch.coverage for patch in few)
    taken = torch.arange(most, device=weights.device) < counts[:, None]
    return weights[:, :most] * taken.to(weights)[..., None, None, None, None]


def _at_depth(few: list[Patch], place: Tensor) -> tuple[Tensor, Tensor]:
    """As ``forming.at_depth``: (patches, kernels, …) weights and (patches, …) E of
    sources at (patches, …) depths.
    """
    pixels, depths = few[0].energy.shape
    first, taps = lagrange(place, depths)
    pixel = torch.arange(pixels, device=place.device).reshape(place.shape[-2:])
    number = torch.arange(len(few), device=place.device).reshape(-1, 1, 1, 1, 1)
    index = (number * pixels + pixel) * depths + first
    kernels = _stacked(
        [patch.weights.permute(2, 0, 1) for patch in few]
    )  # (patches, kernels, pixels, depths)
    table = kernels.to(place).movedim(1, 0).flatten(1)
    level = torch.stack([patch.energy for patch in few]).to(place).flatten()
    weights, light = taps[..., 0] * table[:, index], taps[..., 0] * level[index]
    for k in range(1, taps.shape[-1]):
        weights = torch.addcmul(weights, taps[..., k], table[:, index + k])
        light = torch.addcmul(light, taps[..., k], level[index + k])
    return weights.movedim(0, 1), light
