"""The arithmetic of the scene model for torch tensors; the compiled kernels have their
own of the same names.
"""

import torch
from torch import Tensor


def sqrt(x: Tensor) -> Tensor:
    """Square root of a value kept above 0 by the caller."""
    return torch.sqrt(x)


def unit(x: Tensor) -> Tensor:
    """x held in [0, 1]."""
    return x.clamp(0, 1)


def above(x: Tensor, least: float) -> Tensor:
    """x, at least ``least``."""
    return x.clamp_min(least)


def step(x: Tensor) -> Tensor:
    """Smooth step from 0 at x = -1 to 1 at x = 1."""
    t = (0.5 + 0.5 * x).clamp(0, 1)
    return t * t * (3 - 2 * t)


def tex(bank: Tensor, index: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Sample of picture ``index`` of ``bank`` (pictures, size, size), periodic; u, v in
    pixels.

    Blended by smooth steps between the pixels: bilinear blending would have derivatives
    that jump.
    """
    size = bank.shape[-1]
    fu, fv = torch.floor(u.detach()), torch.floor(v.detach())
    i, j, k = fu.long() % size, fv.long() % size, index.long()
    a, b = bank[k, j, i], bank[k, j, (i + 1) % size]
    c, d = bank[k, (j + 1) % size, i], bank[k, (j + 1) % size, (i + 1) % size]
    s, t = u - fu, v - fv
    s, t = s * s * (3 - 2 * s), t * t * (3 - 2 * t)
    return (a + (b - a) * s) * (1 - t) + (c + (d - c) * s) * t
