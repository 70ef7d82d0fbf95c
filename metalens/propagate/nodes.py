"""How many nodes, directions and correction samples a propagation needs, and how a
window is cut.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from metalens.core import legendre
from metalens.core.arrays import Array
from metalens.core.errors import PropagationError
from metalens.propagate.geometry import PropagationCase, window_tiles
from metalens.propagate.paths import (
    cosine_y,
    direction_range,
    plane_wave_residual,
    probe_positions,
    rayleigh_sommerfeld_kernel,
)

MOST_NODES = 400
MOST_TABLE = 4e6
# by which the error of a truncated series at the corner of a tile, where a PSF may lie,
# exceeds its mean
EDGE = 8
PARTS = (1, 2, 3, 4, 6, 8, 12, 16)


@dataclass(frozen=True, slots=True)
class NodeCounts:
    """Counts chosen for a case and tolerance.

    nodes: (y, x) Legendre nodes over the lens; directions: direction cosines p along x.
    window: (y, x), lens: (row, direction) grids on which the correction is sampled.
    """

    nodes: tuple[int, int]
    directions: int
    window: tuple[int, int]
    lens: tuple[int, int]

    @property
    def table(self) -> int:
        """Size of the table of the correction."""
        return self.window[0] * self.window[1] * self.lens[0] * self.lens[1]


@dataclass(frozen=True, slots=True)
class WindowLayout:
    """nodes: (y, x) over the lens for the whole window; parts: tiles along each axis;
    sizes: of every tile; work: products for all tiles."""

    nodes: tuple[int, int]
    parts: int
    sizes: NodeCounts
    work: float


@functools.lru_cache(maxsize=1024)
def plan_layout(case: PropagationCase, tolerance: float) -> WindowLayout | None:
    """How the window is cut so that it costs least; None where no cut brings the tables
    down to some 100 MB.

    Args:
        case: geometry of the propagation.
        tolerance: relative error of the field.

    Raises:
        PropagationError: more than 400 nodes would be needed; the window is too large
            for this method.
    """
    nodes = lens_nodes(case, tolerance / 4)
    best = None
    for parts in PARTS:
        if parts > max(case.samples):
            break
        rows = window_tiles(case, parts)[1]
        corners = {
            _alike(tile) for row in (rows[0], rows[-1]) for tile in (row[0], row[-1])
        }
        found = _largest([node_counts(tile, tolerance) for tile in corners])
        tile, depths = rows[0][0], len(case.inverse_depths_per_um)
        handing_down = nodes[0] * nodes[1] * (50 + found.nodes[0])
        work = parts**2 * (_products(tile, found, depths) + handing_down)
        if found.table <= MOST_TABLE and (best is None or work < best.work):
            best = WindowLayout(nodes, parts, found, work)
        elif best is not None:
            break
    return best


def _alike(tile: PropagationCase) -> PropagationCase:
    """The tile, or its mirror image, which needs the same counts, where the source is
    straight ahead along an axis.
    """
    x, y = (
        abs(c) if slope == 0 else c
        for c, slope in zip(tile.centre_um, tile.tangents, strict=True)
    )
    return replace(tile, centre_um=(x, y))


def _largest(found: list[NodeCounts]) -> NodeCounts:
    """Counts that do for all."""
    pairs = [
        tuple(max(getattr(s, name)[i] for s in found) for i in (0, 1))
        for name in ("nodes", "window", "lens")
    ]
    return NodeCounts(pairs[0], max(s.directions for s in found), pairs[1], pairs[2])


def _products(case: PropagationCase, found: NodeCounts, depths: int) -> float:
    """Complex products of one tile: along y, along x, and of the depth fields; reading
    a node counts as 25 of them."""
    (my, mx), (ny, nx), b = case.samples, found.nodes, min(depths, 14)
    fields = 0.75 * b * max(found.window)
    along = found.directions * fields * (ny * (25 + my) + mx * my)
    return 1e5 + along + 30 * b * ny * nx


def lens_nodes(case: PropagationCase, tolerance: float) -> tuple[int, int]:
    """(y, x) nodes over the lens that the kernel needs.

    Args:
        case: geometry of the propagation.
        tolerance: relative error of the field.
    """
    high_y, high_x = case.half_size_um
    rows = _count(lambda t: _over_lens(case, None, t * high_y), tolerance, "lens rows")
    return rows, _count(
        lambda t: _over_lens(case, t * high_x, None), tolerance, "lens columns"
    )


def node_counts(case: PropagationCase, tolerance: float) -> NodeCounts:
    """The counts that a tile needs.

    Args:
        case: geometry of the propagation.
        tolerance: relative error of the field.

    Raises:
        PropagationError: more than 400 nodes would be needed.
    """
    share = tolerance / 4
    high_y = case.half_size_um[0]
    nodes = lens_nodes(case, share)
    low, high = direction_range(case, legendre.mapped_nodes(nodes[0], -high_y, high_y))
    middle, reach = (low + high) / 2, (high - low) / 2
    directions = _count(
        lambda t: _over_directions(case, middle + reach * t), share, "directions"
    )
    wy, wx = case.half_window_um
    edge = max(share / EDGE, min(share, 1e-13))  # rounding leaves no smaller tails
    window_x = _count(
        lambda t: _over_window(case, (low, high), X=t * wx), edge, "window columns"
    )
    window_y = _count(
        lambda t: _over_window(case, (low, high), Y=t * wy), edge, "window rows"
    )
    lens_p = _count(
        lambda t: _over_window(case, (low, high), p=middle + reach * t),
        edge,
        "correction directions",
    )
    lens_e = _count(
        lambda t: _over_window(case, (low, high), e=t * high_y), edge, "correction rows"
    )
    return NodeCounts(nodes, directions, (window_y, window_x), (lens_e, lens_p))


def _count(lines: Callable[[Array], Array], tolerance: float, what: str) -> int:
    count = 32
    while count <= 1.5 * MOST_NODES:
        found = legendre.needed_node_count(
            lines(legendre.gauss_legendre_nodes(count)[0]), tolerance
        )
        if found <= min(count, MOST_NODES):
            return max(found, 2)
        count *= 2
    raise PropagationError(
        f"windowed propagation needs more than {MOST_NODES} nodes ({what}); "
        "make the window smaller, or use propagate.exact"
    )


def _over_lens(case: PropagationCase, x: Array | None, y: Array | None) -> Array:
    """(line, node) of the kernel along lens columns (x given) or rows (y given)."""
    (hy, hx), (wy, wx) = case.half_size_um, case.half_window_um
    inverse = np.array(
        [min(case.inverse_depths_per_um), max(case.inverse_depths_per_um)]
    )
    other = np.array([-0.9, 0.0, 0.9])
    grid = np.meshgrid(
        other, probe_positions() * wx, probe_positions() * wy, inverse, indexing="ij"
    )
    o, X, Y, v = (g.reshape(-1, 1) for g in grid)
    return rayleigh_sommerfeld_kernel(
        case, o * hx if x is None else x, o * hy if y is None else y, X, Y, v
    )


def _over_directions(case: PropagationCase, p: Array) -> Array:
    """(line, direction) of the window kernel along p at fixed lens rows."""
    (hy, _), (wy, wx) = case.half_size_um, case.half_window_um
    grid = np.meshgrid(
        np.array([-0.9, 0.0, 0.9]) * hy,
        probe_positions() * wx,
        probe_positions() * wy,
        indexing="ij",
    )
    e, X, Y = (g.reshape(-1, 1) for g in grid)
    residual = plane_wave_residual(case, p, e, X, Y)
    q = cosine_y(case, p, e)
    return np.asarray(residual * np.exp(-1j * case.wavenumber * (p * X + q * Y)))


def _over_window(
    case: PropagationCase, span: tuple[float, float], **line: Array
) -> Array:
    """(line, node) of the correction along one of X, Y, p, e, the others on a few
    probes.
    """
    (hy, _), (wy, wx) = case.half_size_um, case.half_window_um
    low, high = span
    middle, reach = (low + high) / 2, (high - low) / 2
    probes = {
        "X": probe_positions() * wx,
        "Y": probe_positions() * wy,
        "p": middle + reach * probe_positions(),
        "e": probe_positions() * hy,
    }
    names = [n for n in probes if n not in line]
    grid = np.meshgrid(*(probes[n] for n in names), indexing="ij")
    at: dict[str, Any] = {
        n: g.reshape(-1, 1) for n, g in zip(names, grid, strict=True)
    } | line
    return plane_wave_residual(case, at["p"], at["e"], at["X"], at["Y"])
