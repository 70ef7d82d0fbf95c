"""Polygons of horizontal and vertical edges, cut into rectangles, exactly."""

import itertools
from collections.abc import Iterable, Sequence

import numpy as np

from metalens.core.arrays import Array
from metalens.core.errors import ProcessError

IntBox = tuple[int, int, int, int]  # left, bottom, right, top


def split_rectilinear(points: Array) -> Array:
    """(n, 4) left, bottom, right, top of rectangles that fill a rectilinear polygon.

    The polygon is cut at the y of every corner.

    Args:
        points: (m, 2) corners of a simple polygon.

    Raises:
        ProcessError: an edge that is neither horizontal nor vertical.
    """
    start = points
    end = np.roll(points, -1, axis=0)
    if ((start != end).all(axis=1)).any():
        raise ProcessError(
            "a shape with slanted edges where horizontal and vertical ones are needed"
        )
    is_vertical = start[:, 0] == end[:, 0]
    x = start[is_vertical, 0]
    low = np.minimum(start, end)[is_vertical, 1]
    high = np.maximum(start, end)[is_vertical, 1]
    levels = np.unique(points[:, 1])
    rectangles = []
    for bottom, top in zip(levels[:-1].tolist(), levels[1:].tolist(), strict=True):
        crossings = np.sort(x[(low <= bottom) & (high >= top)])
        rectangles += [
            (left, bottom, right, top)
            for left, right in zip(
                crossings[::2].tolist(), crossings[1::2].tolist(), strict=True
            )
        ]
    return np.array(rectangles, points.dtype).reshape(-1, 4)


def merge_runs(rows: Iterable[Array]) -> Array:
    """(n, 4) first column, first row, end column, end row of rectangles of set cells.

    Runs of set cells in a row are rectangles; equal runs of consecutive rows are one.

    Args:
        rows: (columns,) booleans each, from the first row on.
    """
    first_row: dict[tuple[int, int], int] = {}
    rectangles = []
    for row, cells in enumerate(itertools.chain(rows, [np.empty(0, bool)])):
        edges = np.flatnonzero(np.diff(np.r_[False, cells, False])).tolist()
        runs = set(zip(edges[::2], edges[1::2], strict=True))
        for left, right in sorted(first_row.keys() - runs):
            rectangles.append((left, first_row.pop((left, right)), right, row))
        first_row.update(dict.fromkeys(runs - first_row.keys(), row))
    return np.array(rectangles, np.int64).reshape(-1, 4)


def box_corners(box: Array | Sequence[float]) -> Array:
    """(4, 2) corners of left, bottom, right, top, counter-clockwise.

    Args:
        box: (4,) left, bottom, right, top.
    """
    left, bottom, right, top = np.asarray(box).tolist()
    return np.array([[left, bottom], [right, bottom], [right, top], [left, top]])


def box_distance(boxes: Array, box: Array) -> Array:
    """Distance of boxes from one.

    Args:
        boxes: (n, 4) left, bottom, right, top.
        box: (4,).

    Returns:
        (n,) distances; 0 where they meet.
    """
    across = np.maximum(np.maximum(boxes[:, :2] - box[2:], box[:2] - boxes[:, 2:]), 0)
    return np.asarray(np.hypot(*across.T))
