"""Paths of mask files as polygons: a line of some width along points."""

import math

import numpy as np

from metalens.ground.arrays import Array

_ROUND = 32  # corners of a full circle at a round end


def outline(points: Array, half_width: float, *, begin: float = 0.0, end: float = 0.0, rounded: bool = False) -> Array:
    """(n, 2) polygon of a path, corners mitred, on whole units; mitres beyond two widths are cut off.

    Args:
        points: (m, 2), m >= 2 and not all alike. begin, end: lengths by which it goes on beyond its ends.
        rounded: with half circles at the ends.
    """
    p = np.asarray(points, float)
    p = p[np.r_[True, (np.diff(p, axis=0) != 0).any(1)]]
    along = np.diff(p, axis=0)
    along /= np.hypot(*along.T)[:, None]
    if not rounded:
        p[0] -= begin * along[0]
        p[-1] += end * along[-1]
    left = _side(p, along, half_width)
    right = _side(p[::-1], -along[::-1], half_width)
    if rounded:
        left += _cap(p[-1], along[-1], half_width)
        right += _cap(p[0], -along[0], half_width)
    return np.asarray(np.rint(np.array(left + right)), np.int64)


def _side(p: Array, along: Array, half: float) -> list[Array]:
    """The edge to the left of a line, from its first point to its last."""
    normal = np.column_stack([-along[:, 1], along[:, 0]])
    made = [p[0] + half * normal[0]]
    for k in range(1, len(along)):
        both = normal[k - 1] + normal[k]
        scale = 2 / max(float(both @ both), 1e-12)
        if scale < 4:
            made.append(p[k] + half * scale * both)
        else:
            made += [p[k] + half * (normal[k - 1] + along[k - 1]), p[k] + half * (normal[k] - along[k])]
    made.append(p[-1] + half * normal[-1])
    return made


def _cap(at: Array, along: Array, half: float) -> list[Array]:
    """Corners of a half circle from the left of the end to its right."""
    turn = math.atan2(along[1], along[0]) + math.pi / 2 - np.arange(1, _ROUND // 2) * 2 * math.pi / _ROUND
    return list(at + half * np.column_stack([np.cos(turn), np.sin(turn)]))
