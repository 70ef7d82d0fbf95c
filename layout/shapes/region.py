"""Unions and differences of polygons, by the CrossSection of manifold3d; corners on whole units."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from metalens.ground.arrays import Array


def union(polygons: Iterable[Array]) -> list[Array]:
    """Contours of the union: outlines counter-clockwise, holes clockwise."""
    return _contours(_section(polygons))


def difference(polygons: Iterable[Array], taken: Iterable[Array]) -> list[Array]:
    """Contours of what is left of ``polygons`` without ``taken``."""
    return _contours(_section(polygons) - _section(taken))


def without_holes(contours: Sequence[Array]) -> list[Array]:
    """The same area as polygons that any mask file holds: cut through the middle of each hole, and again."""
    return list(_cut(_section(contours, filled=False)))


def _section(polygons: Iterable[Array], *, filled: bool = True) -> Any:
    from manifold3d import CrossSection, FillRule

    rule = FillRule.NonZero if filled else FillRule.Positive
    return CrossSection([np.asarray(p, float) for p in polygons], rule)


def _contours(section: Any) -> list[Array]:
    made = (np.rint(p).astype(np.int64) for p in section.to_polygons())
    kept = (p[(p != np.roll(p, 1, axis=0)).any(1)] for p in made)
    return [p for p in kept if len(p) > 2]


def _cut(section: Any) -> Iterable[Array]:
    from manifold3d import CrossSection

    for part in section.decompose():
        contours = _contours(part)
        if len(contours) < 2:
            yield from contours
            continue
        hole = contours[1]
        x = int(hole[:, 0].min() + hole[:, 0].max()) // 2
        left, bottom, right, top = part.bounds()
        for low, high in ((left - 1, x), (x, right + 1)):
            box = np.array([[low, bottom - 1], [high, bottom - 1], [high, top + 1], [low, top + 1]], float)
            yield from _cut(part ^ CrossSection([box]))
