"""Exact distances and widths of convex polygons with whole coordinates."""

import math

import numpy as np

from metalens.core.arrays import Array


def farthest_vertex(points: Array) -> float:
    """Distance from the origin to the farthest vertex."""
    return float(np.sqrt((points.astype(float) ** 2).sum(1).max()))


def convex_hull(points: Array) -> Array:
    """(m, 2) corners of the convex polygon around points (n, 2), counter-clockwise."""
    from scipy.spatial import ConvexHull

    return np.asarray(points[ConvexHull(points).vertices])


def least_width(points: Array) -> float:
    """Least distance of two parallel lines with the polygon between them: one of them
    runs along an edge.

    Args:
        points: (n, 2) corners, counter-clockwise.
    """
    edges = np.roll(points, -1, axis=0) - points
    normals = np.column_stack([edges[:, 1], -edges[:, 0]])
    spans = normals @ points.T
    return float(((spans.max(1) - spans.min(1)) / np.hypot(*normals.T)).min())


def convex_gap(first: Array, second: Array, dx: int, dy: int) -> float:
    """Distance from ``first`` to ``second`` moved by (dx, dy); 0 where they touch, -1
    where they overlap.
    """
    moved = second + np.array([dx, dy])
    apart = max(_separation(first, moved), _separation(moved, first))
    if apart <= 0:
        return -1.0 if apart < 0 else 0.0
    return math.sqrt(min(_nearest(first, moved), _nearest(moved, first)))


def _separation(a: Array, b: Array) -> int:
    """Above 0 where a line along an edge of ``a`` separates them, 0 where one touches,
    else below.
    """
    edges = np.roll(a, -1, axis=0) - a
    normals = np.column_stack([edges[:, 1], -edges[:, 0]])
    return int(((normals @ b.T).min(1) - (normals * a).sum(1)).max())


def _nearest(vertices: Array, polygon: Array) -> float:
    """Least squared distance from any vertex to any edge."""
    start = polygon.astype(float)
    edge = np.roll(start, -1, axis=0) - start
    to = vertices.astype(float)[:, None, :] - start
    along = np.clip((to * edge).sum(-1) / (edge**2).sum(-1), 0, 1)
    away = to - along[..., None] * edge
    return float((away**2).sum(-1).min())
