"""Paths of mask files as polygons: a line of some width along points."""

import math

import numpy as np

from metalens.core.arrays import Array

_ROUND = 32  # corners of a full circle at a round end
_RIGHT = 1e-9  # of the cosine of a right angle, or of a turn back


def path_outline(
    points: Array,
    half_width: float,
    *,
    begin: float = 0.0,
    end: float = 0.0,
    rounded: bool = False,
) -> Array:
    """(n, 2) polygon of a path, on whole units, corners and round ends as KLayout draws
    them.

    Corners are mitred, on the outside no further than at a right angle: where the path
    turns by more, each arm goes on
    by half its width and the mitre is cut off between them. The formats leave both
    open.

    Args:
        points: (m, 2), m >= 1; where all are equal, the path runs along x. begin, end:
            lengths by which it goes
            on beyond its ends.
        rounded: with half circles at the ends.
        half_width: half the width, database units.
    """
    p = np.asarray(points, float)
    p = p[np.r_[True, (np.diff(p, axis=0) != 0).any(1)]]
    along = np.diff(p, axis=0)
    if not len(along):
        p = np.vstack([p, p])
        along = np.array([[1.0, 0.0]])
    long = np.hypot(*along.T)
    along = along / np.where(long > 0, long, 1.0)[:, None]
    if not rounded:
        p[0] -= begin * along[0]
        p[-1] += end * along[-1]
    left = _side(p, along, long, half_width)
    right = _side(p[::-1], -along[::-1], long[::-1], half_width)
    if rounded:
        left = [*left[1:-1], *_cap(p[-1], along[-1], half_width)]
        right = [*right[1:-1], *_cap(p[0], -along[0], half_width)]
    corners = np.array(left + right)
    return np.asarray(np.copysign(np.floor(np.abs(corners) + 0.5), corners), np.int64)


def _side(p: Array, along: Array, long: Array, half: float) -> list[Array]:
    """The edge to the left of a line, from its first point to its last."""
    normal = np.column_stack([-along[:, 1], along[:, 0]])
    made = [p[0] + half * normal[0]]
    for k in range(1, len(along)):
        dot = float(along[k - 1] @ along[k])
        cross = float(np.linalg.det(along[k - 1 : k + 1]))
        short = half * math.sqrt(
            max(1 - dot, 0.0) / max(1 + dot, 1e-12)
        )  # by which a mitre makes each arm shorter
        if dot >= -_RIGHT or (cross > 0 and short <= half + min(long[k - 1], long[k])):
            made.append(p[k] + half * (normal[k - 1] + normal[k]) / (1 + dot))
        elif cross > 0:
            made += [p[k] + half * normal[k - 1], p[k], p[k] + half * normal[k]]
        else:
            made += [
                p[k] + half * (normal[k - 1] + along[k - 1]),
                p[k] + half * (normal[k] - along[k]),
            ]
    made.append(p[-1] + half * normal[-1])
    return made


def _cap(at: Array, along: Array, half: float) -> list[Array]:
    """Corners of a half circle from the left of the end to its right."""
    middle = (
        (np.arange(_ROUND // 2) + 0.5) * 2 * math.pi / _ROUND
    )  # sides touch the circle
    turn = math.atan2(along[1], along[0]) + math.pi / 2 - middle
    return list(
        at
        + half
        / math.cos(math.pi / _ROUND)
        * np.column_stack([np.cos(turn), np.sin(turn)])
    )
