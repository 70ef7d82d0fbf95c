"""Exposure by rectangles: marks, labels, verniers and boxes, cut into pieces small enough for one dose each."""

from collections.abc import Iterator

import numpy as np

from layout.dose.bodies import Rects
from layout.dose.exposure import PointExposure
from metalens.ground.arrays import Array

_OUTSIDE_UM = 1e-4  # a point that far outside an edge tells whether another piece goes on there
_CORNER = 4.0  # widths of the core: edges that short are round


def own(rects: Rects, near: PointExposure) -> tuple[Array, Array, Array]:
    """What a shape gives to its own edges by the Gaussians that are not summed on nodes, exact.

    Returns:
        (pieces,) mean exposure of the outer edges of each piece by its whole group at unit dose (an inner piece: of
        its middle, less half), and the points (n, 2) of the outer edges with (n,) the piece of each.
    """
    exposure = np.zeros(len(rects.box_um))
    points: list[Array] = []
    piece: list[int] = []
    corner_um = _CORNER * float(near.widths_um.min(initial=0.0))
    for group in np.unique(rects.group):
        members = np.flatnonzero(rects.group == group)
        around = _around(rects.box_um[members], near)
        for n, box, beside in zip(members.tolist(), rects.box_um[members], around, strict=True):
            boxes = rects.box_um[members[beside]]
            edge = _outer(box, boxes, corner_um)
            inside = not len(edge)
            at = np.array([[(box[0] + box[2]) / 2, (box[1] + box[3]) / 2]]) if inside else edge
            exposure[n] = of_boxes(at, boxes, near).mean() / (2 if inside else 1)
            points.extend(at)
            piece.extend([n] * len(at))
    return exposure, np.array(points).reshape(-1, 2), np.array(piece, np.int64)


def _around(boxes: Array, near: PointExposure) -> list[list[int]]:
    """For each box, those that touch it or lie within six widths (exp(-36)) of it."""
    from scipy.spatial import cKDTree

    middle = (boxes[:, :2] + boxes[:, 2:]) / 2
    across = float(np.hypot(*(boxes[:, 2:] - boxes[:, :2]).T).max())
    reach = across + 6 * float(near.widths_um.max(initial=0.0)) + _OUTSIDE_UM
    return list(cKDTree(middle).query_ball_point(middle, reach))


def _outer(box: Array, boxes: Array, least_um: float) -> Array:
    """Middles of those parts of the sides of a piece that no other piece of the shape covers.

    Parts up to ``least_um`` long, which lie in a corner, are left out.
    """
    found: list[tuple[float, float]] = []
    for across in (0, 1):
        low, high = float(box[1 - across]), float(box[3 - across])
        for at, step in ((float(box[across]), -_OUTSIDE_UM), (float(box[across + 2]), _OUTSIDE_UM)):
            beyond = boxes[(boxes[:, across] <= at + step) & (boxes[:, across + 2] >= at + step)]
            for start, end in _free(low, high, beyond[:, [1 - across, 3 - across]]):
                if end - start > least_um:
                    along = (start + end) / 2
                    found.append((along, at) if across else (at, along))
    return np.array(found).reshape(-1, 2)


def _free(low: float, high: float, covered: Array) -> Iterator[tuple[float, float]]:
    """Parts of an interval that none of some others (n, 2) covers."""
    for start, end in sorted(covered.tolist()):
        if start > low:
            yield low, min(start, high)
        low = max(low, end)
        if low >= high:
            return
    yield low, high


def of_boxes(points_um: Array, boxes_um: Array, point: PointExposure) -> Array:
    """(n,) exposure at points by boxes of unit dose: products of error functions, exact."""
    from scipy.special import erf

    total = np.zeros(len(points_um))
    for width, weight in zip(point.widths_um, point.weights, strict=True):
        part = np.ones((len(points_um), len(boxes_um)))
        for axis in (0, 1):
            at = points_um[:, None, axis]
            part *= (erf((boxes_um[:, axis + 2] - at) / width) - erf((boxes_um[:, axis] - at) / width)) / 2
        total += weight * part.sum(-1)
    return total


def _cut(box: Array, side_um: float) -> Array:
    xs, ys = (
        np.linspace(low, high, max(1, int(np.ceil((high - low) / side_um - 1e-9))) + 1)
        for low, high in ((box[0], box[2]), (box[1], box[3]))
    )
    left, bottom = (v.ravel() for v in np.meshgrid(xs[:-1], ys[:-1]))
    right, top = (v.ravel() for v in np.meshgrid(xs[1:], ys[1:]))
    return np.stack([left, bottom, right, top], -1)


def samples(rects: Rects, step_um: float) -> tuple[Array, Array, Array]:
    """Points (n, 2) that stand for the rectangles on nodes, their areas (n,), and the rectangle of each (n,)."""
    if not len(rects.box_um):
        return np.empty((0, 2)), np.empty(0), np.empty(0, np.int64)
    sides = rects.box_um[:, 2:] - rects.box_um[:, :2]
    small = (sides.max(1) <= step_um * (1 + 1e-9)).tolist()
    parts = [box[None] if one else _cut(box, step_um) for box, one in zip(rects.box_um, small, strict=True)]
    cut = np.concatenate(parts)
    middle = (cut[:, :2] + cut[:, 2:]) / 2
    area = (cut[:, 2] - cut[:, 0]) * (cut[:, 3] - cut[:, 1])
    return middle, area, np.repeat(np.arange(len(parts)), [len(p) for p in parts])
