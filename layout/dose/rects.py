"""Exposure by rectangles: marks, labels, verniers and boxes, cut into pieces small enough for one dose each."""

import numpy as np

from layout.dose.bodies import Rects
from layout.dose.exposure import PointExposure
from layout.process import compiled
from metalens.ground.arrays import Array

_OUTSIDE_UM = 1e-4  # a point that far outside an edge tells whether another piece goes on there
_AT_ONCE = 1_000_000  # pairs
CORNER = 2.0  # widths of the core: an edge is round that near its ends


def own(rects: Rects, near: PointExposure) -> tuple[Array, Array, Array]:
    """What a shape gives to its own edges by the Gaussians that are not summed on nodes, exact.

    Returns:
        (pieces,) mean exposure of the outer edges of each piece by its whole group at unit dose (an inner piece: of
        its middle, less half), and the points (n, 2) of the outer edges with (n,) the piece of each.
    """
    boxes, count = rects.box_um, len(rects.box_um)
    if not count:
        return np.empty(0), np.empty((0, 2)), np.empty(0, np.int64)
    one, two = pairs_near(boxes, boxes, near)
    same = rects.group[one] == rects.group[two]
    one, two = one[same], two[same]
    starts = np.searchsorted(one, np.arange(count + 1))
    core_um = float(near.widths_um.min()) if len(near.widths_um) else 0.0
    points, piece = _outer(rects, starts, two, CORNER * core_um)
    inner = np.bincount(piece, minlength=count) == 0
    at = np.concatenate([points, (boxes[inner, :2] + boxes[inner, 2:]) / 2])
    of = np.concatenate([piece, np.flatnonzero(inner)])
    total = np.bincount(of, sums_of_boxes(at, of, boxes, (one, two), near), minlength=count)
    exposure = total / np.bincount(of, minlength=count)
    return np.where(inner, exposure / 2, exposure), at, of


def pairs_near(some: Array, boxes: Array, point: PointExposure) -> tuple[Array, Array]:
    """Pairs (row of ``some``, row of ``boxes``), sorted, that touch or lie within six widths (exp(-36))."""
    from scipy.spatial import cKDTree

    middles, halves = zip(*(((b[:, :2] + b[:, 2:]) / 2, (b[:, 2:] - b[:, :2]) / 2) for b in (some, boxes)), strict=True)
    apart = 6 * float(point.widths_um.max(initial=0.0)) + _OUTSIDE_UM
    size = np.frexp(np.hypot(*halves[1].T))[1]  # boxes of like size together, so that a long one pairs only itself
    ones, twos = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    for level in np.unique(size).tolist():
        members = np.flatnonzero(size == level)
        far = np.hypot(*halves[0].T) + np.hypot(*halves[1][members].T).max() + apart
        found = cKDTree(middles[1][members]).query_ball_point(middles[0], far)
        one, two = (
            np.repeat(np.arange(len(some)), [len(f) for f in found]),
            np.concatenate([*found, []]).astype(np.int64),
        )
        kept = (
            np.abs(middles[0][one] - middles[1][members[two]]) <= halves[0][one] + halves[1][members[two]] + apart
        ).all(1)
        ones.append(one[kept])
        twos.append(members[two[kept]])
    one, two = np.concatenate(ones), np.concatenate(twos)
    order = np.lexsort((two, one))
    return one[order], two[order]


def sums_of_boxes(at_um: Array, row: Array, boxes_um: Array, pairs: tuple[Array, Array], point: PointExposure) -> Array:
    """(n,) exposure at points by those boxes of unit dose that ``pairs`` (sorted) hold for the row of each point."""
    from scipy.special import erf

    one, two = pairs
    first, last = np.searchsorted(one, row), np.searchsorted(one, row, side="right")
    total = np.zeros(len(at_um))
    for part in np.array_split(np.arange(len(at_um)), max(1, int((last - first).sum()) // _AT_ONCE)):
        count = (last - first)[part]
        n = np.repeat(part, count)
        box = boxes_um[
            two[np.arange(len(n)) - np.repeat(np.cumsum(count) - count, count) + np.repeat(first[part], count)]
        ]
        value = np.zeros(len(n))
        for width, weight in zip(point.widths_um.tolist(), point.weights.tolist(), strict=True):
            x, y = (
                (erf((box[:, k + 2] - at_um[n, k]) / width) - erf((box[:, k] - at_um[n, k]) / width)) / 2
                for k in (0, 1)
            )
            value += weight * x * y
        total += np.bincount(n, value, minlength=len(total))
    return total


def _outer(rects: Rects, starts: Array, near: Array, corner_um: float) -> tuple[Array, Array]:
    """Points (n, 2) on those parts of the sides of each piece that no other piece of its shape covers, and the piece.

    near: numbers of the pieces around each, from ``starts`` on. A point is the middle of its part or, within
    ``corner_um`` of an end of the straight run that the part belongs to, of what is left of the part beyond (nothing:
    the nearest place beyond). Runs of twice that length are round: left out.
    """
    room = 4 * (len(near) + len(rects.box_um))
    part, piece, side = np.empty((room, 3)), np.empty(room, np.int64), np.empty(room, np.int64)
    count = _free(rects.box_um, starts, near, _OUTSIDE_UM, part, piece, side)
    part, piece, side = part[:count], piece[:count], side[:count]
    low, high = _run(part, rects.group[piece], side)
    low, high = low + corner_um, high - corner_um
    straight = high > low
    middle = (np.clip(part[:, 1], low, high) + np.clip(part[:, 2], low, high)) / 2
    points = np.where((side % 2 == 0)[:, None], np.stack([part[:, 0], middle], -1), np.stack([middle, part[:, 0]], -1))
    return points[straight], piece[straight]


def _run(part: Array, group: Array, side: Array) -> tuple[Array, Array]:
    """Both ends (n,) of the straight run of outline that each part (n, 3: across, from, to) of a side belongs to."""
    line = np.rint(part[:, 0] / _OUTSIDE_UM)
    order = np.lexsort((part[:, 1], line, side, group))
    keys = np.stack([group, side, line])[:, order]
    apart = part[order[1:], 1] > part[order[:-1], 2] + _OUTSIDE_UM
    new = np.r_[True, (keys[:, 1:] != keys[:, :-1]).any(0) | apart]
    run = np.cumsum(new) - 1
    first = np.flatnonzero(new)
    low, high = np.empty(len(part)), np.empty(len(part))
    low[order], high[order] = part[order[first], 1][run], part[order[np.r_[first[1:], len(order)] - 1], 2][run]
    return low, high


@compiled
def _free(boxes: Array, starts: Array, near: Array, step: float, part: Array, piece: Array, sides: Array) -> int:
    """Fill in the free parts of all sides (across, from, to), longer than a step; how many there are."""
    count = 0
    for n in range(boxes.shape[0]):
        beside = boxes[near[starts[n] : starts[n + 1]]]
        for side in range(4):  # left, bottom, right, top
            across, along = side % 2, 1 - side % 2
            at = boxes[n, side]
            outside = at - step if side < 2 else at + step
            over = beside[(beside[:, across] <= outside) & (beside[:, across + 2] >= outside)]
            over = over[np.argsort(over[:, along])]
            low, high = boxes[n, along], boxes[n, along + 2]
            for k in range(over.shape[0] + 1):
                end = over[k, along] if k < over.shape[0] else high
                if low < high and min(end, high) - low > step:
                    part[count, 0], part[count, 1], part[count, 2] = at, low, min(end, high)
                    piece[count], sides[count] = n, side
                    count += 1
                if k < over.shape[0]:
                    low = max(low, over[k, along + 2])
    return count


def samples(rects: Rects, step_um: float) -> tuple[Array, Array, Array]:
    """Points (n, 2) that stand for the rectangles on nodes, their areas (n,), and the rectangle of each (n,)."""
    box = rects.box_um
    counts = np.maximum(np.ceil((box[:, 2:] - box[:, :2]) / step_um - 1e-9), 1).astype(np.int64)
    of = np.repeat(np.arange(len(box)), counts.prod(1))
    within = np.arange(len(of)) - np.repeat(np.cumsum(counts.prod(1)) - counts.prod(1), counts.prod(1))
    cell = np.stack([within % counts[of, 0], within // counts[of, 0]], -1)
    side = (box[:, 2:] - box[:, :2]) / counts
    return box[of, :2] + (cell + 0.5) * side[of], side.prod(1)[of], of
