"""Unions and differences of polygons, by the CrossSection of manifold3d; corners on whole units."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from metalens.ground.arrays import Array


def union(polygons: Iterable[Array]) -> list[Array]:
    """Contours of the union: outlines counter-clockwise, holes clockwise."""
    return _contours(_section(polygons))


def difference(contours: Iterable[Array], taken: Iterable[Array]) -> list[Array]:
    """Contours of what is left of ``contours`` (outlines counter-clockwise, holes clockwise) without ``taken``."""
    return _contours(_section(contours, filled=False) - _section(taken))


def overlap(contours: Iterable[Array], polygons: Iterable[Array]) -> list[Array]:
    """Contours (outlines and holes) of what ``contours`` share with ``polygons``."""
    return _contours(_section(contours, filled=False) ^ _section(polygons))


def without_holes(contours: Sequence[Array], *, grid: int = 1) -> list[Array]:
    """The same area as polygons that any mask file holds: cut upright through the middle of each hole, and again.

    Args:
        grid: step of the places of the cuts.
    """
    return list(_cut(_section(contours, filled=False), grid))


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
        left, bottom, right, top = part.bounds()
        for low, high in ((left - 1, x), (x, right + 1)):
            box = np.array([[low, bottom - 1], [high, bottom - 1], [high, top + 1], [low, top + 1]], float)
            yield from _cut(part ^ CrossSection([box]), grid)
