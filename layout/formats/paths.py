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
    """(n, 2) polygon of a path on whole units; corners and ends as in KLayout.

    Corners are mitred, on the outside up to a right angle. Where the path turns by
    more, each arm extends by half its width, and the mitre is cut off between them. The
    formats leave both open.

    Args:
        points: (m, 2), m >= 1; where all are equal, the path runs along x.
        half_width: half the width, database units.
        begin: length by which the path extends beyond its first point.
        end: length by which it extends beyond its last point.
        rounded: with half circles at the ends.
    """
    p = np.asarray(points, float)
    p = p[np.r_[True, (np.diff(p, axis=0) != 0).any(1)]]
    direction = np.diff(p, axis=0)
    if not len(direction):
        p = np.vstack([p, p])
        direction = np.array([[1.0, 0.0]])
    length = np.hypot(*direction.T)
    direction = direction / np.where(length > 0, length, 1.0)[:, None]
    if not rounded:
        p[0] -= begin * direction[0]
        p[-1] += end * direction[-1]
    left = _side(p, direction, length, half_width)
    right = _side(p[::-1], -direction[::-1], length[::-1], half_width)
    if rounded:
        left = [*left[1:-1], *_cap(p[-1], direction[-1], half_width)]
        right = [*right[1:-1], *_cap(p[0], -direction[0], half_width)]
    corners = np.array(left + right)
    return np.asarray(np.copysign(np.floor(np.abs(corners) + 0.5), corners), np.int64)


def _side(p: Array, direction: Array, length: Array, half: float) -> list[Array]:
    """Corners of the left edge of a path, from its first point to its last.

    An outer corner is a mitre up to a right angle. Beyond that each arm extends by half
    its width, and the mitre is cut off between them.

    Args:
        p: (n, 2) points.
        direction: (n - 1, 2) unit vectors of the segments.
        length: (n - 1,) of the segments.
        half: half the width.
    """
    normal = np.column_stack([-direction[:, 1], direction[:, 0]])
    corners = [p[0] + half * normal[0]]
    for k in range(1, len(direction)):
        dot = float(direction[k - 1] @ direction[k])
        cross = float(np.linalg.det(direction[k - 1 : k + 1]))
        mitre_loss = half * math.sqrt(
            max(1 - dot, 0.0) / max(1 + dot, 1e-12)
        )  # by which a mitre makes each arm shorter
        if dot >= -_RIGHT or (
            cross > 0 and mitre_loss <= half + min(length[k - 1], length[k])
        ):
            corners.append(p[k] + half * (normal[k - 1] + normal[k]) / (1 + dot))
        elif cross > 0:
            corners += [p[k] + half * normal[k - 1], p[k], p[k] + half * normal[k]]
        else:
            corners += [
                p[k] + half * (normal[k - 1] + direction[k - 1]),
                p[k] + half * (normal[k] - direction[k]),
            ]
    corners.append(p[-1] + half * normal[-1])
    return corners


def _cap(centre: Array, direction: Array, half: float) -> list[Array]:
    """Corners of a half circle at an end, from its left to its right side."""
    angle = (
        (np.arange(_ROUND // 2) + 0.5) * 2 * math.pi / _ROUND
    )  # sides touch the circle
    corner_angle = math.atan2(direction[1], direction[0]) + math.pi / 2 - angle
    return list(
        centre
        + half
        / math.cos(math.pi / _ROUND)
        * np.column_stack([np.cos(corner_angle), np.sin(corner_angle)])
    )
