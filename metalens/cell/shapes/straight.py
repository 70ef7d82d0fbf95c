"""Sections with straight edges: square, rectangle, cross, regular polygon, and the
user's own polygon.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from metalens.cell.shapes.outline import (
    Outline,
    Point,
    PolygonLoop,
    offset_corners,
    rotate_corners,
)
from metalens.core.arrays import Array
from metalens.core.errors import CellError


class _StraightShape:
    """A section of corners for its size, turned by an angle."""

    __slots__ = ()
    angle_rad: float

    def corners_um(self, size_um: float) -> Array:
        """(n, 2) corners of the section of this size, before the turn."""
        raise NotImplementedError

    def outline(self, size_um: float, *, grow_um: float = 0.0) -> Outline:
        """The section of this size, every edge moved out by half of ``grow_um``."""
        corners = rotate_corners(self.corners_um(size_um), self.angle_rad)
        return Outline((PolygonLoop(offset_corners(corners, grow_um)),))


def _box(width_um: float, depth_um: float) -> Array:
    """(4, 2) corners of a rectangle about the origin, um."""
    return np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * (width_um / 2, depth_um / 2)


@dataclass(frozen=True, slots=True)
class Square(_StraightShape):
    """Its size is the edge. angle_rad: in the plane, from +x towards +y. hole: an
    opening in a film.

    kind: of the shape.
    """

    angle_rad: float = 0.0
    hole: bool = False
    kind: Literal["square"] = "square"

    @property
    def name(self) -> str:
        """In words, for reports."""
        return "square"

    def corners_um(self, size_um: float) -> Array:
        """(4, 2) corners, um."""
        return _box(size_um, size_um)


@dataclass(frozen=True, slots=True)
class Rectangle(_StraightShape):
    """Its size is the edge along x before the turn; ratio: of the other edge to it.
    hole: an opening in a film.

    angle_rad: in the plane, from +x towards +y. kind: of the shape.
    """

    ratio: float = 1.0
    angle_rad: float = 0.0
    hole: bool = False
    kind: Literal["rectangle"] = "rectangle"

    def __post_init__(self) -> None:
        if not 0.01 <= self.ratio <= 100:
            raise CellError(
                f"rectangle ratio = {self.ratio}: need the other edge over the size, 0.01 to 100"
            )

    @property
    def name(self) -> str:
        """In words, for reports."""
        return f"rectangle 1:{self.ratio:g}"

    def corners_um(self, size_um: float) -> Array:
        """(4, 2) corners, um."""
        return _box(size_um, self.ratio * size_um)


@dataclass(frozen=True, slots=True)
class Cross(_StraightShape):
    """Two bars of equal length at right angles; its size is the length. ratio: of the
    width of a bar to its length.

    angle_rad: in the plane, from +x towards +y. hole: an opening in a film. kind: of
    the shape.
    """

    ratio: float = 1 / 3
    angle_rad: float = 0.0
    hole: bool = False
    kind: Literal["cross"] = "cross"

    def __post_init__(self) -> None:
        if not 0 < self.ratio < 1:
            raise CellError(
                f"cross ratio = {self.ratio}: need the width over the length of a bar, between 0 and 1"
            )

    @property
    def name(self) -> str:
        """In words, for reports."""
        return f"cross {self.ratio:g}"

    def corners_um(self, size_um: float) -> Array:
        """(12, 2) corners of both bars, um."""
        a, b = size_um / 2, self.ratio * size_um / 2
        corner = np.array([(b, -a), (b, -b), (a, -b)])
        return np.concatenate(
            [rotate_corners(corner, quarter * math.pi / 2) for quarter in range(4)]
        )


@dataclass(frozen=True, slots=True)
class RegularPolygon(_StraightShape):
    """``sides`` equal edges; its size is the diameter of the circle through the
    corners, the first corner at +x.

    sides: number of edges, from 3. angle_rad: in the plane, from +x towards +y. hole:
    an opening in a film.
    kind: of the shape.
    """

    sides: int = 6
    angle_rad: float = 0.0
    hole: bool = False
    kind: Literal["regular-polygon"] = "regular-polygon"

    def __post_init__(self) -> None:
        if not 3 <= self.sides <= 256:
            raise CellError(f"regular polygon sides = {self.sides}: need 3 to 256")

    @property
    def name(self) -> str:
        """In words, for reports."""
        return f"polygon of {self.sides} sides"

    def corners_um(self, size_um: float) -> Array:
        """(sides, 2) corners on the circumscribed circle, um."""
        turn = 2 * np.pi * np.arange(self.sides) / self.sides
        return size_um / 2 * np.stack([np.cos(turn), np.sin(turn)], axis=1)


@dataclass(frozen=True, slots=True)
class Polygon(_StraightShape):
    """The user's own corners (x, y), in units of the size of the pillar; any order of
    turning, no crossings.

    corners: e.g. [[-0.5, -0.3], [0.5, -0.3], [0.0, 0.6]].
    angle_rad: in the plane, from +x towards +y. hole: an opening in a film. kind: of
    the shape.
    """

    corners: tuple[Point, ...]
    angle_rad: float = 0.0
    hole: bool = False
    kind: Literal["polygon"] = "polygon"

    def __post_init__(self) -> None:
        points = np.array(self.corners, float)
        if len(points) < 3 or not np.isfinite(points).all():
            raise CellError(
                f"polygon with {len(points)} corners: need at least 3, finite"
            )
        edges = np.stack([points, np.roll(points, -1, axis=0)], axis=1)
        if (np.hypot(*(edges[:, 1] - edges[:, 0]).T) == 0).any():
            raise CellError(
                "polygon with two equal neighbouring corners: leave one of them out"
            )
        n = len(points)
        for i in range(n):
            for j in range(i + 2, n - (i == 0)):
                if _cross(*edges[i], *edges[j]):
                    raise CellError(
                        f"polygon edges {i} and {j} cross: need a polygon without crossings"
                    )

    @property
    def name(self) -> str:
        """In words, for reports."""
        return f"own polygon of {len(self.corners)} corners"

    def corners_um(self, size_um: float) -> Array:
        """(n, 2) corners of this size, um."""
        return size_um * np.array(self.corners, float)


def _cross(a: Array, b: Array, c: Array, d: Array) -> bool:
    """Whether the edges a-b and c-d meet.

    They do if their bounding boxes overlap, and each edge has the ends of the other on
    different sides or on its line.
    """

    def side(p: Array, q: Array, r: Array) -> float:
        return float((q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0]))

    separated = (np.maximum(a, b) < np.minimum(c, d)) | (
        np.maximum(c, d) < np.minimum(a, b)
    )  # also edges of one line
    return (
        not separated.any()
        and side(a, b, c) * side(a, b, d) <= 0
        and side(c, d, a) * side(c, d, b) <= 0
    )
