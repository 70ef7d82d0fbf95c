"""What a run reached: the network of every budget on test frames, on frames where only
blur tells depth, and what they show.
"""

import copy
import json
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from codesign.batches import CALIBRATION, TEST, VALIDATION, SceneSource
from codesign.gaze.bench import PeopleFrames
from codesign.network import blur, losses, recalibrate_batch_norm, smallest_architecture
from codesign.optics import stack as lens
from codesign.train import assess, evolution
from codesign.train.assess import Predictions, SensorFrames
from codesign.train.evolution import EvaluatedCandidate, EvolutionState
from codesign.train.run import CodesignRun
from codesign.train.search import people_of, specialise_candidate
from codesign.train.separability import depth_information
from codesign.train.trainer import Trainer
from metalens.core import report
from metalens.core.arrays import Array
from metalens.core.errors import TrainingError


@dataclass(frozen=True, eq=False, slots=True)
class BudgetResult:
    """Result of one compute budget.

    row: of the result. trainer: with the final model, lens, pitch and weights of its
    own where that is configured. seen, answers: test frames, and predictions for them.
    interval_mm: (n,) half width of the 90 % intervals of the axial slippage; None of a
    network without an uncertainty.
    """

    row: dict[str, Any]
    trainer: Trainer
    seen: SensorFrames
    answers: Predictions
    interval_mm: Tensor | None


def finished_budgets(run: CodesignRun) -> list[BudgetResult]:
    """Results of all budgets of a finished run; rows have these columns.

    ``gaze_deg``: mean gaze error on people whom training never used, by spherical-eye
    solver and residual regressor. ``pitch_um``: of its own lens and sensor.
    ``mmacs``: million multiply-accumulates of a frame. A search limits the smooth
    count, from which it differs where the pitch does not divide the image, or a
    network's resolution the pixels.
    ``effective_pitch_um``: spacing of the network's input: of pixels binned to its
    resolution.
    ``axial_coverage_90``: fraction of test frames within the network's calibrated 90 %
    interval, whose mean half width is ``axial_interval_mm``.
    ``window_depth_mm``: mean error of the depth of the windows.
    ``finer_axial_slip_mm``, ``finer_lateral_slip_mm``, ``finer_iou``: the same frames
    on an image formed at a quarter of the training tolerance, and ``finer_ratio`` of
    the axial errors: near 1 where the result does not depend on the tolerance.
    Batch statistics are measured on training frames through the final lens, never on
    test frames.
    """
    settings = run.settings
    people = people_of(run, TEST, settings.test_batches)
    frames: _TestFrames | None = None
    results = []
    for budget, best in _best_by_budget(run):
        trainer = specialise_candidate(run, best.architecture, budget)
        if frames is None or settings.search.inner_steps:
            frames = _test_frames(replace(run, trainer=trainer), people)
        results.append(
            _evaluate_budget(
                replace(run, trainer=trainer), budget, best, people, frames
            )
        )
    return results


@dataclass(frozen=True, eq=False, slots=True)
class _TestFrames:
    """Frames through one lens, for every budget that shares it.

    tests: by prefix of their columns. fine: on the finer image. people: for gaze.
    measured: to measure batch statistics on. apart: to calibrate intervals with.
    response: scenes of the depth response.
    """

    tests: dict[str, SensorFrames]
    fine: SensorFrames | None
    people: SensorFrames
    measured: list[Tensor]
    apart: SensorFrames
    response: SceneSource


def _test_frames(run: CodesignRun, people: PeopleFrames) -> _TestFrames:
    """Test, calibration and training frames through the run's present lens."""
    settings, trainer = run.settings, run.trainer
    tests = {"": assess.sensor_frames(trainer, run.scenes(TEST), settings.test_batches)}
    response: SceneSource = run.scenes(TEST)
    if settings.ambiguity_pairs:
        pairs = assess.ambiguous_pairs(
            run.scenes(TEST), settings.ambiguity_pairs, settings.inner.seed
        )
        batches = max(1, len(pairs.states) // settings.inner.batch)
        tests["ambiguous_"] = assess.sensor_frames(trainer, pairs, batches)
        response = pairs
    return _TestFrames(
        tests,
        assess.finer_frames(trainer, run.scenes(TEST), settings.test_batches),
        assess.frames_of(trainer, people),
        assess.training_frames(trainer),
        assess.sensor_frames(
            trainer, run.scenes(CALIBRATION), settings.validation_batches
        ),
        response,
    )


def _evaluate_budget(
    run: CodesignRun,
    budget: float,
    best: EvaluatedCandidate,
    people: PeopleFrames,
    frames: _TestFrames,
) -> BudgetResult:
    """Row of the result of one budget, with predictions; ``run`` holds its final
    trainer.

    Slippage and gaze errors, intervals, the finer image and the depth response.
    """
    settings = run.settings
    trainer = run.trainer
    architecture = best.architecture
    net, inner = trainer.model.net, settings.inner
    recalibrate_batch_norm(net, architecture, frames.measured)
    row: dict[str, Any] = {
        "budget_mmacs": budget,
        "mmacs": run.macs(architecture) / 1e6,
    }
    pitch_um = float(trainer.model.pitch_um.detach())
    row["pitch_um"] = pitch_um
    row["effective_pitch_um"] = pitch_um / architecture.resolution
    row["gaze_deg"] = assess.gaze_error_deg(
        trainer, architecture, people, frames.people
    )
    calibration = assess.predict_frames(net, architecture, frames.apart, inner)
    quantile = conformal_quantiles(calibration, frames.apart)
    test_predictions = assess.predict_frames(net, architecture, frames.tests[""], inner)
    for name, seen in frames.tests.items():
        predictions = (
            assess.predict_frames(net, architecture, seen, inner)
            if name
            else test_predictions
        )
        row |= _errors(name, predictions, seen) | uncertainty_summary(
            name, predictions, seen, quantile
        )
    if frames.fine is not None:
        fine_predictions = assess.predict_frames(net, architecture, frames.fine, inner)
        row |= _errors("finer_", fine_predictions, frames.fine)
        row["finer_ratio"] = row["finer_axial_slip_mm"] / row["axial_slip_mm"]
    response = assess.depth_response(
        trainer,
        frames.response,
        net,
        architecture,
        batches=max(1, settings.test_batches // 4),
    )
    row["depth_response_mm_per_mm"] = response.mean
    row["depth_response_error"] = response.standard_error
    state = json.loads(evolution.state_to_json(EvolutionState((best,))))
    row["architecture"] = state["history"][0]
    return BudgetResult(
        row,
        trainer,
        frames.tests[""],
        test_predictions,
        _half_widths_mm(test_predictions, quantile),
    )


def _best_by_budget(run: CodesignRun) -> list[tuple[float, EvaluatedCandidate]]:
    """(budget, best candidate of its search) of every budget.

    Raises:
        TrainingError: a search is missing.
    """
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
    prefix: str, predictions: Predictions, frames: SensorFrames
) -> dict[str, float | None]:
    """Mean axial and lateral slippage error in mm, and mask IoU; keys begin with
    ``prefix``.
    """
    error = (predictions.slip_mm - frames.slip_mm).abs().mean(0)
    iou = float(predictions.iou.mean())
    return {
        f"{prefix}axial_slip_mm": float(error[2]),
        f"{prefix}lateral_slip_mm": float(error[:2].mean()),
        # nan of a network without a mask
        f"{prefix}iou": iou if iou == iou else None,
    }


def conformal_quantiles(
    answers: Predictions, frames: SensorFrames, *, share: float = 0.9
) -> float | None:
    """Split-conformal quantile of |axial error| / predicted standard deviation.

    The interval of so many standard deviations contains ``share`` of the axial
    slippages, for any distribution of the errors. None of a network without an
    uncertainty.

    Args:
        answers: predictions for ``frames``. share: coverage of the interval.
        frames: of the sensor with labels, that training, search and test never use.
    """
    if answers.slip_sd_mm is None:
        return None
    ratio = (answers.slip_mm - frames.slip_mm)[:, 2].abs() / answers.slip_sd_mm[:, 2]
    rank = min(math.ceil(share * (len(ratio) + 1)), len(ratio))
    return float(ratio.sort().values[rank - 1])


def _half_widths_mm(answers: Predictions, reach: float | None) -> Tensor | None:
    """(n,) half width of the 90 % intervals of the axial slippage."""
    if answers.slip_sd_mm is None or reach is None:
        return None
    return reach * answers.slip_sd_mm[:, 2]


def uncertainty_summary(
    name: str, answers: Predictions, frames: SensorFrames, reach: float | None
) -> dict[str, float]:
    """Coverage and mean half width in mm of the 90 % intervals, and window depth error
    in mm.

    Columns that the network cannot give are left out.

    Args:
        name: prefix of the keys. answers: of the network.
        frames: frames of the sensor with their labels.
        reach: conformal quantile, in standard deviations.
    """
    row: dict[str, float] = {}
    if (half_width := _half_widths_mm(answers, reach)) is not None:
        axial_error = (answers.slip_mm - frames.slip_mm)[:, 2].abs()
        row[f"{name}axial_coverage_90"] = float(
            (axial_error <= half_width).float().mean()
        )
        row[f"{name}axial_interval_mm"] = float(half_width.mean())
    if answers.depth is not None and frames.vergence is not None:
        error = blur.depth_mm(answers.depth[:, 0]) - blur.depth_mm(frames.vergence)
        row[f"{name}window_depth_mm"] = float(error.abs().mean())
    return row


@torch.no_grad()
def run_pictures(run: CodesignRun) -> dict[str, bytes]:
    """PNG pictures by name: psf, frames, masks.

    The run stays as it is: masks come from a copy of the network, whose batch
    statistics are measured in evaluation mode on the frames that are shown.
    """
    trainer = run.trainer
    stack = lens.lens_psf_stack(trainer.optics, trainer.model.coefficients_rad)
    indices = torch.linspace(0, len(stack.depths_um) - 1, 6).long().tolist()
    titles = [f"{float(stack.depths_um[i]) * 1e-3:.0f} mm" for i in indices]
    pictures = {
        "psf": _picture_row(
            [stack.intensity[i].clamp_min(0).sqrt() for i in indices], titles
        )
    }
    frames = assess.sensor_frames(trainer, run.scenes(VALIDATION), 1)
    shown = min(6, len(frames.frames))
    pictures["frames"] = _picture_row(list(frames.frames[:shown, 0]), [""] * shown)
    net = copy.deepcopy(trainer.model.net)  # the run's own statistics must not move
    recalibrate_batch_norm(net, smallest_architecture(net.space), [frames.frames])
    logits = net(frames.frames, smallest_architecture(net.space)).mask_logits.cpu()
    if logits.numel():
        pictures["masks"] = _picture_row(
            list(torch.sigmoid(logits[:shown])), [""] * shown
        )
    return pictures


def _picture_row(images: list[Tensor], titles: list[str]) -> bytes:
    """PNG of images side by side with titles, in grey."""
    figure, _ = report.make_figure(size=(1.6 * len(images), 1.8))
    figure.clear()
    for k, (image, title) in enumerate(zip(images, titles, strict=True)):
        axes = figure.add_subplot(1, len(images), k + 1)
        axes.imshow(image.numpy(), cmap="gray")
        axes.set_title(title)
        axes.set_axis_off()
    return report.figure_png(figure)


@torch.no_grad()
def window_depth_bound(run: CodesignRun) -> dict[str, list[float]]:
    """Cramér-Rao bound, in mm, on the depth of one window from its blur, on axis, by
    depth.

    The window has 1/f texture and is as wide as the PSFs, with noise of a thousandth of
    its power; see :func:`codesign.train.separability.depth_information`.

    Args:
        run: run with its model.
    """
    stack = lens.lens_psf_stack(run.trainer.optics, run.trainer.model.coefficients_rad)
    information = depth_information(stack)
    depth_um = (stack.depths_um[1:] + stack.depths_um[:-1]) / 2
    return {
        "depth_mm": (1e-3 * depth_um).tolist(),
        "window_depth_mm": information.clamp_min(1e-12).rsqrt().tolist(),
    }


def predictions_of_frames(ends: list[BudgetResult], count: int) -> dict[str, Array]:
    """Arrays of the first test frames, with labels and the predictions of each network.

    Args:
        ends: one a compute budget. count: number of frames.

    Returns:
        frames (n, y, x) as the network sees them; pupil (n, y, x) and slip_um (n, 3),
        true; told_pupil (networks, n, y, x) probability, told_slip_um (networks, n, 3);
        interval_um (networks, n) half width of the 90 % interval of the distance, nan
        without one; window_um (n, windows, windows) true depth and told_window_um
        (networks, n, windows, windows). What no network predicts is left out.
    """
    frames = ends[0].seen
    predictions = [end.answers for end in ends]
    pixels = int(frames.frames.shape[-1])
    arrays = {
        "frames": frames.frames[:count, 0],
        "slip_um": 1e3 * frames.slip_mm[:count],
    }
    arrays["told_slip_um"] = torch.stack([1e3 * a.slip_mm[:count] for a in predictions])
    missing = torch.full((min(count, len(frames.frames)),), torch.nan)
    half_widths = [
        missing if end.interval_mm is None else 1e3 * end.interval_mm[:count]
        for end in ends
    ]
    arrays["interval_um"] = torch.stack(half_widths)
    logits = [a.mask for a in predictions if a.mask is not None]
    if len(logits) == len(predictions):
        pairs = [
            losses.at_pixels(mask[:count], frames.mask[:count], pixels)
            for mask in logits
        ]
        arrays |= {
            "pupil": pairs[0][1],
            "told_pupil": torch.stack(
                [torch.sigmoid(mask_logits) for mask_logits, _ in pairs]
            ),
        }
    windows = [a.depth[:count, 0] for a in predictions if a.depth is not None]
    if frames.vergence is not None and len(windows) == len(predictions):
        arrays["window_um"] = 1e3 * blur.depth_mm(frames.vergence[:count])
        arrays["told_window_um"] = 1e3 * blur.depth_mm(torch.stack(windows))
    return {
        name: np.asarray(value.cpu().numpy(), np.float32)
        for name, value in arrays.items()
    }
