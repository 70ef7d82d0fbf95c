"""Posterior about the modes of a fit: profiles where the parabola fails, weighted draws."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special, stats

from characterize.captures import SensorNoise
from characterize.inference.leastsquares import (
    REACH,
    FitProblem,
    FitSolution,
    SolverSettings,
    gaussian_draws,
    pixel_weights,
    shared_error_scatter,
)
from characterize.inference.multistart import SearchTask, distinct_modes, refine_fit
from metalens.core import threads
from metalens.core.arrays import Array

DRAWS = 96
_PARABOLIC = 0.85, 1.18  # end of an interval over that of the parabola
# places of a profile on each side, in units of the parabola's interval
_PLACES = (0.5, 1.0, 2.0, 4.0)
_LOWER = 0.5  # fall of -2 ln posterior below the mode that counts as a better mode
_RESTARTS = 2
_OF_THE_BENCH = ("log_gain", "background")
_PROFILE_FIT = SolverSettings.short(iterations=6, step_tolerance=0.3)


@dataclass(frozen=True, eq=False, slots=True)
class ProfileLikelihood:
    """Profile likelihood of one parameter about a mode.

    low, high: 95 % interval. value, rise: (k,) the parameter, and the rise of -2 ln
    posterior there with all others fitted. stops: the fits with the parameter fixed.
    """

    low: float
    high: float
    value: Array
    rise: Array
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

    The parabola, where -2 ln posterior at its interval's ends rises by ``level`` within
    ``_PARABOLIC``; else nine points, with all other parameters fitted.

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

    The root of the rise of -2 ln posterior, straight for a parabola, is interpolated
    between the points of each side. Where none of them rises so far, the interval ends
    at the bound, at most twice as far as the last.
    """
    sigma = math.sqrt(float(mode.covariance[i, i]))
    goal = math.sqrt(level)
    middle = float(mode.value[i])
    # all parameters on the ridge of the parabola, for one sigma of this one
    along = mode.covariance[:, i] / sigma
    least, most = _PARABOLIC[0] ** 2 * level, _PARABOLIC[1] ** 2 * level
    prior = problem.prior
    places = [mode.value + sign * goal * along for sign in (-1, 1)]
    inside = all(((x >= prior.low) & (x <= prior.high)).all() for x in places)
    if inside and all(least < problem.merit(x) - mode.merit < most for x in places):
        steps = np.array([-2.5, -1.96, -1.0, 0.0, 1.0, 1.96, 2.5])
        low, high = middle - goal * sigma, middle + goal * sigma
        return ProfileLikelihood(low, high, middle + steps * sigma, steps**2)
    ends, stops = [], list[FitSolution]()
    for bound in (float(prior.low[i]), float(prior.high[i])):
        side = _profile_side(problem, mode, i, bound, goal)
        rises = [stop.merit - mode.merit for stop in side]
        roots = np.sqrt(np.maximum.accumulate([0.0, *rises]))
        distance = [0.0, *(abs(float(stop.value[i]) - middle) for stop in side)]
        beyond = min(abs(bound - middle), 2 * distance[-1])
        end = float(np.interp(goal, roots, distance, right=beyond))
        ends.append(middle + math.copysign(end, bound - middle))
        stops += side
    points = ((float(stop.value[i]), stop.merit - mode.merit) for stop in stops)
    value, rise = np.array(sorted([(middle, 0.0), *points])).T
    return ProfileLikelihood(ends[0], ends[1], value, rise, tuple(stops))


def _profile_side(
    problem: FitProblem, mode: FitSolution, i: int, bound: float, goal: float
) -> list[FitSolution]:
    """Fits with parameter ``i`` fixed at the places of one side, until -2 ln posterior
    rises by the square of ``goal``.

    Args:
        bound: of the parameter on this side.
    """
    middle = float(mode.value[i])
    reach = goal * math.sqrt(float(mode.covariance[i, i]))
    stops = [mode]
    for place in _PLACES:
        distance = min(place * reach, abs(bound - middle))
        value = middle + math.copysign(distance, bound - middle)
        here = stops[-1]
        way = here.covariance[:, i] / here.covariance[i, i] * (value - here.value[i])
        fixed = problem.with_fixed(i, value)
        stops.append(fixed.fit(here.value + way, _PROFILE_FIT, here.slopes))
        if stops[-1].merit - mode.merit >= goal**2 or value == bound:
            break
    return stops[1:]


def shared_calibration(problem: FitProblem, mode: FitSolution) -> Array:
    """(p, p) covariance by errors of dark and flat, which all frames share.

    C AᵀW S W A C, with C the covariance of the fit, A its Jacobian, W weights and S the
    covariance of the pixels by these errors, less what the noise already contains.

    Args:
        problem: of the fit. mode: its solution.
    """
    noise, _, weight = pixel_weights(problem.data, mode.image)
    root = np.sqrt(weight) / noise
    shared = problem.data.shared(mode.image) * root
    spread = shared_error_scatter(mode.slopes * root, shared)
    return np.asarray(mode.covariance @ spread @ mode.covariance)


def mode_probabilities(modes: Sequence[FitSolution], spread: float = 1.0) -> Array:
    """(k,) probability of every mode by Laplace's rule.

    exp(-merit / 2) times the root of the determinant of its covariance, normalised.

    Args:
        modes: fits at the modes, best first.
        spread: factor of all variances.
    """
    log_mass = [
        np.linalg.slogdet(mode.covariance)[1] / 2 - mode.merit / (2 * spread)
        for mode in modes
    ]
    return np.asarray(special.softmax(log_mass))


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
    log_q = special.logsumexp(log_parts, axis=1, b=share)
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
    prior = task.prior
    spread = max(1.0, best.chi2_per_dof)
    reach = REACH * np.sqrt(spread * np.diag(best.covariance))
    # intervals: of the parabola, of the profiles, then over the other modes
    low, high = best.value - reach, best.value + reach
    for i, profile in profiles.items():
        low[i], high[i] = profile.low, profile.high
    for mode in modes[1:]:
        root = REACH**2 * spread - mode.merit + best.merit
        if root > 0:
            other = np.sqrt(root * np.diag(mode.covariance))
            low = np.minimum(low, mode.value - other)
            high = np.maximum(high, mode.value + other)
    ratio = np.array([best.value - low, high - best.value]) / reach
    close = (ratio > _PARABOLIC[0]) & (ratio < _PARABOLIC[1])
    parabolic = np.asarray(close.all(0))
    # errors of the calibration, added in quadrature
    common = REACH * np.sqrt(np.maximum(np.diag(calibration), 0.0))
    low = np.maximum(best.value - np.hypot(best.value - low, common), prior.low)
    high = np.minimum(best.value + np.hypot(high - best.value, common), prior.high)
    share = mode_probabilities(modes, spread)
    covariance = best.covariance * spread + calibration
    draws, size = np.empty((0, len(low))), 0.0
    if not parabolic.all() or share[0] < 0.99:
        stops = [stop for profile in profiles.values() for stop in profile.stops]
        draws, size = draw_posterior(problem, [*modes, *stops], spread=spread)
        rng = np.random.default_rng(1)
        shift = gaussian_draws(rng, len(draws), calibration)
        draws = np.clip(draws + shift, prior.low, prior.high)
        wider = (high - low) / (2 * REACH) / np.sqrt(np.diag(covariance))
        covariance = covariance * np.outer(wider, wider)
    named = {task.names[i]: profile for i, profile in profiles.items()}
    return FitPosterior(
        tuple(modes), share, low, high, parabolic, draws, size, named, covariance
    )


def posterior_text(names: Sequence[str], posterior: FitPosterior) -> list[str]:
    """Sentences on what the posterior leaves open: skewed intervals, second modes, few
    draws.

    Args:
        names: of the parameters.
        posterior: their posterior.
    """
    out = []
    for i, name in enumerate(names):
        if not posterior.parabolic[i]:
            out.append(
                f"{name} has a skewed posterior: 95 % within {posterior.low[i]:.3g} to "
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
