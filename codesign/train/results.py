"""What a run reached: the network of every budget on test frames, and what they show."""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from codesign.batches import CALIBRATION, EXPERIMENT, TEST
from codesign.gaze.bench import PeopleFrames
from codesign.network import (
    Architecture,
    Supernet,
    blur,
    exported,
    losses,
    recalibrate_batch_norm,
)
from codesign.train import assess, evolution
from codesign.train.assess import FramePredictions, SensorFrames
from codesign.train.evolution import EvaluatedCandidate
from codesign.train.run import CodesignRun
from codesign.train.search import people_of, specialise_candidate
from codesign.train.trainer import Trainer
from metalens.core.arrays import Array
from metalens.core.errors import TrainingError
from metalens.psf import pixel_count


@dataclass(frozen=True, eq=False, slots=True)
class BudgetResult:
    """Result of one compute budget.

    row: of the result. trainer: with the final model, lens, pitch and weights of its
    own where that is configured. frames, predictions: of the test scenes.
    interval_mm: (n,) half width of the 90 % intervals of the axial slippage.
    """

    row: dict[str, Any]
    trainer: Trainer
    frames: SensorFrames
    predictions: FramePredictions
    interval_mm: Tensor


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
    budgets = settings.run.budgets_mmacs
    if len(run.searches) < len(budgets):
        raise TrainingError(
            f"{len(run.searches)} of {len(budgets)} searches are done; resume the run"
        )
    people = people_of(run, TEST, settings.test_batches)
    frames: _TestFrames | None = None
    results = []
    for budget, state in zip(budgets, run.searches, strict=True):
        best = evolution.best_candidate(state.history)
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

    test: that judge. fine: the same on the finer image. people: for gaze.
    measured: to measure batch statistics on. calibration: to calibrate intervals with.
    shifted: the first of the test, with the PSFs shifted in depth.
    """

    test: SensorFrames
    fine: SensorFrames | None
    people: SensorFrames
    measured: list[Tensor]
    calibration: SensorFrames
    shifted: SensorFrames


def _test_frames(run: CodesignRun, people: PeopleFrames) -> _TestFrames:
    """Test, calibration and training frames through the run's present lens."""
    trainer, scenes = run.trainer, run.scenes(TEST)
    batches = run.settings.test_batches
    held_out = run.scenes(CALIBRATION)
    some = max(1, batches // 4)
    return _TestFrames(
        assess.sensor_frames(trainer, scenes, batches),
        assess.finer_frames(trainer, scenes, batches),
        assess.frames_of(trainer, people),
        assess.training_frames(trainer),
        assess.sensor_frames(trainer, held_out, run.settings.validation_batches),
        assess.sensor_frames(trainer, scenes, some, shift_um=assess.SHIFT_UM),
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

    def predict(images: SensorFrames) -> FramePredictions:
        return assess.predict_frames(net, architecture, images, inner)

    quantile = conformal_quantiles(predict(frames.calibration), frames.calibration)
    predictions = predict(frames.test)
    half_width = quantile * predictions.slip_sd_mm[:, 2]
    row |= _errors("", predictions, frames.test)
    row |= uncertainty_summary(predictions, frames.test, half_width)
    if frames.fine is not None:
        row |= _errors("finer_", predict(frames.fine), frames.fine)
        row["finer_ratio"] = row["finer_axial_slip_mm"] / row["axial_slip_mm"]
    shifted_mm = predict(frames.shifted).slip_mm[:, 2]
    row["depth_response_mm_per_mm"], row["depth_response_error"] = (
        assess.depth_response(predictions.slip_mm[: len(shifted_mm), 2], shifted_mm)
    )
    row["architecture"] = evolution.candidate_to_json(best)
    return BudgetResult(row, trainer, frames.test, predictions, half_width)


def _errors(
    prefix: str, predictions: FramePredictions, frames: SensorFrames
) -> dict[str, float]:
    """Mean axial and lateral slippage error in mm, and mask IoU; keys begin with
    ``prefix``.
    """
    error = (predictions.slip_mm - frames.slip_mm).abs().mean(0)
    return {
        f"{prefix}axial_slip_mm": float(error[2]),
        f"{prefix}lateral_slip_mm": float(error[:2].mean()),
        f"{prefix}iou": float(predictions.iou.mean()),
    }


def conformal_quantiles(
    predictions: FramePredictions, frames: SensorFrames, *, share: float = 0.9
) -> float:
    """Split-conformal quantile of |axial error| / predicted standard deviation.

    The interval of so many standard deviations contains ``share`` of the axial
    slippages, for any distribution of the errors.

    Args:
        predictions: predictions for ``frames``. share: coverage of the interval.
        frames: of the sensor with labels, that training, search and test never use.
    """
    ratio = (predictions.slip_mm - frames.slip_mm)[:, 2].abs() / predictions.slip_sd_mm[
        :, 2
    ]
    rank = min(math.ceil(share * (len(ratio) + 1)), len(ratio))
    return float(ratio.sort().values[rank - 1])


def uncertainty_summary(
    predictions: FramePredictions, frames: SensorFrames, half_width_mm: Tensor
) -> dict[str, float]:
    """Coverage and mean half width in mm of the 90 % intervals, and window depth error
    in mm.

    Args:
        predictions: of the network. frames: frames of the sensor with their labels.
        half_width_mm: (n,) of the intervals of the axial slippage.
    """
    axial_error = (predictions.slip_mm - frames.slip_mm)[:, 2].abs()
    window_error = blur.depth_mm(predictions.depth[:, 0]) - blur.depth_mm(
        frames.vergence
    )
    return {
        "axial_coverage_90": float((axial_error <= half_width_mm).float().mean()),
        "axial_interval_mm": float(half_width_mm.mean()),
        "window_depth_mm": float(window_error.abs().mean()),
    }


def predictions_of_frames(ends: list[BudgetResult], count: int) -> dict[str, Array]:
    """Arrays of the first test frames, with labels and the predictions of each network.

    Args:
        ends: one a compute budget. count: number of frames.

    Returns:
        frames (n, y, x) as the network sees them; pupil (n, y, x) and slip_um (n, 3),
        true; predicted_pupil (networks, n, y, x) probability, predicted_slip_um (networks, n, 3);
        interval_um (networks, n) half width of the 90 % interval of the distance.
    """
    frames = ends[0].frames
    pixels = int(frames.frames.shape[-1])
    pairs = [
        losses.at_pixels(end.predictions.mask[:count], frames.mask[:count], pixels)
        for end in ends
    ]
    arrays = {
        "frames": frames.frames[:count, 0],
        "slip_um": 1e3 * frames.slip_mm[:count],
        "predicted_slip_um": torch.stack(
            [1e3 * end.predictions.slip_mm[:count] for end in ends]
        ),
        "interval_um": torch.stack([1e3 * end.interval_mm[:count] for end in ends]),
        "pupil": pairs[0][1],
        "predicted_pupil": torch.stack([torch.sigmoid(logits) for logits, _ in pairs]),
    }
    return {
        name: np.asarray(value.cpu().numpy(), np.float32)
        for name, value in arrays.items()
    }


def write_network_file(
    path: Path, run: CodesignRun, net: Supernet, architecture: Architecture
) -> None:
    """Write a network of a run, cut to its architecture, for frames of the run's
    sensor.

    Args:
        path: of the file. net: elastic network.

    Raises:
        OSError: the target cannot be written.
    """
    inner, settings = run.settings.inner, run.settings
    pitch_um = float(run.trainer.model.pitch_um.detach())
    size = pixel_count(settings.scenes.pixels, settings.optics.sample_um, pitch_um)
    scale = exported.OutputScale(
        frame_mm=size * pitch_um * 1e-3,
        slip_mm=inner.slip_scale_mm,
        rig=run.scenes(EXPERIMENT).rig,
        axis=inner.axis_weight > 0,
        points=inner.point_weight > 0,
    )
    exported.write_onnx(path, net, architecture, scale, size=size, pitch_um=pitch_um)
