"""Ends of intervals: the farthest that a parameter may go while the least misfit over
all others has risen by no more.

The profile of a parameter is the least misfit over all others as it is moved; where it
rises by 3.84 lie the ends of
its 95 % interval (Wilks 1938), however the valley bends. An end is the solution of "as
far as possible with -2 ln L
below a level" (Venzon and Moolgavkar 1988): each step moves all parameters to where the
straight model about the last
place has it, for one image. So it does not depend on the way there, but for which of
several valleys it is in; whoever
asks begins from all that are known, and again from any place that turns out to lie
beyond an end.
"""

import copy
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from characterize.inference import constrained
from characterize.inference.leastsquares import FitSolution, GaussianPrior
from characterize.inference.posterior import (
    PARABOLIC,
    REACH,
    LocalMode,
    ResidualPoint,
    broyden_update,
)
from characterize.inference.search import SearchTask
from characterize.inference.walk import ProfileScan
from metalens.core import threads
from metalens.core.arrays import Array

# sigma of a last step, which is not tried: slopes that hold are right to a tenth of it
_CLOSE = 0.25
# of the way from the mode, that such a step may go: on a flat tail a quarter of a sigma
# goes far
_SHORT = 0.15
# sigma by which images may miss what slopes foretell while these hold; for shorter
# steps they must
_STRAIGHT = 0.6
_FAR = 1.25  # times the goal: a step at most
_TURNS, _MOST_TURNS = 20, 40  # where steps go to and fro, and where they still go on
_ALIKE = 0.05  # sigma within which a mode and a walk foretell the same end
# from a mode, where a walk knows another begin too: enough for one that is straight
_TRIED = 3
_HIGH = 1.0  # sigma above the goal at which a step that missed is taken back
_BELOW = 0.5  # of -2 ln L, by which a place is a better mode
_BEYOND = 0.02  # of an interval: a place that lies so far beyond its end
_UNSURE = 0.5  # of what is still to go, by a straight model that does not hold yet
_SURE, _LITTLE = (
    0.8,
    0.01,
)  # share of a way that is gone back on, and of it by which another place must be farther
_IDLE = 3  # places in a row that were not
_SHORT_OF = 0.05  # of the way, by which an end may fall short of what was foretold
_WORTH, _SPARE = (
    0.1,
    0.05,
)  # sigma by which a begin must reach beyond what is found, and must promise to on its way
POINTS = 61  # of the curve of a walk
_MODE = -1  # the first mode among stops of a walk; then -2 ...
Begin = tuple[int, Array | None, float]
"""A valley, a place in it or its own lowest, and how far the parameter is thought to reach from there."""
Wanted = tuple[int, int, Begin | None]
"""A parameter, the side (-1, 1), and from where."""


@dataclass(frozen=True, eq=False, slots=True)
class ProfileInterval:
    """One parameter: 95 % interval, and the rise of -2 ln L at ``value`` (points,) with
    the rest fitted.

    found: whether its low and its high end were; one that was not is the farthest place
    inside that was met.
    """

    low: float
    high: float
    value: Array
    rise: Array
    parabolic: bool
    found: tuple[bool, bool] = (True, True)


@dataclass(frozen=True, eq=False, slots=True)
class ConfidenceLimit:
    """Of a profile.

    place: of the parameter. seen: (value, rise) of the profile on the way. met: (places
    (p,), rise) on the way, no more
    than that of the end. lower: a place below the mode, if one was met. steps: images
    that were asked for. done: found,
    or given up, in time; else ``place`` is the farthest that was met.
    """

    place: float
    seen: list[tuple[float, float]]
    met: list[tuple[Array, float]]
    lower: Array | None = None
    steps: int = 0
    done: bool = True


def join_limits(
    sides: list[ConfidenceLimit], mode: float, sigma: float, goal: float
) -> ProfileInterval:
    """Of its two ends; ``sigma``: of the parabola at the mode."""
    low, high = (one.place for one in sides)
    points = [(mode, 0.0), *sides[0].seen, *sides[1].seen]
    if max(one.steps for one in sides) < 2:  # straight
        points = [
            (mode + s * sigma, s * s) for s in (-2.5, -1.96, -1.0, 0.0, 1.0, 1.96, 2.5)
        ]
    value, rise = np.array(sorted(points)).T
    return ProfileInterval(
        low,
        high,
        value,
        rise,
        is_parabolic(low, high, mode, goal * sigma),
        (sides[0].done, sides[1].done),
    )


def is_parabolic(low: float, high: float, middle: float, reach: float) -> bool:
    """Whether an interval is nearly that of the parabola."""
    ratio = np.array([high - middle, middle - low]) / reach
    return bool(((ratio > PARABOLIC[0]) & (ratio < PARABOLIC[1])).all())


def find_limit(
    valley: LocalMode,
    i: int,
    sign: int,
    goal: float,
    *,
    begin: Array | None = None,
    most: float = math.inf,
    beyond: float = -math.inf,
    promised: float = math.inf,
    turns: int = _MOST_TURNS,
) -> ConfidenceLimit:
    """The farthest to one side where the misfit has risen by no more than ``goal``
    squared.

    Where it is not found in time, the farthest place with less that was met.

    begin: (p,) a place near it, instead of the valley's. most: by how much the
    parameter goes in a step.
    beyond: times ``sign``, what is reached already. What promises less is given up:
    though what is still to go by the
        straight model were half as much again, or half of it where it goes back.
    promised: times ``sign``, where the end is thought to be. Where that is reached and
    steps lead no farther, as along
        a bent valley of hardly any slope, it is found. turns: at most.
    """
    here = (
        ResidualPoint(valley.mode, valley.bottom, valley.slopes)
        if begin is None
        else _there(valley, begin)
    )
    way = _Way(valley, i, sign, (goal, promised), begun=None if begin is None else here)
    far, missed, back, turn, onward = _FAR * goal, 0.0, False, 0, True
    while turn < min(turns, _MOST_TURNS if onward else _TURNS):
        turn += 1
        step, least, size = _outwards(
            here, i, sign, way.lowest + goal**2, valley.prior, (far, most)
        )
        if way.steps:
            way.seen[float(here.x[i])] = max(least - way.lowest, 0.0)
        close = size < _CLOSE and _short(
            step[i], here.x[i] + step[i] - valley.mode[i], most
        )
        held = missed <= _STRAIGHT and not (
            close and missed > 0 and here.misfit > way.lowest + (goal + _CLOSE) ** 2
        )
        again = not held and (size < _STRAIGHT or back)
        given_up = (
            not again
            and _at_most(sign * here.x[i], sign * step[i] * max(1.0, size / far))
            < beyond
        )
        if way.steps and ((held and close) or given_up):
            return way.ended(float(here.x[i] + step[i]))
        if way.settled:
            return way.ended(way.sure)
        if again:  # with slopes that hold here
            here, missed = (
                ResidualPoint(here.x, here.rest, valley.slopes_at(here.x, here.rest)),
                0.0,
            )
            continue
        there, off = _moved(valley, here, step)
        way.steps, rise = way.steps + 1, way.saw(there)
        if rise < -_BELOW:
            return ConfidenceLimit(
                float(there.x[i]),
                [(float(there.x[i]), 0.0)],
                way.met,
                there.x,
                way.steps,
                done=False,
            )
        back = rise > (goal + _HIGH) ** 2 and (
            off > size / 2 or there.misfit > here.misfit > way.lowest + goal**2
        )
        onward = sign * step[i] > 0 and not back
        here, missed = (here, missed) if back else (there, missed + off)
        far = min(size, far) / 2 if back else min(_FAR * goal, 2 * far)
    return way.ended(None)


class _Way:
    """What was met on the way to an end: places inside, their misfit, and how far the
    parameter goes for sure.

    That is where the misfit is as high as allowed on the straight way from the mode to
    a place: it rises as a square.

    wanted: goal, and where the end is thought to be. begun: where it was begun, if not
    at the mode.
    """

    def __init__(
        self,
        valley: LocalMode,
        i: int,
        sign: int,
        wanted: tuple[float, float],
        begun: ResidualPoint | None,
    ) -> None:
        self._valley, self._i, self._sign, self._level, self._promised = (
            valley,
            i,
            sign,
            wanted[0] ** 2,
            wanted[1],
        )
        self.lowest, self.steps, self._far, self._idle = (
            valley.least - valley.above,
            0,
            -math.inf,
            0,
        )
        self.seen, self.met = dict[float, float](), list[tuple[Array, float]]()
        if begun is not None:
            self.saw(begun)

    def saw(self, there: ResidualPoint) -> float:
        """Take note of a place; its rise."""
        middle, rise = float(self._valley.mode[self._i]), there.misfit - self.lowest
        if rise < self._level:
            self.met.append((there.x, rise))
        above, way = self._valley.above, float(there.x[self._i]) - middle
        share = (
            1.0
            if rise <= self._level
            else math.sqrt(max(self._level - above, 0.0) / (rise - above))
        )
        far = self._sign * (middle + share * way) if share > _SURE else -math.inf
        farther = far > self._far + _LITTLE * abs(way)
        self._far, self._idle = max(far, self._far), 0 if farther else self._idle + 1
        return rise

    @property
    def sure(self) -> float:
        """Place that the parameter reaches."""
        return self._sign * self._far

    @property
    def settled(self) -> bool:
        """Whether it is where it was thought to be, and the last places were no
        farther.
        """
        way = self._promised - self._sign * float(self._valley.mode[self._i])
        return self._idle >= _IDLE and self._far > self._promised - _SHORT_OF * way

    def ended(self, place: float | None) -> ConfidenceLimit:
        """At a place within the bounds; without one, at the farthest inside that was
        met.
        """
        i, prior = self._i, self._valley.prior
        places = [float(self._valley.mode[i]), *(float(x[i]) for x, _ in self.met)]
        at = max(places, key=lambda x: self._sign * x) if place is None else place
        at = float(np.clip(at, prior.low[i], prior.high[i]))
        return ConfidenceLimit(
            at,
            list(self.seen.items())[-3:],
            self.met,
            None,
            self.steps,
            place is not None,
        )


def _short(step: float, way: float, most: float) -> bool:
    """Whether a last step of a parameter is, beside its way from the mode, and no more
    was asked for.
    """
    return abs(step) <= min(_SHORT * abs(way), 0.999 * most)


def _at_most(place: float, way: float) -> float:
    """Where an end may lie that is still to go a way by slopes that do not hold yet."""
    return place + max((1 - _UNSURE) * way, (1 + _UNSURE) * way)


def _moved(
    valley: LocalMode, here: ResidualPoint, step: Array
) -> tuple[ResidualPoint, float]:
    """After a step, slopes changed by the least that explains it (Broyden 1965), and by
    how many sigma it missed.
    """
    after = valley.residual(here.x + step)
    missed = after - here.rest - here.slopes @ step
    return ResidualPoint(
        here.x + step, after, broyden_update(here.slopes, step, missed)
    ), float(np.linalg.norm(missed))


def _there(valley: LocalMode, x: Array) -> ResidualPoint:
    rest = valley.residual(x)
    return ResidualPoint(x, rest, valley.slopes_at(x, rest))


def _outwards(
    here: ResidualPoint,
    i: int,
    sign: int,
    allowed: float,
    prior: GaussianPrior,
    limits: tuple[float, float],
) -> tuple[Array, float, float]:
    """By the straight model about a spot: ((p,) step to the farthest place whose misfit
    is ``allowed``, the least
    misfit with the parameter where it is, size of the step in sigma of the images).

    Where it is allowed nowhere: to the least. limits: size of the step, and by how much
    the parameter goes, at most.
    What would leave its bounds stays on them.
    """
    curvature, gradient = here.slopes.T @ here.slopes, here.slopes.T @ here.rest
    about = constrained.ProfiledQuadratic(
        curvature, gradient, i, low=prior.low - here.x, high=prior.high - here.x
    )
    rest = about.others(0.0)
    least, tried, step = here.misfit + about.change(rest), set[bytes](), rest
    held = np.zeros(len(rest), bool)
    while (
        held.tobytes() not in tried
    ):  # from piece to piece of the profile, each with others held on their bounds
        tried.add(held.tobytes())
        way = about.way(sign, allowed - here.misfit, step, held)
        step = about.others(float(np.clip(way, -limits[1], limits[1])))
        held = about.held(step)
    size = math.sqrt(max(float(step @ curvature @ step), 0.0))
    return (step * (limits[0] / size) if size > limits[0] else step), least, size


def valley_of(task: SearchTask, at: FitSolution, rise: float) -> LocalMode:
    """The misfit about a fit that is ``rise`` of -2 ln L above the best one."""
    return LocalMode(
        task.problem(),
        task.data,
        at.value,
        task.prior,
        known=(at.image, at.slopes),
        above=rise,
    )


class LimitSearch:
    """Ends of all parameters over all valleys that are known; ``valleys``: of the
    modes, the best first.
    """

    def __init__(
        self,
        task: SearchTask,
        mode: FitSolution,
        by: ProfileScan | None,
        valleys: Sequence[LocalMode],
    ) -> None:
        self._task, self._mode, self._by = task, mode, by
        self._valleys = {_MODE - k: one for k, one in enumerate(valleys)}
        self._level = REACH**2 * max(1.0, mode.chi2_per_dof)
        self._found: dict[tuple[int, int], ConfidenceLimit] = {}
        self._tried: dict[tuple[int, int], float] = {}
        stops = enumerate(zip(by.value, by.rise, strict=True)) if by else ()
        self._met: list[tuple[int, Array | None, Array]] = [
            (k, None, x) for k, (x, r) in stops if r < self._level
        ]

    def ends(self, wanted: Sequence[Wanted]) -> list[Array]:
        """Look for some side by side, and keep them and the slopes that they met; gives
        places below the mode.
        """
        asked = [
            (i, sign, [begin] if begin else self._begins(i, sign))
            for i, sign, begin in wanted
        ]
        for k in sorted(
            {k for *_, begins in asked for k, *_ in begins} - self._valleys.keys()
        ):
            if self._by is not None:  # the others are modes, known from the beginning
                self._valleys[k] = valley_of(
                    self._task, self._by.stops[k], float(self._by.rise[k])
                )
        own = [
            {k: copy.copy(self._valleys[k]) for k, *_ in begins} for *_, begins in asked
        ]
        ends = threads.run_each(self._farthest, list(zip(asked, own, strict=True)))
        for k, shared in self._valleys.items():
            known = len(shared.met)
            shared.met += tuple(
                itertools.chain.from_iterable(
                    one[k].met[known:] for one in own if k in one
                )
            )
        for (i, sign, _), some in zip(asked, ends, strict=True):
            before = [self._found[i, sign]] if (i, sign) in self._found else []
            self._found[i, sign] = max(
                [*before, *(one for _, one in some)], key=lambda one: sign * one.place
            )
            self._met += [(k, x, x) for k, one in some for x, _ in one.met]
        return [one.lower for some in ends for _, one in some if one.lower is not None]

    def beyond(self) -> list[Wanted]:
        """Ends that a place with less misfit lies beyond, or that were not found in
        time, with the farthest such place;
        each is tried once."""
        out: list[Wanted] = []
        for (i, sign), one in self._found.items():
            if not self._met:
                break
            k, begin, x = max(self._met, key=lambda place: sign * place[2][i])
            room = _BEYOND * abs(self._found[i, 1].place - self._found[i, -1].place)
            tried = self._tried.get((i, sign), -math.inf)
            least = (
                max(sign * one.place, tried) + room
                if one.done
                else max(sign * one.place - room, tried + room)
            )
            if sign * x[i] > least:
                self._tried[i, sign] = sign * float(x[i])
                out.append((i, sign, (k, begin, sign * float(x[i]))))
        return out

    def profile(self, i: int) -> ProfileInterval:
        """Of a parameter; of the walk between its ends, where there is one."""
        sides, sigma = (
            [self._found[i, sign] for sign in (-1, 1)],
            float(self._valleys[_MODE].sigma[i]),
        )
        middle = float(self._mode.value[i])
        if self._by is None:
            return join_limits(sides, middle, sigma, math.sqrt(self._level))
        low, high = (one.place for one in sides)
        inner = np.column_stack(self._by.profile_of(i, np.linspace(-1, 1, POINTS)))
        near = self._by.value[
            self._by.rise < self._level, i
        ]  # beyond its stops a walk knows the others' parabola only
        seen = [np.array(one.seen) for one in sides]
        least, most = (
            max(seen[0][:, 0].max(), near.min()),
            min(seen[1][:, 0].min(), near.max()),
        )
        inner = inner[(inner[:, 0] >= least) & (inner[:, 0] <= most)]
        value, rise = np.array(sorted(np.concatenate([*seen, inner]).tolist())).T
        parabolic = is_parabolic(low, high, middle, math.sqrt(self._level) * sigma)
        return ProfileInterval(
            low, high, value, rise, parabolic, (sides[0].done, sides[1].done)
        )

    def _begins(self, i: int, sign: int) -> list[Begin]:
        """Modes, the farthest first; or, of a walk that passes them all, the places on
        it from where a parameter goes
        farthest, after a mode that foretells as much: where the valley is straight it
        takes fewer images.

        Modes without a walk as far as they may reach and still be called a parabola:
        what ends nearer hides no other.
        """
        wide, out = PARABOLIC[1] if self._by is None else 1.0, list[Begin]()
        for k, one in self._valleys.items():
            room = self._level - one.above
            if k <= _MODE and room > 0:
                out.append(
                    (
                        k,
                        None,
                        sign * float(one.mode[i])
                        + wide * math.sqrt(room) * float(one.sigma[i]),
                    )
                )
        if self._by is None:
            return sorted(out, key=lambda begin: -begin[2])
        along = [
            (k, x, sign * float(x[i]))
            for k, x in self._by.outermost(i, sign, self._level)
        ]
        near = _ALIKE * float(self._valleys[_MODE].sigma[i])
        return [one for one in out if abs(one[2] - along[0][2]) < near][:1] + along

    def _farthest(
        self, asked: tuple[tuple[int, int, list[Begin]], dict[int, LocalMode]]
    ) -> list[tuple[int, ConfidenceLimit]]:
        """Ends from all begins that reach beyond those found."""
        (i, sign, begins), valleys = asked
        goal, far, sure, out = math.sqrt(self._level), -math.inf, True, []
        sigma = float(self._valleys[_MODE].sigma[i])
        about: dict[str, Any] = {"most": 2 * goal * sigma}
        for k, begin, reach in begins:
            if reach > far + _WORTH * sigma or not sure:
                about |= {
                    "turns": _TRIED
                    if self._by is not None and begin is None
                    else _MOST_TURNS
                }
                about |= {
                    "begin": begin,
                    "beyond": far + _SPARE * sigma,
                    "promised": reach,
                }
                out.append((k, find_limit(valleys[k], i, sign, goal, **about)))
                far, sure = (
                    max(far, sign * out[-1][1].place),
                    any(one.done for _, one in out),
                )
        return out
