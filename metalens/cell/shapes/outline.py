"""The section of a pillar of a given size: signed ellipses and polygons, with
everything that follows from them.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from metalens.core.arrays import Array
from metalens.core.errors import CellError

Point = tuple[float, float]
_EQUAL = 1e-9  # of the area: Fourier factors that differ less are the same
_INSET = 1e-4  # of an edge, from its end
_PROBES = np.array(
    [[1.31, 0.73], [2.9, -1.7], [0.4, 4.1], [5.3, 3.3], [-7.1, 2.2]]
)  # over the radius, none equal


@dataclass(frozen=True, slots=True)
class EllipseArc:
    """An ellipse with half axes a (along x before the turn) and b; sign -1 cuts it out.

    centre_um: (x, y), the site of the pillar but in rows of several.
    """

    half_x_um: float
    half_y_um: float
    angle_rad: float = 0.0
    sign: int = 1
    centre_um: Point = (0.0, 0.0)

    @property
    def area_um2(self) -> float:
        """pi a b, with its sign."""
        return self.sign * math.pi * self.half_x_um * self.half_y_um

    def fourier(self, gx: Array, gy: Array) -> Array:
        """∫ exp(-i g r) d²r = pi a b 2 J1(s) / s, s = |(a gx', b gy')| in the axes of
        the ellipse.
        """
        from scipy.special import j1

        c, s = math.cos(self.angle_rad), math.sin(self.angle_rad)
        along = self.half_x_um * (c * gx + s * gy)
        across = self.half_y_um * (c * gy - s * gx)
        x = np.hypot(along, across)
        safe = np.where(x < 1e-6, 1.0, x)
        shape = np.where(x < 1e-6, 1 - x * x / 8, 2 * j1(safe) / safe)
        if self.centre_um == (0.0, 0.0):
            return np.asarray(self.area_um2 * shape, complex)
        shift = self.centre_um[0] * gx + self.centre_um[1] * gy
        return np.asarray(self.area_um2 * shape * np.exp(-1j * shift))

    def vertices(self, count: int) -> Array:
        """(count, 2) points, anticlockwise, of the inscribed polygon with the area of
        the ellipse.
        """
        turn = 2 * np.pi * np.arange(count) / count
        swell = math.sqrt(2 * math.pi / count / math.sin(2 * math.pi / count))
        x = swell * self.half_x_um * np.cos(turn)
        y = swell * self.half_y_um * np.sin(turn)
        c, s = math.cos(self.angle_rad), math.sin(self.angle_rad)
        return np.stack([c * x - s * y, s * x + c * y], axis=1) + self.centre_um


@dataclass(frozen=True, slots=True)
class PolygonLoop:
    """A polygon without crossings; sign -1 cuts it out."""

    corners_um: tuple[Point, ...]
    sign: int = 1

    @property
    def area_um2(self) -> float:
        """Half the sum of cross products of neighbouring corners, with the sign of the
        part.
        """
        return self.sign * abs(_signed_area(np.array(self.corners_um)))

    def fourier(self, gx: Array, gy: Array) -> Array:
        """∫ exp(-i g r) d²r by Green's theorem over the edges: sum of i (g x d) / g²
        exp(-i g m) sinc(g d / 2).

        m is the middle and d the vector of an edge; below |g| size = 1e-4 the area and
        the centroid are used.
        """
        points = _anticlockwise(np.array(self.corners_um))
        edge = np.roll(points, -1, axis=0) - points
        middle = points + edge / 2
        g = np.stack(np.broadcast_arrays(gx, gy), axis=-1).astype(float)
        square = (g**2).sum(axis=-1)
        small = np.sqrt(square) * np.abs(points).max() < 1e-4
        half = g @ edge.T / 2
        cross = g[..., :1] * edge[:, 1] - g[..., 1:] * edge[:, 0]
        total = (cross * np.sinc(half / np.pi) * np.exp(-1j * (g @ middle.T))).sum(
            axis=-1
        )
        area = _signed_area(points)
        centre = _centroid(points, area)
        at_small_g = area * (1 - 1j * (g @ centre))
        return np.asarray(
            self.sign
            * np.where(small, at_small_g, 1j * total / np.where(small, 1.0, square))
        )

    def vertices(self, count: int) -> Array:
        """(n, 2) corners, anticlockwise; a polygon needs no more points than it has."""
        return _anticlockwise(np.array(self.corners_um))


@dataclass(frozen=True, slots=True)
class Outline:
    """A section: ellipses and polygons that overlap only where one cuts another out.

    parts: with signs; the first is the outermost.
    """

    parts: tuple[EllipseArc | PolygonLoop, ...]

    @property
    def area_um2(self) -> float:
        """Area of the solid part."""
        return sum(part.area_um2 for part in self.parts)

    @property
    def radius_um(self) -> float:
        """Radius of the smallest circle about the origin around the outline."""
        return max(float(np.hypot(*part.vertices(64).T).max()) for part in self.parts)

    def fourier(self, gx: Array, gy: Array) -> Array:
        """(...) ∫ exp(-i (gx x + gy y)) dx dy over the solid part, um²; exact."""
        return np.asarray(sum(part.fourier(gx, gy) for part in self.parts))

    def polygons(self, count: int = 64) -> tuple[tuple[int, Array], ...]:
        """(sign, (n, 2) corners) of every part: what a mask or a solid is made of;
        ellipses keep their area.
        """
        return tuple((part.sign, part.vertices(count)) for part in self.parts)

    def turned(self, angle_rad: float) -> "Outline":
        """The outline turned about the origin, from +x towards +y."""
        parts: list[EllipseArc | PolygonLoop] = []
        for part in self.parts:
            if isinstance(part, EllipseArc):
                x, y = rotate_corners(np.array([part.centre_um]), angle_rad)[0].tolist()
                angle = part.angle_rad + angle_rad
                parts.append(replace(part, angle_rad=angle, centre_um=(x, y)))
            else:
                corners = rotate_corners(np.array(part.corners_um), angle_rad).tolist()
                parts.append(
                    replace(part, corners_um=tuple((x, y) for x, y in corners))
                )
        return Outline(tuple(parts))

    def boundary(self, step_um: float) -> tuple[Array, Array]:
        """Points (n, 2) on the boundary, spaced by at most ``step_um``, and their unit
        normals, out of the part.
        """
        points, normals = [], []
        for part in self.parts:
            count = 0
            if isinstance(part, EllipseArc):
                radius_um = max(part.half_x_um, part.half_y_um)
                count = max(32, math.ceil(2 * math.pi * radius_um / step_um))
            corners = part.vertices(count)
            edge = np.roll(corners, -1, axis=0) - corners
            for start, d in zip(corners, edge, strict=True):
                n = max(1, math.ceil(float(np.hypot(*d)) / step_um))
                points.append(start + (np.arange(n)[:, None] + 0.5) / n * d)
                normals.append(np.tile([d[1], -d[0]] / np.hypot(*d), (n, 1)))
        return np.concatenate(points), np.concatenate(normals)

    def inside(self, x_um: Array, y_um: Array) -> Array:
        """(...) whether points lie in the solid part."""
        from matplotlib.path import Path as Polygon

        points = np.stack(np.broadcast_arrays(x_um, y_um), axis=-1)
        depth = np.zeros(points.shape[:-1], int)
        for sign, corners in self.polygons(256):
            depth += sign * Polygon(corners).contains_points(
                points.reshape(-1, 2)
            ).reshape(depth.shape)
        return np.asarray(depth > 0)

    def keeps(self, flip_x: int, flip_y: int) -> bool:
        """Whether (x, y) -> (flip_x x, flip_y y), flips +-1, leaves it as it is."""
        return self._is_invariant(np.diag([flip_x, flip_y]))

    def repeats(self, turn_rad: float) -> bool:
        """Whether a turn in the plane leaves it as it is."""
        c, s = math.cos(turn_rad), math.sin(turn_rad)
        return self._is_invariant(np.array([[c, -s], [s, c]]))

    def _is_invariant(self, matrix: Array) -> bool:
        """Whether an orthogonal ``matrix`` leaves the Fourier factors as they are."""
        g = (_PROBES / self.radius_um).T
        difference = np.abs(self.fourier(*g) - self.fourier(*(matrix @ g))).max()
        return bool(difference <= _EQUAL * self.area_um2)

    @property
    def spans_um(self) -> tuple[float, float]:
        """Least solid width (walls of rings, bars of crosses) and least space within
        (holes, hollows; inf), um.

        Convex outlines and holes are measured between parallel lines. All else is
        measured between opposite edges without a common corner. Curves are taken as 64
        edges of the same area: 1e-3 of their radius.
        """
        parts = [corners[::sign] for sign, corners in self.polygons()]
        hollow = [
            _is_concave(corners[:: part.sign])
            for corners, part in zip(parts, self.parts, strict=True)
        ]
        start = np.concatenate(parts)
        end = np.concatenate([np.roll(c, -1, axis=0) for c in parts])
        part_number = np.repeat(np.arange(len(parts)), [len(c) for c in parts])
        along = (end - start) / np.hypot(*(end - start).T)[:, None]
        # pairs of edges that run against each other
        i, j = np.nonzero(along @ along.T < -_EQUAL)
        counted = (part_number[i] != part_number[j]) | np.array(hollow)[part_number[i]]
        counted &= (start[i] != end[j]).any(axis=1) & (end[i] != start[j]).any(axis=1)
        i, j = i[counted], j[counted]
        holes = [
            _least_width(c)
            for c, is_hollow in zip(parts[1:], hollow[1:], strict=True)
            if not is_hollow
        ]
        solid, space = (
            _least_width(self.parts[0].vertices(64)),
            min(holes, default=math.inf),
        )
        for tip in (
            start[i] + _INSET * (end - start)[i],
            end[i] - _INSET * (end - start)[i],
        ):
            foot, is_opposite = _foot(tip, start[j], end[j])
            within = self.inside(*((tip + foot) / 2).T)
            distance = np.hypot(*(tip - foot).T)
            solid = min(
                solid, float(distance[is_opposite & within].min(initial=math.inf))
            )
            space = min(
                space, float(distance[is_opposite & ~within].min(initial=math.inf))
            )
        return solid, space

    def gap_um(self, steps: tuple[Point, ...]) -> float:
        """Least distance (um) to the copies of the outline at lattice steps.

        0 where they touch or overlap, within 1 % of the radius.

        Args:
            steps: (x, y) of the copies, um.
        """
        from scipy.spatial import cKDTree

        points, _ = self.boundary(self.radius_um / 100)
        tree, gap = cKDTree(points), math.inf
        for x, y in steps:
            if math.hypot(x, y) - 2 * self.radius_um >= gap:
                continue
            copy = points + np.array([x, y])
            if self.inside(*copy.T).any():
                return 0.0
            gap = min(gap, float(tree.query(copy)[0].min()))
        return gap


def offset_corners(corners: Array, grow_um: float) -> tuple[Point, ...]:
    """``corners`` of the polygon whose edges lie ``grow_um`` / 2 further out, mitred.

    Raises:
        CellError: so far in that an edge vanishes.
    """
    points = _anticlockwise(corners)
    edge = np.roll(points, -1, axis=0) - points
    normals = np.stack([edge[:, 1], -edge[:, 0]], axis=1) / np.hypot(*edge.T)[:, None]
    previous = np.roll(normals, 1, axis=0)
    mitre = (normals + previous) / (1 + (normals * previous).sum(axis=1))[:, None]
    moved = points + grow_um / 2 * mitre
    if ((np.roll(moved, -1, axis=0) - moved) * edge).sum(axis=1).min() <= 0:
        raise CellError(
            f"an outline moved in by {-grow_um / 2:.4g} um loses an edge; need a larger size or less bias"
        )
    return tuple((float(x), float(y)) for x, y in moved)


def rotate_corners(corners: Array, angle_rad: float) -> Array:
    """(n, 2) ``corners`` turned by ``angle_rad`` from +x towards +y."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.asarray(corners @ np.array([[c, s], [-s, c]]))


def _least_width(corners: Array) -> float:
    """Least width of a polygon: distance of the closest parallel lines around it, one of
    which lies on an edge of the convex hull.
    """
    from scipy.spatial import ConvexHull

    hull = ConvexHull(corners)
    return float(np.ptp(corners @ hull.equations[:, :2].T, axis=0).min())


def _is_concave(corners: Array) -> bool:
    """Whether an anticlockwise polygon is not convex."""
    edge = np.roll(corners, -1, axis=0) - corners
    next_edge = np.roll(edge, -1, axis=0)
    return bool(
        (edge[:, 0] * next_edge[:, 1] - edge[:, 1] * next_edge[:, 0]).min()
        < -_EQUAL * np.abs(edge).max() ** 2
    )


def _foot(tip: Array, start: Array, end: Array) -> tuple[Array, Array]:
    """(n, 2) feet of the perpendiculars on lines, and whether they lie on the edges.

    Args:
        tip: (n, 2) points. start, end: (n, 2) of the edges.
    """
    edge = end - start
    along = ((tip - start) * edge).sum(axis=1) / (edge**2).sum(axis=1)
    return start + along[:, None] * edge, (along > -_EQUAL) & (along < 1 + _EQUAL)


def _anticlockwise(points: Array) -> Array:
    """(n, 2) corners in anticlockwise order."""
    return points if _signed_area(points) > 0 else points[::-1]


def _signed_area(points: Array) -> float:
    """Area of a polygon, positive if anticlockwise (shoelace formula)."""
    x, y = points.T
    return float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2)


def _centroid(points: Array, area: float) -> Array:
    """(2,) centroid of a polygon of this signed area."""
    following = np.roll(points, -1, axis=0)
    cross = points[:, 0] * following[:, 1] - points[:, 1] * following[:, 0]
    return np.asarray(((points + following) * cross[:, None]).sum(axis=0) / (6 * area))
