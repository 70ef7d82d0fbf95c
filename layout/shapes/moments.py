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
    for corner in contours:
        following = np.roll(corner, -1, axis=0)
        cross = corner[:, 0] * following[:, 1] - following[:, 0] * corner[:, 1]
        area += float(cross.sum()) / 2
        first += ((corner + following) * cross[:, None]).sum(0) / 6
        second += (
            float(
                (
                    cross
                    * (
                        corner * corner + corner * following + following * following
                    ).sum(1)
                ).sum()
            )
            / 12
        )
    return area, first, second


def total_perimeter(contours: Contours) -> float:
    """Length of all edges.

    Args:
        contours: of one polygon.
    """
    return sum(
        float(np.hypot(*(np.roll(contour, -1, axis=0) - contour).T).sum())
        for contour in contours
    )


def points_along_edges(contours: Contours, count: int = 32) -> Array:
    """(count, 2) points at equal distances along all edges.

    Args:
        contours: of one polygon.
        count: of the points.
    """
    start = np.concatenate(list(contours))
    edge = (
        np.concatenate([np.roll(contour, -1, axis=0) for contour in contours]) - start
    )
    length = np.hypot(*edge.T)
    end_distance = np.cumsum(length)
    distance = (np.arange(count) + 0.5) / count * end_distance[-1]
    number = np.searchsorted(end_distance, distance)
    return np.asarray(
        start[number]
        + (1 - (end_distance[number] - distance) / length[number])[:, None]
        * edge[number]
    )
