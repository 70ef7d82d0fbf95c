"""Widths, notches and spaces of any polygons, edge against edge: exact for the parts of two edges that face."""

import numpy as np

from layout.process import compiled
from metalens.ground.arrays import Array

WIDTH, SPACE = 0, 1


def facing(edges: Array, shape: Array, feature: float, gap: float) -> Array:
    """(n, 4) pairs of edges that face each other too near: first edge, second edge, kind, distance.

    Args:
        edges: (m, 4) x, y to x, y, the inside to the left. shape: (m,) which polygon each belongs to.
        feature: least width (edges of one shape that face through its inside). gap: least space (through the outside,
            of one shape or two).

    Edges that share a corner face nowhere; of any other pair the parts count that lie before each other.
    """
    order = np.argsort(np.minimum(edges[:, 0], edges[:, 2]), kind="stable")
    room = 1 << 12
    while True:
        found = np.empty((room, 4))
        count = _sweep(np.asarray(edges[order], float), np.asarray(shape[order], np.int64), feature, gap, found)
        if count < room:
            break
        room *= 4
    found = found[:count]
    found[:, :2] = order[found[:, :2].astype(np.int64)]
    return found


@compiled
def _sweep(edges: Array, shape: Array, feature: float, gap: float, found: Array) -> int:
    """Fill ``found``; the number of pairs, or its length where it is full."""
    count, most = 0, max(feature, gap)
    for i in range(edges.shape[0]):
        right = max(edges[i, 0], edges[i, 2]) + most
        low, high = min(edges[i, 1], edges[i, 3]) - most, max(edges[i, 1], edges[i, 3]) + most
        for j in range(i + 1, edges.shape[0]):
            if min(edges[j, 0], edges[j, 2]) > right:
                break
            if min(edges[j, 1], edges[j, 3]) > high or max(edges[j, 1], edges[j, 3]) < low:
                continue
            along = (edges[i, 2] - edges[i, 0]) * (edges[j, 2] - edges[j, 0])
            if along + (edges[i, 3] - edges[i, 1]) * (edges[j, 3] - edges[j, 1]) >= 0:
                continue
            for kind in range(2):
                limit = feature if kind == 0 else gap
                if kind == 0 and shape[i] != shape[j]:
                    continue
                away = _facing_distance(edges[i], edges[j], 1.0 if kind == 0 else -1.0)
                if 0 < away < limit - 1e-9:
                    if count == found.shape[0]:
                        return count
                    found[count, 0], found[count, 1], found[count, 2], found[count, 3] = i, j, kind, away
                    count += 1
    return count


@compiled
def _facing_distance(a: Array, b: Array, side: float) -> float:
    """Distance of the parts that lie before each other, to the left (side 1) or right (-1); -1 where none does."""
    p, q = _before(a, b, side), _before(b, a, side)
    if p[4] == 0 or q[4] == 0:
        return -1.0
    least = min(_to(p[0], p[1], q), _to(p[2], p[3], q))
    return float(min(least, _to(q[0], q[1], p), _to(q[2], q[3], p)) ** 0.5)


@compiled
def _before(line: Array, edge: Array, side: float) -> Array:
    """The part of ``edge`` on the wanted side of ``line``: x, y, x, y, and 1 where there is any."""
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


@compiled
def _to(x: float, y: float, edge: Array) -> float:
    """Squared distance from a point to an edge."""
    dx, dy = edge[2] - edge[0], edge[3] - edge[1]
    long = dx * dx + dy * dy
    t = 0.0 if long == 0 else min(max(((x - edge[0]) * dx + (y - edge[1]) * dy) / long, 0.0), 1.0)
    return float((x - edge[0] - t * dx) ** 2 + (y - edge[1] - t * dy) ** 2)
