"""Lashes that cross the eye and dark places of the skin, as pictures over a rendered
frame.
"""

import numpy as np
import torch
from torch import Tensor

from metalens.core.arrays import Array

SHIFT = 4  # binary places of a pixel that strokes are drawn to
ARC = np.linspace(0, 1, 5)  # along a lash
SHADES = (110, 160, 210, 255)  # of lashes in turn, of 255


def draw_lashes(opening: Tensor, draws: Array) -> Tensor:
    """(y, x) in [0, 1]: strokes rooted on the margins of an opening of the lids (y, x),
    one pixel of 200 thick.

    A lash of the upper lid sinks below its root, across the eye, and rises above it,
    both by the draws of the frame; it
    leans outward, away from the opening's middle. Those of the lower lid are half as
    long.
    """
    import cv2

    size = int(opening.shape[-1])
    canvas = np.zeros((size, size), np.uint8)
    rng = np.random.default_rng(int(draws[0] * 2**32))
    seen = opening.numpy() > 0.5
    columns = np.flatnonzero(seen.any(0))
    if len(columns) < 4:
        return torch.from_numpy(canvas).float()
    margins = seen.argmax(0), size - 1 - seen[::-1].argmax(0)
    length = (0.12 + 0.2 * draws[1]) * len(columns)
    sink = 0.8 * draws[2]
    rise = 1.4 * draws[3]
    for margin, down, share in ((margins[0], -1.0, 1.0), (margins[1], 1.0, 0.5)):
        roots = rng.choice(columns, 20 + int(80 * draws[4]))
        long = share * length * rng.uniform(0.4, 1.2, len(roots))
        lean = long * (
            1.4 * (roots - columns.mean()) / len(columns)
            + 0.3 * rng.standard_normal(len(roots))
        )
        high = margin[roots][:, None] + down * long[:, None] * (
            rise * ARC**2 - sink * ARC
        )
        points = np.stack([roots[:, None] + lean[:, None] * ARC, high], 2)
        strokes = np.round(points * 2**SHIFT).astype(np.int32)
        for k, dark in enumerate(SHADES):
            cv2.polylines(
                canvas,
                list(strokes[k :: len(SHADES)]),
                False,
                dark,
                max(1, size // 200),
                cv2.LINE_AA,
                SHIFT,
            )
    return torch.from_numpy(canvas).float() / 255


def soft_patches(size: int, draws: Array) -> Tensor:
    """(y, x) in [0, 1): one to three ellipses of soft edges, half 5 to 25 % of the
    frame, striped as hair is.

    Args:
        size: side of the frame in pixels.
        draws: (11,) uniform draws in [0, 1) of the frame.
    """
    x = ((torch.arange(size) + 0.5) / size - 0.5)[None]
    y, out = x.T, torch.zeros(size, size)
    for k in range(1 + int(3 * draws[5])):
        at_x = 1.1 * ((draws[6] + 0.38 * k) % 1 - 0.5)
        at_y = 1.1 * ((draws[7] + 0.71 * k) % 1 - 0.5)
        half_x = 0.05 + 0.2 * ((draws[8] + 0.57 * k) % 1)
        half_y = 0.05 + 0.2 * ((draws[9] + 0.23 * k) % 1)
        turn = 3.1416 * ((draws[10] + 0.47 * k) % 1)
        u = (x - at_x) * np.cos(turn) + (y - at_y) * np.sin(turn)
        v = (y - at_y) * np.cos(turn) - (x - at_x) * np.sin(turn)
        dark = 1 / (1 + ((u / half_x) ** 2 + (v / half_y) ** 2) ** 2)
        if k % 2 == 0:
            dark = dark * (0.75 + 0.25 * torch.sin(80 * v + 12 * u))
        out = torch.maximum(out, dark)
    return out
