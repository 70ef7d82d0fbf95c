"""Exposure at the edges of marks, labels and any other polygon, exact for every
Gaussian (Owen's T function).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from layout.shapes import polygon, region
from layout.shapes.moments import polygon_moments
from metalens.core.arrays import Array
from metalens.core.units import nm

_FAR = 5.0  # ranges at which a polygon no longer counts: exp(-25)
ACROSS_UM = 4 * nm  # for the slope across an edge


@dataclass(frozen=True, eq=False)
class ExposedPolygons:
    """Shapes that are no pillars: corners (counter-clockwise, um), relative doses and
    layer numbers, one each.
    """

    corners: Sequence[Array]
    dose: Array
    layer: Array


@dataclass(frozen=True, eq=False)
class EdgeSamples:
    """Points on the outer edges of shapes: (n, 2) places, (n, 2) outward normals, (n,)
    layer numbers.
    """

    at_um: Array
    normal: Array
    layer: Array


def sample_edges(
    polygons: ExposedPolygons,
    range_um: float,
    step_um: float = 1.0,
    unit_um: float = nm,
) -> EdgeSamples:
    """Samples along the outline of what each layer number draws.

    Samples keep two ranges from corners, which are round.

    Args:
        polygons: with their layers.
        range_um: of the core of the point exposure.
        step_um: between samples, about.
        unit_um: database unit, to which the corners are rounded.
    """
    positions = [np.empty((0, 2))]
    normals = [np.empty((0, 2))]
    layers = [np.empty(0, np.int64)]
    for layer in np.unique(polygons.layer).tolist():
        drawn = zip(polygons.corners, polygons.layer.tolist(), strict=True)
        outlines = [
            np.rint(corners / unit_um) for corners, other in drawn if other == layer
        ]
        for contour in region.union_contours(outlines):
            start = contour[polygon.corner_turns(contour) != 0] * unit_um
            edge = np.roll(start, -1, axis=0) - start
            length = np.hypot(*edge.T)
            straight = length - 4 * range_um  # corners round off within two ranges
            counts = np.maximum((straight / step_um).astype(int), straight > 0)
            number = np.repeat(np.arange(len(start)), counts)
            place = np.arange(len(number)) - (np.cumsum(counts) - counts)[number]
            inner = (place + 0.5) / counts[number] * straight[number]
            along = (2 * range_um + inner) / length[number]
            positions.append(start[number] + along[:, None] * edge[number])
            normals.append((edge[:, ::-1] * (1, -1) / length[:, None])[number])
            layers.append(np.full(len(number), layer))
    return EdgeSamples(
        np.concatenate(positions), np.concatenate(normals), np.concatenate(layers)
    )


def exposure_at_edges(
    at_um: Array, polygons: ExposedPolygons, terms: Sequence[tuple[float, float]]
) -> Array:
    """(n,) exposure at points by polygons with their doses.

    Args:
        at_um: (n, 2) points.
        polygons: corners and doses.
        terms: range and weight of each Gaussian.
    """
    total = np.zeros(len(at_um))
    if not (len(at_um) and terms):
        return total
    reach = _FAR * max(width for width, _ in terms)
    point_of_pair, polygon_of_pair = _near(at_um, polygons, reach)
    edge_count = np.array([len(corners) for corners in polygons.corners])
    first_edge = np.r_[0, np.cumsum(edge_count)]
    start = np.concatenate(list(polygons.corners))
    next_corner = np.arange(1, len(start) + 1)
    next_corner[first_edge[1:] - 1] = first_edge[
        :-1
    ]  # the last corner leads back to the first
    end = start[next_corner]
    point = np.repeat(point_of_pair, edge_count[polygon_of_pair])
    edge_in_polygon = np.arange(len(point)) - np.repeat(
        np.cumsum(edge_count[polygon_of_pair]) - edge_count[polygon_of_pair],
        edge_count[polygon_of_pair],
    )
    edge = (
        np.repeat(first_edge[polygon_of_pair], edge_count[polygon_of_pair])
        + edge_in_polygon
    )
    dose = np.repeat(polygons.dose[polygon_of_pair], edge_count[polygon_of_pair])
    for part in np.array_split(np.arange(len(point)), max(1, len(point) // 1_000_000)):
        p = start[edge[part]] - at_um[point[part]]
        q = end[edge[part]] - at_um[point[part]]
        value = sum(weight * _edge(p, q, range_um) for range_um, weight in terms)
        total += np.bincount(point[part], dose[part] * value, minlength=len(total))
    return total


def points_across(samples: EdgeSamples) -> tuple[Array, Array]:
    """Points just outside and just inside the edges, ``ACROSS_UM`` from each other.

    Args:
        samples: samples on edges.
    """
    step = ACROSS_UM / 2 * samples.normal
    return samples.at_um + step, samples.at_um - step


def _near(at_um: Array, polygons: ExposedPolygons, reach: float) -> tuple[Array, Array]:
    """Pairs of points and polygons closer than a distance, by a tree of the points.

    Args:
        at_um: (n, 2) points.
        polygons: with their corners.
        reach: um; a polygon is taken as the circle around its corners.

    Returns:
        (pairs,) number of the point, and (pairs,) number of the polygon.
    """
    from scipy.spatial import cKDTree

    centres = np.array(
        [(corners.min(0) + corners.max(0)) / 2 for corners in polygons.corners]
    )
    radius = np.array(
        [
            np.hypot(*(corners - centre).T).max()
            for corners, centre in zip(polygons.corners, centres, strict=True)
        ]
    )
    tree = cKDTree(at_um)
    points = []
    numbers = []
    for number, members in enumerate(tree.query_ball_point(centres, radius + reach)):
        points.append(np.asarray(members, np.int64))
        numbers.append(np.full(len(members), number))
    return np.concatenate(points), np.concatenate(numbers)


def _edge(p: Array, q: Array, range_um: float) -> Array:
    """Exposure at the origin by the triangle of the origin and an edge, signed.

    With the height of the triangle and low, high the ends of the edge over the height:
    sign [(atan high - atan low) / 2 pi - T(h, high) + T(h, low)], h = sqrt 2 height /
    range, T Owen's function. Counter-clockwise is positive.

    Args:
        p: (n, 2) first corner, um.
        q: (n, 2) second corner, um.
        range_um: 1/e radius of the Gaussian.
    """
    from scipy.special import owens_t

    edge = q - p
    length = np.hypot(*edge.T)
    cross = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
    height = np.maximum(np.abs(cross) / length, 1e-15)
    low, high = ((end * edge).sum(1) / (length * height) for end in (p, q))
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
    """Points that represent polygons in a Gaussian much wider than ``step_um``.

    Args:
        polygons: corners and doses.
        step_um: distance of the points.

    Returns:
        (n,) x, (n,) y, um, and (n,) area times dose.
    """
    parts: list[Array] = [np.empty((0, 3))]
    for corners, dose in zip(polygons.corners, polygons.dose.tolist(), strict=True):
        area, first, _ = polygon_moments([corners])
        low, high = corners.min(0), corners.max(0)
        points = (first / area)[None]
        if (high - low).max() > step_um:
            points = _inside(corners, low, high, step_um)
        mass = np.full(len(points), dose * area / len(points))
        parts.append(np.column_stack([points, mass]))
    spots = np.concatenate(parts)
    return spots[:, 0], spots[:, 1], spots[:, 2]


def _inside(start: Array, low: Array, high: Array, step_um: float) -> Array:
    """(n, 2) points of a raster within a polygon, two or more along each axis.

    A point is inside where a ray to the right crosses the outline an odd number of
    times.
    """
    counts = np.maximum(np.ceil((high - low) / step_um).astype(int), 2)
    x, y = (
        low[k] + (np.arange(counts[k]) + 0.5) * (high - low)[k] / counts[k]
        for k in (0, 1)
    )
    points = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    points = points[enclosed_points([start], points)]
    return points if len(points) else start.mean(0)[None]


def enclosed_points(contours: Sequence[Array], points: Array) -> Array:
    """(n,) whether points lie within an outline and outside its holes (even-odd rule).

    Args:
        contours: (m, 2) corners each.
        points: (n, 2) places.
    """
    px, py = points.T
    is_inside = np.zeros(len(points), bool)
    for corners in contours:
        ends = np.roll(corners, -1, axis=0).tolist()
        for (x0, y0), (x1, y1) in zip(corners.tolist(), ends, strict=True):
            if y0 != y1:
                straddles = (py >= min(y0, y1)) & (py < max(y0, y1))
                is_inside ^= straddles & (x0 + (py - y0) * (x1 - x0) / (y1 - y0) > px)
    return is_inside
