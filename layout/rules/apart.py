"""Distances of any two polygons with whole coordinates, convex or not: edge to edge, 0
where they touch or overlap.
"""

from collections.abc import Sequence

import numpy as np

from layout.process import compiled
from metalens.ground.arrays import Array


def apart(
    outlines: Sequence[Array],
    kinds: tuple[Array, Array],
    moved: tuple[Array, Array],
    *,
    most: float = np.inf,
) -> Array:
    """(n,) distances of pairs of polygons; ``most`` where they are further apart.

    Args:
        outlines: (corners, 2) polygons, whole numbers below 2^30. kinds: (n,) the first
            and the second of each pair.
        moved: (n,) along x and y, by which the second one lies beside its outline.

    Whether two meet is decided in whole numbers; a distance is rounded as its square
    root is. What a polygon encloses
    goes by its turns: a hole that is cut into an outline is outside.
    """
    points = np.concatenate([np.empty((0, 2), np.int64), *outlines]).astype(np.int64)
    first = np.concatenate(
        [[0], np.cumsum([len(outline) for outline in outlines])]
    ).astype(np.int64)
    out = np.empty(len(kinds[0]))
    _apart(points, first, kinds[0], kinds[1], moved[0], moved[1], most, out)
    return out


@compiled
def _apart(
    points: Array,
    first: Array,
    one: Array,
    two: Array,
    dx: Array,
    dy: Array,
    most: float,
    out: Array,
) -> None:
    for n in range(out.shape[0]):
        a = points[first[one[n]] : first[one[n] + 1]]
        b = points[first[two[n]] : first[two[n] + 1]].copy()
        b[:, 0] += dx[n]
        b[:, 1] += dy[n]
        square = _least_square(a, b, most * most)
        if square > 0 and (
            _turns_around(a, b[0, 0], b[0, 1]) or _turns_around(b, a[0, 0], a[0, 1])
        ):
            square = 0.0
        out[n] = most if square >= most * most else square**0.5


@compiled
def _least_square(a: Array, b: Array, best: float) -> float:
    """Squared distance of two outlines, where it is below ``best``; 0 where they meet."""
    low_x, high_x, low_y, high_y = (
        b[:, 0].min(),
        b[:, 0].max(),
        b[:, 1].min(),
        b[:, 1].max(),
    )
    for i in range(a.shape[0]):
        p, q = a[i - 1], a[i]
        left, right, bottom, top = (
            min(p[0], q[0]),
            max(p[0], q[0]),
            min(p[1], q[1]),
            max(p[1], q[1]),
        )
        x, y = (
            max(left - high_x, low_x - right, 0),
            max(bottom - high_y, low_y - top, 0),
        )
        if float(x) * x + float(y) * y >= best:
            continue
        for j in range(b.shape[0]):
            r, s = b[j - 1], b[j]
            x = max(left - max(r[0], s[0]), min(r[0], s[0]) - right, 0)
            y = max(bottom - max(r[1], s[1]), min(r[1], s[1]) - top, 0)
            if float(x) * x + float(y) * y >= best:
                continue
            if x == 0 and y == 0 and _straddles(p, q, r, s) and _straddles(r, s, p, q):
                return 0.0
            ends = min(
                _to_edge(p, r, s),
                _to_edge(q, r, s),
                _to_edge(r, p, q),
                _to_edge(s, p, q),
            )
            best = min(best, ends)
    return best


@compiled
def _straddles(p: Array, q: Array, r: Array, s: Array) -> bool:
    """Whether r and s lie on different sides of the line from p to q, or one on it."""
    one = (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])
    two = (q[0] - p[0]) * (s[1] - p[1]) - (q[1] - p[1]) * (s[0] - p[0])
    return bool((one <= 0 <= two) or (two <= 0 <= one))


@compiled
def _to_edge(end: Array, p: Array, q: Array) -> float:
    """Squared distance of a point from the edge between p and q."""
    dx, dy = float(q[0] - p[0]), float(q[1] - p[1])
    x, y = float(end[0] - p[0]), float(end[1] - p[1])
    along = min(max((x * dx + y * dy) / max(dx * dx + dy * dy, 1.0), 0.0), 1.0)
    return float((x - along * dx) ** 2 + (y - along * dy) ** 2)


@compiled
def _turns_around(polygon: Array, x: int, y: int) -> bool:
    """Whether a polygon winds around a point that is on none of its edges."""
    turns = 0
    for k in range(polygon.shape[0]):
        p, q = polygon[k - 1], polygon[k]
        if (p[1] <= y) != (q[1] <= y):
            side = (q[0] - p[0]) * (y - p[1]) - (q[1] - p[1]) * (x - p[0])
            if (side > 0) == (q[1] > p[1]):
                turns += 1 if q[1] > p[1] else -1
    return turns != 0
