"""Pillar polygons: the area of the circle, on the mask grid, centred exactly, symmetric
under the square.
"""

import functools
import math

import numpy as np

from metalens.core.arrays import Array
from metalens.core.errors import ProcessError

_FREE = 1e-3  # area error below which the nearer outline is taken
_FEWER = (48, 32, 24, 20, 16, 12, 8)  # a coarse grid suits few vertices better
_EITHER = 0.24  # of a grid step: both half widths are tried within this of a half one
_REGULAR = math.sqrt(math.pi / (8 * (math.sqrt(2) - 1)))  # half width of an octagon


def pillar_polygon(diameter: float, *, vertices: int = 32) -> Array:
    """(n, 2) polygon of the area of a circle, in whole grid steps about its site.

    Counter-clockwise, convex, symmetric under the square, not closed.

    For diameters that differ by a grid step or more, widths along both axes and areas
    do not fall as the diameter rises.

    Args:
        diameter: in grid steps; any real number, at least 4.
        vertices: at most so many, a multiple of 4 from 8 to 64; fewer where the grid
            makes some coincide. Eight have horizontal, vertical and diagonal edges
            alone (three trapezoids).

    Raises:
        ProcessError: a diameter below 4 grid steps, or vertices out of range.
    """
    if not (diameter >= 4 and math.isfinite(diameter)):
        raise ProcessError(
            f"pillar of {diameter} grid steps: need at least 4; take a finer grid"
        )
    if vertices % 4 or not 8 <= vertices <= 64:
        raise ProcessError(f"{vertices} vertices: need a multiple of 4 from 8 to 64")
    return _pillar(float(diameter), vertices)


@functools.lru_cache(maxsize=70000)
def _pillar(diameter: float, vertices: int) -> Array:
    """Polygon of the most vertices whose area fits, else of the smallest area error.

    Args:
        diameter: grid steps.
        vertices: most vertices.

    Raises:
        ProcessError: the grid holds no polygon of this size.
    """
    half_width = diameter / 2 * (_REGULAR if vertices == 8 else 1.0)
    halves = sorted({round(half_width - _EITHER), round(half_width + _EITHER)})
    best: tuple[tuple[float, float], Array] | None = None
    for count in (vertices, *(fewer for fewer in _FEWER if fewer < vertices)):
        for half in halves:
            candidate = _eighth(diameter, count, max(half, 2))
            if candidate is not None and (best is None or candidate[0] < best[0]):
                best = candidate
        if best is not None and best[0][0] <= _FREE:
            break
    if best is None:
        raise ProcessError(f"no polygon for {diameter} grid steps; take a finer grid")
    points = eightfold_images(best[1])
    points.setflags(write=False)
    return points


def _eighth(
    diameter: float, count: int, half: int
) -> tuple[tuple[float, float], Array] | None:
    """Best first eighth of a convex polygon, at angles above 0 and up to 45 degrees.

    Candidates are vertices on circles, rounded to the grid. The smallest area error
    wins; errors below a threshold are equal, and then the smallest edge error wins.

    Args:
        diameter: of the circle of equal area, grid steps.
        count: vertices of the whole polygon.
        half: x of the first vertex.

    Returns:
        ((area error, edge error), (m, 2) vertices); None where the grid holds no
        candidate.
    """
    step = 2 * math.pi / count
    angle = np.arange(0.5, count / 8 + 0.25) * step
    radius = diameter / 2 * math.sqrt(math.pi / (count / 2 * math.sin(step)))
    if count == 8:
        y = np.arange(1, half)
        trials = np.stack([np.full(len(y), half), y])[None]
    else:
        trials = _trials(angle, radius, half, diagonal=count % 8 != 0)
    trials = trials[..., _sound(trials, count % 8 != 0)]
    if not trials.shape[-1]:
        return None
    area, spread = _measures(trials, diameter, radius)
    order = np.lexsort((spread, np.maximum(area, _FREE)))
    best = int(order[0])
    return (max(float(area[best]), _FREE), float(spread[best])), trials[..., best]


def _trials(angle: Array, radius: float, half: int, *, diagonal: bool) -> Array:
    """Candidate eighths: vertices on circles near the equal-area circle.

    Vertices are rounded to the grid. Neighbours differ by one step of one vertex; a
    vertex on the diagonal moves along it.

    Args:
        angle: (m,) of the vertices, rad.
        radius: of the vertices of an equal-area polygon, grid steps.
        half: x of the first vertex.
        diagonal: whether the last vertex is on the diagonal.

    Returns:
        (m, 2, t) distinct candidates.
    """
    rings = radius + np.linspace(-0.9, 0.9, 19)
    ring = np.stack([np.cos(angle), np.sin(angle)], -1)[..., None] * rings
    start = np.round(ring).astype(np.int64)
    if diagonal:
        start[-1] = np.round(rings / math.sqrt(2)).astype(np.int64)
    start[0, 1] = np.maximum(start[0, 1], 1)
    candidates = [start]
    for vertex in range(len(angle)):
        for axis in (0, 1):
            for direction in (-1, 1):
                moved = start.copy()
                is_diagonal = diagonal and vertex == len(angle) - 1
                moved[vertex, slice(None) if is_diagonal else axis] += direction
                candidates.append(moved)
    all_candidates = np.concatenate(candidates, axis=-1)
    all_candidates[0, 0] = half
    return np.unique(
        all_candidates.reshape(-1, all_candidates.shape[-1]), axis=1
    ).reshape(len(angle), 2, -1)


def _measures(eighths: Array, diameter: float, radius: float) -> tuple[Array, Array]:
    """(t,) relative area error, and (t,) mean square distance of vertices to a circle.

    Args:
        eighths: (m, 2, t) vertices.
        diameter: of the circle of equal area.
        radius: of the vertices of a regular polygon of that area.
    """
    x, y = eighths[:, 0].astype(float), eighths[:, 1].astype(float)
    middle = (x[-1] + y[-1]) / 2
    twice = x[0] * y[0] + (x[-1] - y[-1]) * middle  # from the x axis to the diagonal
    for k in range(len(x) - 1):
        twice += x[k] * y[k + 1] - x[k + 1] * y[k]
    area = np.abs(4 * twice / (math.pi * diameter**2 / 4) - 1)
    return area, ((np.hypot(x, y) - radius) ** 2).mean(0)


def _sound(eighths: Array, diagonal: bool) -> Array:
    """(t,) whether trials (m, 2, t) are eighths of strictly convex polygons."""
    x, y = eighths[:, 0], eighths[:, 1]
    mirrored = (
        slice(-2, -1) if diagonal and len(x) > 1 else slice(-1, None)
    )  # whose mirror image comes next
    dx = np.diff(np.concatenate([x[:1], x, y[mirrored]]), axis=0)
    dy = np.diff(np.concatenate([-y[:1], y, x[mirrored]]), axis=0)
    is_concave = (dx[:-1] * dy[1:] - dx[1:] * dy[:-1] < 0).any(0)
    crosses_diagonal = y[-1] > x[-1] if diagonal else y[-1] >= x[-1]
    is_invalid = (
        is_concave
        | crosses_diagonal
        | ((dx == 0) & (dy == 0))[:-1].any(0)
        | (y[0] < 1)
        | (dx > 0).any(0)
        | (dy < 0).any(0)
    )
    return np.asarray(~is_invalid)


def eightfold_images(eighth: Array) -> Array:
    """(n, 2) vertices of a polygon from those of one eighth, counter-clockwise.

    Repeated vertices and flat corners are removed.
    """
    quarter = np.concatenate([eighth, eighth[::-1, ::-1]])
    turns = [quarter]
    for _ in range(3):
        last = turns[-1]
        turns.append(np.column_stack([-last[:, 1], last[:, 0]]))
    points = np.concatenate(turns)
    points = points[np.any(points != np.roll(points, 1, axis=0), axis=1)]
    return np.ascontiguousarray(points[corner_turns(points) != 0])


def disc_polygon(
    radius: float, centre: tuple[float, float], corners: int = 64, grid: int = 1
) -> Array:
    """Regular polygon of the area of a circle, rounded to a grid.

    Args:
        radius: of the circle.
        centre: of the circle.
        corners: their number; the first lies half a step above the x axis. Of 64 each
            edge is within 0.12 % of the radius from the circle.
        grid: step of the coordinates.

    Returns:
        (corners, 2) points, counter-clockwise.
    """
    step = 2 * math.pi / corners
    angle = (np.arange(corners) + 0.5) * step
    reach = radius * math.sqrt(step / math.sin(step))
    points = np.column_stack([np.cos(angle), np.sin(angle)]) * reach + centre
    return np.asarray(np.rint(points / grid) * grid, np.int64)


def corner_turns(points: Array) -> Array:
    """Cross product of the edges at each corner, (n,); 0 where it is flat.

    Args:
        points: (n, 2) corners.
    """
    step_in = points - np.roll(points, 1, axis=0)
    step_out = np.roll(points, -1, axis=0) - points
    return np.asarray(step_in[:, 0] * step_out[:, 1] - step_in[:, 1] * step_out[:, 0])


def twice_area(points: Array) -> int:
    """Twice the area that (n, 2) integer points enclose, exact."""
    p = (
        points.astype(object)
        if np.abs(points).max(initial=0) > 2**30
        else points.astype(np.int64)
    )
    x, y = p[:, 0], p[:, 1]
    return int((x[:-1] * y[1:] - x[1:] * y[:-1]).sum() + x[-1] * y[0] - x[0] * y[-1])
