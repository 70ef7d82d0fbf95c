"""The last steps of a free-form design by NLopt's method of moving asymptotes, the
energy as a true constraint.
"""

import contextlib
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from metalens.design.free_form.objective import Objective
from metalens.design.free_form.settings import ResolvedFisherSettings

REACH_RAD = 0.5  # from the start, for every control


def refine_phase(
    controls: Tensor,
    build: Callable[[Tensor], Tensor],
    objective: Objective,
    settings: ResolvedFisherSettings,
    focus_um: float,
) -> Tensor:
    """Lower the objective at fixed depths and positions, with the energy of every depth
    at least what is asked.

    Best feasible point of ``settings.refine`` evaluations (Svanberg 2002); the start
    where none is better.

    Args:
        focus_um: source distance in focus, um.
    """
    start = controls.detach().numpy().ravel()
    known: dict[
        bytes,
        tuple[float, np.ndarray[Any, Any], np.ndarray[Any, Any], np.ndarray[Any, Any]],
    ] = {}
    best = (math.inf, start)

    def evaluate(
        x: np.ndarray[Any, Any],
    ) -> tuple[float, np.ndarray[Any, Any], np.ndarray[Any, Any], Any]:
        nonlocal best
        key = x.tobytes()
        if key not in known:
            known.clear()
            point = (
                torch.from_numpy(x.copy()).reshape(controls.shape).requires_grad_(True)
            )
            loss, energy = objective.loss(build(point), focus_um, None)
            slope = torch.autograd.grad(loss, point, retain_graph=True)[0]
            rows = [
                torch.autograd.grad(e, point, retain_graph=True)[0].numpy().ravel()
                for e in energy
            ]
            missing = settings.encircled + 1e-3 - energy.detach().double().numpy()
            value = float(loss.detach())
            known[key] = (value, slope.numpy().ravel(), missing, -np.stack(rows))
            if missing.max() <= 1e-3 and value < best[0]:
                best = (value, x.copy())
        return known[key]

    def value(x: np.ndarray[Any, Any], gradient: np.ndarray[Any, Any]) -> float:
        found = evaluate(x)
        if gradient.size:
            gradient[:] = found[1]
        return found[0]

    def constraint(
        result: np.ndarray[Any, Any],
        x: np.ndarray[Any, Any],
        gradient: np.ndarray[Any, Any],
    ) -> None:
        found = evaluate(x)
        result[:] = found[2]
        if gradient.size:
            gradient[:] = found[3]

    _climb(
        start,
        value,
        constraint,
        constraints=len(evaluate(start)[2]),
        evaluations=settings.refine,
    )
    return torch.from_numpy(best[1]).reshape(controls.shape)


def _climb(
    start: np.ndarray[Any, Any],
    value: Callable[..., float],
    constraint: Callable[..., None],
    *,
    constraints: int,
    evaluations: int,
) -> None:
    """Let NLopt call ``value`` and ``constraint`` within REACH_RAD of the start; who
    calls keeps the best point.
    """
    import nlopt

    solver = nlopt.opt(nlopt.LD_MMA, start.size)
    solver.set_min_objective(value)
    solver.add_inequality_mconstraint(constraint, np.full(constraints, 1e-4))
    solver.set_lower_bounds(start - REACH_RAD)
    solver.set_upper_bounds(start + REACH_RAD)
    solver.set_maxeval(evaluations)
    with contextlib.suppress(nlopt.RoundoffLimited):  # the best point so far is kept
        solver.optimize(start)
