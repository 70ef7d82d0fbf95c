"""Plane sweep, and distances between edges, polygons and boxes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from layout.formats.library import stable_order
from layout.process.jit import compile_loop
from layout.shapes import convex
from layout.shapes.rectilinear import IntBox
from metalens.core.arrays import Array
from metalens.core.errors import MaskFileError

# degrees; a sharper wedge is narrower than the limit as far from its tip
SHARPEST_CORNER = 60.0
MAX_PAIRS = 40_000_000  # of close boxes, 16 bytes each


@dataclass(frozen=True)
class ShapeMeasurement:
    """A width, notch or sharp corner of one polygon.

    rule: "width", "notch" or "corner".
    value: distance in database units, or angle in degrees.
    box: left, bottom, right, top of the two edges (of the contour where it is convex).
    """

    rule: str
    value: float
    box: IntBox


def clean_contour(points: Array) -> Array:
    """Remove repeated and collinear corners, and dents shallower than one database
    unit.

    Such dents come from rounding a convex outline to the grid; its convex hull replaces
    it.

    Args:
        points: (n, 2) corners in whole database units.

    Returns:
        (m, 2) corners, m < 3 for a contour without area.
    """
    points = np.asarray(points, np.int64)
    points = points[(points != np.roll(points, 1, axis=0)).any(1)]
    before = points - np.roll(points, 1, axis=0)
    after = np.roll(before, -1, axis=0)
    points = points[before[:, 0] * after[:, 1] != before[:, 1] * after[:, 0]]
    if len(points) < 4 or is_convex(points) or is_convex(points[::-1]):
        return points
    from scipy.spatial import ConvexHull

    hull = ConvexHull(points)
    depth = -(points @ hull.equations[:, :2].T + hull.equations[:, 2]).max(1)
    if depth.max() >= 1:
        return points
    x, y = points.T
    is_hole = (x * np.roll(y, -1) - np.roll(x, -1) * y).sum() < 0
    return np.asarray(points[hull.vertices[::-1] if is_hole else hull.vertices])


def is_convex(points: Array) -> bool:
    """Whether a contour without collinear corners turns left at every corner, once
    around.

    Args:
        points: (n, 2) corners.
    """
    before = points - np.roll(points, 1, axis=0)
    after = np.roll(before, -1, axis=0)
    cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    if cross.min(initial=1) <= 0:
        return False
    direction = np.unwrap(np.arctan2(after[:, 1], after[:, 0]))
    return bool(direction[-1] - direction[0] < 2 * np.pi)


def contour_edges(contours: Sequence[Array]) -> Array:
    """(m, 4) edges x1, y1, x2, y2 of closed contours; the interior is on the left of
    each edge.
    """
    edges = [np.hstack([points, np.roll(points, -1, axis=0)]) for points in contours]
    return np.concatenate([np.empty((0, 4)), *edges])


def contour_box(contours: Sequence[Array]) -> IntBox:
    """Left, bottom, right, top of some contours."""
    points = np.concatenate(contours)
    left, bottom = points.min(0).tolist()
    right, top = points.max(0).tolist()
    return left, bottom, right, top


def measure_polygon(
    contours: Sequence[Array], width_limit: float, space_limit: float
) -> list[ShapeMeasurement]:
    """Widths, notches and sharp corners of one polygon in the projection metric.

    A convex contour is as wide as its two nearest parallel supporting lines (calipers);
    a convex hole is a notch of that size. All other edges are measured in pairs (see
    :func:`projected_distance`); edges that share a corner are no pair (see
    :func:`find_sharp_corners`). Pairs hidden behind a nearer edge are counted, too.

    Args:
        contours: cleaned contours, outer ones counter-clockwise, holes clockwise.
        width_limit: pairs facing through the interior are reported below it, database
            units.
        space_limit: pairs facing through the exterior are reported below it, database
            units.

    Returns:
        Pairs below the limits, and the caliper width of each convex contour whatever it
        is.
    """
    measurements = find_sharp_corners(contours)
    number_of_edge = []
    for number, points in enumerate(contours):
        rule = "width" if is_convex(points) else ""
        rule = "notch" if is_convex(points[::-1]) else rule
        number_of_edge.append(np.full(len(points), number if rule else -1))
        if rule:
            value = convex.least_width(points if rule == "width" else points[::-1])
            measurements.append(ShapeMeasurement(rule, value, contour_box([points])))
    if len(contours) == 1 and number_of_edge[0][0] == 0:
        return measurements
    edges = contour_edges(contours)
    start, end = edges[:, :2], edges[:, 2:]
    boxes = np.hstack([np.minimum(start, end), np.maximum(start, end)])
    pairs = find_close_boxes(boxes, max(width_limit, space_limit))
    contour_of_edge = np.concatenate(number_of_edge)
    pairs = pairs[
        (contour_of_edge[pairs[:, 0]] != contour_of_edge[pairs[:, 1]])
        | (contour_of_edge[pairs[:, 0]] < 0)
    ]
    for rule, side, limit in (
        ("width", 1.0, width_limit),
        ("notch", -1.0, space_limit),
    ):
        distances = projected_distances(edges, pairs, side)
        is_below = distances < limit - 1e-9
        for pair, value in zip(pairs[is_below], distances[is_below], strict=True):
            corners = edges[pair].reshape(4, 2).astype(np.int64)
            measurements.append(
                ShapeMeasurement(rule, float(value), contour_box([corners]))
            )
    return measurements


def find_sharp_corners(contours: Sequence[Array]) -> list[ShapeMeasurement]:
    """Corners of less than 60 degrees, of the interior or the exterior.

    Args:
        contours: cleaned contours in database units.

    Accuracy:
        A corner counts where rounding its ends to whole units cannot explain it.
    """
    measurements = []
    for points in contours:
        to_previous = np.roll(points, 1, axis=0) - points
        to_next = np.roll(points, -1, axis=0) - points
        lengths = np.hypot(*to_previous.T), np.hypot(*to_next.T)
        dot = (to_previous * to_next).sum(1)
        product = lengths[0] * lengths[1]
        rounding = 2**0.5 * (lengths[0] + lengths[1])
        for corner in np.flatnonzero(dot > product / 2 + rounding).tolist():
            angle = np.degrees(np.arccos(min(dot[corner] / product[corner], 1.0)))
            x, y = points[corner].tolist()
            box = (x - 1, y - 1, x + 1, y + 1)
            measurements.append(ShapeMeasurement("corner", float(angle), box))
    return measurements


def find_close_boxes(
    boxes: Array,
    distance: float,
    *,
    which: Array | None = None,
    shift: Array | None = None,
) -> Array:
    """Plane sweep along x in horizontal bands: pairs of boxes closer than a distance
    along x and along y.

    Args:
        boxes: (k, 4) left, bottom, right, top in whole database units.
        distance: database units.
        which: (n,) box of each copy; None: every box stands once.
        shift: (n, 2) displacement of each copy; None: none.

    Returns:
        (m, 2) indices of copies, each pair once.

    Raises:
        MaskFileError: more than 40 million pairs.
    """
    which = np.arange(len(boxes)) if which is None else which
    if len(which) < 2:
        return np.empty((0, 2), np.int64)
    shift = np.zeros((len(which), 2), np.int32) if shift is None else shift
    boxes = np.asarray(boxes, float)
    heights = boxes[:, 3] - boxes[:, 1]
    typical_height = np.median(heights[which[:: max(1, len(which) // 10_000)]])
    shift = np.ascontiguousarray(shift)
    order = stable_order(boxes[which, 0] + shift[:, 0])
    bottom, height, offsets, member = _fill_bands(
        boxes, which, shift, order, float(typical_height + distance), distance
    )
    bands = np.array([bottom, height, distance])
    pairs = np.empty((len(which), 2), np.int64)
    count = _sweep_bands(boxes, which, shift, bands, offsets, member, pairs)
    if count > MAX_PAIRS:
        raise MaskFileError(
            f"{count:,} pairs of shapes closer than {distance:g} units, at most "
            f"{MAX_PAIRS:,} are measured; do shapes lie on each other?"
        )
    if count > len(pairs):
        pairs = np.empty((count, 2), np.int64)
        _sweep_bands(boxes, which, shift, bands, offsets, member, pairs)
    return pairs[:count].copy()


@compile_loop
def _fill_bands(
    boxes: Array,
    which: Array,
    shift: Array,
    order: Array,
    height: float,
    distance: float,
) -> tuple[float, float, Array, Array]:
    """Sort copies of boxes into horizontal bands, each copy into every band it meets.

    A band is raised so that there are no more bands than copies.

    Args:
        boxes: (k, 4) left, bottom, right, top.
        which: (copies,) box of each copy.
        shift: (copies, 2) displacement of each copy.
        order: (copies,) copies by their left edges.
        height: smallest height of a band.
        distance: added to the top of each box.

    Returns:
        Bottom of the lowest band, height of the bands, (bands + 1,) offsets into the
        last array, and the copies of all bands, each band in the order of ``order``.
    """
    low, top_end = np.inf, -np.inf
    for copy in range(len(which)):
        low = min(low, boxes[which[copy], 1] + shift[copy, 1])
        top_end = max(top_end, boxes[which[copy], 3] + shift[copy, 1] + distance)
    height = max(height, (top_end - low) / len(which))
    offsets = np.zeros(int((top_end - low) // height) + 2, np.int64)
    for copy in range(len(which)):
        up = shift[copy, 1] - low
        lowest, highest = _band_range(boxes[which[copy]], up, height, distance)
        for band in range(lowest, highest + 1):
            offsets[band + 1] += 1
    offsets = np.cumsum(offsets)
    member = np.empty(offsets[-1], np.int32)
    next_free = offsets.copy()
    for copy in order:
        up = shift[copy, 1] - low
        lowest, highest = _band_range(boxes[which[copy]], up, height, distance)
        for band in range(lowest, highest + 1):
            member[next_free[band]] = copy
            next_free[band] += 1
    return low, height, offsets, member


@compile_loop
def _band_range(
    box: Array, up: float, height: float, distance: float
) -> tuple[int, int]:
    """Lowest and highest band that a box meets.

    Args:
        box: left, bottom, right, top.
        up: its displacement along y from the bottom of the lowest band.
        height: of the bands.
        distance: added to the top of the box.
    """
    return int((box[1] + up) // height), int((box[3] + up + distance) // height)


@compile_loop
def _sweep_bands(
    boxes: Array,
    which: Array,
    shift: Array,
    bands: Array,
    offsets: Array,
    member: Array,
    pairs: Array,
) -> int:
    """Number of pairs of copies closer than a distance; as many as fit go to ``pairs``.

    A pair in several bands counts in the lowest band that holds both copies.

    Args:
        boxes: (k, 4) left, bottom, right, top.
        which: (copies,) box of each copy.
        shift: (copies, 2) displacement of each copy.
        bands: bottom of the lowest band, height of the bands, distance.
        offsets: (bands + 1,) first entry of each band in ``member``.
        member: copies of each band by their left edges.
        pairs: (n, 2) output, copies.
    """
    count = 0
    low, height, distance = bands
    for band in range(len(offsets) - 1):
        for position in range(offsets[band], offsets[band + 1]):
            first = member[position]
            first_box = boxes[which[first]]
            right = first_box[2] + shift[first, 0] + distance
            for later in range(position + 1, offsets[band + 1]):
                second = member[later]
                second_box = boxes[which[second]]
                if second_box[0] + shift[second, 0] >= right:
                    break
                first_bottom = first_box[1] + shift[first, 1]
                second_bottom = second_box[1] + shift[second, 1]
                if int((max(first_bottom, second_bottom) - low) // height) != band:
                    continue
                if (
                    second_bottom - first_box[3] - shift[first, 1] >= distance
                    or first_bottom - second_box[3] - shift[second, 1] >= distance
                ):
                    continue
                if count < len(pairs):
                    pairs[count, 0], pairs[count, 1] = first, second
                count += 1
    return count


def measure_separation(
    polygons: Sequence[Array], first: Array, second: Array, offset: Array
) -> tuple[Array, Array]:
    """Distances between pairs of polygons, edge to edge.

    Args:
        polygons: edges (m, 4) of each distinct polygon.
        first: (n,) polygon of each pair.
        second: (n,) the other polygon of each pair.
        offset: (n, 2) displacement of the second polygon of each pair.

    Returns:
        (n,) Euclidean distance, 0 where the polygons touch, overlap or contain each
        other; and (n,) distance in the projection metric, inf where no edges face each
        other.

    Accuracy:
        Intersections are exact for extents below 2^26 database units; distances are
        rounded as float64.
    """
    first_edge = np.cumsum([0, *(len(edges) for edges in polygons)])
    edges = np.concatenate([np.empty((0, 4)), *polygons]).astype(float)
    euclidean, projected = np.empty(len(first)), np.empty(len(first))
    _measure_separation(
        edges, first_edge, first, second, offset.astype(float), euclidean, projected
    )
    return euclidean, projected


@compile_loop
def _measure_separation(
    edges: Array,
    first_edge: Array,
    first: Array,
    second: Array,
    offset: Array,
    euclidean: Array,
    projected: Array,
) -> None:
    """Fill ``euclidean`` and ``projected`` (n,) with distances of pairs of polygons.

    The distance is the least over all pairs of edges. Where one polygon encloses a
    corner of the other, the Euclidean distance is 0.

    Args:
        edges: (m, 4) x1, y1, x2, y2 of all polygons.
        first_edge: (polygons + 1,) first edge of each polygon.
        first: (n,) polygon of each pair.
        second: (n,) the other polygon of each pair.
        offset: (n, 2) displacement of the second polygon.
        euclidean: (n,) output.
        projected: (n,) output, in the projection metric; inf where no edges face.
    """
    for pair in range(len(first)):
        edges_1 = edges[first_edge[first[pair]] : first_edge[first[pair] + 1]]
        edges_2 = edges[first_edge[second[pair]] : first_edge[second[pair] + 1]].copy()
        edges_2[:, 0::2] += offset[pair, 0]
        edges_2[:, 1::2] += offset[pair, 1]
        least_square = np.inf
        least_projected = np.inf
        for i in range(len(edges_1)):
            for j in range(len(edges_2)):
                square = edge_distance_squared(edges_1[i], edges_2[j])
                least_square = min(least_square, square)
                if square < least_projected * least_projected:
                    least_projected = min(
                        least_projected,
                        projected_distance(edges_1[i], edges_2[j], -1.0),
                    )
        if least_square > 0 and (
            encloses_point(edges_1, edges_2[0, 0], edges_2[0, 1])
            or encloses_point(edges_2, edges_1[0, 0], edges_1[0, 1])
        ):
            least_square = 0.0
        euclidean[pair] = least_square**0.5
        projected[pair] = least_projected


@compile_loop
def edge_distance_squared(e: Array, f: Array) -> float:
    """Squared distance of two edges, 0 where they cross or touch.

    Args:
        e: x1, y1, x2, y2.
        f: the other edge.
    """
    if _on_both_sides(e, f) and _on_both_sides(f, e) and _overlap_on_axes(e, f):
        return 0.0
    ends = min(
        _point_distance_squared(e[0], e[1], f), _point_distance_squared(e[2], e[3], f)
    )
    return min(
        ends,
        _point_distance_squared(f[0], f[1], e),
        _point_distance_squared(f[2], f[3], e),
    )


@compile_loop
def _on_both_sides(e: Array, f: Array) -> bool:
    """Whether the ends of f lie on different sides of the line through e, or on it."""
    dx, dy = e[2] - e[0], e[3] - e[1]
    start = dx * (f[1] - e[1]) - dy * (f[0] - e[0])
    end = dx * (f[3] - e[1]) - dy * (f[2] - e[0])
    return bool(start <= 0 <= end or end <= 0 <= start)


@compile_loop
def _overlap_on_axes(e: Array, f: Array) -> bool:
    """Whether the bounding boxes of two edges meet."""
    for axis in range(2):
        if max(e[axis], e[axis + 2]) < min(f[axis], f[axis + 2]):
            return False
        if max(f[axis], f[axis + 2]) < min(e[axis], e[axis + 2]):
            return False
    return True


@compile_loop
def _point_distance_squared(x: float, y: float, e: Array) -> float:
    """Squared distance of a point from an edge."""
    dx, dy = e[2] - e[0], e[3] - e[1]
    along = ((x - e[0]) * dx + (y - e[1]) * dy) / (dx * dx + dy * dy)
    along = min(max(along, 0.0), 1.0)
    return float((x - e[0] - along * dx) ** 2 + (y - e[1] - along * dy) ** 2)


@compile_loop
def encloses_point(edges: Array, x: float, y: float) -> bool:
    """Whether the winding number of a polygon about a point off its edges is not 0.

    Args:
        edges: (m, 4) x1, y1, x2, y2.
        x: of the point.
        y: of the point.
    """
    winding = 0
    for n in range(len(edges)):
        x1, y1, x2, y2 = edges[n]
        if (y1 <= y) != (y2 <= y):
            side = (x2 - x1) * (y - y1) - (x - x1) * (y2 - y1)
            if (side > 0) == (y2 > y1):
                winding += 1 if y2 > y1 else -1
    return winding != 0


@compile_loop
def projected_distances(edges: Array, pairs: Array, side: float) -> Array:
    """(n,) :func:`projected_distance` of pairs of edges.

    Args:
        edges: (m, 4) x1, y1, x2, y2.
        pairs: (n, 2) edge numbers.
        side: 1 through the interior, -1 through the exterior.
    """
    out = np.empty(len(pairs))
    for n in range(len(pairs)):
        out[n] = projected_distance(edges[pairs[n, 0]], edges[pairs[n, 1]], side)
    return out


@compile_loop
def projected_distance(e: Array, f: Array, side: float) -> float:
    """Distance of two edges in the projection metric, as KLayout measures it.

    Edges face each other where their directions differ by more than 90 degrees, each
    lies on the side ``side`` of the other, and the perpendicular projection of each
    onto the other has a length.

    Args:
        e: x1, y1, x2, y2 with the interior on the left.
        f: the other edge.
        side: 1 through the interior (width), -1 through the exterior (space, notch).

    Returns:
        The larger of the two perpendicular distances; inf where the edges do not face,
        or share a corner.
    """
    if (e[2] - e[0]) * (f[2] - f[0]) + (e[3] - e[1]) * (f[3] - f[1]) >= 0:
        return np.inf
    if (e[0] == f[2] and e[1] == f[3]) or (e[2] == f[0] and e[3] == f[1]):
        return np.inf
    return max(_perpendicular_distance(e, f, side), _perpendicular_distance(f, e, side))


@compile_loop
def _perpendicular_distance(e: Array, f: Array, side: float) -> float:
    """Least distance of edge f from the line of edge e, on one side of it.

    Only that part of f counts whose projection falls on e; inf where it has no length.

    Args:
        e: x1, y1, x2, y2 with the interior on the left.
        f: the other edge.
        side: 1 through the interior, -1 through the exterior.
    """
    length = ((e[2] - e[0]) ** 2 + (e[3] - e[1]) ** 2) ** 0.5
    ux, uy = (e[2] - e[0]) / length, (e[3] - e[1]) / length
    along_start = (f[0] - e[0]) * ux + (f[1] - e[1]) * uy
    along_end = (f[2] - e[0]) * ux + (f[3] - e[1]) * uy
    distance_start = side * (ux * (f[1] - e[1]) - uy * (f[0] - e[0]))
    distance_end = side * (ux * (f[3] - e[1]) - uy * (f[2] - e[0]))
    if max(distance_start, distance_end) <= 0:
        return np.inf
    low, high = _clip_to_range(along_start, along_end, 0.0, length)
    low_on_side, high_on_side = _clip_to_range(
        distance_start, distance_end, 0.0, np.inf
    )
    low, high = max(low, low_on_side), min(high, high_on_side)
    if (high - low) * abs(along_end - along_start) <= 1e-9:
        return np.inf
    slope = distance_end - distance_start
    return float(
        max(min(distance_start + low * slope, distance_start + high * slope), 0.0)
    )


@compile_loop
def _clip_to_range(
    start: float, end: float, low: float, high: float
) -> tuple[float, float]:
    """Part of the segment from start to end that lies between two values.

    Returns:
        First and last fraction (0 to 1) of the way; nothing lies between the two values
        where the last is smaller than the first.
    """
    if start == end:
        return (0.0, 1.0) if low <= start <= high else (1.0, 0.0)
    first = (low - start) / (end - start)
    last = (high - start) / (end - start)
    return max(min(first, last), 0.0), min(max(first, last), 1.0)
