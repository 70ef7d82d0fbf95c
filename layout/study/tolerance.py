"""What the spread of the process does to a lens: effect of each cause, and Monte Carlo
with confidence bands.
"""

from dataclasses import dataclass

import numpy as np

from layout.process.process import Process
from layout.study.focus import FocusWindow, focus_window, prepare_focus
from layout.study.sensitivity import compute_sensitivities
from layout.study.spread_model import SpreadModel, reduce_spread, reduction_error
from metalens.core import executor, threads
from metalens.core.arrays import Array
from metalens.core.errors import ProcessError
from metalens.fabrication import (
    Draw,
    ResponseRates,
    State,
    draw_lenses,
    pair_sensitivities,
)
from metalens.lens import Lens, reach
from metalens.psf import encircled_power, find_peak, fwhm

# of the finite difference in the paper's Eq. 11 in the range of depths: 0.2 mm from 16
# to 26 mm
STEPS = 50
_BATCH = 25


@dataclass(frozen=True, eq=False)
class ToleranceOutcome:
    """Quantities of the study for draws of the process; the first axis counts them.

    strehl: (draws,) peak at the design depth relative to the nominal lens. efficiency:
    (draws,) focusing efficiency: power within a circle of three FWHM over power on the
    aperture. psf_change: (draws,) relative L2 change of the PSF at the design depth
    from the nominal PSF. information: (draws, depths) axial Fisher information of the
    normalised PSF (paper Eq. 11), 1 / um^2. psf: (draws, x) intensity along x through
    the middle at the design depth, 1 at the nominal peak.
    """

    strehl: Array
    efficiency: Array
    psf_change: Array
    information: Array
    psf: Array


@dataclass(frozen=True)
class CauseEffect:
    """One cause at its standard deviation; for each number the worse of both signs.

    phase_rad: rms change of the pillars' phases about their mean. strehl, efficiency,
    information (summed over the depths): relative change. psf: relative L2 change.
    """

    cause: str
    deviation: float
    phase_rad: float
    strehl: float
    efficiency: float
    psf: float
    information: float


@dataclass(frozen=True, eq=False)
class ToleranceReport:
    """Result of :func:`analyse_tolerance`.

    effects: of each cause alone. nominal: the lens as designed (one draw). draws: Monte
    Carlo. depths_um: of the information, by differences over step_um. window: of the
    sensor where the PSFs are evaluated. rank: dimensions of the space of t(D). error:
    largest rms relative error of t over the pillars in any draw.
    """

    effects: tuple[CauseEffect, ...]
    nominal: ToleranceOutcome
    draws: ToleranceOutcome
    depths_um: Array
    step_um: float
    window: FocusWindow
    rank: int
    error: float
    seed: int

    def band(self, name: str, percent: tuple[float, ...] = (5, 50, 95)) -> Array:
        """(percent, ...) percentiles of a quantity of :class:`ToleranceOutcome` over
        the draws.
        """
        return np.asarray(np.percentile(getattr(self.draws, name), percent, axis=0))


def analyse_tolerance(
    lens: Lens,
    process: Process,
    *,
    sens: ResponseRates | None = None,
    depths_um: tuple[float, ...] = (),
    draws: int = 100,
    seed: int = 0,
) -> ToleranceReport:
    """Effect of each cause at its standard deviation, and Monte Carlo over all of them.

    The causes are those of ``process.spread``.

    Args:
        lens: as designed.
        process: spread.
        sens: sensitivities to height, wall and index; None: from the RCWA solver.
        depths_um: of the axial information; left out: both ends and the middle of the
            depths at which the lens blurs (:mod:`metalens.lens.reach`). The design
            source is always studied too.
        draws: of the Monte Carlo.
        seed: of the draws.

    Accuracy: see ``error`` of the report (measured); bands of percentiles carry the
    sampling error of ``draws``.

    Raises:
        ProcessError: fewer than 10 draws, or a spread that pillars of this shape cannot
            have.
    """
    if draws < 10:
        raise ProcessError(f"draws = {draws}: need 10 or more for confidence bands")
    process.spread.check(lens.cell)
    if sens is None:
        sens = (
            compute_sensitivities(lens)
            if lens.pairs is None
            else pair_sensitivities(lens)[lens.light]
        )
    nearest_um, farthest_um = reach.depth_range_um(lens)
    depths_um = depths_um or (nearest_um, (nearest_um + farthest_um) / 2, farthest_um)
    step_um = (farthest_um - nearest_um) / STEPS
    all_depths_um = np.array(
        [
            lens.source_distance_um,
            *(
                evaluated
                for depth in depths_um
                for evaluated in (depth, depth + step_um)
            ),
        ]
    )
    focus = prepare_focus(lens, focus_window(lens, depths_um=all_depths_um))
    model = reduce_spread(lens, sens, focus, process.spread, seed=seed)
    single = [
        Draw({name: sign * deviation})
        for name, deviation in process.spread.stated.items()
        for sign in (-1, 1)
    ]
    all_draws = [Draw({}), *single, *draw_lenses(process.spread, draws, seed=seed + 1)]
    outcome = _outcome(model, [draw.state() for draw in all_draws], step_um)
    nominal, single_outcomes, monte_carlo = (
        _part(outcome, part)
        for part in (
            slice(0, 1),
            slice(1, 1 + len(single)),
            slice(1 + len(single), None),
        )
    )
    effects = tuple(
        _effect(
            model,
            tuple(single[2 * n : 2 * n + 2]),
            _part(single_outcomes, slice(2 * n, 2 * n + 2)),
            nominal,
        )
        for n in range(len(single) // 2)
    )
    error = reduction_error(model, all_draws)
    return ToleranceReport(
        effects,
        nominal,
        monte_carlo,
        np.array(depths_um),
        step_um,
        focus.window,
        len(model.basis),
        error,
        seed,
    )


def _outcome(
    model: SpreadModel, lenses: list[State], step_um: float
) -> ToleranceOutcome:
    """Outcome of all lenses, in parallel batches; the first is the reference.

    Args:
        model: sums over the pillars.
        lenses: states of the process, the nominal state first.
        step_um: of the finite difference along depth.
    """
    with threads.one_blas_thread():  # as workers have
        reference = np.asarray(
            abs(model.focus.light(model.drawn(lenses[:1]))[0, 0]) ** 2
        )
    batches = [
        lenses[start : start + _BATCH] for start in range(0, len(lenses), _BATCH)
    ]
    parts = executor.gather_parallel(_outcome_of, (model, reference, step_um), batches)
    return ToleranceOutcome(
        *(np.concatenate(column) for column in zip(*parts, strict=True))
    )


def _outcome_of(
    about: tuple[SpreadModel, Array, float], lenses: list[State]
) -> tuple[Array, ...]:
    """Fields of :class:`ToleranceOutcome` of some lenses.

    The information is sum |d p / d z|^2 over the window, p the PSF of sum 1, by forward
    differences.

    Args:
        about: model, (y, x) intensity of the nominal lens at the design depth, and step
            of the depths in um.
        lenses: states of the process.
    """
    model, reference, step_um = about
    window = model.focus.window
    sample_um2 = float(np.diff(window.x_um[:2])[0] * np.diff(window.y_um[:2])[0])
    incident = model.count.sum() * model.focus.case.area_um2
    psf = abs(model.focus.light(model.drawn(lenses))) ** 2
    at_design = psf[:, 0]
    normalised = psf[:, 1:] / psf[:, 1:].sum((2, 3), keepdims=True)
    steps = (normalised[:, 1::2] - normalised[:, ::2]) / step_um
    peaks = [find_peak(image) for image in at_design]
    powers = [  # within a circle of three FWHM about the peak
        encircled_power(image, peak, 1.5 * fwhm(image, 1.0))
        for image, peak in zip(at_design, peaks, strict=True)
    ]
    return (
        np.array([peak for *_, peak in peaks]) / find_peak(reference)[2],
        np.array(powers) * sample_um2 / incident,
        np.sqrt(((at_design - reference) ** 2).sum((1, 2)) / (reference**2).sum()),
        (steps**2).sum((2, 3)),
        at_design[:, len(window.y_um) // 2] / reference.max(),
    )


def _part(outcome: ToleranceOutcome, rows: slice) -> ToleranceOutcome:
    """The outcome of some draws."""
    return ToleranceOutcome(*(values[rows] for values in vars(outcome).values()))


def _effect(
    model: SpreadModel,
    signs: tuple[Draw, ...],
    outcome: ToleranceOutcome,
    nominal: ToleranceOutcome,
) -> CauseEffect:
    """Effect of one cause: for each number the worse of both signs.

    Args:
        model: sums over the pillars.
        signs: draws of minus and plus one standard deviation.
        outcome: of both draws.
        nominal: outcome of the designed lens.
    """
    ((cause, deviation),) = signs[1].amounts.items()

    def worst(values: Array, reference: Array) -> float:
        return float(abs(values / reference - 1).max())

    return CauseEffect(
        cause=cause,
        deviation=deviation,
        phase_rad=max(_phase_change_rad(model, draw.state()) for draw in signs),
        strehl=worst(outcome.strehl, nominal.strehl),
        efficiency=worst(outcome.efficiency, nominal.efficiency),
        psf=float(outcome.psf_change.max()),
        information=worst(outcome.information.sum(1), nominal.information.sum(1)),
    )


def _phase_change_rad(model: SpreadModel, state: State) -> float:
    """Rms change of phase about its mean over the pillars.

    Pillars are evaluated at 64 places spread evenly over the aperture (golden angle).

    Args:
        model: kinds of pillars and their numbers.
        state: of the process.
    """
    radius = np.sqrt((np.arange(64) + 0.5) / 64)
    angle = np.arange(64) * np.pi * (3 - np.sqrt(5))
    u, v = radius * np.cos(angle), radius * np.sin(angle)
    designed = model.curve(np.zeros(1), State.of())
    changed = model.curve(state.bias_um(u, v), state)
    weight = np.broadcast_to(model.count, changed.shape) / (model.count.sum() * len(u))
    ratio = changed / designed * np.exp(1j * state.phase_rad(u, v))[:, None]
    ratio = ratio * np.exp(-1j * np.angle((ratio * weight).sum()))
    return float(np.sqrt((np.angle(ratio) ** 2 * weight).sum()))
