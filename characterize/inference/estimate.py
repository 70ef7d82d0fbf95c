"""Bench captures and a design to the as-built lens: every mode of the posterior, checked
and explained.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from characterize.captures import Capture, SensorNoise, orient_frames, to_electrons
from characterize.inference import (
    identifiability,
    multistart,
    uncertainty,
    unmodelled_effects,
    verdict,
)
from characterize.inference.asbuilt import AsBuilt, PosteriorMoments
from characterize.inference.frame_alignment import arrangement_text, find_arrangement
from characterize.inference.leastsquares import REACH, FitSolution, gaussian_draws
from characterize.inference.multistart import SearchTask, with_values
from characterize.inference.prepare import (
    check_depths,
    check_enough,
    data_of,
    merge_exposures,
    setting_of,
    stated_priors,
)
from characterize.inference.uncertainty import FitPosterior
from characterize.inference.unmodelled_effects import (
    ResidualFinding,
    ScoreTest,
    UnmodelledShifts,
)
from characterize.model import (
    NAMES,
    PLACE,
    ForwardModel,
    KnownValue,
    log_response_slopes,
    parameter_vector,
    unfitted_sizes,
    usual_parameters,
)
from metalens.core import threads
from metalens.core.arrays import Array
from metalens.core.errors import FitRefused
from metalens.fabrication import Sensitivity
from metalens.lens import Lens

_ROUGH = 0.1  # relative error of the slopes of pillars above which it is said
_DECISIVE = 5.0  # significance of findings in residuals that cost the trust
# score tests, shifts by unstated effects, and stated values that the frames contradict
ResidualAnalysis = tuple[list[ScoreTest], UnmodelledShifts, list[ResidualFinding]]


@dataclass(frozen=True, slots=True)
class FitOptions:
    """How to fit.

    free: parameters to fit beyond the usual ones. known: metrology, as priors.
    window: largest side in pixels of what is fitted. scan_um: half range of the
    stage-zero search.
    insist: return a result that fails its checks (problems filled) instead of refusing
    it.
    """

    free: tuple[str, ...] = ()
    known: tuple[KnownValue, ...] = ()
    window: int = 48
    scan_um: float | None = None
    insist: bool = False


def fit(
    capture: Capture,
    lens: Lens,
    options: FitOptions | None = None,
    *,
    response: Sensitivity | None = None,
) -> AsBuilt:
    """The as-built lens behind a capture.

    Args:
        options: free parameters, stated values, window and search range.
        response: what height, index and sidewall do to the pillars; from the cell
            solvers without it.

    Raises:
        CaptureError: depths, pixel or wavelength missing, or frames unusable.
        FitError: refused, with the cause: another lens, a model that cannot explain the
            frames, a parameter at its
            bound, no convergence.
    """
    # matrices are small: more BLAS threads only occupy cores
    with threads.one_blas_thread():
        return _fit(capture, lens, options or FitOptions(), response)


def _fit(
    capture: Capture, lens: Lens, options: FitOptions, response: Sensitivity | None
) -> AsBuilt:
    """:func:`fit` in its steps, on one BLAS thread.

    Prepare the frames, find their arrangement, search the modes, free the parameters
    of likely causes, explore the posterior, check. Problems are refused before and
    after the posterior.
    """
    capture, frames = merge_exposures(capture, to_electrons(capture))
    setting, window = setting_of(capture, options.window)
    check_depths(setting.depth_um, lens)
    data = data_of(frames, window)
    known = {k.name: k for k in (*stated_priors(capture, lens), *options.known)}
    sizes = unfitted_sizes(known, lens)
    check_enough(data, multistart.names_of(known, options.free))
    # what is as designed needs no slope
    changed = (k.name for k in options.known if k.value or k.sigma)
    stated = {*options.free, *changed}
    response = response or log_response_slopes(lens, names=stated)
    model = ForwardModel(lens, setting, response)
    start = parameter_vector({name: k.value for name, k in known.items()})
    scan_um = options.scan_um
    if scan_um is None:
        scan_um = 0.12 * float(np.median(setting.depth_um))
    # two prior sigma, within the bounds
    prior = multistart.prior_of(("distance_um",), known, lens)
    reach_um = float(min(2 * prior.sigma[0], prior.high[0]))
    arrangement = find_arrangement(
        model, data, start, scan_um=scan_um, reach_um=reach_um
    )
    task = SearchTask(
        model.about(arrangement.middle_um),
        data.arranged(lambda part: orient_frames(part, arrangement.orientation)),
        start,
        known,
        options.free,
        sizes,
    )
    cautions = [
        *frames.corrections,
        *arrangement_text(arrangement),
        *verdict.spectrum_text(lens, known),
    ]
    if model.response.error > _ROUGH:
        cautions.append(
            "slopes of the pillars by height and index are known to "
            f"{model.response.error:.0%} only"
        )
    task, ends = multistart.search_modes(task, arrangement)
    task, ends = multistart.place_windows(task, ends)
    task, ends, analysis = _with_likely_causes(task, ends, frames.gain, cautions)
    _refuse(_problems(task, ends[0], frames.gain), options, analysis[0])
    posterior = uncertainty.explore_posterior(task, ends, frames.gain)
    if posterior.best is not ends[0]:
        tests, shifts = unmodelled_effects.run_score_tests(task, posterior.best)
        analysis = tests, shifts, analysis[2]
    result = _result(capture, task, posterior, cautions, frames.gain, analysis)
    _refuse(result.problems, options, analysis[0])
    return result


def _refuse(
    problems: Sequence[str], options: FitOptions, score_tests: list[ScoreTest]
) -> None:
    """Raise FitRefused with the problems and the effects that score tests name."""
    if problems and not options.insist:
        leaning = (
            finding.words for finding in unmodelled_effects.score_test_text(score_tests)
        )
        reasons = dict.fromkeys([*problems, *leaning])  # each once
        raise FitRefused("fit refused: " + "; ".join(reasons))


def _with_likely_causes(
    task: SearchTask, ends: list[FitSolution], gain: SensorNoise, cautions: list[str]
) -> tuple[SearchTask, list[FitSolution], ResidualAnalysis]:
    """The task with the parameters of likely causes freed
    (:func:`unmodelled_effects.effects_to_fit`).

    At most four, one after the other, each the largest fall of the misfit; none without
    a known gain.
    """
    tests, shifts = unmodelled_effects.run_score_tests(task, ends[0])
    doubts = list[ResidualFinding]()
    for _ in range(4 if gain.known else 0):  # causes, one after the other
        if not ends[0].converged:
            break
        falls = _misfit_falls(task, ends[0], tests)
        cause = next((test for _, test in falls if not test.effect.stated), None)
        if cause is None:
            break
        frees = cause.effect.frees
        extended = dataclasses.replace(task, free=(*task.free, *frees))
        wider = multistart.widen_search(extended, task.all_of(ends[0].value))
        if not wider or wider[0].merit > ends[0].merit:
            break
        extended, wider = multistart.widen_priors(extended, wider, frees)
        fall = ends[0].merit - wider[0].merit
        cautions.append(
            f"{cause.effect.cause} explains the frames better (chi-square falls by "
            f"{fall:.0f}): {', '.join(frees)} fitted too"
        )
        doubts += _contradicted_statements(cause, falls)
        task, ends = extended, wider
        tests, shifts = unmodelled_effects.run_score_tests(task, ends[0])
    return task, ends, (tests, shifts, doubts)


def _misfit_falls(
    task: SearchTask, best: FitSolution, score_tests: list[ScoreTest]
) -> list[tuple[float, ScoreTest]]:
    """(fall of the misfit, cause) of causes whose parameters explain the frames better.

    Largest first. A cause must lower -2 ln L by half of its score-test chi-square, or,
    where a parameter ran to its bound, by 10.
    """
    stuck = bool(verdict.at_bounds(task.names, best, task.prior))
    falls: list[tuple[float, ScoreTest]] = []
    for cause in unmodelled_effects.effects_to_fit(score_tests, stuck=stuck):
        fall = best.merit - multistart.merit_with(task, best, cause.effect.frees)
        if fall > (10.0 if stuck else cause.chi2 / 2):
            falls.append((fall, cause))
    return sorted(falls, key=lambda pair: -pair[0])


def _contradicted_statements(
    fitted: ScoreTest, falls: list[tuple[float, ScoreTest]]
) -> list[ResidualFinding]:
    """Statements without an error that contradict the frames.

    Were one wrong, it would explain the frames about as well as the cause that is
    ``fitted`` in its place.
    """
    largest = next(fall for fall, cause in falls if cause is fitted)
    return [
        ResidualFinding(
            f"{test.effect.cause} would explain the frames about as well as "
            f"{fitted.effect.cause} "
            f"({math.sqrt(fall):.1f} sigma: chi-square falls by {fall:.0f}), but "
            f"{', '.join(test.effect.frees)} is fixed as stated: state it with its error, or "
            "mend the bench",
            math.sqrt(fall),
        )
        for fall, test in falls
        if test.effect.stated and fall > largest - multistart.MODES_WITHIN
    ]


def _result(
    capture: Capture,
    task: SearchTask,
    posterior: FitPosterior,
    cautions: list[str],
    gain: SensorNoise,
    analysis: ResidualAnalysis,
) -> AsBuilt:
    """The as-built lens of a posterior, with its checks, intervals and texts.

    Errors of causes that nobody stated widen covariance and intervals.

    Args:
        analysis: score tests, shifts by unstated effects, contradicted statements.
    """
    tests, unstated, doubts = analysis
    model, data, names = task.model, task.data, task.names
    solution, value = posterior.best, posterior.best.value
    fitted = dict(zip(names, value.tolist(), strict=True))
    findings = [*_findings(task, solution, tests), *doubts]
    # about the joint optimum, never within the statistical interval
    centre = value - unstated.mean
    more = REACH * unstated.sigma
    low = np.minimum(centre - np.hypot(value - posterior.low, more), posterior.low)
    high = np.maximum(centre + np.hypot(posterior.high - value, more), posterior.high)
    # second moment about the value
    spread = unstated.covariance + np.outer(unstated.mean, unstated.mean)
    prior_share = (posterior.high - posterior.low) / (2 * REACH)
    cautions = [*cautions, *(finding.words for finding in findings)]
    return AsBuilt(
        design=model.lens,
        response=model.response,
        names=names,
        value=value,
        covariance=posterior.covariance + spread,
        information=solution.information,
        fixed={
            name: float(task.start[PLACE[name]]) for name in NAMES if name not in fitted
        },
        depth_um=model.setting.depth_um,
        angle_rad=model.setting.angle_rad,
        pixel_um=capture.pixel_um,
        measured=data.electrons,
        predicted=solution.image,
        nominal=_nominal(task, fitted),
        residual_sigma=solution.residual_sigma,
        chi2_per_dof=solution.chi2_per_dof,
        converged=solution.converged,
        reason=solution.reason,
        identifiable=tuple(
            identifiability.identifiable_combinations(
                names, solution.information, task.prior.sigma
            )
        ),
        degeneracies=(
            *uncertainty.posterior_text(names, posterior),
            *identifiability.correlated_pairs(
                names, posterior.covariance, task.prior.sigma
            ),
        ),
        cautions=tuple(cautions),
        problems=(
            *_problems(task, solution, gain),
            *verdict.bounds_text(names, solution, task.prior),
            *(finding.words for finding in findings if finding.sigma > _DECISIVE),
        ),
        low=low,
        high=high,
        draws=_drawn(task, posterior.draws, spread),
        within=PosteriorMoments(
            posterior.covariance, posterior.low, posterior.high, posterior.draws
        ),
        curves={
            name: np.stack([profile.value, profile.rise])
            for name, profile in posterior.profiles.items()
        },
        verdicts=(
            verdict.psf_verdict(task, posterior),
            verdict.process_verdict(
                usual_parameters(names, model.lens),
                low,
                high,
                prior_share / task.prior.sigma,
            ),
        ),
        causes=unstated.causes,
        by_cause=unstated.by_cause,
        bench=unstated.bench,
    )


def _drawn(task: SearchTask, draws: Array, spread: Array) -> Array:
    """Draws with the shifts by unstated effects; none where there are none."""
    if not len(draws):
        return draws
    shifted = draws + gaussian_draws(np.random.default_rng(2), len(draws), spread)
    return np.asarray(np.clip(shifted, task.prior.low, task.prior.high))


def _nominal(task: SearchTask, fitted: dict[str, float]) -> Array:
    """(n, y, x) electrons as designed, with the fitted gain, background, place and
    blur.
    """
    bench = {
        k: v
        for k, v in fitted.items()
        if k.startswith(("log_gain", "background", "decentre", "crosstalk"))
    }
    return task.model.images(with_values(task.start, bench))[0]


def _findings(
    task: SearchTask, solution: FitSolution, tests: list[ScoreTest]
) -> list[ResidualFinding]:
    """Findings in the residuals: correlated structure, and causes that they lean to.

    Residuals are scaled to unit chi-square, as the noise may be more than its model.
    """
    data = task.data
    residual = solution.residual_sigma / math.sqrt(solution.chi2_per_dof)
    noise = np.sqrt(data.variance(solution.image))
    structure = verdict.correlated_residuals_text(
        np.where(data.saturated, 0.0, residual), data.shared(solution.image)[1] / noise
    )
    return [*structure, *unmodelled_effects.score_test_text(tests)]


def _problems(task: SearchTask, solution: FitSolution, gain: SensorNoise) -> list[str]:
    """Reasons to refuse a solution, in words; empty where it passes."""
    problems = [
        *verdict.fit_problems(task.names, solution, gain),
        *verdict.too_quiet(solution, gain),
    ]
    clipped = float(task.data.saturated.mean())
    if problems and clipped > 0.1:
        problems.insert(
            0,
            f"{clipped:.0%} of the pixels are saturated: too little is left to fit; expose shorter",
        )
    return problems
