"""The least of a quadratic inside limits: between bounds by BVLS (SciPy), inside a ball by SLSQP (NLopt); one led."""

import contextlib
import math
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

    def share(self, x: Array, step: Array) -> float:
        """Of a step from x, inside, to where the limit no longer holds: the larger t with |x + t step| = radius."""
        at, way = x[self.index], step[self.index]
        along, long = float(at @ way), float(way @ way)
        room = max(self.radius**2 - float(at @ at), 0.0)
        return (math.sqrt(along**2 + long * room) - along) / long


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


class Led:
    """The quadratic sᵀCs + 2 gᵀs, one of s led and the others at their least between bounds (p,)."""

    def __init__(self, curvature: Array, gradient: Array, i: int, *, low: Array, high: Array) -> None:
        self.curvature, self._gradient, self._i = curvature, gradient, i
        self._low, self._high = low, high
        self._rest = np.flatnonzero(np.arange(len(gradient)) != i)
        self._free = self._solved(self._rest, self._gradient)

    def _solved(self, free: Array, pull: Array) -> Array:
        """(free, 2) how these go with what is led, and against their pull."""
        inner = self.curvature[np.ix_(free, free)]
        both = np.stack([self.curvature[free, self._i], pull[free]], 1)
        return np.asarray(np.linalg.lstsq(inner, both, rcond=1e-14)[0])

    def change(self, step: Array) -> float:
        """Of the quadratic by a step."""
        return float(step @ (2 * self._gradient + self.curvature @ step))

    def held(self, step: Array) -> Array:
        """(p,) whether a step of the others ends on a bound."""
        on = (step == self._low) | (step == self._high)
        on[self._i] = False
        return np.asarray(on)

    def others(self, way: float) -> Array:
        """(p,) step of all with one led to ``way``, or as far as its bounds let it."""
        i, rest = self._i, self._rest
        step = np.zeros(len(self._low))
        step[i] = np.clip(way, self._low[i], self._high[i])
        step[rest] = -self._free[:, 1] - self._free[:, 0] * step[i]
        if ((step < self._low) | (step > self._high))[rest].any():
            pull = self._gradient + self.curvature[:, i] * step[i]
            inner = self.curvature[np.ix_(rest, rest)]
            step[rest] = between(inner, pull[rest], self._low[rest], self._high[rest])
        return step

    def way(self, sign: int, room: float, step: Array, held: Array) -> float:
        """How far the one led goes until the quadratic has changed by ``room``, the ``held`` of a step kept there.

        Where it is more everywhere, to the least.
        """
        i, still = self._i, np.where(held, step, 0.0)
        free = self._rest[~held[self._rest]]
        pull = self._gradient + self.curvature @ still
        answers = self._solved(free, pull)
        bend = float(self.curvature[i, i] - self.curvature[free, i] @ answers[:, 0])
        slope = float(pull[i] - self.curvature[free, i] @ answers[:, 1])
        least = self.change(still) - float(pull[free] @ answers[:, 1])
        root = math.sqrt(max(slope**2 - bend * (least - room), 0.0))
        return (sign * root - slope) / max(bend, 1e-300)


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
