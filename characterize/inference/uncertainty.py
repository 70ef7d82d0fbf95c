"""Posterior about the modes of a fit: profiles where the parabola fails, weighted draws."""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special, stats

from characterize.captures import SensorNoise
from characterize.inference.leastsquares import (
    FitProblem,
    FitSolution,
    SolverSettings,
    gaussian_draws,
    pixel_weights,
)
from characterize.inference.multistart import (
    SearchTask,
    add_mirrored_starts,
    distinct_modes,
    follow_starts,
    refine_fit,
    starts_along,
)
from metalens.core import threads
from metalens.core.arrays import Array

REACH = 1.959964  # sigma of a 95 % interval
DRAWS = 96
_PARABOLIC = 0.85, 1.18  # end of an interval over that of the parabola
_SIDE = 4  # most places of a profile on each side of the mode
_CLOSE = 0.05  # relative error of the goal at which a place is the profile's end
_LOWER = 0.5  # fall of -2 ln posterior below the mode that counts as a better mode
_RESTARTS = 2
_OF_THE_BENCH = ("log_gain", "background")
_PROFILE_FIT = SolverSettings(
    iterations=6, step_tolerance=0.3, near=math.inf, finish=False
)


@dataclass(frozen=True, eq=False, slots=True)
class ProfileLikelihood:
    """Profile likelihood of one parameter about a mode.

    low, high: 95 % interval. value, rise: (k,) the parameter, and the rise of -2 ln
    posterior there with all others fitted. parabolic: whether the ends are those of the
    parabola. reached: whether the low and the high end were reached. stops: the fits with
    the parameter fixed.
    """

    low: float
    high: float
    value: Array
    rise: Array
    parabolic: bool
    reached: tuple[bool, bool] = (True, True)
    stops: tuple[FitSolution, ...] = ()


@dataclass(frozen=True, eq=False, slots=True)
class FitPosterior:
    """What is left open about the fitted parameters.

    modes: best first; share: (k,) probability of each. low, high: (p,) 95 % intervals
    over all modes. parabolic: (p,) whether the parabola of the best gives the same.
    draws: (m, p); none where a parabola is all of it. effective_draws: effective sample
    size of these. profiles: by name. covariance: (p, p).
    """

    modes: tuple[FitSolution, ...]
    share: Array
    low: Array
    high: Array
    parabolic: Array
    draws: Array
    effective_draws: float
    profiles: dict[str, ProfileLikelihood]
    covariance: Array

    @property
    def best(self) -> FitSolution:
        """The mode of least misfit."""
        return self.modes[0]


def explore_posterior(
    task: SearchTask, ends: Sequence[FitSolution], gain: SensorNoise
) -> FitPosterior:
    """Intervals, profiles, covariance and draws about the modes of a fit.

    Where a profile falls below the best mode, its lowest place is fitted and the
    profiles are repeated. Errors of dark and flat, which all frames share, and of the
    gain are included.

    Args:
        task: model, frames and priors.
        ends: the modes, best first.
        gain: noise model of the sensor, with the error of its gain.
    """
    modes = list(ends)
    if "bias_nm" in task.names:
        starts = starts_along(task, modes[0], "bias_nm")
        modes = distinct_modes([*modes, *follow_starts(task, modes[0], starts)])
    if modes[0] is not ends[0]:
        modes = add_mirrored_starts(task, modes)
    problem = task.posed()
    named = [i for i, n in enumerate(task.names) if not n.startswith(_OF_THE_BENCH)]
    for _ in range(_RESTARTS + 1):
        spread = max(1.0, modes[0].chi2_per_dof)
        profiles = profile_parameters(problem, modes[0], named, REACH**2 * spread)
        lowest = min(
            (stop for profile in profiles.values() for stop in profile.stops),
            key=lambda stop: stop.merit,
            default=modes[0],
        )
        if lowest.merit > modes[0].merit - _LOWER:
            break
        modes = distinct_modes([*modes, refine_fit(task, lowest.value)])
    best = modes[0]
    calibration = shared_calibration(problem, best)
    # the gain scales what is counted in electrons
    relative = min(gain.gain_sigma_e / gain.gain_e, 1.0)
    by_gain = [
        relative * (1.0 if name == "log_gain" else value) * (i not in named)
        for i, (name, value) in enumerate(zip(task.names, best.value, strict=True))
    ]
    calibration += np.outer(by_gain, by_gain)
    return _joined(task, problem, modes, profiles, calibration)


def profile_parameters(
    problem: FitProblem, mode: FitSolution, index: Sequence[int], level: float
) -> dict[int, ProfileLikelihood]:
    """Profile of each parameter in ``index`` about ``mode``, to a rise of ``level``.

    Where -2 ln posterior at both ends of the parabola's interval is that of the
    parabola, these are the ends, and no fit is made.

    Args:
        problem: images, frames and prior.
    """
    here = dataclasses.replace(mode, merit=problem.merit(mode.value))
    profiles = threads.run_each(lambda i: _profile(problem, here, i, level), index)
    return dict(zip(index, profiles, strict=True))


def _profile(
    problem: FitProblem, mode: FitSolution, i: int, level: float
) -> ProfileLikelihood:
    """Profile likelihood of parameter ``i``: the parabola where it holds, else fits.

    The parabola holds where -2 ln posterior at its interval's ends rises by ``level``
    within ``_PARABOLIC``.
    """
    sigma = math.sqrt(float(mode.covariance[i, i]))
    goal = math.sqrt(level)
    middle = float(mode.value[i])
    # all parameters on the ridge of the parabola, for one sigma of this one
    along = mode.covariance[:, i] / sigma
    low, high = _PARABOLIC[0] ** 2 * level, _PARABOLIC[1] ** 2 * level
    places = [mode.value + sign * goal * along for sign in (-1, 1)]
    inside = all(
        ((x >= problem.prior.low) & (x <= problem.prior.high)).all() for x in places
    )
    if inside and all(low < problem.merit(x) - mode.merit < high for x in places):
        steps = np.array([-2.5, -1.96, -1.0, 0.0, 1.0, 1.96, 2.5])
        value = middle + steps * sigma
        return ProfileLikelihood(
            middle - goal * sigma, middle + goal * sigma, value, steps**2, True
        )
    sides = [_profile_side(problem, mode, i, sign, goal) for sign in (-1, 1)]
    ends = [middle + sign * side[0] for sign, side in zip((-1, 1), sides, strict=True)]
    stops = tuple(itertools.chain.from_iterable(side[2] for side in sides))
    points = ((float(stop.value[i]), stop.merit - mode.merit) for stop in stops)
    value, rise = np.array(sorted([(middle, 0.0), *points])).T
    ratio = np.abs(np.array(ends) - middle) / (goal * sigma)
    straight = bool(((ratio > _PARABOLIC[0]) & (ratio < _PARABOLIC[1])).all())
    reached = sides[0][1], sides[1][1]
    return ProfileLikelihood(ends[0], ends[1], value, rise, straight, reached, stops)


def _profile_side(
    problem: FitProblem, mode: FitSolution, i: int, sign: int, goal: float
) -> tuple[float, bool, list[FitSolution]]:
    """One end of a profile: where the root of the rise of -2 ln posterior is ``goal``.

    That root grows nearly evenly with the distance: each place is interpolated in those
    before, or extrapolated along the line from the mode, at most to twice the distance.
    At every place the other parameters are fitted.

    Args:
        sign: side, -1 or 1.

    Returns:
        (distance of the end from the mode, whether it was reached, fits on the way).
    """
    prior = problem.prior
    middle = float(mode.value[i])
    bound = abs(float((prior.high if sign > 0 else prior.low)[i]) - middle)
    distance = min(goal * math.sqrt(float(mode.covariance[i, i])), bound)
    # distances from the mode, roots of the rise there, and the fits
    places, roots, stops = [0.0], [0.0], [mode]
    for _ in range(_SIDE):
        here = stops[int(np.argmin(np.abs(np.array(places) - distance)))]
        value = middle + sign * distance
        way = here.covariance[:, i] / here.covariance[i, i] * (value - here.value[i])
        stop = problem.with_fixed(i, value).fit(
            here.value + way, _PROFILE_FIT, here.slopes
        )
        root = math.sqrt(max(stop.merit - mode.merit, 0.0))
        at = int(np.searchsorted(places, distance))
        places.insert(at, distance)
        roots.insert(at, root)
        stops.insert(at, stop)
        if abs(root - goal) < _CLOSE * goal or (distance >= bound and root < goal):
            break
        if max(roots) >= goal:
            distance = float(np.interp(goal, np.maximum.accumulate(roots), places))
        else:
            distance *= min(2.0, goal / max(root, goal / 2))
        distance = min(distance, bound)
    end = float(np.interp(goal, np.maximum.accumulate(roots), places))
    reached = max(roots) > (1 - _CLOSE) * goal or end >= bound
    return end, reached, [stop for stop in stops if stop is not mode]


def shared_calibration(problem: FitProblem, mode: FitSolution) -> Array:
    """(p, p) covariance by errors of dark and flat, which all frames share.

    C AᵀW S W A C, with C the covariance of the fit, A its Jacobian, W weights and S the
    covariance of the pixels by these errors, less what the noise already contains.

    Args:
        problem: of the fit. mode: its solution.
    """
    noise, _, weight = pixel_weights(problem.data, mode.image)
    root = np.sqrt(weight) / noise
    slopes = mode.slopes * root
    p = len(mode.value)
    dark, light = problem.data.shared(mode.image) * root
    flat, floor = ((slopes * c).sum(1).reshape(p, -1) for c in (light, dark))
    counted = (slopes * dark).reshape(p, -1)
    spread = flat @ flat.T + floor @ floor.T - counted @ counted.T
    return np.asarray(mode.covariance @ spread @ mode.covariance)


def mode_probabilities(modes: Sequence[FitSolution], spread: float = 1.0) -> Array:
    """(k,) probability of every mode by Laplace's rule.

    exp(-merit / 2) times the root of the determinant of its covariance, normalised.

    Args:
        modes: fits at the modes, best first.
        spread: factor of all variances.
    """
    log = np.array([_log_mass(mode.merit, mode.covariance, spread) for mode in modes])
    return np.asarray(special.softmax(log))


def _log_mass(merit: float, covariance: Array, spread: float) -> float:
    return float(np.linalg.slogdet(covariance)[1]) / 2 - merit / (2 * spread)


def draw_posterior(
    problem: FitProblem,
    components: Sequence[FitSolution],
    *,
    count: int = DRAWS,
    spread: float = 1.0,
    seed: int = 0,
) -> tuple[Array, float]:
    """(count, p) draws of the posterior, and their effective sample size.

    Importance resampling from a mixture of Gaussians about ``components``, 2 ``count``
    draws. Weights are truncated at their mean times the root of their number (Ionides
    2008).

    Args:
        problem: images, frames and prior.
        components: fits; each is a Gaussian of its covariance.
        spread: factor of all variances.
        seed: of the random numbers.
    """
    rng = np.random.default_rng(seed)
    share = mode_probabilities(components, spread)
    # in units of their sigma: eigenvalues are cut off at rounding
    unit = np.sqrt(np.diag(components[0].covariance))
    mixture = [
        stats.multivariate_normal(
            fit.value / unit,
            spread * fit.covariance / np.outer(unit, unit),
            allow_singular=True,
        )
        for fit in components
    ]
    counts = rng.multinomial(2 * count, share)
    pairs = zip(mixture, counts, strict=True)
    drawn = [part.rvs(n, rng).reshape(n, -1) for part, n in pairs if n]
    whitened = np.concatenate(drawn)
    x = whitened * unit
    log_parts = np.stack([part.logpdf(whitened) for part in mixture], 1)
    log_q = special.logsumexp(np.log(share) + log_parts, axis=1)
    inside = ((x >= problem.prior.low) & (x <= problem.prior.high)).all(1)
    x, log_q = x[inside], log_q[inside]
    # weights posterior / q, truncated
    merit = np.array(threads.run_each(problem.merit, list(x)))
    log_w = -merit / (2 * spread) - log_q
    weight = np.exp(log_w - log_w.max())
    weight = np.minimum(weight, weight.mean() * math.sqrt(len(weight)))
    weight /= weight.sum()
    # systematic resampling
    places = (rng.random() + np.arange(count)) / count
    index = np.searchsorted(np.cumsum(weight), places).clip(0, len(x) - 1)
    return rng.permutation(x[index]), float(1 / (weight**2).sum())


def _joined(
    task: SearchTask,
    problem: FitProblem,
    modes: list[FitSolution],
    profiles: dict[int, ProfileLikelihood],
    calibration: Array,
) -> FitPosterior:
    """The posterior over all modes, with the errors of the camera's calibration.

    Draws are made only where a parabola does not describe it; the covariance is then
    scaled to the widths of the intervals.

    Args:
        problem: the least-squares problem of the modes.
        profiles: by index of the parameter.
        calibration: (p, p) covariance by errors of dark, flat and gain.
    """
    best = modes[0]
    names = task.names
    prior = task.prior
    spread = max(1.0, best.chi2_per_dof)
    level = REACH**2 * spread
    sigma = np.sqrt(spread * np.diag(best.covariance))
    # intervals: of the parabola, of the profiles, then over the other modes
    low = best.value - REACH * sigma
    high = best.value + REACH * sigma
    parabolic = np.ones(len(names), bool)
    for i, profile in profiles.items():
        low[i] = profile.low
        high[i] = profile.high
        parabolic[i] = profile.parabolic
    for mode in modes[1:]:
        root = math.sqrt(max(level - (mode.merit - best.merit), 0.0))
        reach = root * np.sqrt(np.diag(mode.covariance))
        low = np.minimum(low, np.where(root > 0, mode.value - reach, low))
        high = np.maximum(high, np.where(root > 0, mode.value + reach, high))
    ratio = np.maximum(high - best.value, best.value - low) / (REACH * sigma)
    parabolic &= ratio < _PARABOLIC[1]
    # errors of the calibration, added in quadrature
    common = REACH * np.sqrt(np.maximum(np.diag(calibration), 0.0))
    low = np.maximum(best.value - np.hypot(best.value - low, common), prior.low)
    high = np.minimum(best.value + np.hypot(high - best.value, common), prior.high)
    share = mode_probabilities(modes, spread)
    covariance = best.covariance * spread + calibration
    draws, size = np.empty((0, len(names))), 0.0
    if not parabolic.all() or share[0] < 0.99:
        stops = [stop for profile in profiles.values() for stop in profile.stops]
        draws, size = draw_posterior(problem, [*modes, *stops], spread=spread)
        rng = np.random.default_rng(1)
        shift = gaussian_draws(rng, len(draws), calibration)
        draws = np.clip(draws + shift, prior.low, prior.high)
        own = np.sqrt(np.diag(covariance))
        wide = (high - low) / (2 * REACH)
        covariance = covariance / np.outer(own, own) * np.outer(wide, wide)
    named = {
        names[i]: dataclasses.replace(profile, low=float(low[i]), high=float(high[i]))
        for i, profile in profiles.items()
    }
    return FitPosterior(
        tuple(modes), share, low, high, parabolic, draws, size, named, covariance
    )


def posterior_text(names: Sequence[str], posterior: FitPosterior) -> list[str]:
    """Sentences on what the posterior leaves open.

    Ends of intervals that were not reached, skewed intervals, second modes, few draws.

    Args:
        names: of the parameters.
        posterior: their posterior.
    """
    out = [
        f"the {which} end of {name} was not found: 95 % reach to {place:.3g} at least, "
        "perhaps beyond"
        for name, profile in posterior.profiles.items()
        for which, place, reached in zip(
            ("lower", "upper"),
            (profile.low, profile.high),
            profile.reached,
            strict=True,
        )
        if not reached
    ]
    for i, name in enumerate(names):
        if not posterior.parabolic[i]:
            out.append(
                f"{name} is bent: 95 % within {posterior.low[i]:.3g} to "
                f"{posterior.high[i]:.3g} about {posterior.best.value[i]:.3g}, not the same "
                "on both sides; take draws, not value and sigma"
            )
    sigma = np.sqrt(np.diag(posterior.best.covariance))
    for mode, share in zip(posterior.modes[1:], posterior.share[1:], strict=True):
        most = np.argsort(-np.abs(mode.value - posterior.best.value) / sigma)[:3]
        values = ", ".join(
            f"{names[i]} {mode.value[i]:.3g} for {posterior.best.value[i]:.3g}"
            for i in most
        )
        out.append(
            "a second lens explains the frames nearly as well (misfit "
            f"{mode.merit - posterior.best.merit:+.1f}, probability {share:.0%}): {values}; "
            "frames farther from focus on both sides distinguish them"
        )
    if len(posterior.draws) and posterior.effective_draws < DRAWS / 4:
        out.append(
            f"draws of the posterior are worth {posterior.effective_draws:.0f} "
            "independent ones: take intervals, not draws"
        )
    return out
