"""The posterior of a fit: every valley, the profile of every named parameter, draws where one is bent, all in words."""

import copy
import dataclasses
import functools
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from characterize.inference import posterior, residual, walk
from characterize.inference.leastsquares import Solution
from characterize.inference.posterior import Profile, Valley
from characterize.inference.search import Task, distinct, mirrored, refine
from characterize.inference.walk import Walk
from characterize.model import ForwardModel
from metalens.ground import threads
from metalens.ground.arrays import Array

REACH = posterior.REACH
_RESTARTS = 2
_LOST, _LOWER = 3.0, 0.5  # sigma of bend from which on a parameter is walked; misfit below the mode that is followed
_OF_THE_BENCH = ("log_gain", "background")
_BESIDE = 8  # profiles side by side, whatever the number of cores; the next ones know the slopes that these met
_POINTS = 61  # of the curve of a walk
_SHOWN = 24  # draws whose images give the predicted error at depths in between


@dataclass(frozen=True, eq=False, slots=True)
class Posterior:
    """What is left open about the fitted parameters.

    modes: the valleys, best first; share: (k,) probability of each.
    low, high: (p,) 95 % intervals over all valleys. parabolic: (p,) whether the parabola gives the same.
    draws: (m, p) of the posterior; none where a parabola is all of it.
    profiles: of the parameters by name. covariance: (p, p) of the posterior.
    """

    modes: tuple[Solution, ...]
    share: Array
    low: Array
    high: Array
    parabolic: Array
    draws: Array
    profiles: dict[str, Profile]
    covariance: Array

    @property
    def best(self) -> Solution:
        """The valley of least misfit."""
        return self.modes[0]


def explore(task: Task, ends: Sequence[Solution]) -> Posterior:
    """Walks over the prior of what may have several valleys; profiles; what falls below its mode is followed first.

    Intervals, curves, draws and covariance hold the errors of dark and flat too, which all frames have in common.
    """
    modes = list(ends)
    for name in walk.WALKED:
        modes = walk.valleys(task, modes, name) if name in task.names else modes
    if modes[0] is not ends[0]:  # the search has asked for the mirror images of its own best
        modes = mirrored(task, modes)
    for left in reversed(range(_RESTARTS + 1)):
        valleys = [_valley(task, mode) for mode in modes]
        walks = _walks(task, modes, valleys[0])
        profiles, better = _profiles(task, valleys[0], modes[0], walks, followed=bool(left))
        if better is None:
            break
        modes = distinct([*modes, better])
    bent = [name for name in walk.WALKED if name in profiles and name not in walks and not profiles[name].parabolic]
    walks |= {name: _walk(task, modes, name) for name in bent}
    return _joined(task, modes, valleys, profiles, walks)


def _walks(task: Task, modes: list[Solution], valley: Valley) -> dict[str, Walk]:
    """Of what has several valleys, or one so bent that a profile would be lost in it."""
    names = [name for name in walk.WALKED if name in task.names]
    bent = [name for name in names if len(modes) > 1 or valley.bend(task.names.index(name)) > _LOST]
    return {name: _walk(task, modes, name) for name in bent}


def _walk(task: Task, modes: list[Solution], name: str) -> Walk:
    return walk.walk(task, modes, name, widened=max(1.0, modes[0].chi2_per_dof))


def _valley(task: Task, mode: Solution) -> Valley:
    return Valley(task.problem(), task.data, mode.value, task.prior, known=(mode.image, mode.slopes))


def _profiles(
    task: Task, valley: Valley, mode: Solution, walks: Mapping[str, Walk], *, followed: bool
) -> tuple[dict[str, Profile], Solution | None]:
    """Of all named parameters; second: a better mode that one led to, where that is ``followed``.

    By the walk where there is one and what is left is straight with the walked parameter held, else by descents.
    """
    found: dict[str, Profile] = {}
    places = [one.value[np.argmin(one.rise)] for one in walks.values() if one.rise.min() < -_LOWER]
    named = [i for i, name in enumerate(task.names) if not name.startswith(_OF_THE_BENCH)]
    for first in range(0, len(named), _BESIDE):
        some = [(i, copy.copy(valley)) for i in named[first : first + _BESIDE]]
        ends = threads.each(functools.partial(_profile, mode, walks), some)
        known = len(valley.met)
        valley.met += tuple(itertools.chain.from_iterable(part.met[known:] for _, part in some))
        for (i, _), (one, better) in zip(some, ends, strict=True):
            found[task.names[i]] = one
            places += [] if better is None else [better]
        if places and followed:
            other = refine(task, places[0])
            if other.merit < mode.merit - 0.05:
                return found, other
            places, followed = [], False
    return found, None


def _profile(mode: Solution, walks: Mapping[str, Walk], one: tuple[int, Valley]) -> tuple[Profile, Array | None]:
    """Of a parameter, by its place among the others; second: a place below the mode, if one was met."""
    i, valley = one
    level = posterior.REACH**2 * max(1.0, mode.chi2_per_dof)
    by = next((w for w in walks.values() if i == w.index or valley.bend(i, w.index) < posterior.BENT), None)
    if by is not None:
        return _along(by, i, mode, float(valley.sigma[i]), level), None
    return posterior.profile(valley, i, level=level)


def _along(one: Walk, i: int, mode: Solution, sigma: float, level: float) -> Profile:
    """Of any parameter by a walk along another, those left over straight."""
    low, high = (float(end[i]) for end in one.interval(level))
    value, rise = one.profile() if i == one.index else one.profile_of(i, np.linspace(-1, 1, _POINTS))
    ratio = np.array([high - mode.value[i], mode.value[i] - low]) / (math.sqrt(level) * sigma)
    plain = bool(((ratio > posterior.PARABOLIC[0]) & (ratio < posterior.PARABOLIC[1])).all())
    return Profile(low, high, value, rise, plain)


def _joined(
    task: Task,
    modes: list[Solution],
    valleys: list[Valley],
    profiles: dict[str, Profile],
    walks: Mapping[str, Walk],
) -> Posterior:
    best, names = modes[0], task.names
    spread = max(1.0, best.chi2_per_dof)
    calibration = valleys[0].calibration()
    sigma = valleys[0].sigma * np.sqrt(spread)
    low, high, parabolic = _intervals(task, modes, valleys, profiles, walks)
    wider = np.sqrt(1 + np.maximum(np.diag(calibration), 0.0) / sigma**2)
    profiles = profiles | {names[one.index]: _whole(one, best, low, high) for one in walks.values()}
    low = np.maximum(best.value + wider * (low - best.value), task.prior.low)
    high = np.minimum(best.value + wider * (high - best.value), task.prior.high)
    profiles = {name: _widened(one, best.value, wider, names.index(name)) for name, one in profiles.items()}
    share = posterior.shares(valleys)
    covariance = valleys[0].covariance * spread + calibration
    draws = np.empty((0, len(names)))
    if not parabolic.all() or share[0] < 0.99:
        size, vectors = np.linalg.eigh(calibration)
        normal = np.random.default_rng(1).standard_normal((posterior.DRAWS, len(names)))
        shift = normal * np.sqrt(np.maximum(size, 0)) @ vectors.T
        drawn = _drawn(modes, valleys, list(walks.values()), spread)
        draws = np.clip(drawn + shift, task.prior.low, task.prior.high)
        covariance = _covariance(draws, valleys[0], (high - low) / (2 * posterior.REACH))
    return Posterior(tuple(modes), share, low, high, parabolic, draws, profiles, covariance)


def _intervals(
    task: Task,
    modes: list[Solution],
    valleys: list[Valley],
    profiles: dict[str, Profile],
    walks: Mapping[str, Walk],
) -> tuple[Array, Array, Array]:
    """(p,) ends over all profiles, modes and walks, and whether the parabola of the best has the same."""
    best, names = modes[0], task.names
    spread = max(1.0, best.chi2_per_dof)
    level = posterior.REACH**2 * spread
    sigma = valleys[0].sigma * np.sqrt(spread)
    low, high = best.value - posterior.REACH * sigma, best.value + posterior.REACH * sigma
    parabolic = np.ones(len(names), bool)
    for i, name in enumerate(names):
        if name in profiles:
            low[i], high[i], parabolic[i] = profiles[name].low, profiles[name].high, profiles[name].parabolic
    for mode, valley in zip(modes[1:], valleys[1:], strict=True):
        room = np.sqrt(max(level - (mode.merit - best.merit), 0.0))
        if room > 0:
            low = np.minimum(low, mode.value - room * valley.sigma)
            high = np.maximum(high, mode.value + room * valley.sigma)
    for one in walks.values():
        ends = one.interval(level)
        low, high = np.minimum(low, ends[0]), np.maximum(high, ends[1])
        apart = np.maximum(high - best.value, best.value - low) / (posterior.REACH * sigma)
        parabolic &= apart < posterior.PARABOLIC[1]
    return low, high, parabolic


def _whole(one: Walk, best: Solution, low: Array, high: Array) -> Profile:
    """The profile that a walk is."""
    value, rise = one.profile()
    some = np.unique(np.linspace(0, len(value) - 1, _POINTS).round().astype(int))
    return Profile(float(low[one.index]), float(high[one.index]), value[some], rise[some], parabolic=False)


def _drawn(modes: list[Solution], valleys: list[Valley], walks: list[Walk], spread: float) -> Array:
    """Draws about the modes; of the walks where there are any, and about those modes alone that lie on none."""
    if not walks:
        return posterior.draws(valleys)
    rng, least = np.random.default_rng(0), modes[0].merit
    beside = [k for k, mode in enumerate(modes) if not any(one.passes(mode.value) for one in walks)]
    one = max(walks, key=Walk.log_mass)
    log = [one.log_mass(), *(_log_mass(modes[k], valleys[k], least) for k in beside)]
    share = np.exp(np.array(log) - max(log))
    count = rng.multinomial(posterior.DRAWS, share / share.sum())
    parts = [one.draws(int(count[0]), widened=spread, rng=rng)]
    parts += [posterior.draws([valleys[k]], int(n)) for k, n in zip(beside, count[1:], strict=True) if n]
    return np.asarray(rng.permutation(np.concatenate(parts)))


def _log_mass(mode: Solution, valley: Valley, least: float) -> float:
    """As :meth:`Walk.log_mass`, of a parabola."""
    return float(posterior.half_volume(valley) - (mode.merit - least) / 2 + np.log(2 * np.pi) / 2)


def _widened(one: Profile, best: Array, wider: Array, i: int) -> Profile:
    """A profile stretched about its mode by errors that its likelihood does not know: those of the calibration."""
    ends, value = (best[i] + wider[i] * (part - best[i]) for part in (np.array([one.low, one.high]), one.value))
    return dataclasses.replace(one, low=float(ends[0]), high=float(ends[1]), value=value)


def _covariance(draws: Array, valley: Valley, sigma: Array) -> Array:
    """Correlation of the draws, a fifth of the parabola's mixed in to keep it regular, with the intervals' sigma."""
    seen = np.cov(draws.T) + 1e-12 * np.diag(valley.sigma**2)
    parts = []
    for one in (seen, valley.covariance):
        size = np.sqrt(np.diag(one))
        parts.append(one / np.outer(size, size))
    return np.asarray((0.8 * parts[0] + 0.2 * parts[1]) * np.outer(sigma, sigma))


def words(task: Task, found: Posterior) -> list[str]:
    """Bent and double posteriors, in words."""
    out = []
    for name, flat in zip(task.names, found.parabolic, strict=True):
        if not flat:
            i = task.names.index(name)
            out.append(
                f"{name} is bent: 95 % within {found.low[i]:.3g} to {found.high[i]:.3g} about "
                f"{found.best.value[i]:.3g}, not the same on both sides; take draws, not value and sigma"
            )
    for mode, share in zip(found.modes[1:], found.share[1:], strict=True):
        step = np.abs(mode.value - found.best.value) / np.sqrt(np.diag(found.best.covariance))
        most = np.argsort(-step)[:3]
        values = ", ".join(f"{task.names[i]} {mode.value[i]:.3g} for {found.best.value[i]:.3g}" for i in most)
        out.append(
            f"a second lens explains the frames nearly as well (misfit {mode.merit - found.best.merit:+.1f}, "
            f"probability {share:.0%}): {values}; frames farther from focus on both sides tell them apart"
        )
    return out


def predicted_error(task: Task, found: Posterior) -> tuple[float, float]:
    """Expected NRMSE of the as-built images: at the captured depths, and half-way between them."""
    model = task.model
    rng = np.random.default_rng(0)
    if len(found.draws):
        values = found.draws[:_SHOWN]
    else:
        size, vectors = np.linalg.eigh(found.covariance)
        normal = rng.standard_normal((_SHOWN, len(size))) * np.sqrt(np.maximum(size, 0))
        values = found.best.value + normal @ vectors.T
    values = np.clip(values, task.prior.low, task.prior.high)
    return _spread(task, model, found.best.value, values), _spread(task, between(model), found.best.value, values)


def _spread(task: Task, model: ForwardModel, best: Array, values: Array) -> float:
    """Rms over draws of |image - best| / |best|, each as bright as the best, without its background."""
    images = residual.problem(model, task.names, task.start)
    dark = [i for i, name in enumerate(task.names) if name.startswith("background")]

    def light(x: Array) -> Array:
        x = x.copy()
        x[dark] = 0.0
        return np.asarray(images(x, False)[0])

    mean = light(best)

    def away(x: Array) -> float:
        one = light(x)
        one *= (one * mean).sum() / max(float((one**2).sum()), 1e-300)
        return float(((one - mean) ** 2).sum())

    return float(np.sqrt(sum(threads.each(away, values)) / len(values) / (mean**2).sum()))


def between(model: ForwardModel) -> ForwardModel:
    """The model half-way, in 1/z, between neighbouring depths at each angle; the farthest frame moves inwards."""
    part, s = copy.copy(model), model.setting
    depth = s.depth_um.copy()
    for group in model.groups:
        order = group.index[np.argsort(s.depth_um[group.index], kind="stable")]
        if len(order) > 1:
            inverse = 1 / s.depth_um[order]
            middle = (inverse[1:] + inverse[:-1]) / 2
            depth[order] = 1 / np.append(middle, middle[-1])
    part.setting = dataclasses.replace(s, depth_um=depth)
    return part


def left_out(task: Task, mode: Solution) -> float:
    """Chi-square a pixel of frames left out, every second depth and then the others, over that of the full fit.

    About 1 + parameters over pixels where model and intervals hold; nan with fewer than four frames.
    """
    n = len(task.data.electrons)
    if n < 4:
        return float("nan")
    order = np.argsort(task.model.setting.depth_um, kind="stable")
    halves = [(np.sort(seen), np.sort(hidden)) for seen, hidden in itertools.permutations((order[::2], order[1::2]))]
    total, count = np.sum(threads.each(functools.partial(_unseen, task, mode), halves), 0)
    return float(total / max(count, 1))


def _unseen(task: Task, mode: Solution, part: tuple[Array, Array]) -> tuple[float, int]:
    """(chi-square, pixels) of the second frames by what the first say."""
    seen, hidden = part
    images = residual.problem(task.model.only(seen), task.names, task.start)
    known = mode.image[seen], mode.slopes[:, seen]
    valley = Valley(images, task.data.planes(seen), mode.value, task.prior, known=known)
    value, _ = valley.descend(mode.value, rounds=6)
    rest = task.data.planes(hidden)
    image = residual.problem(task.model.only(hidden), task.names, task.start)(value, False)[0]
    keep = rest.usable & ~rest.saturated
    slopes = mode.slopes[:, hidden][:, keep]
    known_e2 = np.einsum("iN,ij,jN->N", slopes, valley.covariance, slopes, optimize=True)
    variance = rest.variance(image)[keep] + known_e2
    return float(np.minimum((rest.electrons - image)[keep] ** 2 / variance, 36.0).sum()), int(keep.sum())
