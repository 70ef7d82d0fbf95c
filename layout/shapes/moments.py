"""Polygons with holes: area, moments and edges, by Green's theorem; outlines
counter-clockwise, holes clockwise.
"""

from collections.abc import Sequence

import numpy as np

from metalens.core.arrays import Array

Contours = Sequence[Array]  # (n, 2) each


def polygon_moments(contours: Contours) -> tuple[float, Array, float]:
    """Area, (2,) integral of x and y over it, and integral of x² + y²; of a hole alone
    the area is below 0.

    Args:
        contours: of one polygon.
    """
    area = 0.0
    first = np.zeros(2)
    second = 0.0
    for a in contours:
        b = np.roll(a, -1, axis=0)
        cross = a[:, 0] * b[:, 1] - b[:, 0] * a[:, 1]
        area += float(cross.sum()) / 2
        first += ((a + b) * cross[:, None]).sum(0) / 6
        second += float((cross * (a * a + a * b + b * b).sum(1)).sum()) / 12
    return area, first, second


def perimeter(contours: Contours) -> float:
    """Length of all edges.

    Args:
        contours: of one polygon.
    """
    return sum(float(np.hypot(*(np.roll(c, -1, axis=0) - c).T).sum()) for c in contours)


def points_along_edges(contours: Contours, count: int) -> Array:
    """(count, 2) places evenly along all edges.

    Args:
        contours: of one polygon.
    """
    start = np.concatenate(list(contours))
    edge = np.concatenate([np.roll(c, -1, axis=0) for c in contours]) - start
    long = np.hypot(*edge.T)
    ends = np.cumsum(long)
    at = (np.arange(count) + 0.5) / count * ends[-1]
    k = np.searchsorted(ends, at)
    return np.asarray(start[k] + (1 - (ends[k] - at) / long[k])[:, None] * edge[k])
