"""The least of a quadratic inside limits: between bounds by active sets, inside a ball
by SLSQP (NLopt); one led.
"""

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass

import nlopt
import numpy as np

from metalens.core.arrays import Array

_KNOWN, _PLAIN = (
    1e-14,
    1e-12,
)  # of the largest eigenvalue: what is known, and where elimination solves as it stands
_ROUNDING = 2 * float(np.finfo(float).eps)  # of each term of a sum
# of each parameter: each is lower than the last, so that no active set comes back but
# by rounding
_RELEASES = 3


@dataclass(frozen=True, eq=False, slots=True)
class BallConstraint:
    """Limit of the root sum of squares of some parameters: ``index`` of them,
    ``radius`` in their unit.
    """

    index: Array
    radius: float

    def inside(self, x: Array) -> bool:
        """Whether the limit holds."""
        return float(np.linalg.norm(x[self.index])) <= self.radius * (1 + 1e-9)

    def share(self, x: Array, step: Array) -> float:
        """Of a step from x, inside, to where the limit no longer holds: the larger t
        with |x + t step| = radius.
        """
        at, way = x[self.index], step[self.index]
        along, long = float(at @ way), float(way @ way)
        room = max(self.radius**2 - float(at @ at), 0.0)
        return (math.sqrt(along**2 + long * room) - along) / long


def bounded_quadratic_step(
    curvature: Array, gradient: Array, low: Array, high: Array
) -> Array:
    """The s with least sᵀCs / 2 + gᵀs between ``low`` and ``high``, exactly on those
    that stop it.

    By active sets (Lawson and Hanson 1974, ch. 23; both sides: Stark and Parker 1995):
    the least over what is free,
    until no held one is drawn inside, to rounding.

    Clipping the free minimum to the bounds is not it where parameters go together: what
    one may not do, others do. Nor
    is what stays when all that the free minimum violates are held at once: some of them
    leave for others alone.

    Args:
        curvature: (p, p) positive; combinations that it knows to less than 1e-14 of the
            rest do not move.
        gradient, low, high: (p,); bounds may be infinite, and touch.
    """
    own = np.sqrt(np.maximum(np.diag(curvature), 1e-300))
    equal, slope = curvature / np.outer(own, own), gradient / own
    values, vectors = np.linalg.eigh(equal)
    unknown = vectors[:, values <= _KNOWN * values[-1]]
    plain = values[0] > _PLAIN * values[-1]
    x = _Bounded(
        equal, slope - unknown @ (unknown.T @ slope), low * own, high * own, plain
    ).least()
    return np.where(
        x == low * own,
        low,
        np.where(x == high * own, high, np.clip(x / own, low, high)),
    )


class _Bounded:
    """The least xᵀKx / 2 + qᵀx between bounds, K of unit diagonal: where x (p,) is, and
    which of it are free.
    """

    def __init__(
        self, curvature: Array, gradient: Array, low: Array, high: Array, plain: bool
    ) -> None:
        self._curvature, self._gradient, self._low, self._high, self._plain = (
            curvature,
            gradient,
            low,
            high,
            plain,
        )
        self._x, self._free = np.clip(np.zeros(len(low)), low, high), high > low

    def least(self) -> Array:
        """Begun with all held that would leave; one at a time is released, the one that
        is drawn inside the most.
        """
        leave = self._free
        while leave.any():
            goal = self._x + self._move()
            leave = self._free & ((goal < self._low) | (goal > self._high))
            self._x, self._free = (
                np.clip(goal, self._low, self._high),
                self._free & ~leave,
            )
        tried, settled = np.zeros(len(self._x), bool), False
        for _ in range(_RELEASES * len(tried)):
            inward = np.where(tried, 0, self._inward())
            i = int(np.argmax(inward))
            release = inward[i] > 0
            if settled and not release:
                break
            before, pull, settled = (
                self._x,
                self._pull(),
                not release,
            )  # once more: the rounding of a long way
            self._free[i] |= release
            self._settle()
            way = self._x - before
            lower = way @ (pull - self._curvature @ way / 2) > 0
            tried &= not lower
            tried[i] |= release and not lower
        return self._x

    def _pull(self) -> Array:
        return np.asarray(-self._gradient - self._curvature @ self._x)

    def _inward(self) -> Array:
        """(p,) pull towards the inside, beyond its rounding, of those on one of their
        two bounds.
        """
        held, terms = (
            ~self._free & (self._high > self._low),
            np.abs(self._curvature) @ np.abs(self._x),
        )
        rounding = (np.abs(self._gradient) + terms) * _ROUNDING * len(terms)
        return np.where(
            held, np.where(self._x == self._low, 1, -1) * self._pull() - rounding, 0
        )

    def _move(self) -> Array:
        """(p,) to the least over what is free, with no regard to bounds."""
        move, free = np.zeros(len(self._x)), self._free
        inner, pull = self._curvature[np.ix_(free, free)], self._pull()[free]
        move[free] = (
            np.linalg.solve(inner, pull)
            if self._plain
            else np.linalg.lstsq(inner, pull, rcond=_KNOWN)[0]
        )
        return move

    def _settle(self) -> None:
        """To the least over what is free; what meets a bound on the way is held there."""
        while self._free.any():
            move = self._move()
            room = np.where(move > 0, self._high, self._low) - self._x
            share = np.divide(
                room, move, out=np.full(len(move), np.inf), where=move != 0
            )
            first = int(np.argmin(share))
            self._x = np.clip(
                self._x + min(share[first], 1.0) * move, self._low, self._high
            )
            if share[first] >= 1:
                return
            self._x[first] = (self._high if move[first] > 0 else self._low)[first]
            self._free[first] = False


class ProfiledQuadratic:
    """The quadratic sᵀCs + 2 gᵀs, one of s led and the others at their least between
    bounds (p,).
    """

    def __init__(
        self, curvature: Array, gradient: Array, i: int, *, low: Array, high: Array
    ) -> None:
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
            step[rest] = bounded_quadratic_step(
                inner, pull[rest], self._low[rest], self._high[rest]
            )
        return step

    def way(self, sign: int, room: float, step: Array, held: Array) -> float:
        """How far the one led goes until the quadratic has changed by ``room``, the
        ``held`` of a step kept there.

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


def constrained_step(
    curvature: Array,
    gradient: Array,
    x: Array,
    *,
    low: Array,
    high: Array,
    ball: BallConstraint | None = None,
    tolerance: float = 1e-3,
) -> Array:
    """The s with least sᵀCs / 2 + gᵀs for which x + s lies between ``low`` and ``high``
    and inside the ball.

    Args:
        curvature: (p, p) positive definite. gradient, x, low, high: (p,); x inside all
            limits, bounds may be infinite.
        tolerance: of the step, in each parameter's own sigma.
    """
    own = np.sqrt(np.diag(curvature))
    matrix, slope = curvature / np.outer(own, own), gradient / own
    length = max(
        float(np.linalg.norm(slope)), 1e-12
    )  # of the step along the gradient, in sigma: makes it of order 1
    size, slope = own / length, slope / length

    def value(s: Array, out: Array) -> float:
        bent = matrix @ s
        if out.size:
            out[:] = bent + slope
        return float(s @ (bent / 2 + slope))

    solver = nlopt.opt(nlopt.LD_SLSQP, len(x))
    solver.set_min_objective(value)
    solver.set_lower_bounds(
        np.minimum((low - x) * size, 0)
    )  # x may sit on a limit to within rounding
    solver.set_upper_bounds(np.maximum((high - x) * size, 0))
    if ball is not None:
        solver.add_inequality_constraint(_limit(ball, x, size), 1e-10)
    solver.set_xtol_abs(tolerance / length)
    solver.set_maxeval(100)
    best = np.zeros(len(x))
    with contextlib.suppress(nlopt.RoundoffLimited, RuntimeError):
        best = np.asarray(solver.optimize(best))
    return np.asarray(np.clip(x + best / size, low, high) - x)


def _limit(
    ball: BallConstraint, x: Array, size: Array
) -> Callable[[Array, Array], float]:
    def excess(s: Array, out: Array) -> float:
        inside = (x + s / size)[ball.index]
        if out.size:
            out[:] = 0
            out[ball.index] = 2 * inside / size[ball.index] / ball.radius**2
        return float(inside @ inside) / ball.radius**2 - 1

    return excess
