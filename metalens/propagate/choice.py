"""Which method is cheapest for a case at a tolerance, and why."""

import functools
from dataclasses import dataclass

from metalens.core.errors import PropagationError
from metalens.core.threads import one_blas_thread
from metalens.propagate import grids
from metalens.propagate.geometry import PropagationCase, split_window
from metalens.propagate.nodes import MOST_NODES, WindowLayout, plan_layout

# seconds on one core: per pillar and point, and per pillar, point and depth of the
# exact sum; per pillar of the
# windowed method, and for the plan of a tile
_EXACT = (4e-9, 1.5e-9)
_RAY = 5e-7  # beside the first where every ray is refracted by films
_PILLAR = 3e-9
_PLAN_SECONDS = 0.02


@dataclass(frozen=True, slots=True)
class MethodChoice:
    """method: ``exact``, ``windowed``, ``tiled`` or ``wide``; tiles: windows that are
    computed apart; seconds:
    expected, one core, planning included."""

    method: str
    reason: str
    tiles: tuple[tuple[PropagationCase, ...], ...]
    seconds: float


@functools.lru_cache(maxsize=1024)
def choose_method(
    case: PropagationCase,
    tolerance: float,
    *,
    differentiable: bool = False,
    moving: bool = False,
) -> MethodChoice:
    """The cheapest method that meets the tolerance.

    Args:
        differentiable: leave out the exact sum, which has no derivatives.
        moving: leave out the transforms too, which have none in the geometry.

    The angular spectrum is never chosen: its error (lattice, padding) has no bound.
    Radial lenses known by their
    radial profile have a faster way of their own, :mod:`benchmarks.peers.radial`.
    """
    pillars = case.shape[0] * case.shape[1]
    exact = exact_seconds(case)
    apart = grids.expected_cost(case, tolerance) + _PLAN_SECONDS + 2 * pillars * _PILLAR
    if not moving and apart < exact and grids.is_wide(case, tolerance):
        reason = f"wide window by Fourier transforms: {_told(apart)} s, exact sum {_told(exact)} s"
        return MethodChoice("wide", reason, ((case,),), apart)
    with one_blas_thread():
        cut = _windows(case, tolerance)
        found = [_layout(window, tolerance) for row in cut for window in row]
    plans = [
        (one.seconds + one.parts**2 * _PLAN_SECONDS, one.nodes)
        for one in found
        if one is not None
    ]
    windowed = sum(seconds + pillars * _PILLAR for seconds, _ in plans)
    if exact < windowed and not differentiable:
        size = f"{pillars:,} pillars at {_points(case)} points"
        reason = (
            f"exact sum: {size} take {_told(exact)} s, windowed {_told(windowed)} s"
        )
        return MethodChoice("exact", reason, ((case,),), exact)
    times = f"{_told(windowed)} s, exact sum {_told(exact)} s"
    if len(found) > 1:
        why = f"the whole window would need over {MOST_NODES} nodes or a large table"
        return MethodChoice(
            "tiled", f"windowed in {len(found)} tiles: {why}; {times}", cut, windowed
        )
    rows, columns = plans[0][1]
    return MethodChoice(
        "windowed", f"windowed: {rows} x {columns} nodes, {times}", cut, windowed
    )


def _told(seconds: float) -> str:
    """Two digits, never as a power of ten: ``580``, ``1.4``."""
    return f"{float(f'{seconds:.2g}'):g}"


def exact_seconds(case: PropagationCase) -> float:
    """Expected time of the exact sum."""
    each, depth = _EXACT
    pillars = case.shape[0] * case.shape[1]
    each = each if case.behind is None else each + _RAY
    return (
        pillars * _points(case) * (each + depth * len(case.inverse_depths_per_um))
        + 1e-4
    )


def _points(case: PropagationCase) -> int:
    return case.samples[0] * case.samples[1]


def _windows(
    case: PropagationCase, tolerance: float
) -> tuple[tuple[PropagationCase, ...], ...]:
    """The window, cut into equal parts until each can be planned with a useful number
    of nodes.
    """
    parts = 1
    while True:
        rows = split_window(case, parts)
        if all(
            _layout(window, tolerance) is not None
            for window in (rows[0][0], rows[-1][-1])
        ):
            return rows
        if parts >= max(case.samples):
            raise PropagationError(
                "the windowed method cannot reach this geometry even sample by sample; use propagate.exact"
            )
        parts *= 2


def _layout(case: PropagationCase, tolerance: float) -> WindowLayout | None:
    try:
        return plan_layout(case, tolerance)
    except PropagationError:
        return None
