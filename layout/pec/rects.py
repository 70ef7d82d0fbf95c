"""Exposure by rectangles: marks, labels, verniers and boxes, cut into pieces small
enough for one dose each.
"""

import math

import numpy as np

from layout.pec.psf import PointExposure
from layout.process.jit import compile_loop
from metalens.core import threads
from metalens.core.arrays import Array

_OUTSIDE_UM = (
    1e-4  # a point that far outside an edge tells whether another piece goes on there
)
CORNER = 2.0  # widths of the core: an edge is round that near its ends


def self_exposure(
    boxes: Array, group: Array, near: PointExposure
) -> tuple[Array, Array, Array]:
    """What a shape gives to its own edges by the Gaussians that are not summed on
    nodes, exact.

    Args:
        boxes: (pieces, 4) left, bottom, right, top, um.
        group: (pieces,) shape that each is a piece of.
        near: Gaussians that are not summed on nodes.

    Returns:
        (pieces,) mean exposure of the outer edges of each piece by its whole group at
        unit dose (an inner piece: of
        its middle, less half), and the points (n, 2) of the outer edges with (n,) the
        piece of each.
    """
    count = len(boxes)
    if not count:
        return np.empty(0), np.empty((0, 2)), np.empty(0, np.int64)
    one, two = pairs_near(boxes, group, near)
    starts = np.searchsorted(one, np.arange(count + 1))
    core_um = float(near.widths_um.min()) if len(near.widths_um) else 0.0
    points, piece = _outer(boxes, group, starts, two, CORNER * core_um)
    inner = np.bincount(piece, minlength=count) == 0
    at = np.concatenate([points, (boxes[inner, :2] + boxes[inner, 2:]) / 2])
    of = np.concatenate([piece, np.flatnonzero(inner)])
    total = np.bincount(
        of,
        sums_of_boxes(at[:, :1], at[:, 1:], of, boxes, (one, two), near)[:, 0, 0],
        minlength=count,
    )
    exposure = total / np.bincount(of, minlength=count)
    return np.where(inner, exposure / 2, exposure), at, of


def pairs_near(
    boxes_um: Array, group: Array, point: PointExposure
) -> tuple[Array, Array]:
    """Pairs of rows (one, two), sorted, of boxes of one group that touch or lie within
    six widths (exp(-36)).

    Args:
        boxes_um: (n, 4) left, bottom, right, top.
        point: sum of Gaussians.
    """
    order = np.lexsort((boxes_um[:, 0], group))
    boxes = np.ascontiguousarray(boxes_um[order])
    group = group[order]
    starts = np.flatnonzero(
        np.r_[np.ones(len(group[:1]), bool), group[1:] != group[:-1], True]
    )
    distance = 6 * float(point.widths_um.max(initial=0.0)) + _OUTSIDE_UM
    counts = np.zeros(len(boxes), np.int64)
    _pairs(boxes, starts, distance, counts, np.empty(0, np.int64))
    first = np.cumsum(counts) - counts
    near = np.empty(int(counts.sum()), np.int64)
    _pairs(boxes, starts, distance, first, near)
    one = order[np.repeat(np.arange(len(boxes)), counts)]
    two = order[near]
    rank = np.lexsort((two, one))
    return one[rank], two[rank]


@compile_loop
def _pairs(
    boxes: Array, starts: Array, distance: float, at: Array, near: Array
) -> None:
    """Boxes of a shape (sorted by their left sides) within ``distance`` of each of its
    boxes: written to ``near`` from
    ``at`` on, or counted there where ``near`` is empty.
    """
    for g in range(starts.shape[0] - 1):
        for n in range(starts[g], starts[g + 1]):
            found = 0
            for m in range(starts[g], starts[g + 1]):
                if boxes[m, 0] > boxes[n, 2] + distance:
                    break
                if boxes[m, 2] < boxes[n, 0] - distance:
                    continue
                if (
                    boxes[m, 1] > boxes[n, 3] + distance
                    or boxes[m, 3] < boxes[n, 1] - distance
                ):
                    continue
                if near.shape[0] > 0:
                    near[at[n] + found] = m
                found += 1
            if near.shape[0] == 0:
                at[n] = found


def sums_of_boxes(
    x_um: Array,
    y_um: Array,
    row: Array,
    boxes_um: Array,
    pairs: tuple[Array, Array],
    point: PointExposure,
) -> Array:
    """Exposure at the crossings of lines by those boxes of unit dose that ``pairs``
    (sorted) hold for a row.

    Args:
        x_um, y_um: (n, i) and (n, j) lines; row: (n,) whose boxes each of the n takes.
        boxes_um: (m, 4) left, bottom, right, top.
        point: sum of Gaussians.

    Returns:
        (n, j, i) exposure, exact to rounding.
    """
    one, two = pairs
    first = np.searchsorted(one, row)
    last = np.searchsorted(one, row, side="right")
    out = np.zeros((len(row), y_um.shape[1], x_um.shape[1]))
    lines = (np.ascontiguousarray(x_um), np.ascontiguousarray(y_um))
    boxes = np.ascontiguousarray(boxes_um, float)

    def work(start: int, stop: int) -> None:
        _sum(
            *lines,
            first,
            last,
            two,
            boxes,
            point.widths_um,
            point.weights,
            start,
            stop,
            out,
        )

    if len(row):
        threads.run_split(len(row), work)
    return out


@compile_loop
def _sum(
    x: Array, y: Array, first: Array, last: Array, near: Array, boxes: Array, widths: Array, weights: Array,
    start: int, stop: int, out: Array,
) -> None:  # fmt: skip
    """A Gaussian over a box is a product of differences of error functions; beyond six
    widths they are 0.
    """
    across, along = np.empty(x.shape[1]), np.empty(y.shape[1])
    for n in range(start, stop):
        for k in range(widths.shape[0]):
            reach = 6 * widths[k]
            scale = 1 / widths[k]
            left, right = x[n].min() - reach, x[n].max() + reach
            bottom, top = y[n].min() - reach, y[n].max() + reach
            for m in range(first[n], last[n]):
                b = boxes[near[m]]
                if b[0] > right or b[2] < left or b[1] > top or b[3] < bottom:
                    continue
                for i in range(x.shape[1]):
                    across[i] = math.erf((b[2] - x[n, i]) * scale) - math.erf(
                        (b[0] - x[n, i]) * scale
                    )
                for j in range(y.shape[1]):
                    along[j] = math.erf((b[3] - y[n, j]) * scale) - math.erf(
                        (b[1] - y[n, j]) * scale
                    )
                for j in range(y.shape[1]):
                    for i in range(x.shape[1]):
                        out[n, j, i] += weights[k] / 4 * along[j] * across[i]


def _outer(
    boxes: Array, group: Array, starts: Array, near: Array, corner_um: float
) -> tuple[Array, Array]:
    """Points (n, 2) on those parts of the sides of each piece that no other piece of
    its shape covers, and the piece.

    near: numbers of the pieces around each, from ``starts`` on. A point is the middle
    of its part or, within
    ``corner_um`` of an end of the straight run that the part belongs to, of what is
    left of the part beyond (nothing:
    the nearest place beyond). Runs of twice that length are round: left out.
    """
    room = 4 * (len(near) + len(boxes))
    part = np.empty((room, 3))
    piece = np.empty(room, np.int64)
    side = np.empty(room, np.int64)
    count = _free(boxes, starts, near, _OUTSIDE_UM, part, piece, side)
    part, piece, side = part[:count], piece[:count], side[:count]
    low, high = _run(part, group[piece], side)
    low, high = low + corner_um, high - corner_um
    straight = high > low
    middle = (np.clip(part[:, 1], low, high) + np.clip(part[:, 2], low, high)) / 2
    points = np.where(
        (side % 2 == 0)[:, None],
        np.stack([part[:, 0], middle], -1),
        np.stack([middle, part[:, 0]], -1),
    )
    return points[straight], piece[straight]


def _run(part: Array, group: Array, side: Array) -> tuple[Array, Array]:
    """Both ends (n,) of the straight run of outline that each part (n, 3: across, from,
    to) of a side belongs to.
    """
    line = np.rint(part[:, 0] / _OUTSIDE_UM)
    order = np.lexsort((part[:, 1], line, side, group))
    keys = np.stack([group, side, line])[:, order]
    distance = part[order[1:], 1] > part[order[:-1], 2] + _OUTSIDE_UM
    new = np.r_[True, (keys[:, 1:] != keys[:, :-1]).any(0) | distance]
    run = np.cumsum(new) - 1
    first = np.flatnonzero(new)
    low, high = np.empty(len(part)), np.empty(len(part))
    low[order], high[order] = (
        part[order[first], 1][run],
        part[order[np.r_[first[1:], len(order)] - 1], 2][run],
    )
    return low, high


@compile_loop
def _free(
    boxes: Array,
    starts: Array,
    near: Array,
    step: float,
    part: Array,
    piece: Array,
    sides: Array,
) -> int:
    """Fill in the free parts of all sides (across, from, to), longer than a step; how
    many there are.
    """
    count = 0
    for n in range(boxes.shape[0]):
        neighbours = boxes[near[starts[n] : starts[n + 1]]]
        for side in range(4):  # left, bottom, right, top
            across, along = side % 2, 1 - side % 2
            at = boxes[n, side]
            outside = at - step if side < 2 else at + step
            over = neighbours[
                (neighbours[:, across] <= outside)
                & (neighbours[:, across + 2] >= outside)
            ]
            over = over[np.argsort(over[:, along])]
            low, high = boxes[n, along], boxes[n, along + 2]
            for k in range(over.shape[0] + 1):
                end = over[k, along] if k < over.shape[0] else high
                if low < high and min(end, high) - low > step:
                    part[count, 0], part[count, 1], part[count, 2] = (
                        at,
                        low,
                        min(end, high),
                    )
                    piece[count], sides[count] = n, side
                    count += 1
                if k < over.shape[0]:
                    low = max(low, over[k, along + 2])
    return count


def rectangle_samples(box: Array, step_um: float) -> tuple[Array, Array, Array]:
    """Points (n, 2) that stand for the rectangles on nodes, their areas (n,), and the
    rectangle of each (n,).

    Args:
        box: (pieces, 4) left, bottom, right, top, um.
        step_um: between the points, at most.
    """
    counts = np.maximum(np.ceil((box[:, 2:] - box[:, :2]) / step_um - 1e-9), 1).astype(
        np.int64
    )
    of = np.repeat(np.arange(len(box)), counts.prod(1))
    within = np.arange(len(of)) - np.repeat(
        np.cumsum(counts.prod(1)) - counts.prod(1), counts.prod(1)
    )
    cell = np.stack([within % counts[of, 0], within // counts[of, 0]], -1)
    side = (box[:, 2:] - box[:, :2]) / counts
    return box[of, :2] + (cell + 0.5) * side[of], side.prod(1)[of], of
