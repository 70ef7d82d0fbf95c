"""The posterior of a fit: every valley, the profile of every named parameter, draws
where one is bent, all in words.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from characterize.inference import posterior, walk
from characterize.inference.ends import (
    POINTS,
    LimitSearch,
    ProfileInterval,
    Wanted,
    valley_of,
)
from characterize.inference.leastsquares import FitSolution
from characterize.inference.posterior import LocalMode
from characterize.inference.search import (
    SearchTask,
    add_mirrored_starts,
    correct_surrogate,
    distinct_modes,
    refine_fit,
)
from characterize.inference.walk import ProfileScan
from metalens.core.arrays import Array

REACH = posterior.REACH
_RESTARTS = 2
_LOST, _LOWER = (
    3.0,
    0.5,
)  # sigma of bend from which on a parameter is walked; misfit below the mode that is followed
_OF_THE_BENCH = ("log_gain", "background")
# profiles side by side, whatever the number of cores; the next ones know the slopes
# that these met
_BESIDE = 8


@dataclass(frozen=True, eq=False, slots=True)
class Posterior:
    """What is left open about the fitted parameters.

    modes: the valleys, best first; share: (k,) probability of each.
    low, high: (p,) 95 % intervals over all valleys. parabolic: (p,) whether the
    parabola gives the same.
    draws: (m, p) of the posterior; none where a parabola is all of it.
    profiles: of the parameters by name. covariance: (p, p) of the posterior.
    """

    modes: tuple[FitSolution, ...]
    share: Array
    low: Array
    high: Array
    parabolic: Array
    draws: Array
    profiles: dict[str, ProfileInterval]
    covariance: Array

    @property
    def best(self) -> FitSolution:
        """The valley of least misfit."""
        return self.modes[0]


def explore_posterior(task: SearchTask, ends: Sequence[FitSolution]) -> Posterior:
    """Walks over the prior of what may have several valleys; profiles; what falls below
    its mode is followed first.

    Intervals, curves, draws and covariance hold the errors of dark and flat too, which
    all frames have in common.
    """
    task, modes = correct_surrogate(task, ends[0]), list(ends)
    for name in walk.WALKED:
        modes = walk.find_modes(task, modes, name) if name in task.names else modes
    if (
        modes[0] is not ends[0]
    ):  # the search has asked for the mirror images of its own best
        modes = add_mirrored_starts(task, modes)
    for left in reversed(range(_RESTARTS + 1)):
        valleys = [valley_of(task, mode, mode.merit - modes[0].merit) for mode in modes]
        walks = _walks(task, modes, valleys[0])
        profiles, better = _profiles(
            task, valleys[0], modes[0], walks, followed=bool(left), others=valleys[1:]
        )
        if better is None:
            break
        modes = distinct_modes([*modes, better])
    bent = [
        name
        for name in walk.WALKED
        if name in profiles and name not in walks and not profiles[name].parabolic
    ]
    walks |= {name: _walk(task, modes, name) for name in bent}
    return _joined(task, modes, valleys, profiles, walks)


def _walks(
    task: SearchTask, modes: list[FitSolution], valley: LocalMode
) -> dict[str, ProfileScan]:
    """Of what has several valleys, or one so bent that a profile would be lost in it."""
    names = [name for name in walk.WALKED if name in task.names]
    bent = [
        name
        for name in names
        if len(modes) > 1 or valley.bend(task.names.index(name)) > _LOST
    ]
    return {name: _walk(task, modes, name) for name in bent}


def _walk(task: SearchTask, modes: list[FitSolution], name: str) -> ProfileScan:
    return walk.scan_profile(task, modes, name, widened=max(1.0, modes[0].chi2_per_dof))


def _profiles(
    task: SearchTask,
    valley: LocalMode,
    mode: FitSolution,
    walks: Mapping[str, ProfileScan],
    *,
    followed: bool,
    others: Sequence[LocalMode] = (),
) -> tuple[dict[str, ProfileInterval], FitSolution | None]:
    """Of all named parameters; second: a better mode that one led to, where that is
    ``followed``.

    Ends from the mode and those of ``others``, or from the places on a walk where a
    parameter goes farthest; then
    again from whatever was met on the way and lies beyond an end.
    """
    named = [
        i for i, name in enumerate(task.names) if not name.startswith(_OF_THE_BENCH)
    ]
    places = [
        one.value[np.argmin(one.rise)]
        for one in walks.values()
        if one.rise.min() < -_LOWER
    ]
    search = LimitSearch(
        task, mode, next(iter(walks.values()), None), [valley, *others]
    )
    wanted: list[Wanted] = [(i, sign, None) for i in named for sign in (-1, 1)]
    while wanted:
        for first in range(0, len(wanted), 2 * _BESIDE):
            places += search.ends(wanted[first : first + 2 * _BESIDE])
            if places and followed:
                other = refine_fit(task, places[0])
                if other.merit < mode.merit - 0.05:
                    return {}, other
                places, followed = [], False
        wanted = search.beyond()
    return {task.names[i]: search.profile(i) for i in named}, None


def _joined(
    task: SearchTask,
    modes: list[FitSolution],
    valleys: list[LocalMode],
    profiles: dict[str, ProfileInterval],
    walks: Mapping[str, ProfileScan],
) -> Posterior:
    best, names, profiles = modes[0], task.names, dict(profiles)
    spread = max(1.0, best.chi2_per_dof)
    calibration = valleys[0].calibration()
    sigma = valleys[0].sigma * np.sqrt(spread)
    low, high, parabolic = _intervals(task, modes, valleys, profiles, walks)
    wider = np.sqrt(1 + np.maximum(np.diag(calibration), 0.0) / sigma**2)
    for one in walks.values():
        known = profiles.get(names[one.index])
        whole = _whole(one, best, low, high)
        profiles |= {
            names[one.index]: dataclasses.replace(whole, found=known.found)
            if known
            else whole
        }
    low = np.maximum(best.value + wider * (low - best.value), task.prior.low)
    high = np.minimum(best.value + wider * (high - best.value), task.prior.high)
    profiles = {
        name: _widened(one, best.value, wider, names.index(name))
        for name, one in profiles.items()
    }
    share = posterior.mode_probabilities(valleys)
    covariance = valleys[0].covariance * spread + calibration
    draws = np.empty((0, len(names)))
    if not parabolic.all() or share[0] < 0.99:
        size, vectors = np.linalg.eigh(calibration)
        normal = np.random.default_rng(1).standard_normal((posterior.DRAWS, len(names)))
        shift = normal * np.sqrt(np.maximum(size, 0)) @ vectors.T
        drawn = _drawn(modes, valleys, list(walks.values()), spread)
        draws = np.clip(drawn + shift, task.prior.low, task.prior.high)
        covariance = _covariance(
            draws, valleys[0], (high - low) / (2 * posterior.REACH)
        )
    return Posterior(
        tuple(modes), share, low, high, parabolic, draws, profiles, covariance
    )


def _intervals(
    task: SearchTask,
    modes: list[FitSolution],
    valleys: list[LocalMode],
    profiles: dict[str, ProfileInterval],
    walks: Mapping[str, ProfileScan],
) -> tuple[Array, Array, Array]:
    """(p,) ends over all profiles, modes and walks, and whether the parabola of the
    best has the same.
    """
    best, names = modes[0], task.names
    spread = max(1.0, best.chi2_per_dof)
    level = posterior.REACH**2 * spread
    sigma = valleys[0].sigma * np.sqrt(spread)
    low, high = (
        best.value - posterior.REACH * sigma,
        best.value + posterior.REACH * sigma,
    )
    parabolic = np.ones(len(names), bool)
    for i, name in enumerate(names):
        if name in profiles:
            low[i], high[i], parabolic[i] = (
                profiles[name].low,
                profiles[name].high,
                profiles[name].parabolic,
            )
    loose = np.array([name not in profiles for name in names])
    for mode, valley in zip(modes[1:], valleys[1:], strict=True):
        room = np.sqrt(max(level - (mode.merit - best.merit), 0.0))
        if room > 0:
            low = np.where(
                loose, np.minimum(low, mode.value - room * valley.sigma), low
            )
            high = np.where(
                loose, np.maximum(high, mode.value + room * valley.sigma), high
            )
    for one in walks.values():
        ends = one.interval(level)
        low = np.where(loose, np.minimum(low, ends[0]), low)
        high = np.where(loose, np.maximum(high, ends[1]), high)
        apart = np.maximum(high - best.value, best.value - low) / (
            posterior.REACH * sigma
        )
        parabolic &= apart < posterior.PARABOLIC[1]
    return low, high, parabolic


def _whole(
    one: ProfileScan, best: FitSolution, low: Array, high: Array
) -> ProfileInterval:
    """The profile that a walk is."""
    value, rise = one.profile()
    some = np.unique(np.linspace(0, len(value) - 1, POINTS).round().astype(int))
    return ProfileInterval(
        float(low[one.index]),
        float(high[one.index]),
        value[some],
        rise[some],
        parabolic=False,
    )


def _drawn(
    modes: list[FitSolution],
    valleys: list[LocalMode],
    walks: list[ProfileScan],
    spread: float,
) -> Array:
    """Draws about the modes; of the walks where there are any, and about those modes
    alone that lie on none.
    """
    if not walks:
        return posterior.draw_posterior(valleys)
    rng = np.random.default_rng(0)
    beside = [
        k
        for k, mode in enumerate(modes)
        if not any(one.passes(mode.value) for one in walks)
    ]
    one = max(walks, key=ProfileScan.log_mass)
    one_axis = np.log(2 * np.pi) / 2  # which a walk's mass holds and evidence does not
    log = [
        one.log_mass(),
        *(posterior.log_evidence(valleys[k]) + one_axis for k in beside),
    ]
    share = np.exp(np.array(log) - max(log))
    count = rng.multinomial(posterior.DRAWS, share / share.sum())
    parts = [one.draws(int(count[0]), widened=spread, rng=rng)]
    parts += [
        posterior.draw_posterior([valleys[k]], int(n))
        for k, n in zip(beside, count[1:], strict=True)
        if n
    ]
    return np.asarray(rng.permutation(np.concatenate(parts)))


def _widened(
    one: ProfileInterval, best: Array, wider: Array, i: int
) -> ProfileInterval:
    """A profile stretched about its mode by errors that its likelihood does not know:
    those of the calibration.
    """
    ends, value = (
        best[i] + wider[i] * (part - best[i])
        for part in (np.array([one.low, one.high]), one.value)
    )
    return dataclasses.replace(
        one, low=float(ends[0]), high=float(ends[1]), value=value
    )


def _covariance(draws: Array, valley: LocalMode, sigma: Array) -> Array:
    """Correlation of the draws, with the intervals' sigma; of the parabola's a fifth at
    least, which keeps it regular.

    So much more of the parabola's as few draws cannot tell theirs from it: the inverse
    of what they scatter by is too
    sure along the best known combinations. The share of least expected square error is
    that of Schäfer and Strimmer
    (2005, Stat. Appl. Genet. Mol. Biol. 4, 32), with (1 - r²)² / n for the variance of
    a correlation r of n draws.
    """
    seen = np.cov(draws.T) + 1e-12 * np.diag(valley.sigma**2)
    of_draws, parabola = (
        one / np.sqrt(np.outer(np.diag(one), np.diag(one)))
        for one in (seen, valley.covariance)
    )
    apart = ((of_draws - parabola) ** 2).sum()
    chance = ((1 - of_draws**2) ** 2 / len(draws)).sum()
    share = min(max(chance / max(apart, 1e-300), 0.2), 1.0)
    return np.asarray(
        ((1 - share) * of_draws + share * parabola) * np.outer(sigma, sigma)
    )


def posterior_text(task: SearchTask, found: Posterior) -> list[str]:
    """Bent and double posteriors, and ends that were not found, in words."""
    out = [
        f"the {which} end of {name} was not found: 95 % reach to {place:.3g} at least, perhaps beyond"
        for name, one in found.profiles.items()
        for which, place, there in zip(
            ("lower", "upper"), (one.low, one.high), one.found, strict=True
        )
        if not there
    ]
    for name, flat in zip(task.names, found.parabolic, strict=True):
        if not flat:
            i = task.names.index(name)
            out.append(
                f"{name} is bent: 95 % within {found.low[i]:.3g} to {found.high[i]:.3g} about "
                f"{found.best.value[i]:.3g}, not the same on both sides; take draws, not value and sigma"
            )
    for mode, share in zip(found.modes[1:], found.share[1:], strict=True):
        step = np.abs(mode.value - found.best.value) / np.sqrt(
            np.diag(found.best.covariance)
        )
        most = np.argsort(-step)[:3]
        values = ", ".join(
            f"{task.names[i]} {mode.value[i]:.3g} for {found.best.value[i]:.3g}"
            for i in most
        )
        out.append(
            f"a second lens explains the frames nearly as well (misfit {mode.merit - found.best.merit:+.1f}, "
            f"probability {share:.0%}): {values}; frames farther from focus on both sides tell them apart"
        )
    return out
