"""Shapes of one layer number of a mask made anywhere: different outlines once, and
where each stands.
"""

import math
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from layout.files import MaskContent, Turn, flat
from layout.rules import near
from layout.rules.apart import apart
from metalens.ground.arrays import Array


@dataclass(frozen=True, eq=False, slots=True)
class Layer:
    """Shapes of one layer number: different outlines, and (n,) int32 which each is,
    with its place x, y.
    """

    outlines: list[Array]
    cells: list[str]
    kind: Array
    x: Array
    y: Array

    @property
    def discs(self) -> near.Discs:
        """Circles around the shapes, about the middles of their boxes."""
        middle = np.array([(o.min(0) + o.max(0)) / 2 for o in self.outlines]).reshape(
            -1, 2
        )
        reach = np.array(
            [
                np.hypot(*(o - m).T).max()
                for o, m in zip(self.outlines, middle, strict=True)
            ]
        )
        return near.Discs(self.x, self.y, self.kind, middle, reach)

    def points(self, n: int) -> Array:
        """(m, 2) corners of shape ``n``."""
        return np.asarray(
            self.outlines[self.kind[n]] + np.array([self.x[n], self.y[n]], np.int64)
        )

    def box(self, *members: int) -> tuple[int, int, int, int]:
        """Left, bottom, right, top of some shapes."""
        corners = np.concatenate([self.points(n) for n in members])
        (left, bottom), (right, top) = corners.min(0).tolist(), corners.max(0).tolist()
        return left, bottom, right, top

    def boxes(self, members: "Array | slice" = slice(None)) -> Array:
        """(n, 4) left, bottom, right, top of each of some shapes."""
        own = np.array(
            [[*o.min(0), *o.max(0)] for o in self.outlines], np.int64
        ).reshape(-1, 4)
        place = np.column_stack([self.x[members], self.y[members]]).astype(np.int64)
        return np.asarray(own[self.kind[members]] + np.hstack([place, place]))

    def distances(self, one: Array, two: Array, most: float) -> Array:
        """(n,) between shapes: 0 where they touch or overlap, ``most`` where they are
        further apart.
        """
        moved = (
            self.x[two].astype(np.int64) - self.x[one],
            self.y[two].astype(np.int64) - self.y[one],
        )
        return apart(self.outlines, (self.kind[one], self.kind[two]), moved, most=most)

    @property
    def around(self) -> Array:
        """(1, 4) left, bottom, right, top of all shapes together; (0, 4) where there
        are none.
        """
        if not len(self.kind):
            return np.empty((0, 4), np.int64)
        low, high = (
            np.array([f(o, 0) for o in self.outlines], np.int64)
            for f in (np.min, np.max)
        )
        places = (self.x, self.y)
        ends = [np.min(v + low[self.kind, n]) for n, v in enumerate(places)]
        ends += [np.max(v + high[self.kind, n]) for n, v in enumerate(places)]
        return np.array([ends], np.int64)

    def only(self, members: Array) -> "Layer":
        """Some of the shapes: (n,) bool or numbers."""
        return Layer(
            self.outlines,
            self.cells,
            self.kind[members],
            self.x[members],
            self.y[members],
        )

    def copied(self, turn: Turn, x: Array, y: Array) -> "Layer":
        """A copy of all shapes, turned by quarters, at each of (m,) places."""
        outlines = [np.column_stack(turn.apply(*o.T)) for o in self.outlines]
        outlines = [o[::-1] for o in outlines] if turn.mirrored else outlines
        u, v = turn.apply(self.x.astype(np.int64), self.y.astype(np.int64))
        px, py = (
            (a[:, None] + b).ravel().astype(np.int32)
            for a, b in ((x.astype(np.int64), u), (y, v))
        )
        return Layer(outlines, self.cells, np.tile(self.kind, len(x)), px, py)


EMPTY = Layer([], [], *(np.empty(0, np.int32) for _ in range(3)))


def joined(some: Sequence[Layer]) -> Layer:
    """All shapes together; equal outlines are one."""
    if len(some) == 1:
        return some[0]
    number: dict[bytes, int] = {}
    outlines: list[Array] = []
    cells: list[str] = []
    kinds: list[Array] = []
    for layer in some:
        new = np.empty(len(layer.outlines), np.int32)
        for k, (outline, cell) in enumerate(
            zip(layer.outlines, layer.cells, strict=True)
        ):
            key = np.ascontiguousarray(outline, np.int64).tobytes()
            if key not in number:
                number[key] = len(outlines)
                outlines.append(outline)
                cells.append(cell)
            new[k] = number[key]
        kinds.append(new[layer.kind])
    x, y = (np.concatenate([getattr(layer, axis) for layer in some]) for axis in "xy")
    return Layer(outlines, cells, np.concatenate(kinds), x, y)


Groups = dict[int, list[list[flat.Shapes]]]


def groups(
    content: MaskContent,
    tops: Sequence[str],
    skip: Sequence[int],
    whole: Set[str],
    number_of: Mapping[int, int] = MappingProxyType({}),
) -> Groups:
    """{layer number: shapes below ``tops``, those of one outline together}, without
    cells that are kept ``whole``.

    number_of: layer numbers that count as another.
    """
    found: Groups = {}

    def number(shape: flat.Shapes) -> int | None:
        return (
            None
            if shape.layer[0] in skip
            else number_of.get(shape.layer[0], shape.layer[0])
        )

    for group in flat.alike(content, number, tops=tops, whole=whole).values():
        found.setdefault(
            number_of.get(group[0].layer[0], group[0].layer[0]), []
        ).append(group)
    return found


def gathered(some: list[list[flat.Shapes]]) -> Layer:
    """All of them, those of one outline together; they are let go on the way. Points
    and lines draw nothing.
    """
    corners = [plain(np.asarray(group[0].outline, np.int64)) for group in some]
    some = [group for group, own in zip(some, corners, strict=True) if len(own) > 2]
    outlines = [filled(own) for own in corners if len(own) > 2]
    cells = [group[0].cell for group in some]
    total, at = sum(len(shape.x) for group in some for shape in group), 0
    kind, x, y = (np.empty(total, np.int32) for _ in range(3))
    for number, group in enumerate(some):
        while group:
            shape = group.pop()
            part = slice(at, at + len(shape.x))
            kind[part], x[part], y[part] = number, shape.x, shape.y
            at = part.stop
    return Layer(outlines, cells, kind, x, y)


def plain(points: Array) -> Array:
    """Corners without repeats and without those on a straight line."""
    points = points[(points != np.roll(points, 1, axis=0)).any(1)]
    before, after = (
        points - np.roll(points, 1, axis=0),
        np.roll(points, -1, axis=0) - points,
    )
    return np.asarray(points[before[:, 0] * after[:, 1] != before[:, 1] * after[:, 0]])


def filled(points: Array) -> Array:
    """Corners without dents shallower than a unit, which rounding leaves in turned and
    round shapes.
    """
    if is_convex(points) or len(points) < 4:
        return points
    from scipy.spatial import ConvexHull

    hull = ConvexHull(points)
    depth = -(points @ hull.equations[:, :2].T + hull.equations[:, 2]).max(1)
    return np.asarray(points[hull.vertices]) if depth.max() < 1 else points


def is_convex(points: Array) -> bool:
    """Whether corners turn left all the way around, once."""
    before, after = (
        points - np.roll(points, 1, axis=0),
        np.roll(points, -1, axis=0) - points,
    )
    if (before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]).min() <= 0:
        return False
    turned = np.unwrap(np.arctan2(after[:, 1], after[:, 0]))
    return bool(turned[-1] - turned[0] < 2 * math.pi)
