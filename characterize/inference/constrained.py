"""The least of a quadratic inside limits: between bounds by BVLS (SciPy), inside a ball too by SLSQP (NLopt)."""

import contextlib
from collections.abc import Callable
from dataclasses import dataclass

import nlopt
import numpy as np
from scipy import optimize

from metalens.ground.arrays import Array

_KNOWN = 1e-14  # of the largest eigenvalue


@dataclass(frozen=True, eq=False, slots=True)
class Ball:
    """Limit of the root sum of squares of some parameters: ``index`` of them, ``radius`` in their unit."""

    index: Array
    radius: float

    def inside(self, x: Array) -> bool:
        """Whether the limit holds."""
        return float(np.linalg.norm(x[self.index])) <= self.radius * (1 + 1e-9)


def between(curvature: Array, gradient: Array, low: Array, high: Array) -> Array:
    """The s with least sᵀCs / 2 + gᵀs between ``low`` and ``high``, exactly on those that stop it (Stark, Parker 1995).

    Clipping the free minimum to the bounds is not it where parameters go together: what one may not do, others do. Nor
    is what stays when all that the free minimum violates are held at once: some of them leave for others alone.

    Args:
        curvature: (p, p) positive; combinations that it knows to less than 1e-14 of the rest do not move.
        gradient, low, high: (p,); bounds may be infinite, and touch.
    """
    own = np.sqrt(np.maximum(np.diag(curvature), 1e-300))
    values, vectors = np.linalg.eigh(curvature / np.outer(own, own))
    some = values > _KNOWN * values[-1]
    root = np.sqrt(values[some])
    matrix, wanted = (vectors[:, some] * root).T, -(vectors[:, some].T @ (gradient / own)) / root
    out, loose = np.clip(np.zeros(len(own)), low, high), high > low
    limits = low[loose] * own[loose], high[loose] * own[loose]
    rest = wanted - matrix[:, ~loose] @ (out[~loose] * own[~loose])
    found = optimize.lsq_linear(matrix[:, loose], rest, limits, method="bvls", tol=1e-12, max_iter=20 * len(own))
    held = np.where(found.active_mask < 0, low[loose], high[loose])
    out[loose] = np.where(found.active_mask == 0, np.clip(found.x / own[loose], low[loose], high[loose]), held)
    return out


def step(
    curvature: Array,
    gradient: Array,
    x: Array,
    *,
    low: Array,
    high: Array,
    ball: Ball | None = None,
    tolerance: float = 1e-3,
) -> Array:
    """The s with least sᵀCs / 2 + gᵀs for which x + s lies between ``low`` and ``high`` and inside the ball.

    Args:
        curvature: (p, p) positive definite. gradient, x, low, high: (p,); x inside all limits, bounds may be infinite.
        tolerance: of the step, in each parameter's own sigma.
    """
    own = np.sqrt(np.diag(curvature))
    matrix, slope = curvature / np.outer(own, own), gradient / own
    length = max(float(np.linalg.norm(slope)), 1e-12)  # of the step along the gradient, in sigma: makes it of order 1
    size, slope = own / length, slope / length

    def value(s: Array, out: Array) -> float:
        bent = matrix @ s
        if out.size:
            out[:] = bent + slope
        return float(s @ (bent / 2 + slope))

    solver = nlopt.opt(nlopt.LD_SLSQP, len(x))
    solver.set_min_objective(value)
    solver.set_lower_bounds(np.minimum((low - x) * size, 0))  # x may sit on a limit to within rounding
    solver.set_upper_bounds(np.maximum((high - x) * size, 0))
    if ball is not None:
        solver.add_inequality_constraint(_limit(ball, x, size), 1e-10)
    solver.set_xtol_abs(tolerance / length)
    solver.set_maxeval(100)
    best = np.zeros(len(x))
    with contextlib.suppress(nlopt.RoundoffLimited, RuntimeError):
        best = np.asarray(solver.optimize(best))
    return np.asarray(np.clip(x + best / size, low, high) - x)


def _limit(ball: Ball, x: Array, size: Array) -> Callable[[Array, Array], float]:
    def excess(s: Array, out: Array) -> float:
        inside = (x + s / size)[ball.index]
        if out.size:
            out[:] = 0
            out[ball.index] = 2 * inside / size[ball.index] / ball.radius**2
        return float(inside @ inside) / ball.radius**2 - 1

    return excess
