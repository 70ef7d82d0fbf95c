"""Rectangles of marks and labels cut into pieces of one dose each: short where the
background changes, long elsewhere.
"""

from dataclasses import dataclass

import numpy as np

from layout.pec.psf import THRESHOLD, PointExposure
from layout.pec.rects import CORNER, pairs_near, sums_of_boxes
from layout.process.jit import compile_loop
from metalens.core.arrays import Array
from metalens.core.errors import ProcessError

MOST_PIECES = 500_000
# of the tolerance, which the background may change from the middle of a side to its end
_SHARE = 0.2
_SHORTEST = 64  # pieces along the range, at most
# ranges: of a piece; where longer ones meet, doses change so far into a shape that
# edges are 1 to 2 % off
_LONGEST = 0.5
_BESIDE = 8  # pieces along the range next to a lens, whose edge is no box
_FEW = 3.0  # ranges at which a lens, or a corner, no longer counts


@dataclass(frozen=True, eq=False, slots=True)
class _Pieces:
    """box: (n, 4) left, bottom, right, top in grid steps. outer: (n, 4) which of these
    sides the box has of its
    shape, in part at least.

    of: (n,) the box it was cut from.
    """

    box: Array
    outer: Array
    of: Array

    def some(self, which: Array) -> "_Pieces":
        return _Pieces(self.box[which], self.outer[which], self.of[which])

    def halved(self, axis: int) -> "_Pieces":
        """Both halves of each, cut across ``axis`` (0: x)."""
        middle = (self.box[:, axis] + self.box[:, axis + 2]) // 2
        low, high = self.box.copy(), self.box.copy()
        low[:, axis + 2], high[:, axis] = middle, middle
        first, second = self.outer.copy(), self.outer.copy()
        first[:, axis + 2], second[:, axis] = False, False
        return _joined([_Pieces(low, first, self.of), _Pieces(high, second, self.of)])


def fracture_boxes(
    boxes: Array,
    lattices: Array,
    *,
    step_um: float,
    point: PointExposure,
    tolerance: float,
) -> tuple[Array, Array]:
    """Boxes (n, 4) on the grid cut to pieces (m, 4) on the grid, and (m,) the box of
    each.

    Args:
        boxes: whole grid steps; step_um: one of them. lattices: (l, 4) boxes around the
            pillars, um.
        tolerance: of the exposure; the background changes by a fifth of it between
            middle and end of a side, or
            the piece is a 64th of the range or two of the core short (doses that step
            so often are even once blurred).
        point: exposure of a beam.

    Raises:
        ProcessError: more than 500 000 pieces.
    """
    wide = point.widths_um > 4 * point.widths_um.min()
    if not wide.any() or not len(boxes):
        return np.asarray(boxes, np.int64), np.arange(len(boxes))
    around = PointExposure(point.widths_um[wide], point.weights[wide])
    shortest = (
        max(
            float(around.widths_um.min()) / _SHORTEST,
            CORNER * float(point.widths_um.min()),
        )
        / step_um
    )
    change = _SHARE * tolerance * THRESHOLD
    usual, corners = _ranges(around, change)
    every = np.asarray(boxes) * step_um
    whole = np.asarray(boxes, np.int64)
    pairs = pairs_near(every, np.zeros(len(every)), around)
    first = np.searchsorted(pairs[0], np.arange(len(every) + 1))
    done: list[_Pieces] = []
    count = 0
    outer = np.ones((len(boxes), 4), bool)
    open_ = _Pieces(whole, outer, np.arange(len(boxes)))
    while len(open_.box):
        _uncover(open_.box, open_.of, whole, first, pairs[1], open_.outer)
        longest = np.full(len(open_.box), _LONGEST * usual)
        _shorten(longest, open_.box * step_um, every[open_.of], corners)
        _shorten_near_lens(longest, open_.box * step_um, lattices, around)
        ratio = _change(open_, every, pairs, step_um, around) / change
        side = open_.box[:, 2:] - open_.box[:, :2]
        split = (side >= 2 * shortest) & (
            (side > longest[:, None] / step_um) | (ratio > 1)
        )
        # the longer side where both need it
        across = split & ~(split[:, ::-1] & (side < side[:, ::-1]))
        done.append(open_.some(np.asarray(~split.any(1))))
        count += len(done[-1].box)
        open_ = _joined(
            [
                open_.some(across[:, 0]).halved(0),
                open_.some(across[:, 1] & ~across[:, 0]).halved(1),
            ]
        )
        if count + len(open_.box) > MOST_PIECES:
            raise ProcessError(
                f"marks and labels need more than {MOST_PIECES:,} pieces of one dose each for a point exposure whose "
                f"backscatter ranges {usual:.3g} um; draw smaller marks (die.mark_um), or set exposure.correct = false"
            )
    pieces = _joined(done)
    order = np.argsort(pieces.of, kind="stable")
    return pieces.box[order], pieces.of[order]


def _ranges(around: PointExposure, change: float) -> tuple[float, list[float]]:
    """Width that half of the scattered energy reaches, and the narrower ones, falling,
    whose energy counts at corners.

    There a Gaussian gives an eighth of its weight less than in the middle of what it
    changes by. All that together change by less than ``change`` are left out: the
    doses there are as even without.
    """
    order = np.argsort(around.widths_um)
    widths = around.widths_um[order]
    total = np.cumsum(around.weights[order])
    usual = float(widths[np.searchsorted(total, total[-1] / 2)])
    return usual, widths[(widths < usual) & (total > 8 * change)][::-1].tolist()


@compile_loop
def _uncover(
    box: Array, of: Array, whole: Array, first: Array, near: Array, outer: Array
) -> None:
    """Take sides that other boxes cover from end to end out of ``outer``: no edge is
    there.

    near: numbers of the boxes around each of ``whole``, from ``first`` on.
    """
    for n in range(box.shape[0]):
        neighbours = near[first[of[n]] : first[of[n] + 1]]
        for side in range(4):  # left, bottom, right, top
            if not outer[n, side]:
                continue
            across = side % 2
            along = 1 - side % 2
            at = box[n, side]
            low = box[n, along]
            reached = box[n, along] - 1
            while reached < low < box[n, along + 2]:
                reached = low
                for m in neighbours:
                    b = whole[m]
                    over = (
                        b[across] < at <= b[across + 2]
                        if side < 2
                        else b[across] <= at < b[across + 2]
                    )
                    if over and b[along] <= low:
                        low = max(low, b[along + 2])
            outer[n, side] = low < box[n, along + 2]


def _joined(parts: list[_Pieces]) -> _Pieces:
    return _Pieces(
        *(
            np.concatenate([getattr(p, name) for p in parts])
            for name in ("box", "outer", "of")
        )
    )


def _shorten(longest: Array, box: Array, whole: Array, corners: list[float]) -> None:
    """Shorter pieces near the corners of the box (n, 4) that each is of, for ranges
    that count there.
    """
    ends = [
        np.minimum(box[:, k] - whole[:, k], whole[:, k + 2] - box[:, k + 2])
        for k in (0, 1)
    ]
    for width in corners:
        longest[np.hypot(*ends) < _FEW * width] = _LONGEST * width


def _shorten_near_lens(
    longest: Array, box: Array, lattices: Array, around: PointExposure
) -> None:
    """Shorter pieces near a lens, whose edge is no box."""
    for width in np.sort(around.widths_um)[::-1].tolist():
        for left, bottom, right, top in lattices.tolist():
            x = np.maximum(np.maximum(left - box[:, 2], box[:, 0] - right), 0)
            y = np.maximum(np.maximum(bottom - box[:, 3], box[:, 1] - top), 0)
            longest[np.hypot(x, y) < _FEW * width] = width / _BESIDE


def _change(
    pieces: _Pieces,
    every: Array,
    pairs: tuple[Array, Array],
    step_um: float,
    around: PointExposure,
) -> Array:
    """(n, 2) half the change of the background of all boxes at unit dose along x and y:
    along outer sides, and from
    one outer side to the opposite one. every: (boxes, 4) um, and ``pairs`` of them that
    see each other.
    """
    box = pieces.box * step_um
    middle = (box[:, :2] + box[:, 2:]) / 2
    xs = np.stack([box[:, 0], middle[:, 0], box[:, 2]], -1)
    ys = np.stack([box[:, 1], middle[:, 1], box[:, 3]], -1)
    field = sums_of_boxes(xs, ys, pieces.of, every, pairs, around)
    along_x, along_y = (
        np.ptp(field, axis=axis) / 2 for axis in (2, 1)
    )  # of the lines bottom to top, left to right
    held = pieces.outer
    x = np.maximum(along_x[:, 0] * held[:, 1], along_x[:, 2] * held[:, 3])
    y = np.maximum(along_y[:, 0] * held[:, 0], along_y[:, 2] * held[:, 2])
    over = (
        np.abs(field[:, :, 2] - field[:, :, 0]).max(1) / 2 * (held[:, 0] & held[:, 2])
    )
    up = np.abs(field[:, 2] - field[:, 0]).max(1) / 2 * (held[:, 1] & held[:, 3])
    return np.stack([np.maximum(x, over), np.maximum(y, up)], -1)
