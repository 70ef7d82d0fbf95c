"""Exposure at the edges of marks, labels and any other polygon, exact for every
Gaussian (Owen's T function).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from layout.shapes import region
from metalens.core.arrays import Array
from metalens.core.units import nm

_STEP_UM = 1.0  # between the samples along an edge
_FAR = 5.0  # ranges at which a polygon no longer counts: exp(-25)
ACROSS_UM = 4 * nm  # for the slope across an edge


@dataclass(frozen=True, eq=False, slots=True)
class ExposedPolygons:
    """Shapes that are no pillars: corners (counter-clockwise, um), relative doses and
    layer numbers, one each.
    """

    corners: Sequence[Array]
    dose: Array
    layer: Array


@dataclass(frozen=True, eq=False, slots=True)
class EdgeSamples:
    """Points on the outer edges of shapes: (n, 2) places, (n, 2) outward normals, (n,)
    layer numbers.
    """

    at_um: Array
    normal: Array
    layer: Array


def sample_edges(polygons: ExposedPolygons, range_um: float) -> EdgeSamples:
    """Every few um along the outline of what each layer number draws, two ranges and
    more away from corners.

    Args:
        polygons: with their layers.
        range_um: of the core of the point exposure.
    """
    places = [np.empty((0, 2))]
    normals = [np.empty((0, 2))]
    layers = [np.empty(0, np.int64)]
    for layer in np.unique(polygons.layer).tolist():
        drawn = zip(polygons.corners, polygons.layer.tolist(), strict=True)
        units = [np.rint(corners / nm) for corners, other in drawn if other == layer]
        for contour in region.union_contours(units):
            corners = contour[_turns(contour)]
            start, end = corners * nm, np.roll(corners, -1, axis=0) * nm
            for a, b in zip(start, end, strict=True):
                long = float(np.hypot(*(b - a)))
                free = long - 4 * range_um  # corners round off within two ranges
                if free <= 0:
                    continue
                count = max(1, int(free / _STEP_UM))
                share = (2 * range_um + (np.arange(count) + 0.5) / count * free) / long
                places.append(a + share[:, None] * (b - a))
                normals.append(
                    np.tile([(b - a)[1] / long, -(b - a)[0] / long], (count, 1))
                )
                layers.append(np.full(count, layer))
    return EdgeSamples(
        np.concatenate(places), np.concatenate(normals), np.concatenate(layers)
    )


def _turns(contour: Array) -> Array:
    """(n,) which points are corners, not on the way between two others."""
    before = contour - np.roll(contour, 1, axis=0)
    after = np.roll(contour, -1, axis=0) - contour
    return np.asarray(before[:, 0] * after[:, 1] != before[:, 1] * after[:, 0])


def exposure_at_edges(
    at_um: Array, polygons: ExposedPolygons, terms: Sequence[tuple[float, float]]
) -> Array:
    """(n,) exposure at points by the polygons with their doses, for (range, weight) of
    each Gaussian.

    Args:
        at_um: (n, 2) points.
        terms: range and weight of each Gaussian.
    """
    total = np.zeros(len(at_um))
    if not (len(at_um) and terms):
        return total
    reach = _FAR * max(a for a, _ in terms)
    one, two = _near(at_um, polygons, reach)
    count = np.array([len(c) for c in polygons.corners])
    first = np.r_[0, np.cumsum(count)]
    start = np.concatenate(list(polygons.corners))
    after = np.arange(1, len(start) + 1)
    after[first[1:] - 1] = first[:-1]  # the last corner leads back to the first
    end = start[after]
    point = np.repeat(one, count[two])
    within = np.arange(len(point)) - np.repeat(
        np.cumsum(count[two]) - count[two], count[two]
    )
    edge = np.repeat(first[two], count[two]) + within
    given = np.repeat(polygons.dose[two], count[two])
    for part in np.array_split(np.arange(len(point)), max(1, len(point) // 1_000_000)):
        p = start[edge[part]] - at_um[point[part]]
        q = end[edge[part]] - at_um[point[part]]
        value = sum(weight * _edge(p, q, range_um) for range_um, weight in terms)
        total += np.bincount(point[part], given[part] * value, minlength=len(total))
    return total


def points_across(found: EdgeSamples) -> tuple[Array, Array]:
    """Points just outside and just inside the edges, ``ACROSS_UM`` from each other.

    Args:
        found: samples on edges.
    """
    away = ACROSS_UM / 2 * found.normal
    return found.at_um + away, found.at_um - away


def _near(at_um: Array, polygons: ExposedPolygons, reach: float) -> tuple[Array, Array]:
    """Pairs (point, polygon) that can matter to each other; small polygons through a
    tree of their middles.
    """
    from scipy.spatial import cKDTree

    middle = np.array([(c.min(0) + c.max(0)) / 2 for c in polygons.corners])
    radius = np.array(
        [
            np.hypot(*(c - m).T).max()
            for c, m in zip(polygons.corners, middle, strict=True)
        ]
    )
    tree = cKDTree(at_um)
    ones = []
    twos = []
    for n, found in enumerate(tree.query_ball_point(middle, radius + reach)):
        ones.append(np.asarray(found, np.int64))
        twos.append(np.full(len(found), n))
    return np.concatenate(ones), np.concatenate(twos)


def _edge(p: Array, q: Array, range_um: float) -> Array:
    """Contribution of edges from p to q (n, 2), seen from the origin, counter-clockwise
    around it positive.
    """
    from scipy.special import owens_t

    along = q - p
    long = np.hypot(*along.T)
    cross = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
    height = np.maximum(np.abs(cross) / long, 1e-15)
    low, high = ((v * along).sum(1) / (long * height) for v in (p, q))
    h = height * np.sqrt(2) / range_um
    value = (
        (np.arctan(high) - np.arctan(low)) / (2 * np.pi)
        - owens_t(h, high)
        + owens_t(h, low)
    )
    return np.asarray(np.sign(cross) * value)


def equivalent_spots(
    polygons: ExposedPolygons, step_um: float
) -> tuple[Array, Array, Array]:
    """(x, y, area times dose) of points that stand for the polygons in a Gaussian much
    wider than ``step_um``.
    """
    places: list[Array] = [np.empty((0, 3))]
    for corners, dose in zip(polygons.corners, polygons.dose.tolist(), strict=True):
        after = np.roll(corners, -1, axis=0)
        mass = (
            dose
            * float((corners[:, 0] * after[:, 1] - after[:, 0] * corners[:, 1]).sum())
            / 2
        )
        low, high = corners.min(0), corners.max(0)
        small = bool((high - low).max() <= step_um)
        inside = (
            corners.mean(0)[None]
            if small
            else _inside(corners, after, low, high, step_um)
        )
        places.append(
            np.column_stack([inside, np.full(len(inside), mass / len(inside))])
        )
    found = np.concatenate(places)
    return found[:, 0], found[:, 1], found[:, 2]


def _inside(start: Array, end: Array, low: Array, high: Array, step_um: float) -> Array:
    """(n, 2) points of a raster within a polygon (crossings to the right are odd), on
    each side at least four.
    """
    counts = np.maximum(np.ceil((high - low) / step_um).astype(int), 4)
    x, y = (
        low[k] + (np.arange(counts[k]) + 0.5) * (high - low)[k] / counts[k]
        for k in (0, 1)
    )
    px, py = (v.ravel() for v in np.meshgrid(x, y))
    odd = np.zeros(len(px), bool)
    for (x0, y0), (x1, y1) in zip(start.tolist(), end.tolist(), strict=True):
        if y0 != y1:
            straddles = (py >= min(y0, y1)) & (py < max(y0, y1))
            odd ^= straddles & (x0 + (py - y0) * (x1 - x0) / (y1 - y0) > px)
    found = np.column_stack([px, py])[odd]
    return found if len(found) else start.mean(0)[None]
