"""Pillar polygons: the area of the circle, on the mask grid, centred exactly, symmetric
under the square.

A polygon is built from one eighth of a turn and mirrored, so its centroid is the site
to the last digit and any
of the eight mirrored placements gives the same shape. Odd diameters need no half grid
step: the flats stand on
whole steps and the other vertices carry the area.
"""

import functools
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from metalens.ground.arrays import Array
from metalens.ground.errors import ProcessError


@dataclass(frozen=True, eq=False, slots=True)
class PillarShape:
    """The drawn outline of one pillar class.

    points: (n, 2) integer (x, y) about the site in grid steps, counter-clockwise,
    convex, not closed.
    diameter: of the circle it stands for, in grid steps.
    """

    points: Array
    diameter: float

    @property
    def area(self) -> float:
        """In squared grid steps, by the shoelace formula (exact: twice the area is an
        integer).
        """
        return twice_area(self.points) / 2

    @property
    def area_error(self) -> float:
        """Relative difference from the area of the circle."""
        return self.area / (math.pi * self.diameter**2 / 4) - 1

    @property
    def edge_error(self) -> float:
        """Largest distance between outline and circle, in grid steps."""
        return edge_error(self.points, self.diameter / 2)

    @property
    def shots(self) -> int:
        """Trapezoids with horizontal parallel sides that a shaped-beam writer needs:
        levels of y less one.
        """
        return len(np.unique(self.points[:, 1])) - 1


def pillar(diameter: float, *, vertices: int = 32, shape: str = "round") -> PillarShape:
    """Polygon of the area of a circle.

    Args:
        diameter: in grid steps; any real number, at least 4.
        vertices: at most so many, a multiple of 4 from 8 to 64; fewer where the grid
            makes some coincide.
        shape: ``round``, or ``shot``: an octagon of horizontal, vertical and diagonal
            edges (three trapezoids).

    Raises:
        ProcessError: a diameter below 4 grid steps, or vertices out of range.
    """
    if not (diameter >= 4 and math.isfinite(diameter)):
        raise ProcessError(
            f"pillar of {diameter} grid steps: need at least 4; take a finer grid"
        )
    if vertices % 4 or not 8 <= vertices <= 64:
        raise ProcessError(f"{vertices} vertices: need a multiple of 4 from 8 to 64")
    return _pillar(float(diameter), 8 if shape == "shot" else vertices)


_GOOD = 1e-3  # area error at which fewer vertices are not tried
_FEWER = (48, 32, 24, 20, 16, 12)  # a coarse grid suits few vertices better


@functools.lru_cache(maxsize=70000)
def _pillar(diameter: float, vertices: int) -> PillarShape:
    best: PillarShape | None = None
    for count in (vertices, *(n for n in _FEWER if n < vertices)):
        points = mirrored(_octagon(diameter) if count == 8 else _round(diameter, count))
        points.setflags(write=False)
        made = PillarShape(points, diameter)
        if best is None or abs(made.area_error) < 0.7 * abs(best.area_error):
            best = made
        if abs(best.area_error) <= _GOOD:
            break
    return best or made


def _octagon(diameter: float) -> Array:
    """(1, 2) vertex (a, b), 0 < b < a, of the octagon of area 4 a^2 - 2 (a - b)^2
    nearest to the circle's.

    Edges along x, y and the diagonals follow from the mirror images alone.
    """
    goal = math.pi * diameter**2 / 4
    regular = math.sqrt(
        goal / (8 * (math.sqrt(2) - 1))
    )  # half width of the regular octagon
    cut = (2 - math.sqrt(2)) * regular
    a = np.arange(max(2, math.floor(regular * 0.96)), math.ceil(regular * 1.04) + 1)[
        :, None
    ]
    c = np.arange(1, math.ceil(cut * 1.4) + 2)[None, :]
    error = np.abs((4 * a**2 - 2 * c**2) / goal - 1)
    lopsided = (a - regular) ** 2 + 0.25 * (c - cut) ** 2
    cost = np.where(
        c < a, np.maximum(error / 5e-4 - 1, 0) ** 2 * 4 + error * 100 + lopsided, np.inf
    )
    i, j = np.unravel_index(int(cost.argmin()), cost.shape)
    return np.array([[a[i, 0], a[i, 0] - c[0, j]]], np.int64)


def _round(diameter: float, vertices: int) -> Array:
    """(m, 2) vertices of the first eighth, 0 < angle <= 45 degrees: rounded, then moved
    until the area fits.
    """
    step = 2 * math.pi / vertices
    angle = np.arange(0.5, vertices / 8 + 0.25) * step
    radius = diameter / 2 * math.sqrt(math.pi / (vertices / 2 * math.sin(step)))
    start = np.round(radius * np.column_stack([np.cos(angle), np.sin(angle)])).astype(
        np.int64
    )
    if vertices % 8:
        start[-1] = round(radius / math.sqrt(2))
    start[:, 1] = np.maximum(start[:, 1], 1)
    return _refine(_without_dents(start), diameter)


def _without_dents(eighth: Array) -> Array:
    """The vertices without those that rounding has moved onto, or inside the line of,
    their neighbours.
    """
    eighth = eighth[np.append(True, np.any(np.diff(eighth, axis=0) != 0, axis=1))]
    while len(eighth) > 1:
        on_diagonal = int(eighth[-1, 0] == eighth[-1, 1])
        line = np.concatenate(
            [eighth[:1] * (1, -1), eighth, eighth[-1 - on_diagonal :][:1, ::-1]]
        )
        step = np.diff(line, axis=0)
        turn = step[:-1, 0] * step[1:, 1] - step[:-1, 1] * step[1:, 0]
        if turn.min() >= 0:
            break
        eighth = np.delete(eighth, int(turn.argmin()), axis=0)
    return eighth


def _refine(eighth: Array, diameter: float) -> Array:
    """Move vertices by whole steps to the least cost: all combinations for few
    vertices, else pairs in turn.
    """
    diagonal = bool(eighth[-1, 0] == eighth[-1, 1])
    moves = _moves(len(eighth), diagonal)
    here = eighth[..., None]
    cost = float(_cost(here, diameter)[0]) if _sound(here, diagonal)[0] else math.inf
    for _ in range(12):
        trials = here + moves
        costs = _cost(trials, diameter)
        better = np.flatnonzero(costs < cost - 1e-12)
        better = better[_sound(trials[..., better], diagonal)]
        if not len(better):
            break
        best = better[costs[better].argmin()]
        cost, here = float(costs[best]), trials[..., best : best + 1]
    return np.asarray(here[..., 0])


@functools.lru_cache(maxsize=64)
def _moves(count: int, diagonal: bool) -> Array:
    """(count, 2, t) trial moves; the last vertex stays on the diagonal where it stands
    on it.
    """
    free = 2 * count - diagonal
    if free <= 8:
        steps = np.arange(-2, 3) if free <= 4 else np.arange(-1, 2)
        flat = np.stack(np.meshgrid(*[steps] * free, indexing="ij"), axis=-1).reshape(
            -1, free
        )
    else:
        single = np.concatenate(
            [np.eye(free, dtype=np.int64), -np.eye(free, dtype=np.int64)]
        )
        first, second = np.triu_indices(len(single), 1)
        flat = np.concatenate([single, single[first] + single[second]])
    if diagonal:
        flat = np.concatenate([flat, flat[:, -1:]], axis=1)
    return np.ascontiguousarray(np.moveaxis(flat.reshape(-1, count, 2), 0, -1))


def _cost(eighths: Array, diameter: float) -> Array:
    """(t,) cost of (m, 2, t) trials: area errors beyond 0.05 % first, then the mean
    square of the edge error.
    """
    x, y = eighths[:, 0].astype(float), eighths[:, 1].astype(float)
    middle = (x[-1] + y[-1]) / 2
    eighth = (
        x[0] * y[0] + (x[-1] - y[-1]) * middle
    )  # twice the area, from the x axis to the diagonal
    for k in range(len(x) - 1):
        eighth += x[k] * y[k + 1] - x[k + 1] * y[k]
    area = 4 * eighth / (math.pi * diameter**2 / 4) - 1
    lean = (
        1 + 3.3 / (8 * len(x)) ** 2
    )  # vertices of an equal-area polygon stand outside the circle
    spread = ((np.hypot(x, y) - diameter / 2 * lean) ** 2).mean(0)
    return np.asarray(
        np.maximum(np.abs(area) / 5e-4 - 1, 0) ** 2 * 4 + np.abs(area) * 100 + spread
    )


def _sound(eighths: Array, diagonal: bool) -> Array:
    """(t,) whether (m, 2, t) trials are first eighths of convex polygons whose vertices
    all differ.
    """
    x, y = eighths[:, 0], eighths[:, 1]
    after = (
        slice(-2, -1) if diagonal and len(x) > 1 else slice(-1, None)
    )  # whose mirror image comes next
    dx = np.diff(np.concatenate([x[:1], x, y[after]]), axis=0)
    dy = np.diff(np.concatenate([-y[:1], y, x[after]]), axis=0)
    bent = (dx[:-1] * dy[1:] - dx[1:] * dy[:-1] < 0).any(0)
    crossed = y[-1] > x[-1] if diagonal else y[-1] >= x[-1]
    wrong = (
        bent
        | crossed
        | ((dx == 0) & (dy == 0))[:-1].any(0)
        | (y[0] < 1)
        | (dx > 0).any(0)
        | (dy < 0).any(0)
    )
    return np.asarray(~wrong)


def mirrored(eighth: Array) -> Array:
    """All eight images of the vertices of one eighth: (n, 2), counter-clockwise;
    doubles and flat corners go.
    """
    quarter = np.concatenate([eighth, eighth[::-1, ::-1]])
    turns = [quarter]
    for _ in range(3):
        last = turns[-1]
        turns.append(np.column_stack([-last[:, 1], last[:, 0]]))
    points = np.concatenate(turns)
    points = points[np.any(points != np.roll(points, 1, axis=0), axis=1)]
    return np.ascontiguousarray(points[_turn(points) != 0])


def _turn(points: Array) -> Array:
    before = points - np.roll(points, 1, axis=0)
    after = np.roll(points, -1, axis=0) - points
    return np.asarray(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0])


def twice_area(points: Array) -> int:
    """Twice the area that (n, 2) integer points enclose, exact."""
    p = (
        points.astype(object)
        if np.abs(points).max(initial=0) > 2**30
        else points.astype(np.int64)
    )
    x, y = p[:, 0], p[:, 1]
    return int((x[:-1] * y[1:] - x[1:] * y[:-1]).sum() + x[-1] * y[0] - x[0] * y[-1])


def edge_error(points: Array, radius: float) -> float:
    """Largest distance between a polygon around the origin and a circle: at a vertex or
    at the foot of an edge.
    """
    p, q = points.astype(float), np.roll(points, -1, axis=0).astype(float)
    edge = q - p
    along = np.clip(-(p * edge).sum(1) / (edge**2).sum(1), 0, 1)
    foot = np.hypot(*(p + along[:, None] * edge).T)
    vertex = np.hypot(*p.T)
    return float(
        max(vertex.max() - radius, radius - foot.min())
    )  # feet lie nearer to the origin than vertices


@dataclass(frozen=True, slots=True)
class FrontierPoint:
    """What a number of vertices costs and gives, worst over a range of diameters.

    area_error: relative; edge_error_nm; corners, shots: mean counts of one pillar.
    """

    vertices: int
    shape: str
    area_error: float
    edge_error_nm: float
    corners: float
    shots: float


def frontier(
    diameters_nm: Iterable[float],
    *,
    grid_nm: float = 1.0,
    vertices: Iterable[int] = (8, 12, 16, 24, 32, 48, 64),
) -> Iterator[FrontierPoint]:
    """Area error, edge error and cost for each number of vertices, and for the
    shot-friendly octagon.
    """
    sizes = [d / grid_nm for d in diameters_nm]
    for shape, n in [("shot", 8), *(("round", n) for n in vertices)]:
        made = [pillar(s, vertices=n, shape=shape) for s in sizes]
        yield FrontierPoint(
            vertices=n,
            shape=shape,
            area_error=max(abs(m.area_error) for m in made),
            edge_error_nm=max(m.edge_error for m in made) * grid_nm,
            corners=sum(len(m.points) for m in made) / len(made),
            shots=sum(m.shots for m in made) / len(made),
        )
