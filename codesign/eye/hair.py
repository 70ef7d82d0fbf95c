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
    """(y, x) opacity in [0, 1] of lashes rooted on the margins of a lid opening.

    Upper lashes sink below their root, across the eye, and then rise, by the draws of
    the frame; they lean away from the centre of the opening. Lower lashes are half as
    long. Strokes are size / 200 pixels thick.

    Args:
        opening: (y, x) coverage of the opening.
        draws: (5 or more,) uniform draws in [0, 1) of the frame.
    """
    import cv2

    size = int(opening.shape[-1])
    canvas = np.zeros((size, size), np.uint8)
    rng = np.random.default_rng(int(draws[0] * 2**32))
    is_open = opening.numpy() > 0.5
    columns = np.flatnonzero(is_open.any(0))
    if len(columns) < 4:
        return torch.from_numpy(canvas).float()
    margins = is_open.argmax(0), size - 1 - is_open[::-1].argmax(0)
    length = (0.12 + 0.2 * draws[1]) * len(columns)
    sink = 0.8 * draws[2]
    rise = 1.4 * draws[3]
    for margin, direction, share in ((margins[0], -1.0, 1.0), (margins[1], 1.0, 0.5)):
        roots = rng.choice(columns, 20 + int(80 * draws[4]))
        lengths = share * length * rng.uniform(0.4, 1.2, len(roots))
        lean = lengths * (
            1.4 * (roots - columns.mean()) / len(columns)
            + 0.3 * rng.standard_normal(len(roots))
        )
        height = margin[roots][:, None] + direction * lengths[:, None] * (
            rise * ARC**2 - sink * ARC
        )
        points = np.stack([roots[:, None] + lean[:, None] * ARC, height], 2)
        strokes = np.round(points * 2**SHIFT).astype(np.int32)
        for k, shade in enumerate(SHADES):
            cv2.polylines(
                canvas,
                list(strokes[k :: len(SHADES)]),
                False,
                shade,
                max(1, size // 200),
                cv2.LINE_AA,
                SHIFT,
            )
    return torch.from_numpy(canvas).float() / 255


def soft_patches(size: int, draws: Array) -> Tensor:
    """(y, x) opacity in [0, 1) of one to three soft ellipses, some striped like hair.

    Profile 1 / (1 + (u² / a² + v² / b²)²), half axes a and b of 5 to 25 % of the frame.

    Args:
        size: side of the frame in pixels.
        draws: (11,) uniform draws in [0, 1) of the frame.
    """
    x = ((torch.arange(size) + 0.5) / size - 0.5)[None]
    y = x.T
    out = torch.zeros(size, size)
    for k in range(1 + int(3 * draws[5])):
        centre_x = 1.1 * ((draws[6] + 0.38 * k) % 1 - 0.5)
        centre_y = 1.1 * ((draws[7] + 0.71 * k) % 1 - 0.5)
        half_x = 0.05 + 0.2 * ((draws[8] + 0.57 * k) % 1)
        half_y = 0.05 + 0.2 * ((draws[9] + 0.23 * k) % 1)
        angle = 3.1416 * ((draws[10] + 0.47 * k) % 1)
        u = (x - centre_x) * np.cos(angle) + (y - centre_y) * np.sin(angle)
        v = (y - centre_y) * np.cos(angle) - (x - centre_x) * np.sin(angle)
        opacity = 1 / (1 + ((u / half_x) ** 2 + (v / half_y) ** 2) ** 2)
        if k % 2 == 0:
            opacity = opacity * (0.75 + 0.25 * torch.sin(80 * v + 12 * u))
        out = torch.maximum(out, opacity)
    return out
