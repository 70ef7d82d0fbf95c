"""Widths, notches and spaces of any polygons, edge against edge: exact where two of
them see each other.
"""

import numpy as np

from layout.process import compiled
from metalens.ground.arrays import Array

WIDTH, SPACE = 0, 1
KNOWN = -1  # shape number of contours whose widths are measured elsewhere
# parts of two edges that are looked at, nearest first, where others stand between them
_TRIES = 400
_SHORTEST = 1 / 16  # of the rule: parts so short are not halved
# start of each strip among its edges, their numbers, how far along x they go up to
# each; of each edge its lowest strip;
# bottom and height of the strips
Strips = tuple[Array, Array, Array, Array, float, float]
_NEAR = 1e-7  # units: a line that ends that near to an edge does not cross it


def facing(
    edges: Array, shape: Array, feature: float, gap: float, *, hole: Array | None = None
) -> Array:
    """(n, 4) pairs of edges that face each other too near: first edge, second edge,
    kind, distance.

    Args:
        edges: (m, 4) x, y to x, y, the inside to the left. shape: (m,) which polygon
            each belongs to; of ``KNOWN`` no
            widths are measured.
        hole: (m,) numbers from 0 on of holes in which no spaces are measured, -1
            elsewhere. None: in all they are.
        feature: least width (edges of one shape that face through its inside). gap:
            least space (through the outside,
            of one shape or two).

    Edges that share a corner face nowhere; of any other pair the parts count that lie
    before each other and see each
    other: through the inside for a width, through the outside for a space.
    """
    edges = np.asarray(edges, float)
    order = np.argsort(np.minimum(edges[:, 0], edges[:, 2]), kind="stable")
    edges, shape, room = edges[order], np.asarray(shape[order], np.int64), 1 << 12
    strips = _strips(edges, max(feature, gap))
    hole = np.full(len(edges), -1) if hole is None else hole[order]
    while True:
        found = np.empty((room, 4))
        count = _sweep(edges, shape, hole, strips, feature, gap, found)
        if count < room:
            break
        room *= 4
    found = found[:count]
    found[:, :2] = order[found[:, :2].astype(np.int64)]
    return found


def _strips(edges: Array, most: float) -> Strips:
    """Edges, sorted along x, in strips along x in which each keeps its order: some
    three places for each edge.
    """
    low, high = edges[:, 1::2].min(1), edges[:, 1::2].max(1)
    bottom, extent = (
        float(low.min(initial=0)),
        float(np.ptp(edges[:, 1::2])) if len(edges) else 0.0,
    )
    height = max(
        most,
        float((high - low).mean()) if len(edges) else 0.0,
        extent / (4 * len(edges) + 1024),
    )
    first, last = ((v - bottom) // height for v in (low, high))
    first, last = first.astype(np.int64), last.astype(np.int64)
    start = np.concatenate(
        [
            [0],
            np.cumsum(
                _counted(first, last, np.zeros(int(last.max(initial=0)) + 1, np.int64))
            ),
        ]
    )
    member, reach = np.empty(start[-1], np.int64), np.empty(start[-1])
    _filled(edges, first, last, start[:-1].copy(), start, member, reach)
    return start, member, reach, first, bottom, height


@compiled
def _counted(first: Array, last: Array, out: Array) -> Array:
    for k in range(first.shape[0]):
        for strip in range(first[k], last[k] + 1):
            out[strip] += 1
    return out


@compiled
def _filled(
    edges: Array,
    first: Array,
    last: Array,
    at: Array,
    start: Array,
    member: Array,
    reach: Array,
) -> None:
    """``reach``: how far along x the edges of a strip go up to each of them."""
    for k in range(edges.shape[0]):
        right = max(edges[k, 0], edges[k, 2])
        for strip in range(first[k], last[k] + 1):
            n = at[strip]
            member[n] = k
            reach[n] = right if n == start[strip] else max(right, reach[n - 1])
            at[strip] += 1


@compiled
def _strip_of(y: float, strips: Strips) -> int:
    """Number of the strip at a height; one of those that there are."""
    return int(min(max((y - strips[4]) // strips[5], 0), strips[0].shape[0] - 2))


@compiled
def _sweep(
    edges: Array,
    shape: Array,
    hole: Array,
    strips: Strips,
    feature: float,
    gap: float,
    found: Array,
) -> int:
    """Fill ``found``; the number of pairs, or its length where it is full."""
    count, most = 0, max(feature, gap)
    start, member, _, first, _, _ = strips
    for i in range(edges.shape[0]):
        right = max(edges[i, 0], edges[i, 2]) + most
        low, high = (
            min(edges[i, 1], edges[i, 3]) - most,
            max(edges[i, 1], edges[i, 3]) + most,
        )
        lowest = _strip_of(low, strips)
        for strip in range(lowest, _strip_of(high, strips) + 1):
            some = member[start[strip] : start[strip + 1]]
            for n in range(np.searchsorted(some, i + 1), some.shape[0]):
                j = some[n]
                if min(edges[j, 0], edges[j, 2]) > right:
                    break
                if strip != max(lowest, first[j]):  # seen in a strip below
                    continue
                if (
                    min(edges[j, 1], edges[j, 3]) > high
                    or max(edges[j, 1], edges[j, 3]) < low
                ):
                    continue
                if not _opposite(edges[i], edges[j]):
                    continue
                for kind in range(2):
                    if kind == 0 and (shape[i] != shape[j] or shape[i] == KNOWN):
                        continue
                    if kind == 1 and hole[i] >= 0 and hole[i] == hole[j]:
                        continue
                    away = _seen(
                        i,
                        j,
                        edges,
                        strips,
                        1.0 if kind == 0 else -1.0,
                        feature if kind == 0 else gap,
                    )
                    if away > 0:
                        if count == found.shape[0]:
                            return count
                        (
                            found[count, 0],
                            found[count, 1],
                            found[count, 2],
                            found[count, 3],
                        ) = i, j, kind, away
                        count += 1
    return count


@compiled
def _opposite(one: Array, two: Array) -> bool:
    """Whether two edges run against each other."""
    return bool(
        (one[2] - one[0]) * (two[2] - two[0]) + (one[3] - one[1]) * (two[3] - two[1])
        < 0
    )


@compiled
def _seen(
    i: int, j: int, edges: Array, strips: Strips, side: float, limit: float
) -> float:
    """Distance of the parts of two edges that lie before each other, to the left (side
    1) or right (-1), and see each
    other; -1 where none does, or none nearer than ``limit``.
    """
    p, q = _before(edges[i], edges[j], side), _before(edges[j], edges[i], side)
    if p[4] == 0 or q[4] == 0:
        return -1.0
    pair, line = np.empty(9), np.empty(4)
    pair[:4], pair[4:8] = p[:4], q[:4]
    pair[8] = _nearest(pair, line)
    if not 0 < pair[8] < limit - 1e-9:
        return -1.0
    if _is_free(line, i, j, edges, strips, side):
        return float(pair[8])
    parts = np.empty((3 * _TRIES + 4, 9))
    count = _halves(pair, limit, parts, 0)
    for _ in range(_TRIES):
        if count == 0:
            return -1.0
        best = np.argmin(parts[:count, 8])
        pair[:] = parts[best]
        _nearest(pair, line)
        if _is_free(line, i, j, edges, strips, side):
            return float(pair[8])
        parts[best] = parts[count - 1]
        count = _halves(pair, limit, parts, count - 1)
    return -1.0


@compiled
def _halves(pair: Array, limit: float, parts: Array, count: int) -> int:
    """Put both halves of both edges of a pair, that are nearer than ``limit``, behind
    the first ``count`` parts.
    """
    line, least = np.empty(4), _SHORTEST * limit
    if (
        max(
            abs(pair[0] - pair[2]),
            abs(pair[1] - pair[3]),
            abs(pair[4] - pair[6]),
            abs(pair[5] - pair[7]),
        )
        < least
    ):
        return count
    for k in range(4):
        made = parts[count]
        made[:] = pair
        for edge, half in ((0, k & 1), (4, k >> 1)):
            for axis in range(2):
                middle = (pair[edge + axis] + pair[edge + 2 + axis]) / 2
                made[edge + axis + (0 if half else 2)] = middle
        made[8] = _nearest(made, line)
        count += 1 if made[8] < limit else 0
    return count


@compiled
def _nearest(pair: Array, line: Array) -> float:
    """Distance of two edges (the first eight numbers) that do not cross; ``line``:
    between their nearest points.
    """
    best = np.inf
    for k in range(4):
        end, edge = (pair[2 * k : 2 * k + 2], pair[4:8] if k < 2 else pair[:4])
        dx, dy = edge[2] - edge[0], edge[3] - edge[1]
        long = dx * dx + dy * dy
        t = (
            0.0
            if long == 0
            else min(
                max(((end[0] - edge[0]) * dx + (end[1] - edge[1]) * dy) / long, 0.0),
                1.0,
            )
        )
        x, y = edge[0] + t * dx, edge[1] + t * dy
        away = (end[0] - x) ** 2 + (end[1] - y) ** 2
        if away < best:
            best = away
            line[:2] = end
            line[2], line[3] = x, y
    return float(best**0.5)


@compiled
def _is_free(
    line: Array, i: int, j: int, edges: Array, strips: Strips, side: float
) -> bool:
    """Whether a line between edges ``i`` and ``j`` crosses no other, and leaves corners
    on the wanted side.
    """
    low, high = min(line[0], line[2]), max(line[0], line[2])
    bottom, top = min(line[1], line[3]), max(line[1], line[3])
    corners, numbers = (
        np.zeros((2, 4)),
        np.zeros(4, np.int64),
    )  # directions into and out of the corner at each end
    start, member, reach, first, _, _ = strips
    lowest = _strip_of(bottom, strips)
    for strip in range(lowest, _strip_of(top, strips) + 1):
        begin, end = start[strip], start[strip + 1]
        for n in range(begin + np.searchsorted(reach[begin:end], low), end):
            k = member[n]
            e = edges[k]
            if min(e[0], e[2]) > high:
                break
            if strip != max(lowest, first[k]):  # seen in a strip below
                continue
            if (
                max(e[0], e[2]) < low
                or min(e[1], e[3]) > top
                or max(e[1], e[3]) < bottom
            ):
                continue
            _at_ends(e, line, corners, numbers)
            if k not in (i, j) and _cross(line, e):
                return False
    for end in range(2):
        if numbers[2 * end] == 1 and numbers[2 * end + 1] == 1:
            away = 1.0 if end == 0 else -1.0
            if not _leaves(
                corners[end],
                away * (line[2] - line[0]),
                away * (line[3] - line[1]),
                side,
            ):
                return False
    return True


@compiled
def _at_ends(e: Array, line: Array, corners: Array, numbers: Array) -> None:
    """Enter an edge that leads into or out of an end of the line: its direction, and
    that there is one.
    """
    for end in range(2):
        for tip in range(2):
            if e[2 - 2 * tip] == line[2 * end] and e[3 - 2 * tip] == line[2 * end + 1]:
                corners[end, 2 * tip], corners[end, 2 * tip + 1] = (
                    e[2] - e[0],
                    e[3] - e[1],
                )
                numbers[2 * end + tip] += 1


@compiled
def _cross(line: Array, e: Array) -> bool:
    """Whether a line passes through an edge, farther than rounding from its own ends."""
    dx, dy = line[2] - line[0], line[3] - line[1]
    one = dx * (e[1] - line[1]) - dy * (e[0] - line[0])
    two = dx * (e[3] - line[1]) - dy * (e[2] - line[0])
    if (one > 0) == (two > 0):
        return False
    ex, ey = e[2] - e[0], e[3] - e[1]
    one = ex * (line[1] - e[1]) - ey * (line[0] - e[0])
    two = ex * (line[3] - e[1]) - ey * (line[2] - e[0])
    return bool(
        one * two < 0 and min(abs(one), abs(two)) > _NEAR * (ex * ex + ey * ey) ** 0.5
    )


@compiled
def _leaves(corner: Array, dx: float, dy: float, side: float) -> bool:
    """Whether a direction from a corner (directions in and out of it) goes to its left
    (side 1) or right (-1).
    """
    of_one = side * (corner[0] * dy - corner[1] * dx) >= 0
    of_two = side * (corner[2] * dy - corner[3] * dx) >= 0
    turned = side * (corner[0] * corner[3] - corner[1] * corner[2]) > 0
    return bool(of_one and of_two) if turned else bool(of_one or of_two)


@compiled
def _before(line: Array, edge: Array, side: float) -> Array:
    """The part of ``edge`` on the wanted side of ``line``: x, y, x, y, and 1 where
    there is any.
    """
    dx, dy = line[2] - line[0], line[3] - line[1]
    s = side * (dx * (edge[1] - line[1]) - dy * (edge[0] - line[0]))
    e = side * (dx * (edge[3] - line[1]) - dy * (edge[2] - line[0]))
    out = np.array([edge[0], edge[1], edge[2], edge[3], 1.0])
    if s <= 0 and e <= 0:
        out[4] = 0.0
    elif s < 0 or e < 0:
        t = s / (s - e)
        x, y = edge[0] + t * (edge[2] - edge[0]), edge[1] + t * (edge[3] - edge[1])
        if s < 0:
            out[0], out[1] = x, y
        else:
            out[2], out[3] = x, y
    return out
