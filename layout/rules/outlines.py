"""The different outlines of pillar classes, convex or not, with holes or without:
widths, spaces within, distances.
"""

from dataclasses import dataclass

import numpy as np

from layout.mask import PillarClass
from layout.rules import edges as facing
from layout.rules.apart import apart
from layout.rules.layer import filled, is_convex, plain
from layout.shapes import convex
from metalens.ground.arrays import Array

_EDGED = 4  # reaches: no two edges of a shape are farther apart


@dataclass(frozen=True, eq=False, slots=True)
class Outlines:
    """``kind[class number]`` is 0 for none, else 1 + index into the outlines.

    contours: outline and holes of each. convex: whether an outline is. reach: (outlines
    + 1,) distance to the farthest
    corner, 0 for none. widths, spaces: (outlines,) least width, and least space between
    edges of the same shape (inf
    for none), as the check of any mask measures them.
    """

    contours: list[tuple[Array, ...]]
    convex: list[bool]
    kind: Array
    reach: Array
    widths: Array
    spaces: Array

    @classmethod
    def of(cls, classes: tuple[PillarClass, ...]) -> "Outlines":
        """Equal outlines once."""
        number: dict[bytes, int] = {}
        contours: list[tuple[Array, ...]] = []
        kind = np.zeros(len(classes) + 1, np.int64)
        for k, made in enumerate(classes, 1):
            found = tuple(
                np.ascontiguousarray(contour, np.int64) for contour in made.contours
            )
            key = b"/".join(contour.tobytes() for contour in found)
            if key not in number:
                contours.append(found)
                number[key] = len(contours)
            kind[k] = number[key]
        measured = [_measured(found) for found in contours]
        widths, spaces = (
            np.array([one[part] for one in measured]) for part in range(2)
        )
        reach = np.array([0.0, *(convex.reach(found[0]) for found in contours)])
        return cls(contours, [one[2] for one in measured], kind, reach, widths, spaces)

    def gap(self, one: int, two: int, dx: int, dy: int) -> float:
        """Distance of outline ``one`` from outline ``two`` moved by (dx, dy); 0 or less
        where they touch or overlap.
        """
        a, b = self.contours[one][0], self.contours[two][0]
        if self.convex[one] and self.convex[two]:
            return convex.gap(a, b, dx, dy)
        first, second = np.array([0]), np.array([1])
        return float(
            apart([a, b], (first, second), (np.array([dx]), np.array([dy])))[0]
        )


def _measured(contours: tuple[Array, ...]) -> tuple[float, float, bool]:
    """Least width, least space within, and whether the outline is convex (dents of less
    than a unit are none).
    """
    outline, holes = filled(plain(contours[0])), [plain(hole) for hole in contours[1:]]
    solid = is_convex(outline)
    if solid and not holes:
        return convex.width(outline), np.inf, True
    whole, most = [outline, *holes], _EDGED * convex.reach(outline)
    edges = np.concatenate([np.hstack([c, np.roll(c, -1, axis=0)]) for c in whole])
    closed = [
        is_convex(c[::-1]) for c in whole
    ]  # convex holes are as wide as two lines around them
    of = np.concatenate(
        [np.full(len(c), n if closed[n] else -1) for n, c in enumerate(whole)]
    )
    found = facing.facing(edges, np.zeros(len(edges), np.int64), most, most, hole=of)
    least = [
        float(found[found[:, 2] == part, 3].min(initial=np.inf))
        for part in (facing.WIDTH, facing.SPACE)
    ]
    across = [
        convex.width(c[::-1])
        for c, is_open in zip(whole, closed, strict=True)
        if is_open
    ]
    return (
        min(least[0], convex.width(convex.hull(outline))),
        min([least[1], *across]),
        solid,
    )
