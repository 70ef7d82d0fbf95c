"""Bench captures and a design to the as-built lens: every mode of the posterior, checked
and explained.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from characterize.captures import Capture, SensorNoise, to_electrons
from characterize.inference import (
    identifiability,
    multistart,
    uncertainty,
    unmodelled_effects,
    verdict,
)
from characterize.inference.asbuilt import AsBuilt, WithinModel
from characterize.inference.frame_alignment import (
    FrameArrangement,
    arrangement_text,
    find_arrangement,
    rearrange_frames,
)
from characterize.inference.leastsquares import FitSolution, gaussian_draws
from characterize.inference.multistart import SearchTask, with_values
from characterize.inference.prepare import (
    check_depths,
    check_enough,
    correct_quantization,
    data_of,
    merge_exposures,
    quick_enough,
    roughly_known,
    setting_of,
    stated_priors,
)
from characterize.inference.uncertainty import FitPosterior
from characterize.inference.unmodelled_effects import (
    ResidualFinding,
    ScoreTest,
    ScoreTests,
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
from metalens.core.errors import FitError, FitRefused
from metalens.fabrication import Sensitivity
from metalens.lens import Lens

LIKENESS = 0.45
# fitted too where the usual parameters do not explain the frames
EXTRA = (
    "bias_a_nm", "bias_o_nm", "bandwidth_nm", "tilt_x_deg", "tilt_y_deg", "pinhole_um",
    "pixel_percent",
)  # fmt: skip
# fits with rounded counts: at most so many, until none moves by more sigma
_ROUNDS, _STAYS = 5, 0.1
# a solution, its score tests, and stated values that it contradicts
Looked = tuple[FitSolution, ScoreTests, list[ResidualFinding]]
# chi-square a pixel of frames left out, over noise and uncertainty of the prediction
_HELD_OUT = 1.25


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
    response = response or log_response_slopes(lens, names=_spoken_of(options))
    model = ForwardModel(lens, setting, response)
    start = parameter_vector({name: k.value for name, k in known.items()})
    scan_um = options.scan_um
    if scan_um is None:
        scan_um = 0.12 * float(np.median(setting.depth_um))
    arrangement = find_arrangement(
        model, data, scan_um=scan_um, start=start, reach_um=_reach_um(known, lens)
    )
    _check_likeness(arrangement, lens)
    whole = SearchTask(model, data, start, known, arrangement, options.free, sizes)
    task = multistart.choose_orientation(
        [
            _arranged(whole, candidate)
            for candidate in (arrangement, *arrangement.others)
        ]
    )
    cautions = [
        *frames.corrections,
        *arrangement_text(task.arrangement or arrangement),
        *verdict.spectrum_text(lens, known),
    ]
    cautions += roughly_known(lens, model.response)
    unbiased = multistart.starting_points(task, biases_nm=(0.0,))[0]
    fast = quick_enough(task.model, task.data, unbiased)
    task = dataclasses.replace(task, model=fast)
    task, ends = _ends(task, frames.gain, cautions)
    task, ends = multistart.place_windows(task, ends)
    task, ends = _unrounded(task, ends, frames.gain)
    task, ends, looked = _with_likely_causes(task, ends, frames.gain, cautions)
    score_tests = looked[1].tests if looked else []
    _refuse(_problems(task, ends[0], frames.gain), options, score_tests)
    posterior = uncertainty.explore_posterior(task, ends, frames.gain)
    doubts = looked[2] if looked else []
    if looked is None or posterior.best is not looked[0]:
        looked = (
            posterior.best,
            unmodelled_effects.run_score_tests(task, posterior.best),
            doubts,
        )
    cautions += verdict.quantization_text(frames.gain, whole=frames.count_e > 0)
    result = _result(capture, task, posterior, cautions, frames.gain, looked)
    _refuse(result.problems, options, score_tests)
    return result


def _reach_um(known: dict[str, KnownValue], lens: Lens) -> float:
    """Half the range of distances to scan, um: two prior sigma, within the bounds."""
    prior = multistart.prior_of(("distance_um",), known, lens)
    return float(min(2 * prior.sigma[0], prior.high[0]))


def _refuse(
    problems: Sequence[str], options: FitOptions, score_tests: list[ScoreTest]
) -> None:
    """Raise FitRefused with the problems and the causes the residuals lean to."""
    if problems and not options.insist:
        leaning = (
            finding.words for finding in unmodelled_effects.score_test_text(score_tests)
        )
        reasons = dict.fromkeys([*problems, *leaning])  # each once
        raise FitRefused("fit refused: " + "; ".join(reasons))


def _ends(
    task: SearchTask, gain: SensorNoise, cautions: list[str]
) -> tuple[SearchTask, list[FitSolution]]:
    """Modes of the usual parameters, or with ``EXTRA`` where these do not fit.

    The extra parameters stay only where chi-square falls by 3 % or more.
    """
    task, ends = multistart.search_modes(task)
    if verdict.is_chi_square_consistent(ends[0], gain) or set(EXTRA) <= set(task.names):
        return task, ends
    extended = dataclasses.replace(task, free=(*task.free, *EXTRA))
    begin = task.all_of(ends[0].value)
    try:
        wider = multistart.search_modes(extended, begins=[begin])
    except FitError:
        return task, ends
    if wider[1][0].chi2_per_dof >= 0.97 * ends[0].chi2_per_dof:
        return task, ends
    cautions.append(
        f"the usual parameters did not explain the frames: {', '.join(EXTRA)} fitted too"
    )
    return wider


def _unrounded(
    task: SearchTask, ends: list[FitSolution], gain: SensorNoise
) -> tuple[SearchTask, list[FitSolution]]:
    """The fit with the likelihood of rounded counts, where rounding matters.

    Repeated with the correction at the last fit, until no parameter moves.
    """
    if not (gain.coarse and task.data.count_e):
        return task, ends
    counts = task.data
    for _ in range(_ROUNDS):
        task = dataclasses.replace(
            task, data=correct_quantization(counts, ends[0].image)
        )
        before = ends[0]
        ends = multistart.distinct_modes(
            [multistart.refine_fit(task, end.value) for end in ends]
        )
        off = (ends[0].value - before.value) / np.sqrt(np.diag(ends[0].covariance))
        if np.abs(off).max() < _STAYS:
            break
    return task, ends


def _with_likely_causes(
    task: SearchTask, ends: list[FitSolution], gain: SensorNoise, cautions: list[str]
) -> tuple[SearchTask, list[FitSolution], Looked | None]:
    """The task with the parameters of likely causes (:func:`unmodelled_effects.to_fit`) freed.

    At most four, one after the other, each the largest fall of the misfit.

    Returns:
        (task, its modes, (solution, score tests, contradicted statements)); the last is
        None without a known gain.
    """
    if not gain.known:
        return task, ends, None
    tests = unmodelled_effects.run_score_tests(task, ends[0])
    doubts = list[ResidualFinding]()
    for _ in range(4):  # causes, one after the other
        if not ends[0].converged:
            break
        falls = _falls(task, ends[0], tests.tests)
        cause = next((test for _, test in falls if not test.stated), None)
        if cause is None:
            break
        extended = dataclasses.replace(task, free=(*task.free, *cause.frees))
        wider = multistart.widen_search(extended, task.all_of(ends[0].value))
        if not wider or wider[0].merit > ends[0].merit:
            break
        fall = ends[0].merit - wider[0].merit
        cautions.append(
            f"{cause.cause} explains the frames better (chi-square falls by "
            f"{fall:.0f}): {', '.join(cause.frees)} fitted too"
        )
        doubts += _contradicted(cause, falls)
        task, ends = extended, wider
        tests = unmodelled_effects.run_score_tests(task, ends[0])
    return task, ends, (ends[0], tests, doubts)


def _falls(
    task: SearchTask,
    best: FitSolution,
    score_tests: list[ScoreTest],
    *,
    out_of_bounds: float = 10.0,
) -> list[tuple[float, ScoreTest]]:
    """(fall of the misfit, cause) of causes whose parameters explain the frames better.

    Largest first. A cause must lower -2 ln L by half of its score-test chi-square, or,
    where a parameter ran to its bound, by ``out_of_bounds``.
    """
    stuck = bool(verdict.at_bounds(task.names, best, task.prior))
    falls: list[tuple[float, ScoreTest]] = []
    for cause in unmodelled_effects.to_fit(score_tests, stuck=stuck):
        fall = best.merit - multistart.merit_with(task, best, cause.frees)
        if fall > (out_of_bounds if stuck else cause.chi2 / 2):
            falls.append((fall, cause))
    return sorted(falls, key=lambda pair: -pair[0])


def _contradicted(
    fitted: ScoreTest, falls: list[tuple[float, ScoreTest]]
) -> list[ResidualFinding]:
    """Statements without an error that contradict the frames.

    Were one wrong, it would explain the frames about as well as the cause that is
    ``fitted`` in its place.
    """
    largest = next(fall for fall, cause in falls if cause is fitted)
    return [
        ResidualFinding(
            f"{test.cause} would explain the frames about as well as {fitted.cause} "
            f"({math.sqrt(fall):.1f} sigma: chi-square falls by {fall:.0f}), but "
            f"{', '.join(test.frees)} is fixed as stated: state it with its error, or "
            "mend the bench",
            math.sqrt(fall),
        )
        for fall, test in falls
        if test.stated and fall > largest - multistart.MODES_WITHIN
    ]


def _spoken_of(options: FitOptions) -> set[str]:
    """Parameters that the options free or know."""
    return {*options.free, *(k.name for k in options.known)}


def _check_likeness(arrangement: FrameArrangement, lens: Lens) -> None:
    if arrangement.likeness < LIKENESS:
        raise FitRefused(
            f"fit refused: the frames look like no image of this lens (best correlation {arrangement.likeness:.2f}); "
            f"they are of another lens than this {lens.profile} one, far from the stated depths, or dark"
        )


def _arranged(task: SearchTask, arrangement: FrameArrangement) -> SearchTask:
    """The task with its frames in an arrangement, and its window fixed at the light."""
    sideways = arrangement.clearly and arrangement.orientation % 2 == 1
    model = task.model.exchanged() if sideways else task.model
    model = model.about(multistart.window_um(arrangement, model))
    return dataclasses.replace(
        task,
        model=model,
        data=task.data.arranged(lambda part: rearrange_frames(part, arrangement)),
        arrangement=arrangement,
    )


def _result(
    capture: Capture,
    task: SearchTask,
    posterior: FitPosterior,
    cautions: list[str],
    gain: SensorNoise,
    looked: Looked,
) -> AsBuilt:
    """The as-built lens of a posterior, with its checks, intervals and texts.

    Errors of causes that nobody stated widen covariance and intervals.

    Args:
        looked: (solution, its score tests, contradicted statements).
    """
    _, tests, doubts = looked
    model, data, names = task.model, task.data, task.names
    solution, value = posterior.best, posterior.best.value
    fitted = dict(zip(names, value.tolist(), strict=True))
    held_out = verdict.hold_out_chi_square(task, solution)
    unstated = tests.shifts()
    findings = [*_findings(task, solution, tests), *doubts]
    # intervals about the value less the expected shift, widened by its spread
    centre = value - unstated.mean
    more = uncertainty.REACH * unstated.spread
    low = np.minimum(centre - np.hypot(value - posterior.low, more), posterior.low)
    high = np.maximum(centre + np.hypot(posterior.high - value, more), posterior.high)
    prior_share = (posterior.high - posterior.low) / (2 * uncertainty.REACH)
    cautions = [*cautions, *(finding.words for finding in findings)]
    if gain.known and held_out > _HELD_OUT:
        cautions.append(
            f"frames left out are predicted with chi-square {held_out:.2f} a pixel, not "
            "1: do not extrapolate"
        )
    return AsBuilt(
        design=model.lens,
        response=model.response,
        names=names,
        value=value,
        covariance=posterior.covariance + unstated.covariance,
        information=solution.information,
        held={
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
            *verdict.held_back(names, solution, task.prior),
            *unmodelled_effects.decisive_findings(findings),
        ),
        low=low,
        high=high,
        draws=_drawn(task, posterior.draws, unstated),
        within=WithinModel(
            posterior.covariance, posterior.low, posterior.high, posterior.draws
        ),
        curves={
            name: np.stack([profile.value, profile.rise])
            for name, profile in posterior.profiles.items()
        },
        verdicts=(
            verdict.psf_verdict(task, posterior, held_out),
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


def _drawn(task: SearchTask, draws: Array, unstated: UnmodelledShifts) -> Array:
    """Draws with the shifts by unstated effects; none where there are none."""
    if not len(draws):
        return draws
    shifted = draws + gaussian_draws(
        np.random.default_rng(2), len(draws), unstated.covariance
    )
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
    task: SearchTask, solution: FitSolution, looked: ScoreTests
) -> list[ResidualFinding]:
    """Findings in the residuals: correlated structure, and causes that they lean to.

    Residuals are scaled to unit chi-square, as the noise may be more than its model.
    """
    data = task.data
    residual = solution.residual_sigma / math.sqrt(solution.chi2_per_dof)
    noise = np.sqrt(data.variance(solution.image))
    shared = data.shared(solution.image) / noise
    structure = verdict.correlated_residuals_text(
        np.where(data.saturated, 0.0, residual), shared
    )
    return [*structure, *unmodelled_effects.score_test_text(looked.tests)]


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
