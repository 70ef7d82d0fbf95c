"""The method for a case at a tolerance, and why."""

import functools
from dataclasses import dataclass
from typing import Any

import torch

from metalens.core.arrays import Array, to_tensor
from metalens.core.errors import PropagationError
from metalens.core.threads import one_blas_thread
from metalens.propagate.geometry import PropagationCase, make_case
from metalens.propagate.moments import Pupils, mix_components, reduce_to_moments
from metalens.propagate.wide import WidePlan, is_wide, wide_axes
from metalens.propagate.window import (
    WindowPlan,
    field_windowed,
    plan_layout,
    plan_window,
)

EXACT_WORK = 3e7  # pillars x samples x depths below which the exact sum is as quick
WIDE_WORK = 1e9  # pillars x samples from which transforms are


@dataclass(frozen=True, slots=True)
class MethodChoice:
    """How the field on a window is computed.

    method: ``exact``, ``windowed`` or ``wide``. reason: in words.
    """

    method: str
    reason: str


@functools.lru_cache(maxsize=1024)
def choose_method(
    case: PropagationCase, tolerance: float, *, differentiable: bool = False
) -> MethodChoice:
    """Exact sum for little work, Fourier transforms for wide windows, else windowed.

    Args:
        case, tolerance: geometry, and relative error of the field.
        differentiable: leave out the exact sum, which has no derivatives.

    Raises:
        PropagationError: rays are too steep for transforms, and the window is too large
            for the windowed method.
    """
    pillars = case.shape[0] * case.shape[1]
    points = case.samples[0] * case.samples[1]
    depths = len(case.inverse_depths_per_um)
    if not differentiable and pillars * points * (depths + 2) / 3 < EXACT_WORK:
        return MethodChoice(
            "exact", f"exact sum: {pillars:,} pillars at {points} points"
        )
    if pillars * points > WIDE_WORK and is_wide(case, tolerance):
        return MethodChoice("wide", "wide window by Fourier transforms")
    with one_blas_thread():
        try:
            rows, columns = plan_layout(case, tolerance).nodes
        except PropagationError:
            if wide_axes(case, tolerance) is None:
                raise
            return MethodChoice("wide", "window by Fourier transforms")
    return MethodChoice("windowed", f"windowed: {rows} x {columns} nodes")


def light_on_window(
    maps: tuple[torch.Tensor, torch.Tensor],
    plan: WindowPlan | WidePlan,
    pupils: Pupils | None = None,
) -> tuple[torch.Tensor, Array, list[float]]:
    """Irradiance on the window, Σ_c sign_c |field_c|², differentiable once.

    Args:
        maps: (map, y, x) phase in rad, and transmission.
        plan: of :func:`plan_window` or :func:`plan_wide`.
        pupils: factors on the light of the maps (of a window with a ``smooth`` plan);
            None for the |U|² of one map.

    Returns:
        Irradiance (depth, y, x); light of every map on the nodes of the posterior
        error; sums of squares of the transmissions.
    """
    reduced = [reduce_to_moments(*one, plan.moments) for one in zip(*maps, strict=True)]
    moments = torch.stack([one_map for one_map, _ in reduced])
    parts = mix_components(plan.on_nodes(moments), pupils, plan.nodes_um)
    total: Any = None
    for sign, light in parts:
        irradiance = plan.irradiance(light)
        irradiance = irradiance if sign == 1 else sign * irradiance
        total = irradiance if total is None else total + irradiance
    return total, plan.on_check_nodes(moments), [power for _, power in reduced]


def windowed(
    phase_rad: Any, transmission: Any, *, tolerance: float = 1e-4, **geometry: Any
) -> Any:
    """Windowed propagation: only the field on the window, differentiable in torch phase
    and transmission.

    Args:
        phase_rad, transmission: (y, x) torch tensors or numpy arrays, float32 or
            float64.
        tolerance: relative error of the field that the node counts are chosen for.
        geometry: as :func:`make_case`.

    Returns:
        (depth, y, x) complex, of the kind that came in.

    Raises:
        PropagationError: the window is too large for the method, a tolerance that is
            not above 0 and below 1;
            otherwise as :func:`exact`.

    Sums are in float64 whatever comes in, so that a tighter tolerance is not lost in
    rounding.
    """
    if not 0 < tolerance < 1:
        raise PropagationError(
            f"tolerance is {tolerance}, need a relative error above 0 and below 1"
        )
    phase = to_tensor(phase_rad)
    level = to_tensor(transmission).to(phase)
    plan = plan_window(make_case(phase.shape, **geometry), tolerance, torch.float64)
    field = field_windowed(phase.double(), level.double(), plan)
    field = field.to(torch.complex(phase.new_zeros(()), phase.new_zeros(())).dtype)
    return field if isinstance(phase_rad, torch.Tensor) else field.detach().numpy()
