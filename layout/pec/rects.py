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
    1e-4  # another piece covers an edge where it holds a point that far outside
)
CORNER = 2.0  # widths of the core: an edge is round that near its ends


def self_exposure(
    boxes: Array, group: Array, near: PointExposure
) -> tuple[Array, Array, Array]:
    """Mean exposure of the edges of each piece by its own shape at unit dose, exact.

    Args:
        boxes: (pieces, 4) left, bottom, right, top, um.
        group: (pieces,) shape that each is a piece of.
        near: Gaussians that are not summed on nodes.

    Returns:
        (pieces,) mean exposure over the outer edges of each piece (half of that in the
        middle of a piece without outer edges), (n, 2) positions where it was evaluated,
        um, and (n,) the piece of each position.
    """
    count = len(boxes)
    if not count:
        return np.empty(0), np.empty((0, 2)), np.empty(0, np.int64)
    first, second = pairs_near(boxes, group, near)
    starts = np.searchsorted(first, np.arange(count + 1))
    core_um = float(near.widths_um.min()) if len(near.widths_um) else 0.0
    points, piece = _outer(boxes, group, starts, second, CORNER * core_um)
    is_inner = np.bincount(piece, minlength=count) == 0
    positions = np.concatenate(
        [points, (boxes[is_inner, :2] + boxes[is_inner, 2:]) / 2]
    )
    piece_of_position = np.concatenate([piece, np.flatnonzero(is_inner)])
    sums = np.bincount(
        piece_of_position,
        sums_of_boxes(
            positions[:, :1],
            positions[:, 1:],
            piece_of_position,
            boxes,
            (first, second),
            near,
        )[:, 0, 0],
        minlength=count,
    )
    exposure = sums / np.bincount(piece_of_position, minlength=count)
    return np.where(is_inner, exposure / 2, exposure), positions, piece_of_position


def pairs_near(
    boxes_um: Array, group: Array, point: PointExposure
) -> tuple[Array, Array]:
    """Pairs of boxes of one group that touch or lie within six widths.

    Beyond six widths a Gaussian is below exp(-36).

    Args:
        boxes_um: (n, 4) left, bottom, right, top.
        group: (n,) group of each box.
        point: sum of Gaussians.

    Returns:
        (pairs,) first and (pairs,) second box, sorted; each box also pairs with itself.
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
    offsets = np.cumsum(counts) - counts
    neighbours = np.empty(int(counts.sum()), np.int64)
    _pairs(boxes, starts, distance, offsets, neighbours)
    first = order[np.repeat(np.arange(len(boxes)), counts)]
    second = order[neighbours]
    rank = np.lexsort((second, first))
    return first[rank], second[rank]


@compile_loop
def _pairs(
    boxes: Array, starts: Array, distance: float, offsets: Array, neighbours: Array
) -> None:
    """Boxes of the same shape within ``distance`` of each box, along x and along y.

    Called twice: first it counts them, then it lists them.

    Args:
        boxes: (n, 4) left, bottom, right, top, sorted by shape, then by left side.
        starts: (shapes + 1,) first box of each shape.
        distance: um.
        offsets: (n,) output, numbers of neighbours, where ``neighbours`` is empty; else
            input, where the list of each box begins.
        neighbours: output, box numbers; empty to count.
    """
    for shape in range(starts.shape[0] - 1):
        for box in range(starts[shape], starts[shape + 1]):
            count = 0
            for other in range(starts[shape], starts[shape + 1]):
                if boxes[other, 0] > boxes[box, 2] + distance:
                    break
                if boxes[other, 2] < boxes[box, 0] - distance:
                    continue
                if (
                    boxes[other, 1] > boxes[box, 3] + distance
                    or boxes[other, 3] < boxes[box, 1] - distance
                ):
                    continue
                if neighbours.shape[0] > 0:
                    neighbours[offsets[box] + count] = other
                count += 1
            if neighbours.shape[0] == 0:
                offsets[box] = count


def sums_of_boxes(
    x_um: Array,
    y_um: Array,
    row: Array,
    boxes_um: Array,
    pairs: tuple[Array, Array],
    point: PointExposure,
) -> Array:
    """Exposure at the crossings of lines by some boxes of unit dose, exact to rounding.

    Args:
        x_um: (n, i) x of the upright lines of each row.
        y_um: (n, j) y of the level lines of each row.
        row: (n,) box whose neighbours, by ``pairs``, expose each row.
        boxes_um: (m, 4) left, bottom, right, top.
        pairs: first and second box of each pair, sorted.
        point: sum of Gaussians.

    Returns:
        (n, j, i) exposure.
    """
    first_box, second_box = pairs
    begin = np.searchsorted(first_box, row)
    end = np.searchsorted(first_box, row, side="right")
    exposure = np.zeros((len(row), y_um.shape[1], x_um.shape[1]))
    lines = (np.ascontiguousarray(x_um), np.ascontiguousarray(y_um))
    boxes = np.ascontiguousarray(boxes_um, float)

    def sum_rows(start: int, stop: int) -> None:
        _sum(
            *lines,
            begin,
            end,
            second_box,
            boxes,
            point.widths_um,
            point.weights,
            start,
            stop,
            exposure,
        )

    if len(row):
        threads.run_split(len(row), sum_rows)
    return exposure


@compile_loop
def _sum(
    x: Array, y: Array, begin: Array, end: Array, other: Array, boxes: Array, widths: Array, weights: Array,
    start: int, stop: int, exposure: Array,
) -> None:  # fmt: skip
    """Add the exposure by boxes of unit dose at the crossings of lines.

    A Gaussian of width w over a box is 1/4 [erf((right - x) / w) - erf((left - x) / w)]
    times the same along y. Boxes beyond six widths are left out.

    Args:
        x: (n, i) and y: (n, j) lines, um.
        begin: (n,) and end: (n,) range of ``other`` for each row.
        other: box numbers.
        boxes: (m, 4) left, bottom, right, top, um.
        widths: (terms,) 1/e radii, um, and weights of the Gaussians.
        start: first row, and stop: row after the last.
        exposure: (n, j, i) output.
    """
    along_x, along_y = np.empty(x.shape[1]), np.empty(y.shape[1])
    for n in range(start, stop):
        for term in range(widths.shape[0]):
            reach = 6 * widths[term]
            scale = 1 / widths[term]
            left, right = x[n].min() - reach, x[n].max() + reach
            bottom, top = y[n].min() - reach, y[n].max() + reach
            for position in range(begin[n], end[n]):
                box = boxes[other[position]]
                if box[0] > right or box[2] < left or box[1] > top or box[3] < bottom:
                    continue
                for i in range(x.shape[1]):
                    along_x[i] = math.erf((box[2] - x[n, i]) * scale) - math.erf(
                        (box[0] - x[n, i]) * scale
                    )
                for j in range(y.shape[1]):
                    along_y[j] = math.erf((box[3] - y[n, j]) * scale) - math.erf(
                        (box[1] - y[n, j]) * scale
                    )
                for j in range(y.shape[1]):
                    for i in range(x.shape[1]):
                        exposure[n, j, i] += weights[term] / 4 * along_y[j] * along_x[i]


def _outer(
    boxes: Array, group: Array, starts: Array, neighbours: Array, corner_um: float
) -> tuple[Array, Array]:
    """Points on the outer sides of each piece, one for each uncovered part of a side.

    A point is the middle of its part. Corners of the outline are round: within
    ``corner_um`` of the end of a straight run no point is placed, and the part is
    clipped to what remains. Runs shorter than twice that length have no point.

    Args:
        boxes: (pieces, 4) left, bottom, right, top, um.
        group: (pieces,) shape of each.
        starts: (pieces + 1,) first entry of each piece in ``neighbours``.
        neighbours: numbers of the pieces around each.
        corner_um: length at both ends of a run.

    Returns:
        (n, 2) points, um, and (n,) the piece of each.
    """
    most_parts = 4 * (len(neighbours) + len(boxes))
    part = np.empty((most_parts, 3))
    piece = np.empty(most_parts, np.int64)
    side = np.empty(most_parts, np.int64)
    count = _free(boxes, starts, neighbours, _OUTSIDE_UM, part, piece, side)
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
    """Both ends of the straight run of outline that each part of a side belongs to.

    Parts of one shape, side and line are a run where no gap divides them.

    Args:
        part: (n, 3) coordinate across the side, and from, to along it, um.
        group: (n,) shape of each part.
        side: (n,) 0 left, 1 bottom, 2 right, 3 top.

    Returns:
        (n,) lower and (n,) upper end, um.
    """
    line = np.rint(part[:, 0] / _OUTSIDE_UM)
    order = np.lexsort((part[:, 1], line, side, group))
    keys = np.stack([group, side, line])[:, order]
    has_gap = part[order[1:], 1] > part[order[:-1], 2] + _OUTSIDE_UM
    starts_run = np.r_[True, (keys[:, 1:] != keys[:, :-1]).any(0) | has_gap]
    run = np.cumsum(starts_run) - 1
    first = np.flatnonzero(starts_run)
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
    neighbours: Array,
    step: float,
    parts: Array,
    pieces: Array,
    sides: Array,
) -> int:
    """Number of uncovered parts of all sides; the parts themselves are written out.

    Args:
        boxes: (n, 4) left, bottom, right, top, um.
        starts: (n + 1,) first entry of each box in ``neighbours``.
        neighbours: numbers of the boxes around each.
        step: shorter parts are left out; also how far outside a side another box must
            reach to cover it, um.
        parts: (room, 3) output: coordinate across the side, and from, to along it.
        pieces: (room,) output: box of each part.
        sides: (room,) output: 0 left, 1 bottom, 2 right, 3 top.
    """
    count = 0
    for n in range(boxes.shape[0]):
        around = boxes[neighbours[starts[n] : starts[n + 1]]]
        for side in range(4):  # left, bottom, right, top
            across, along = side % 2, 1 - side % 2
            position = boxes[n, side]
            outside = position - step if side < 2 else position + step
            covering = around[
                (around[:, across] <= outside) & (around[:, across + 2] >= outside)
            ]
            covering = covering[np.argsort(covering[:, along])]
            low, high = boxes[n, along], boxes[n, along + 2]
            for number in range(covering.shape[0] + 1):
                end = covering[number, along] if number < covering.shape[0] else high
                if low < high and min(end, high) - low > step:
                    parts[count, 0], parts[count, 1], parts[count, 2] = (
                        position,
                        low,
                        min(end, high),
                    )
                    pieces[count], sides[count] = n, side
                    count += 1
                if number < covering.shape[0]:
                    low = max(low, covering[number, along + 2])
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
    rectangle = np.repeat(np.arange(len(box)), counts.prod(1))
    index = np.arange(len(rectangle)) - np.repeat(
        np.cumsum(counts.prod(1)) - counts.prod(1), counts.prod(1)
    )
    cell = np.stack([index % counts[rectangle, 0], index // counts[rectangle, 0]], -1)
    side = (box[:, 2:] - box[:, :2]) / counts
    return (
        box[rectangle, :2] + (cell + 0.5) * side[rectangle],
        side.prod(1)[rectangle],
        rectangle,
    )
