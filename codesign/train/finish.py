"""What a run reached: the network of every budget on test frames, on frames where only
blur tells depth, and why.
"""

import json
import math
from dataclasses import dataclass, replace
from typing import Any

from torch import Tensor

from codesign.batches import CALIBRATION, TEST, SceneSource
from codesign.gaze.bench import PeopleFrames
from codesign.network import blur, recalibrate_batch_norm
from codesign.train import ambiguity, assess, evolution, specialise
from codesign.train.assess import Predictions, SensorFrames
from codesign.train.depth_test import depth_response
from codesign.train.evolution import EvaluatedCandidate, EvolutionState
from codesign.train.inner import Trainer
from codesign.train.run import CodesignRun
from metalens.core.errors import TrainingError


def finish_budgets(run: CodesignRun) -> list[dict[str, Any]]:
    """The best of every budget on the test frames: one row a budget.

    Args:
        run: run with its model.

    Raises:
        TrainingError: a search has not ended.
    """
    return [end.row for end in finished_budgets(run)]


@dataclass(frozen=True, eq=False, slots=True)
class BudgetResult:
    """What a budget ended in.

    row: of the result. trainer: with the model that reached it, lens, pitch and weights
    of its own where that is asked for. seen, answers: test frames, and
    what the model said of them. interval_mm: (n,) half width of its 90 % intervals of
    the axial slippage; None of a
    network that gives none.
    """

    row: dict[str, Any]
    trainer: Trainer
    seen: SensorFrames
    answers: Predictions
    interval_mm: Tensor | None


def finished_budgets(run: CodesignRun) -> list[BudgetResult]:
    """The ends of :func:`finish_budgets`, a budget each.

    ``gaze_deg``: mean gaze error on people whom training never saw, by spherical-eye
    solver and residual regressor. ``pitch_um``: of its own lens and sensor.
    ``mmacs``: that run for a frame. A search holds its budget to the smooth count,
    beside which it may lie where the
    pitch does not divide the image, or a network's resolution the pixels.
    ``effective_pitch_um``: distance of the cells that the network sees: of pixels
    binned to its resolution.
    ``axial_coverage_90``: share of test frames within the network's calibrated 90 %
    interval, whose mean half width is
    ``axial_interval_mm``. ``window_depth_mm``: mean error of the depth of the windows.
    ``finer_axial_slip_mm``, ``finer_lateral_slip_mm``, ``finer_iou``: the same frames
    on
    an image formed at a quarter of the training tolerance, and ``finer_ratio`` of the
    axial errors: near 1 where the result does not depend on the tolerance.
    Batch statistics are measured on training frames through the final lens, never on
    those that are judged.
    """
    settings = run.settings
    people = specialise.people_of(run, TEST, settings.test_batches)
    shared: _Frames | None = None
    out = []
    for budget, best in _chosen(run):
        trainer = specialise.specialise_candidate(run, best.architecture, budget)
        if shared is None or settings.search.inner_steps:
            shared = _frames(replace(run, trainer=trainer), people)
        out.append(_end(replace(run, trainer=trainer), budget, best, people, shared))
    return out


@dataclass(frozen=True, eq=False, slots=True)
class _Frames:
    """Frames through one lens: tests by prefix of their columns, on the finer image, of
    people, to measure batch statistics on, to calibrate intervals with.
    """

    tests: dict[str, SensorFrames]
    fine: SensorFrames | None
    people: SensorFrames
    measured: list[Tensor]
    apart: SensorFrames
    response: SceneSource


def _frames(run: CodesignRun, people: PeopleFrames) -> _Frames:
    settings, trainer = run.settings, run.trainer
    tests = {"": assess.sensor_frames(trainer, run.scenes(TEST), settings.test_batches)}
    response: SceneSource = run.scenes(TEST)
    if settings.ambiguity_pairs:
        pairs = ambiguity.ambiguous_pairs(
            run.scenes(TEST), settings.ambiguity_pairs, settings.inner.seed
        )
        batches = max(1, len(pairs) // settings.inner.batch)
        tests["ambiguous_"] = assess.sensor_frames(trainer, pairs, batches)
        response = pairs
    return _Frames(
        tests,
        assess.finer_frames(trainer, run.scenes(TEST), settings.test_batches),
        specialise.frames_of(trainer, people),
        assess.training_frames(trainer),
        assess.sensor_frames(
            trainer, run.scenes(CALIBRATION), settings.validation_batches
        ),
        response,
    )


def _end(
    run: CodesignRun,
    budget: float,
    best: EvaluatedCandidate,
    people: PeopleFrames,
    shown: _Frames,
) -> BudgetResult:
    """The row of one budget; ``run`` holds the trainer that reached it."""
    settings, trainer, architecture = run.settings, run.trainer, best.architecture
    net, inner = trainer.model.net, settings.inner
    recalibrate_batch_norm(net, architecture, shown.measured)
    row: dict[str, Any] = {
        "budget_mmacs": budget,
        "mmacs": run.macs(architecture) / 1e6,
    }
    pitch = float(trainer.model.pitch_um.detach())
    row["pitch_um"], row["effective_pitch_um"] = pitch, pitch / architecture.resolution
    row["gaze_deg"] = specialise.gaze_error_deg(
        trainer, architecture, people, shown.people
    )
    reach = conformal_quantiles(
        assess.predict_frames(net, architecture, shown.apart, inner), shown.apart
    )
    plain = assess.predict_frames(net, architecture, shown.tests[""], inner)
    for name, seen in shown.tests.items():
        answers = (
            assess.predict_frames(net, architecture, seen, inner) if name else plain
        )
        row |= _errors(name, answers, seen) | uncertainty_summary(
            name, answers, seen, reach
        )
    if shown.fine is not None:
        on_fine = assess.predict_frames(net, architecture, shown.fine, inner)
        row |= _errors("finer_", on_fine, shown.fine)
        row["finer_ratio"] = row["finer_axial_slip_mm"] / row["axial_slip_mm"]
    response = depth_response(
        trainer,
        shown.response,
        net,
        architecture,
        batches=max(1, settings.test_batches // 4),
    )
    row["depth_response_mm_per_mm"] = response.mean
    row["depth_response_error"] = response.standard_error
    row["architecture"] = json.loads(evolution.state_to_json(EvolutionState((best,))))[
        "history"
    ][0]
    return BudgetResult(row, trainer, shown.tests[""], plain, _wide(plain, reach))


def _chosen(run: CodesignRun) -> list[tuple[float, EvaluatedCandidate]]:
    settings = run.settings
    if len(run.searches) < len(settings.run.budgets_mmacs):
        raise TrainingError(
            f"{len(run.searches)} of {len(settings.run.budgets_mmacs)} searches are "
            "done; resume the run"
        )
    return [
        (b, evolution.best_candidate(s.history))
        for b, s in zip(settings.run.budgets_mmacs, run.searches, strict=True)
    ]


def _errors(
    name: str, answers: Predictions, seen: SensorFrames
) -> dict[str, float | None]:
    error = (answers.slip_mm - seen.slip_mm).abs().mean(0)
    shared = float(answers.iou.mean())
    return {
        f"{name}axial_slip_mm": float(error[2]),
        f"{name}lateral_slip_mm": float(error[:2].mean()),
        f"{name}iou": shared
        if shared == shared
        else None,  # a network without a mask has none
    }


def conformal_quantiles(
    answers: Predictions, seen: SensorFrames, *, share: float = 0.9
) -> float | None:
    """Half width, in its own standard deviations, of the interval that holds this share
    of the axial slippages.

    From frames that training, search and test never use: with them the network's
    uncertainty is calibrated (split conformal prediction).

    Args:
        answers: of the network. seen: frames of the sensor with their truth.
    """
    if answers.slip_sd_mm is None:
        return None
    ratio = (answers.slip_mm - seen.slip_mm)[:, 2].abs() / answers.slip_sd_mm[:, 2]
    rank = min(
        math.ceil(share * (len(ratio) + 1)), len(ratio)
    )  # conformal: holds whatever the distribution
    return float(ratio.sort().values[rank - 1])


def _wide(answers: Predictions, reach: float | None) -> Tensor | None:
    """(n,) half width of the 90 % intervals of the axial slippage."""
    return (
        None
        if answers.slip_sd_mm is None or reach is None
        else reach * answers.slip_sd_mm[:, 2]
    )


def uncertainty_summary(
    name: str, answers: Predictions, seen: SensorFrames, reach: float | None
) -> dict[str, float]:
    """Coverage and width of the 90 % intervals of the slippage, and depth error of the
    windows.

    Args:
        name: prefix of the keys. answers: of the network.
        seen: frames of the sensor with their truth.
        reach: conformal quantile, in standard deviations.
    """
    row: dict[str, float] = {}
    if (wide := _wide(answers, reach)) is not None:
        row[f"{name}axial_coverage_90"] = float(
            ((answers.slip_mm - seen.slip_mm)[:, 2].abs() <= wide).float().mean()
        )
        row[f"{name}axial_interval_mm"] = float(wide.mean())
    if answers.depth is not None and seen.vergence is not None:
        miss = blur.depth_mm(answers.depth[:, 0]) - blur.depth_mm(seen.vergence)
        row[f"{name}window_depth_mm"] = float(miss.abs().mean())
    return row
