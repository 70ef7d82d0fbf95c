"""Which method is cheapest for a case at a tolerance, and why."""

import itertools
from dataclasses import dataclass, replace

from metalens.errors import PropagationError
from metalens.propagate_case import Case
from metalens.propagate_plan import MOST_USEFUL_NODES, sizes

# seconds on one core: per pillar and point, and per pillar, point and depth of the exact sum; per pillar of the
# windowed method, per pillar and node of its matrix product, and per window sample, node and kept pair
_EXACT = (4e-9, 1.5e-9)
_WINDOWED = (4e-9, 8e-11, 1e-10)
_PLAN_SECONDS = 0.03


@dataclass(frozen=True, slots=True)
class Choice:
    """method: ``exact``, ``windowed`` or ``tiled``; tiles: of the window; seconds: expected, one core."""

    method: str
    reason: str
    tiles: tuple[tuple[Case, ...], ...]
    seconds: float


def choose(case: Case, tolerance: float, *, differentiable: bool = False) -> Choice:
    """The cheapest method that meets the tolerance.

    Args:
        differentiable: leave out the exact sum, which has no derivatives.

    The angular spectrum is never chosen: its error (lattice, padding) has no bound. Radial lenses known by their
    radial profile have a faster way of their own, :mod:`metalens.propagate_radial`.
    """
    tiles = _tiles(case, tolerance)
    windowed = sum(_windowed_seconds(tile, tolerance) for row in tiles for tile in row)
    exact = exact_seconds(case)
    count = sum(map(len, tiles))
    if exact < windowed and not differentiable:
        size = f"{_pillars(case)} pillars at {_points(case)} points"
        reason = f"exact sum: {size} take {exact:.2g} s, windowed {windowed:.2g} s"
        return Choice("exact", reason, ((case,),), exact)
    if count > 1:
        reason = (
            f"windowed in {count} tiles: the whole window would need over {MOST_USEFUL_NODES} nodes or a large table"
        )
        return Choice("tiled", f"{reason}; {windowed:.2g} s, exact sum {exact:.2g} s", tiles, windowed)
    found = sizes(case, tolerance)
    nodes = f"{found.nodes[0]} x {found.nodes[1]} nodes"
    return Choice("windowed", f"windowed: {nodes}, {windowed:.2g} s, exact sum {exact:.2g} s", tiles, windowed)


def exact_seconds(case: Case) -> float:
    """Expected time of the exact sum."""
    each, depth = _EXACT
    return _pillars(case) * _points(case) * (each + depth * len(case.inverse_depths_per_um)) + 1e-4


def _windowed_seconds(case: Case, tolerance: float) -> float:
    pillar, product, sample = _WINDOWED
    found = sizes(case, tolerance)
    nodes = max(found.nodes)
    return _PLAN_SECONDS + _pillars(case) * (pillar + product * nodes) + _points(case) * nodes * 50 * sample


def _pillars(case: Case) -> int:
    return case.shape[0] * case.shape[1]


def _points(case: Case) -> int:
    return case.samples[0] * case.samples[1]


def _tiles(case: Case, tolerance: float) -> tuple[tuple[Case, ...], ...]:
    """The window, cut into equal tiles until each needs a useful number of nodes."""
    parts = 1
    while True:
        rows, columns = (_cut(count, parts) for count in case.samples)
        widest = _part(case, rows[0], columns[0]), _part(case, rows[-1], columns[-1])
        if all(_fits(tile, tolerance) for tile in widest):
            return tuple(tuple(_part(case, r, c) for c in columns) for r in rows)
        if parts >= max(case.samples):
            raise PropagationError(
                "the windowed method cannot reach this geometry even sample by sample; use propagate.exact"
            )
        parts *= 2


def _fits(case: Case, tolerance: float) -> bool:
    try:
        return sizes(case, tolerance).practical
    except PropagationError:
        return False


def _cut(count: int, parts: int) -> list[tuple[int, int]]:
    parts = min(parts, count)
    edges = [count * i // parts for i in range(parts + 1)]
    return [(a, b) for a, b in itertools.pairwise(edges) if b > a]


def _part(case: Case, rows: tuple[int, int], columns: tuple[int, int]) -> Case:
    """The case for samples rows[0]…rows[1]-1 and columns[0]…columns[1]-1 of the window."""
    my, mx = case.samples
    y = case.centre_um[1] + ((rows[0] + rows[1] - 1) / 2 - (my - 1) / 2) * case.step_um
    x = case.centre_um[0] + ((columns[0] + columns[1] - 1) / 2 - (mx - 1) / 2) * case.step_um
    return replace(case, centre_um=(x, y), samples=(rows[1] - rows[0], columns[1] - columns[0]))
