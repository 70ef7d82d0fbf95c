"""Unions and differences of polygons, by the CrossSection of manifold3d; corners on
whole units.
"""

import itertools
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from layout.shapes.rectilinear import box_corners
from metalens.core.arrays import Array


def union_contours(polygons: Iterable[Array]) -> list[Array]:
    """Contours of the union: outlines counter-clockwise, holes clockwise.

    Args:
        polygons: (n, 2) corners each.
    """
    return _contours(_section(polygons))


def subtract_contours(contours: Iterable[Array], taken: Iterable[Array]) -> list[Array]:
    """Contours of the area of ``contours`` without ``taken``.

    Args:
        contours: outlines counter-clockwise, holes clockwise.
        taken: polygons.
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
    """The same area as polygons without holes, which any mask file holds.

    A part is cut upright through the middle of each hole, again and again. Where
    slanted edges would end the cut off whole units, and there is one hole, the cut goes
    from corner to corner.

    Args:
        contours: outlines counter-clockwise, holes clockwise.
        grid: step of the places of the cuts.
    """
    return list(_cut(_section(contours, filled=False), grid))


def separate_areas(polygons: Iterable[Array]) -> list[list[Array]]:
    """Outline and holes of each connected area of the union of polygons."""
    return [_contours(part) for part in _section(polygons).decompose()]


def halve_area(contours: list[Array], axis: int) -> list[list[Array]]:
    """Areas on both sides of a line near the middle that meets edges on whole units.

    Args:
        contours: outline and holes of an area.
        axis: 0: the line is x = constant, 1: y; the other where there is no such line.

    Returns:
        Outline and holes of each area; empty where no line meets all edges so.
    """
    corners = np.concatenate(contours)
    ends = np.array([corners.min(0), corners.max(0)])
    is_box = len(corners) == 4 and all(len(set(values)) == 2 for values in corners.T)
    for k in (axis, 1 - axis):
        low, high = ends[:, k].tolist()
        middle = (low + high) // 2
        lines = sorted(set(corners[:, k].tolist()), key=lambda at: abs(at - middle))
        turned = [contour[:, [k, 1 - k]] for contour in contours]
        for at in (middle, *lines):
            if low < at < high and (
                is_box or all(_ends_exactly(at, contour, 1) for contour in turned)
            ):
                boxes = np.stack([ends, ends])
                boxes[[0, 1], [1, 0], k] = at
                halves = [box_corners(box.ravel()) for box in boxes]
                if is_box:
                    return [[half] for half in halves]
                section = _section(contours, filled=False)
                parts = [(section ^ _section([half])).decompose() for half in halves]
                return [_contours(part) for part in itertools.chain(*parts)]
    return []


def triangulate_region(contours: Sequence[Array]) -> Array:
    """(n, 3) corners of triangles that fill outlines but for their holes.

    Corners are numbered through all contours; triangles run counter-clockwise.

    Args:
        contours: outlines counter-clockwise, holes clockwise.
    """
    from manifold3d import triangulate

    return np.asarray(
        triangulate([np.asarray(c, float) for c in contours], allow_convex=False),
        np.int64,
    )


def _section(polygons: Iterable[Array], *, filled: bool = True) -> Any:
    """Cross section of manifold3d; ``filled``: contours of any direction add area."""
    from manifold3d import CrossSection, FillRule

    rule = FillRule.NonZero if filled else FillRule.Positive
    return CrossSection([np.asarray(polygon, float) for polygon in polygons], rule)


def _contours(section: Any) -> list[Array]:
    """Contours of a section on whole units, repeated corners removed."""
    rounded = (np.rint(points).astype(np.int64) for points in section.to_polygons())
    distinct = (
        points[(points != np.roll(points, 1, axis=0)).any(1)] for points in rounded
    )
    return [points for points in distinct if len(points) > 2]


def _cut(section: Any, grid: int) -> Iterable[Array]:
    """Polygons of a section without holes, cut along x through the middle of each hole.

    With one hole, a cut that would leave the grid goes from corner to corner instead.
    """
    from manifold3d import CrossSection

    for part in section.decompose():
        contours = _contours(part)
        if len(contours) < 2:
            yield from contours
            continue
        hole = contours[1]
        cut_x = round(float(hole[:, 0].min() + hole[:, 0].max()) / 2 / grid) * grid
        if len(contours) == 2 and not all(
            _ends_exactly(cut_x, contour, grid) for contour in contours
        ):
            yield from _bridged(*contours)
            continue
        left, bottom, right, top = part.bounds()
        for low, high in ((left - 1, cut_x), (cut_x, right + 1)):
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
    distance = x - contour[:, 0]
    is_met = (distance * (distance - step[:, 0]) <= 0) & (step[:, 0] != 0)
    rise, run = distance[is_met] * step[is_met, 1], step[is_met, 0]
    is_whole = rise % run == 0
    return bool(
        is_whole.all() and ((contour[is_met, 1] + rise // run) % grid == 0).all()
    )


def _bridged(outer: Array, hole: Array) -> tuple[Array, Array]:
    """Two polygons that share the area between an outline and its hole.

    Both cuts lead from a corner of the outline to a corner of the hole. The first is
    the shortest that meets no edge. The second ends as far from it along the hole as
    possible, and is the shortest of those.

    Args:
        outer: (n, 2) corners, counter-clockwise.
        hole: (m, 2) corners, clockwise.
    """
    i, j = (v.ravel() for v in np.indices((len(outer), len(hole))))
    is_visible = _free(outer[i], hole[j], (outer, hole))
    i, j = i[is_visible], j[is_visible]
    length = ((outer[i] - hole[j]) ** 2).sum(1)
    first = int(length.argmin())
    separation = np.abs(j - j[first])
    separation = np.minimum(separation, len(hole) - separation)
    is_candidate = (i != i[first]) & (separation > 0)
    ends = np.stack([outer[i[first]], hole[j[first]]])
    is_candidate[is_candidate] = _free(
        outer[i[is_candidate]], hole[j[is_candidate]], (ends,)
    )
    last = min(
        np.flatnonzero(is_candidate).tolist(), key=lambda n: (-separation[n], length[n])
    )
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
    """(n,) whether segments meet no edge of some contours.

    Edges that share an end with the segment do not count.

    Args:
        start: (n, 2) whole points.
        end: (n, 2) whole points.
        contours: (m, 2) corners each.
    """
    free = np.ones(len(start), bool)
    for contour in contours:
        for p, q in zip(contour, np.roll(contour, -1, axis=0), strict=True):
            shares_end = [
                (start == point).all(1) | (end == point).all(1) for point in (p, q)
            ]
            sides = [np.sign(_cross(end - start, point - start)) for point in (p, q)]
            edge_sides = [np.sign(_cross(q - p, point - p)) for point in (start, end)]
            meets = (sides[0] * sides[1] <= 0) & (edge_sides[0] * edge_sides[1] <= 0)
            low, high = np.minimum(start, end), np.maximum(start, end)
            meets &= ((low <= np.maximum(p, q)) & (high >= np.minimum(p, q))).all(1)
            free &= ~(meets & ~(shares_end[0] | shares_end[1]))
    return free


def _cross(a: Array, b: Array) -> Array:
    """Cross product of vectors (..., 2)."""
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
