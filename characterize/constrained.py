"""One step of a fit inside its limits: the least of a quadratic between bounds and inside a ball, by NLopt's SLSQP."""

import contextlib
from collections.abc import Callable

import nlopt
import numpy as np

from characterize.leastsquares import Ball
from metalens.store import Array


def step(curvature: Array, gradient: Array, x: Array, *, low: Array, high: Array, ball: Ball | None = None) -> Array:
    """The s with least sᵀCs / 2 + gᵀs for which x + s lies between ``low`` and ``high`` and inside the ball.

    Clipping the free minimum to the bounds is not it where parameters go together: what one may not do, others do.

    Args:
        curvature: (p, p) positive definite. gradient, x, low, high: (p,); x inside all limits, bounds may be infinite.

    Accuracy:
        1e-8 of a parameter's own sigma (Kraft 1988, as NLopt has it).
    """
    size = np.sqrt(np.diag(curvature))
    matrix, slope = curvature / np.outer(size, size), gradient / size

    def value(s: Array, out: Array) -> float:
        bent = matrix @ s
        if out.size:
            out[:] = bent + slope
        return float(s @ (bent / 2 + slope))

    solver = nlopt.opt(nlopt.LD_SLSQP, len(x))
    solver.set_min_objective(value)
    solver.set_lower_bounds((low - x) * size)
    solver.set_upper_bounds((high - x) * size)
    if ball is not None:
        solver.add_inequality_constraint(_limit(ball, x, size), 1e-10)
    solver.set_xtol_abs(1e-8)
    solver.set_maxeval(400)
    best = np.zeros(len(x))
    with contextlib.suppress(nlopt.RoundoffLimited, RuntimeError):  # a step of zero is refused by the caller
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
