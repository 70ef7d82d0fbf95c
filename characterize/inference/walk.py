"""One parameter over its whole prior, all others fitted at every place: valleys that no
start led to, bent ones whole.

The least misfit along such a walk is a profile however its valley bends. Times the
volume of the others' parabola at
each place it is the marginal posterior of what is walked (Laplace; Tierney and Kadane
1986), and with the others
Gaussian about their own place it is drawn from, two valleys or more as they come.
"""

import dataclasses
import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import interpolate

from characterize.inference import leastsquares
from characterize.inference.arrange import few_frames
from characterize.inference.leastsquares import (
    FitImages,
    FitSolution,
    GaussianPrior,
    Model,
    SolverSettings,
)
from characterize.inference.search import SearchTask, distinct_modes, follow_starts
from metalens.core import threads
from metalens.core.arrays import Array

WALKED = ("bias_nm",)
REACH = 2.5  # prior sigma to either side of what is thought
# rise of -2 ln L up to which a walk is a profile, a probability of 1e-3; beyond it, it
# looks for valleys
SHOWN = 14.0
_WIDEST = 0.35  # of the prior sigma: a step at most
_VALLEYS, _AGAIN, _BRANCHES = 3, 3, 2
_NEAR = SolverSettings(
    iterations=6, step_tolerance=0.3, secant=True, near=math.inf, miss=0.5, finish=False
)
_FAR = SolverSettings(
    iterations=5, step_tolerance=1.0, secant=True, near=math.inf, miss=0.7, finish=False
)
_FINE, _COARSE, _ON_IT = 1201, 101, 3.0
_HUBER = SolverSettings().huber
Part = tuple[Model, FitImages]


@dataclass(frozen=True, eq=False, slots=True)
class ProfileScan:
    """Where the others go as one parameter is walked.

    index: of the parameter. value: (k, p) all parameters, the walked one's rising.
    rise: (k,) of -2 ln L above the best.
    spread: (k, p, p) covariance of the others with this one held; 0 in its row and
    column.
    shown: rise up to which it is a profile. stops: (k) fits there.
    """

    index: int
    value: Array
    rise: Array
    spread: Array
    shown: float = SHOWN
    stops: tuple[FitSolution, ...] = ()

    @classmethod
    def of(
        cls,
        task: SearchTask,
        stops: Sequence[FitSolution],
        index: int,
        *,
        least: float = 0.0,
        shown: float = SHOWN,
    ) -> "ProfileScan":
        """By its stops, in any order; of two at one place the lower. Their merits are
        those of :func:`_measured`.
        """
        order: list[FitSolution] = []
        for one in sorted(stops, key=lambda s: (s.value[index], s.merit)):
            if not order or one.value[index] > order[-1].value[index]:
                order.append(one)
        value, rise = (
            np.array([one.value for one in order]),
            np.array([one.merit for one in order]) - least,
        )
        return cls(
            index,
            value,
            rise,
            np.array([_held(task, one, index) for one in order]),
            shown,
            tuple(order),
        )

    def minima(self) -> list[int]:
        """Places lower than their neighbours, the lowest first."""
        wall = np.concatenate([[math.inf], self.rise, [math.inf]])
        low = np.flatnonzero((wall[1:-1] <= wall[:-2]) & (wall[1:-1] <= wall[2:]))
        return [int(k) for k in low[np.argsort(self.rise[low])]]

    def profile(self) -> tuple[Array, Array]:
        """(m,) values of the walked parameter and (m,) rise, where it is below
        ``shown``.
        """
        at, rise, *_ = self._between()
        keep = rise < self.shown
        return at[keep], rise[keep]

    def profile_of(self, i: int, share: Array) -> tuple[Array, Array]:
        """(m,) values of another parameter and (m,) rise, the others straight about the
        walk.

        share: of the way from the lowest place to where it has risen by ``shown``, -1
            to 1.
        """
        _, rise, value, spread = self._between()
        size, middle = (
            np.sqrt(np.maximum(spread[:, i, i], 1e-300)),
            float(value[np.argmin(rise), i]),
        )
        low, high = (float(end[i]) for end in self.interval(self.shown))
        at = middle + np.where(
            share < 0, share * (middle - low), share * (high - middle)
        )
        return at, np.asarray((rise + ((at[:, None] - value[:, i]) / size) ** 2).min(1))

    def interval(self, level: float) -> tuple[Array, Array]:
        """(p,) lowest and highest values at which -2 ln L has risen by ``level`` or
        less.
        """
        _, rise, value, spread = self._between()
        room = np.sqrt(np.maximum(level - rise, 0))[:, None] * np.sqrt(
            np.einsum("mii->mi", spread)
        )
        inside = rise <= level
        if not inside.any():
            nearest = value[np.argmin(rise)]
            return nearest, nearest
        return (value - room)[inside].min(0), (value + room)[inside].max(0)

    def outermost(self, i: int, sign: int, level: float) -> list[tuple[int, Array]]:
        """From where another parameter goes farthest to one side with a rise of
        ``level``: (nearest stop, (p,) place).

        One or two places, each farther than its neighbours, farthest first. Where the
        other is hardly held, as between
        valleys, it is followed as far as usually.
        """
        _, rise, value, spread = self._between(_COARSE)
        inside, size = rise < level, np.sqrt(spread[:, i, i])
        step = np.sqrt(np.maximum(level - rise, 0.0)) * np.minimum(
            size, 2 * np.median(size[inside])
        )
        far = np.concatenate(
            [
                [-math.inf],
                np.where(inside, sign * value[:, i] + step, -math.inf),
                [-math.inf],
            ]
        )
        peaks = np.flatnonzero((far[1:-1] > far[:-2]) & (far[1:-1] >= far[2:]))
        best = peaks[np.argsort(-far[1:-1][peaks])][:_BRANCHES]
        along = spread[:, :, i] / np.maximum(size**2, 1e-300)[:, None]
        nearest = np.abs(self.value[:, self.index] - value[:, self.index, None]).argmin(
            1
        )
        return [(int(nearest[k]), value[k] + sign * step[k] * along[k]) for k in best]

    def draws(self, count: int, *, widened: float, rng: np.random.Generator) -> Array:
        """(count, p) of the posterior along the walk; ``widened``: factor of all
        variances.
        """
        at, rise, value, spread = self._between()
        density = np.exp(-rise / (2 * widened) + _half_volume(spread, self.index))
        mass = np.concatenate(
            [[0.0], np.cumsum((density[1:] + density[:-1]) / 2 * np.diff(at))]
        )
        place = np.interp(
            (rng.permutation(count) + rng.random(count)) / count * mass[-1],
            mass,
            np.arange(len(at)),
        )
        k = place.astype(int).clip(0, len(at) - 2)
        value = value[k] + (place - k)[:, None] * (value[k + 1] - value[k])
        size, vectors = np.linalg.eigh(spread[np.rint(place).astype(int)])
        normal = rng.standard_normal(size.shape) * np.sqrt(
            np.maximum(size, 0) * widened
        )
        return np.asarray(value + np.einsum("mij,mj->mi", vectors, normal))

    def log_mass(self) -> float:
        """Of the posterior along the walk: log of the integral of exp(-rise / 2) times
        the others' volume.
        """
        at, rise, _, spread = self._between()
        log = -rise / 2 + _half_volume(spread, self.index)
        return float(log.max() + np.log(np.trapezoid(np.exp(log - log.max()), at)))

    def passes(self, value: Array) -> bool:
        """Whether (p,) values lie within three sigma of the walk."""
        at, there = self.value[:, self.index], float(value[self.index])
        if not at[0] <= there <= at[-1]:
            return False
        middle, spread = (
            interpolate.interp1d(at, part, axis=0)(there)
            for part in (self.value, self.spread)
        )
        others = np.flatnonzero(np.arange(len(value)) != self.index)
        away = (value - middle)[others]
        return bool(
            away
            @ leastsquares.invert_information(spread[np.ix_(others, others)])
            @ away
            < _ON_IT**2
        )

    def _between(self, count: int | None = None) -> tuple[Array, Array, Array, Array]:
        """Finely: values walked (m,), rise (m,), all parameters (m, p), covariance of
        the others (m, p, p).

        The rise by a cubic that keeps between its points, the others linearly.
        """
        at = self.value[:, self.index]
        some = slice(None)
        close = np.flatnonzero(self.rise < self.shown)
        if len(close):
            some = slice(max(int(close[0]) - 1, 0), int(close[-1]) + 2)
        at, known = at[some], self.rise[some]
        fine = np.union1d(np.linspace(at[0], at[-1], count or _FINE), at)
        rise = np.maximum(interpolate.PchipInterpolator(at, known)(fine), 0.0)
        value, spread = (
            interpolate.interp1d(at, part[some], axis=0)(fine)
            for part in (self.value, self.spread)
        )
        value[:, self.index] = fine
        return fine, rise, value, spread


def _half_volume(spread: Array, index: int) -> Array:
    """(m,) half the log determinant of the others' covariance."""
    others = np.flatnonzero(np.arange(spread.shape[1]) != index)
    return np.asarray(np.linalg.slogdet(spread[:, others[:, None], others])[1] / 2)


def find_modes(
    task: SearchTask, modes: Sequence[FitSolution], name: str
) -> list[FitSolution]:
    """The modes with those that a walk over the prior of one parameter leads to, best
    first.

    On a few frames, which show where the misfit falls again; from there with all free,
    on all frames. Again from a
    new best.
    """
    i, kept = task.names.index(name), list(modes)
    for _ in range(_AGAIN):
        best, few = kept[0], few_frames(task.model.setting)
        part, step = (
            (task.problem(few), task.data.planes(few)),
            _WIDEST * _wide(task, best, i),
        )
        here = dataclasses.replace(best, merit=_misfit(task, part, best.value))
        here = dataclasses.replace(
            here, image=best.image[few], slopes=best.slopes[:, few]
        )
        side = functools.partial(_side, task, part, here, i, step=step, settings=_FAR)
        sides = threads.run_each(side, _ends(task, best, i))
        seen = ProfileScan.of(task, [*sides[0], *sides[1], here], i)
        begins = [
            seen.value[k] for k in seen.minima() if seen.value[k, i] != best.value[i]
        ]
        kept = distinct_modes([*kept, *follow_starts(task, best, begins[:_VALLEYS])])
        if kept[0].merit > best.merit - 1:
            break
    return kept


def scan_profile(
    task: SearchTask, modes: Sequence[FitSolution], name: str, *, widened: float = 1.0
) -> ProfileScan:
    """Through the valleys of the modes, on all frames, as far as they are no higher
    than ``SHOWN`` above the best.

    Times ``widened``, the factor of all variances: a wider posterior reaches that much
    higher.
    """
    i, part = task.names.index(name), (task.problem(), task.data)
    lows = [
        dataclasses.replace(one, merit=_measured(task, task.data, one.value, one.image))
        for one in modes
    ]
    sigma = max(float(np.sqrt(one.covariance[i, i])) for one in modes)
    step, shown = min(sigma, _WIDEST * _wide(task, lows[0], i)), SHOWN * widened
    stops: list[FitSolution] = []
    for mode in lows:
        low, high = _ends(task, mode, i)
        if stops and ProfileScan.of(task, stops, i).passes(
            mode.value
        ):  # as finely about this one as about the first
            low, high = (
                max(low, mode.value[i] - 2 * step),
                min(high, mode.value[i] + 2 * step),
            )
        stops.append(mode)
        most = lows[0].merit + shown
        side = functools.partial(
            _side, task, part, mode, i, step=step, settings=_NEAR, most=most
        )
        stops += itertools.chain.from_iterable(threads.run_each(side, (low, high)))
    return ProfileScan.of(task, stops, i, least=lows[0].merit, shown=shown)


def _wide(task: SearchTask, mode: FitSolution, i: int) -> float:
    """Sigma of the prior, or what stands for it where there is none."""
    known = float(task.prior.sigma[i])
    return (
        known
        if np.isfinite(known)
        else 8 / REACH * float(np.sqrt(mode.covariance[i, i]))
    )


def _ends(task: SearchTask, mode: FitSolution, i: int) -> tuple[float, float]:
    """What the prior leaves possible, and the mode."""
    prior, here = task.prior, float(mode.value[i])
    middle = float(prior.mean[i]) if np.isfinite(prior.sigma[i]) else here
    reach = REACH * _wide(task, mode, i)
    return min(max(middle - reach, prior.low[i]), here), max(
        min(middle + reach, prior.high[i]), here
    )


def _side(
    task: SearchTask,
    part: Part,
    mode: FitSolution,
    i: int,
    end: float,
    *,
    step: float,
    settings: SolverSettings,
    most: float = math.inf,
) -> list[FitSolution]:
    """Stops from the mode to one end, or to the first that is higher than ``most``.

    Two steps at a time with a Jacobian, then the stop that was left out, with the mean
    of both of its neighbours'.
    """
    count = int(np.ceil(abs(end - mode.value[i]) / step - 1e-3))
    goals = np.linspace(mode.value[i], end, count + 1)[1:].tolist()
    here, out = mode, []
    for k in range(0, count, 2):
        there = _stop(task, part, here, i, goals[min(k + 1, count - 1)], settings)
        if k + 1 < count:
            out.append(_amid(task, part, (here, there), i, goals[k], settings))
        out.append(there)
        here = there
        if here.merit > most:
            break
    return out


def _stop(
    task: SearchTask,
    part: Part,
    here: FitSolution,
    i: int,
    goal: float,
    settings: SolverSettings,
) -> FitSolution:
    """The others fitted with one parameter at ``goal``, from where they are or where
    the parabola sends them.

    From there, unless they are thought to do better where they are; then from where
    they really do.
    """
    known = _holding(task.prior, i, goal)
    way = here.covariance[:, i] / here.covariance[i, i] * (goal - here.value[i])
    alone, along = (
        np.clip(x, known.low, known.high) for x in (here.value, here.value + way)
    )
    straight = here.image + np.tensordot(alone - here.value, here.slopes, 1)
    least = _misfit(task, part, along)
    far = (
        least > _measured(task, part[1], alone, straight)
        and _misfit(task, part, alone) < least
    )
    return _fitted(task, part, alone if far else along, known, settings)


def _amid(
    task: SearchTask,
    part: Part,
    ends: tuple[FitSolution, FitSolution],
    i: int,
    goal: float,
    settings: SolverSettings,
) -> FitSolution:
    """As :func:`_stop`, between two stops, from the straight line between them and with
    slopes in proportion.
    """
    share = (goal - ends[0].value[i]) / (ends[1].value[i] - ends[0].value[i])
    known = _holding(task.prior, i, goal)
    begin = ends[0].value + share * (ends[1].value - ends[0].value)
    slopes = ends[0].slopes + share * (ends[1].slopes - ends[0].slopes)
    return _fitted(
        task, part, np.clip(begin, known.low, known.high), known, settings, slopes
    )


def _holding(prior: GaussianPrior, i: int, goal: float) -> GaussianPrior:
    """A prior that leaves one parameter at ``goal``."""
    low, high = prior.low.copy(), prior.high.copy()
    low[i] = high[i] = goal
    return dataclasses.replace(prior, low=low, high=high)


def _fitted(
    task: SearchTask,
    part: Part,
    begin: Array,
    known: GaussianPrior,
    settings: SolverSettings,
    slopes: Array | None = None,
) -> FitSolution:
    found = leastsquares.fit_levenberg_marquardt(
        *part, begin, prior=known, settings=settings, slopes=slopes
    )
    return dataclasses.replace(
        found, merit=_measured(task, part[1], found.value, found.image)
    )


def _held(task: SearchTask, stop: FitSolution, i: int) -> Array:
    """(p, p) covariance of the others with one parameter held."""
    p = len(stop.value)
    others = np.flatnonzero(np.arange(p) != i)
    out, known = np.zeros((p, p)), stop.information + np.diag(task.prior.sigma**-2.0)
    out[np.ix_(others, others)] = leastsquares.invert_information(
        known[np.ix_(others, others)]
    )
    return out


def _misfit(task: SearchTask, part: Part, x: Array) -> float:
    """The misfit at (p,) parameters."""
    return _measured(task, part[1], x, part[0](x, False)[0])


def _measured(task: SearchTask, data: FitImages, x: Array, image: Array) -> float:
    """Quasi-deviance of the pixels, outliers linear, and the prior's part: its slope is
    the score that a fit sets to 0.

    2 times the integral from image I to count d of (d - t) / v(t), with v = floor + t /
    scale above no light and the
    floor below (McCullagh and Nelder 1989, 9.2): of one height in valleys far apart, as
    weights held at one are not.
    """
    seen, floor, scale = data.electrons, data.variance_e2, data.scale
    up, lit = np.maximum(seen, 0), np.maximum(image, 0)
    light = floor * scale + lit
    z = (up - lit) / light
    bend = np.where(np.abs(z) < 1e-3, z**2 / 2 * (1 - z / 3), (1 + z) * np.log1p(z) - z)
    above = 2 * scale * (light * bend + (seen - up) * np.log1p(z))
    below = (
        (seen - np.minimum(image, 0)) ** 2 - np.where(seen < 0, 0.0, seen**2)
    ) / floor
    size = np.sqrt(np.maximum(above + below, 0.0))
    loss = np.where(size <= _HUBER, size**2, _HUBER * (2 * size - _HUBER))
    counted = data.usable & ~(data.saturated & (image >= seen))
    pull = np.where(
        np.isfinite(task.prior.sigma), (x - task.prior.mean) / task.prior.sigma, 0.0
    )
    return float(loss[counted].sum() + (pull**2).sum())
