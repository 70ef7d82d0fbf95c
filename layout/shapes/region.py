"""Unions and differences of polygons, by the CrossSection of manifold3d; corners on
whole units.
"""

import itertools
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from layout.shapes.rectilinear import box_corners, split_rectilinear
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


def covering_rectangles(shape: Array, *, slices: int = 64, height: int = 5000) -> Array:
    """(n, 4) rectangles of a rectilinear polygon, or boxes around slices of any other.

    Args:
        shape: (n, 2) corners, nm.
        slices: at most so many.
        height: of a slice, at least, nm.
    """
    if not np.diff(shape, axis=0, append=shape[:1]).all(1).any():
        return split_rectilinear(shape)
    section = _section([shape])
    if section.is_empty():
        return np.empty((0, 4), np.int64)
    left, bottom, right, top = section.bounds()
    count = min(slices, max(1, int(top - bottom) // height))
    ends = np.linspace(bottom, top, count + 1).tolist()
    boxes = np.array(
        [
            (section ^ _section([box_corners([left, low, right, high])])).bounds()
            for low, high in itertools.pairwise(ends)
        ]
    )
    return np.hstack([np.floor(boxes[:, :2]), np.ceil(boxes[:, 2:])]).astype(np.int64)


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
            box = box_corners([low, bottom - 1, high, top + 1])
            yield from _cut(part ^ _section([box]), grid)


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

    Both cuts are edges of a triangulation from a corner of the outline to one of the
    hole. The first is the shortest. The second ends as far from it along the hole as
    possible, and is the shortest of those.

    Args:
        outer: (n, 2) corners, counter-clockwise.
        hole: (m, 2) corners, clockwise.
    """
    triangles = triangulate_region([outer, hole])
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    i, j = edges[(edges[:, 0] < len(outer)) & (edges[:, 1] >= len(outer))].T
    j = j - len(outer)
    length = ((outer[i] - hole[j]) ** 2).sum(1)
    first = int(length.argmin())
    separation = np.abs(j - j[first])
    separation = np.minimum(separation, len(hole) - separation)
    last = min(
        np.flatnonzero((i != i[first]) & (separation > 0)).tolist(),
        key=lambda n: (-separation[n], length[n]),
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
