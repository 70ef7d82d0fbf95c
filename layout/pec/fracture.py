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
    """Pieces of boxes, on the grid.

    box: (n, 4) left, bottom, right, top in grid steps. outer: (n, 4) whether each side
    is, at least in part, an edge of the shape. of: (n,) the box it was cut from.
    """

    box: Array
    outer: Array
    of: Array

    def some(self, which: Array) -> "_Pieces":
        """The pieces of some indices, or of a mask."""
        return _Pieces(self.box[which], self.outer[which], self.of[which])

    def halved(self, axis: int) -> "_Pieces":
        """Both halves of each, cut across ``axis`` (0: x)."""
        middle = (self.box[:, axis] + self.box[:, axis + 2]) // 2
        low, high = self.box.copy(), self.box.copy()
        low[:, axis + 2], high[:, axis] = middle, middle
        low_outer, high_outer = self.outer.copy(), self.outer.copy()
        low_outer[:, axis + 2], high_outer[:, axis] = False, False
        return _joined(
            [_Pieces(low, low_outer, self.of), _Pieces(high, high_outer, self.of)]
        )


def fracture_boxes(
    boxes: Array,
    lattices: Array,
    *,
    step_um: float,
    point: PointExposure,
    tolerance: float,
) -> tuple[Array, Array]:
    """Cut boxes to pieces of one dose each, halving them until the background is even.

    A piece is cut while its background at unit dose changes by more than a fifth of the
    tolerance between middle and end of a side, or while it is longer than half the
    scattering range. It is not cut below 1/64 of the range or two widths of the core.

    Args:
        boxes: (n, 4) left, bottom, right, top in grid steps.
        lattices: (l, 4) boxes around the pillars, um.
        step_um: grid step.
        point: exposure of a beam.
        tolerance: relative, of the exposure.

    Returns:
        (m, 4) pieces in grid steps, and (m,) the box of each.

    Raises:
        ProcessError: more than 500 000 pieces.
    """
    wide = point.widths_um > 4 * point.widths_um.min()
    if not wide.any() or not len(boxes):
        return np.asarray(boxes, np.int64), np.arange(len(boxes))
    scattered = PointExposure(point.widths_um[wide], point.weights[wide])
    shortest = (
        max(
            float(scattered.widths_um.min()) / _SHORTEST,
            CORNER * float(point.widths_um.min()),
        )
        / step_um
    )
    allowed = _SHARE * tolerance * THRESHOLD
    usual, narrower_um = _ranges(scattered, allowed)
    boxes_um = np.asarray(boxes) * step_um
    whole = np.asarray(boxes, np.int64)
    pairs = pairs_near(boxes_um, np.zeros(len(boxes_um)), scattered)
    offsets = np.searchsorted(pairs[0], np.arange(len(boxes_um) + 1))
    finished: list[_Pieces] = []
    count = 0
    outer = np.ones((len(boxes), 4), bool)
    waiting = _Pieces(whole, outer, np.arange(len(boxes)))
    while len(waiting.box):
        _uncover(waiting.box, waiting.of, whole, offsets, pairs[1], waiting.outer)
        longest = np.full(len(waiting.box), _LONGEST * usual)
        _shorten(longest, waiting.box * step_um, boxes_um[waiting.of], narrower_um)
        _shorten_near_lens(longest, waiting.box * step_um, lattices, scattered)
        excess = _change(waiting, boxes_um, pairs, step_um, scattered) / allowed
        side = waiting.box[:, 2:] - waiting.box[:, :2]
        split = (side >= 2 * shortest) & (
            (side > longest[:, None] / step_um) | (excess > 1)
        )
        # the longer side where both need it
        across = split & ~(split[:, ::-1] & (side < side[:, ::-1]))
        finished.append(waiting.some(np.asarray(~split.any(1))))
        count += len(finished[-1].box)
        waiting = _joined(
            [
                waiting.some(across[:, 0]).halved(0),
                waiting.some(across[:, 1] & ~across[:, 0]).halved(1),
            ]
        )
        if count + len(waiting.box) > MOST_PIECES:
            raise ProcessError(
                f"marks and labels need more than {MOST_PIECES:,} pieces of one dose each for a point exposure whose "
                f"backscatter ranges {usual:.3g} um; draw smaller marks (die.mark_um), or set exposure.correct = false"
            )
    pieces = _joined(finished)
    order = np.argsort(pieces.of, kind="stable")
    return pieces.box[order], pieces.of[order]


def _ranges(scattered: PointExposure, change: float) -> tuple[float, list[float]]:
    """Scattering ranges that set the length of pieces, um.

    At a corner a Gaussian gives an eighth of its weight less than at the middle of a
    side. The narrowest ranges, which together change by less than ``change``, are left
    out.

    Args:
        scattered: wide Gaussians of the point exposure.
        change: allowed change of the exposure.

    Returns:
        Width up to which half of the scattered energy reaches, and the narrower widths
        that count at corners, falling.
    """
    order = np.argsort(scattered.widths_um)
    widths = scattered.widths_um[order]
    energy = np.cumsum(scattered.weights[order])
    usual = float(widths[np.searchsorted(energy, energy[-1] / 2)])
    return usual, widths[(widths < usual) & (energy > 8 * change)][::-1].tolist()


@compile_loop
def _uncover(
    box: Array,
    source: Array,
    whole: Array,
    offsets: Array,
    neighbour_numbers: Array,
    outer: Array,
) -> None:
    """Clear the flags ``outer`` of sides that other boxes cover from end to end.

    Args:
        box: (n, 4) left, bottom, right, top of the pieces, grid steps.
        source: (n,) box that each piece was cut from.
        whole: (boxes, 4) boxes before they were cut.
        offsets: (boxes + 1,) first entry of each box in ``neighbour_numbers``.
        neighbour_numbers: numbers of the boxes around each.
        outer: (n, 4) whether a side is an edge of the shape; changed in place.
    """
    for piece in range(box.shape[0]):
        neighbours = neighbour_numbers[
            offsets[source[piece]] : offsets[source[piece] + 1]
        ]
        for side in range(4):  # left, bottom, right, top
            if not outer[piece, side]:
                continue
            across = side % 2
            along = 1 - side % 2
            position = box[piece, side]
            low = box[piece, along]
            reached = box[piece, along] - 1
            while reached < low < box[piece, along + 2]:
                reached = low
                for number in neighbours:
                    other = whole[number]
                    over = (
                        other[across] < position <= other[across + 2]
                        if side < 2
                        else other[across] <= position < other[across + 2]
                    )
                    if over and other[along] <= low:
                        low = max(low, other[along + 2])
            outer[piece, side] = low < box[piece, along + 2]


def _joined(parts: list[_Pieces]) -> _Pieces:
    return _Pieces(
        *(
            np.concatenate([getattr(p, name) for p in parts])
            for name in ("box", "outer", "of")
        )
    )


def _shorten(longest: Array, box: Array, whole: Array, corners: list[float]) -> None:
    """Reduce the longest allowed length of pieces near the corners of their boxes.

    Args:
        longest: (n,) um, changed in place.
        box: (n, 4) pieces, um.
        whole: (n, 4) the box of each piece, um.
        corners: widths that count at corners, falling, um.
    """
    ends = [
        np.minimum(box[:, k] - whole[:, k], whole[:, k + 2] - box[:, k + 2])
        for k in (0, 1)
    ]
    for width in corners:
        longest[np.hypot(*ends) < _FEW * width] = _LONGEST * width


def _shorten_near_lens(
    longest: Array, box: Array, lattices: Array, scattered: PointExposure
) -> None:
    """Reduce the longest allowed length of pieces near a lens, whose edge is no box.

    Args:
        longest: (n,) um, changed in place.
        box: (n, 4) pieces, um.
        lattices: (l, 4) boxes around the pillars, um.
        scattered: wide Gaussians of the point exposure.
    """
    for width in np.sort(scattered.widths_um)[::-1].tolist():
        for left, bottom, right, top in lattices.tolist():
            x = np.maximum(np.maximum(left - box[:, 2], box[:, 0] - right), 0)
            y = np.maximum(np.maximum(bottom - box[:, 3], box[:, 1] - top), 0)
            longest[np.hypot(x, y) < _FEW * width] = width / _BESIDE


def _change(
    pieces: _Pieces,
    boxes_um: Array,
    pairs: tuple[Array, Array],
    step_um: float,
    scattered: PointExposure,
) -> Array:
    """(n, 2) half the change of the background over each piece, along x and along y.

    The background of all boxes at unit dose is evaluated at 3 x 3 points of a piece.
    Its changes along the outer sides count, and from an outer side to an opposite outer
    side.

    Args:
        pieces: in grid steps.
        boxes_um: (boxes, 4) left, bottom, right, top.
        pairs: first and second box of all pairs within reach, sorted.
        step_um: grid step.
        scattered: wide Gaussians of the point exposure.
    """
    box = pieces.box * step_um
    middle = (box[:, :2] + box[:, 2:]) / 2
    xs = np.stack([box[:, 0], middle[:, 0], box[:, 2]], -1)
    ys = np.stack([box[:, 1], middle[:, 1], box[:, 3]], -1)
    field = sums_of_boxes(xs, ys, pieces.of, boxes_um, pairs, scattered)
    along_x, along_y = (
        np.ptp(field, axis=axis) / 2 for axis in (2, 1)
    )  # of the lines bottom to top, left to right
    outer = pieces.outer
    x = np.maximum(along_x[:, 0] * outer[:, 1], along_x[:, 2] * outer[:, 3])
    y = np.maximum(along_y[:, 0] * outer[:, 0], along_y[:, 2] * outer[:, 2])
    across_x = (
        np.abs(field[:, :, 2] - field[:, :, 0]).max(1) / 2 * (outer[:, 0] & outer[:, 2])
    )
    across_y = (
        np.abs(field[:, 2] - field[:, 0]).max(1) / 2 * (outer[:, 1] & outer[:, 3])
    )
    return np.stack([np.maximum(x, across_x), np.maximum(y, across_y)], -1)
