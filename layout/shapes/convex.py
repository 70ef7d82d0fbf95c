"""Exact widths of convex polygons with whole coordinates."""

import numpy as np

from metalens.core.arrays import Array


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
