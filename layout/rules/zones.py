"""Exclusion zones, and the room between the structures of a die."""

import itertools
import math
from collections.abc import Iterator

import numpy as np

from layout.mask import EXPOSED, Lattice, MaskPlan
from layout.process import Rules, Zone
from layout.rules.layer import is_convex
from layout.rules.report import DrcReport, Violation
from layout.shapes import region
from metalens.ground.arrays import Array

Box = tuple[float, float, float, float]  # left, bottom, right, top; database units


def in_zones(plan: MaskPlan, rules: Rules, report: DrcReport, shown: int) -> None:
    """Pillars that stand in an exclusion zone, even with a corner.

    A zone spans (x_um, y_um) to (x_um + width_um, y_um + height_um), +y up as mask
    readers draw it.
    """
    for zone, lattice in itertools.product(rules.exclusion, plan.lattices):
        found = list(_standing(plan, lattice, _zone_box(zone, plan.unit_nm)))
        report.add("exclusion", sum(len(xy) for _, xy in found), None)
        places = ((k, x, y) for k, xy in found for x, y in xy.tolist())
        for k, x, y in itertools.islice(places, shown):
            low, high = (
                plan.classes[k - 1].outline.min(0),
                plan.classes[k - 1].outline.max(0),
            )
            box = (x + int(low[0]), y + int(low[1]), x + int(high[0]), y + int(high[1]))
            text = f"{plan.classes[k - 1].name} in {zone.name}"
            report.add("exclusion", 0, Violation("exclusion", box, 0.0, 0.0, text))


def _zone_box(zone: Zone, unit_nm: float) -> Box:
    scale = 1e3 / unit_nm
    x, y = zone.x_um * scale, zone.y_um * scale
    return x, y, x + zone.width_um * scale, y + zone.height_um * scale


def _standing(
    plan: MaskPlan, lattice: Lattice, zone: Box
) -> Iterator[tuple[int, Array]]:
    """(class, (n, 2) sites) of the pillars that reach into the zone."""
    pitch, down = lattice.pitch, lattice.down
    reach = max(int(np.abs(made.outline).max()) for made in plan.classes)
    left = max(0, math.floor((zone[0] - reach - lattice.x0) / pitch))
    right = min(lattice.columns, math.ceil((zone[2] + reach - lattice.x0) / pitch) + 1)
    top = max(0, math.floor((lattice.y0 - zone[3] - reach) / down))
    bottom = min(lattice.rows, math.ceil((lattice.y0 - zone[1] + reach) / down) + 1)
    if left >= right or top >= bottom:
        return
    block = lattice.source(top, bottom)[:, left:right]
    for k in np.unique(block[block > 0]).tolist():
        rows, columns = np.nonzero(block == k)
        xy = np.column_stack(
            [lattice.x0 + (columns + left) * pitch, lattice.y0 - (rows + top) * down]
        )
        hit = xy[_overlaps(plan.classes[k - 1].contours, xy, zone)]
        if len(hit):
            yield k, hit


def _overlaps(contours: tuple[Array, ...], xy: Array, zone: Box) -> Array:
    """(n,) whether an outline without its holes, at each site, shares area with the
    rectangle.
    """
    if len(contours) == 1 and is_convex(contours[0]):
        return _meets(contours[0], xy, zone)
    points = np.concatenate(contours)
    return np.asarray(
        np.any(
            [_meets(points[three], xy, zone) for three in region.triangles(contours)],
            axis=0,
        )
    )


def _meets(outline: Array, xy: Array, zone: Box) -> Array:
    """(n,) whether a convex outline at each site shares area with the rectangle: no
    edge of either separates them.
    """
    low, high = outline.min(0) + xy, outline.max(0) + xy
    meets = (
        (low[:, 0] < zone[2])
        & (high[:, 0] > zone[0])
        & (low[:, 1] < zone[3])
        & (high[:, 1] > zone[1])
    )
    corners = np.array([(zone[i], zone[j]) for i in (0, 2) for j in (1, 3)])
    edges = np.roll(outline, -1, axis=0) - outline
    normals = np.column_stack([edges[:, 1], -edges[:, 0]])
    own = (normals * outline).sum(1)
    for normal, level in zip(normals, own, strict=True):
        meets &= (corners @ normal).min() < xy @ normal + level
    return np.asarray(meets)


def structures_apart(plan: MaskPlan, rules: Rules, report: DrcReport) -> None:
    """Lattices, marks and labels keep the minimum gap, box to box (outlines and
    apertures lie over them).
    """
    groups: dict[str, list[Box]] = {}
    for lattice in plan.lattices:
        groups.setdefault(lattice.name, []).append(_lattice_box(plan, lattice))
    for figure in plan.figures:
        if figure.name in EXPOSED:
            shapes = itertools.chain.from_iterable(figure.polygons.values())
            groups.setdefault(figure.name, []).extend(
                _box(np.asarray(shape)) for shape in shapes
            )
    limit = rules.minimum_gap_nm / plan.unit_nm
    boxes = [(name, np.array(some)) for name, some in groups.items() if some]
    for (one, first), (two, second) in itertools.combinations(boxes, 2):
        near = first[
            _apart(first, _around(second)) < limit
        ]  # of many pieces those that can matter
        others = second[_apart(second, _around(near)) < limit] if len(near) else near
        for a in near if len(others) else near[:0]:
            gaps = _apart(others, a)
            for b, gap in zip(
                others[gaps < limit],
                (gaps[gaps < limit] * plan.unit_nm).tolist(),
                strict=True,
            ):
                left, bottom, right, top = (int(v) for v in _around(np.stack([a, b])))
                shown = Violation(
                    "structures",
                    (left, bottom, right, top),
                    gap,
                    rules.minimum_gap_nm,
                    f"{one} to {two}",
                )
                report.add("structures", 1, shown)


def _around(boxes: Array) -> Array:
    """(4,) the box around boxes (n, 4)."""
    return np.concatenate([boxes[:, :2].min(0), boxes[:, 2:].max(0)])


def _apart(boxes: Array, box: Array) -> Array:
    """(n,) distances of boxes (n, 4) from one."""
    across = np.maximum(np.maximum(boxes[:, :2] - box[2:], box[:2] - boxes[:, 2:]), 0)
    return np.asarray(np.hypot(*across.T))


def _lattice_box(plan: MaskPlan, lattice: Lattice) -> Box:
    reach = max(int(np.abs(made.outline).max()) for made in plan.classes)
    right, bottom = (
        (lattice.columns - 1) * lattice.pitch,
        (lattice.rows - 1) * lattice.down,
    )
    return (
        lattice.x0 - reach,
        lattice.y0 - bottom - reach,
        lattice.x0 + right + reach,
        lattice.y0 + reach,
    )


def _box(shape: Array) -> Box:
    (left, bottom), (right, top) = shape.min(0).tolist(), shape.max(0).tolist()
    return left, bottom, right, top
