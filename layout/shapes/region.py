"""Unions and differences of polygons, by the CrossSection of manifold3d; corners on
whole units.
"""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from metalens.core.arrays import Array


def union_contours(polygons: Iterable[Array]) -> list[Array]:
    """Contours of the union: outlines counter-clockwise, holes clockwise.

    Args:
        polygons: (n, 2) corners each.
    """
    return _contours(_section(polygons))


def subtract_contours(contours: Iterable[Array], taken: Iterable[Array]) -> list[Array]:
    """Contours of what is left of ``contours`` (outlines counter-clockwise, holes
    clockwise) without ``taken``.
    """
    return _contours(_section(contours, filled=False) - _section(taken))


def overlap_contours(
    contours: Iterable[Array], polygons: Iterable[Array]
) -> list[Array]:
    """Contours (outlines and holes) of what ``contours`` share with ``polygons``."""
    return _contours(_section(contours, filled=False) ^ _section(polygons))


def overlap_area(contours: Iterable[Array], polygons: Iterable[Array]) -> float:
    """Area that ``contours`` (outlines and holes) share with ``polygons``."""
    return float((_section(contours, filled=False) ^ _section(polygons)).area())


def without_holes(contours: Sequence[Array], *, grid: int = 1) -> list[Array]:
    """The same area as polygons that any mask file holds: cut upright through the
    middle of each hole, and again.

    A cut that slanted edges would end off whole units goes from corner to corner
    instead, where there is one hole.

    Args:
        grid: step of the places of the cuts.
        contours: outlines counter-clockwise, holes clockwise.
    """
    return list(_cut(_section(contours, filled=False), grid))


def triangulate(contours: Sequence[Array]) -> Array:
    """(n, 3) corners, numbered on through all contours, of triangles that fill outlines
    (counter-clockwise) but for
    their holes (clockwise); they run counter-clockwise.
    """
    from manifold3d import triangulate

    return np.asarray(
        triangulate([np.asarray(c, float) for c in contours], allow_convex=False),
        np.int64,
    )


def _section(polygons: Iterable[Array], *, filled: bool = True) -> Any:
    from manifold3d import CrossSection, FillRule

    rule = FillRule.NonZero if filled else FillRule.Positive
    return CrossSection([np.asarray(p, float) for p in polygons], rule)


def _contours(section: Any) -> list[Array]:
    made = (np.rint(p).astype(np.int64) for p in section.to_polygons())
    kept = (p[(p != np.roll(p, 1, axis=0)).any(1)] for p in made)
    return [p for p in kept if len(p) > 2]


def _cut(section: Any, grid: int) -> Iterable[Array]:
    from manifold3d import CrossSection

    for part in section.decompose():
        contours = _contours(part)
        if len(contours) < 2:
            yield from contours
            continue
        hole = contours[1]
        x = round(float(hole[:, 0].min() + hole[:, 0].max()) / 2 / grid) * grid
        if len(contours) == 2 and not all(
            _ends_exactly(x, contour, grid) for contour in contours
        ):
            yield from _bridged(*contours)
            continue
        left, bottom, right, top = part.bounds()
        for low, high in ((left - 1, x), (x, right + 1)):
            box = np.array(
                [
                    [low, bottom - 1],
                    [high, bottom - 1],
                    [high, top + 1],
                    [low, top + 1],
                ],
                float,
            )
            yield from _cut(part ^ CrossSection([box]), grid)


def _ends_exactly(x: int, contour: Array, grid: int) -> bool:
    """Whether an upright line meets an outline on the grid alone."""
    step = np.roll(contour, -1, axis=0) - contour
    to = x - contour[:, 0]
    met = (to * (to - step[:, 0]) <= 0) & (step[:, 0] != 0)
    rise, run = to[met] * step[met, 1], step[met, 0]
    exact = rise % run == 0
    return bool(exact.all() and ((contour[met, 1] + rise // run) % grid == 0).all())


def _bridged(outer: Array, hole: Array) -> tuple[Array, Array]:
    """The area between an outline (counter-clockwise) and its hole (clockwise) in two,
    without further corners.

    Cut from the hole's corners to those of the outline: the shortest way that meets no
    edge, and one as far from it
    along the hole as there is (of those, the shortest).
    """
    i, j = (v.ravel() for v in np.indices((len(outer), len(hole))))
    seen = _free(outer[i], hole[j], (outer, hole))
    i, j = i[seen], j[seen]
    long = ((outer[i] - hole[j]) ** 2).sum(1)
    first = int(long.argmin())
    away = np.abs(j - j[first])
    away = np.minimum(away, len(hole) - away)
    others = (i != i[first]) & (away > 0)
    ends = np.stack([outer[i[first]], hole[j[first]]])
    others[others] = _free(outer[i[others]], hole[j[others]], (ends,))
    last = min(np.flatnonzero(others).tolist(), key=lambda n: (-away[n], long[n]))
    return (
        np.concatenate(
            [_between(outer, i[first], i[last]), _between(hole, j[last], j[first])]
        ),
        np.concatenate(
            [_between(outer, i[last], i[first]), _between(hole, j[first], j[last])]
        ),
    )


def _between(contour: Array, first: int, last: int) -> Array:
    """Corners from one to another, both included, the way that the contour runs."""
    return np.roll(contour, -first, axis=0)[: (last - first) % len(contour) + 1]


def _free(start: Array, end: Array, contours: Sequence[Array]) -> Array:
    """(n,) whether lines between whole points touch no edge, but for edges that end
    where they do.
    """
    free = np.ones(len(start), bool)
    for contour in contours:
        for p, q in zip(contour, np.roll(contour, -1, axis=0), strict=True):
            near = [(start == one).all(1) | (end == one).all(1) for one in (p, q)]
            sides = [np.sign(_cross(end - start, one - start)) for one in (p, q)]
            own = [np.sign(_cross(q - p, one - p)) for one in (start, end)]
            meets = (sides[0] * sides[1] <= 0) & (own[0] * own[1] <= 0)
            low, high = np.minimum(start, end), np.maximum(start, end)
            meets &= ((low <= np.maximum(p, q)) & (high >= np.minimum(p, q))).all(1)
            free &= ~(meets & ~(near[0] | near[1]))
    return free


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
