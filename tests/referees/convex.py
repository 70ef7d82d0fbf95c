"""Distance of convex polygons by separating lines, with whole coordinates."""

import math

import numpy as np


def convex_gap(first, second, dx: int, dy: int) -> float:
    """Distance from ``first`` to ``second`` moved by (dx, dy); 0 where they touch, -1
    where they overlap.
    """
    moved = second + np.array([dx, dy])
    apart = max(_separation(first, moved), _separation(moved, first))
    if apart <= 0:
        return -1.0 if apart < 0 else 0.0
    return math.sqrt(min(_nearest(first, moved), _nearest(moved, first)))


def _separation(a, b) -> int:
    """Above 0 where a line along an edge of ``a`` separates them, 0 where one touches,
    else below.
    """
    edges = np.roll(a, -1, axis=0) - a
    normals = np.column_stack([edges[:, 1], -edges[:, 0]])
    return int(((normals @ b.T).min(1) - (normals * a).sum(1)).max())


def _nearest(vertices, polygon) -> float:
    """Least squared distance from any vertex to any edge."""
    start = polygon.astype(float)
    edge = np.roll(start, -1, axis=0) - start
    to = vertices.astype(float)[:, None, :] - start
    along = np.clip((to * edge).sum(-1) / (edge**2).sum(-1), 0, 1)
    away = to - along[..., None] * edge
    return float((away**2).sum(-1).min())
