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
    people = people_of(run, TEST, settings.test_batches)
    shared: _Frames | None = None
    out = []
    for budget, best in _chosen(run):
        trainer = specialise_candidate(run, best.architecture, budget)
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
        pairs = assess.ambiguous_pairs(
            run.scenes(TEST), settings.ambiguity_pairs, settings.inner.seed
        )
        batches = max(1, len(pairs.states) // settings.inner.batch)
        tests["ambiguous_"] = assess.sensor_frames(trainer, pairs, batches)
        response = pairs
    return _Frames(
        tests,
        assess.finer_frames(trainer, run.scenes(TEST), settings.test_batches),
        assess.frames_of(trainer, people),
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
    settings = run.settings
    trainer = run.trainer
    architecture = best.architecture
    net, inner = trainer.model.net, settings.inner
    recalibrate_batch_norm(net, architecture, shown.measured)
    row: dict[str, Any] = {
        "budget_mmacs": budget,
        "mmacs": run.macs(architecture) / 1e6,
    }
    pitch = float(trainer.model.pitch_um.detach())
    row["pitch_um"], row["effective_pitch_um"] = pitch, pitch / architecture.resolution
    row["gaze_deg"] = assess.gaze_error_deg(trainer, architecture, people, shown.people)
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
    response = assess.depth_response(
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


@torch.no_grad()
def run_pictures(run: CodesignRun) -> dict[str, bytes]:
    """PNG pictures by name: psf, frames, masks.

    The run stays as it is: masks come from a copy of the network, whose batch
    statistics are measured in evaluation mode on the frames that are shown.
    """
    trainer = run.trainer
    made = lens.lens_psf_stack(trainer.optics, trainer.model.coefficients_rad)
    chosen = torch.linspace(0, len(made.depths_um) - 1, 6).long().tolist()
    titles = [f"{float(made.depths_um[i]) * 1e-3:.0f} mm" for i in chosen]
    pictures = {
        "psf": _row([made.intensity[i].clamp_min(0).sqrt() for i in chosen], titles)
    }
    seen = assess.sensor_frames(trainer, run.scenes(VALIDATION), 1)
    shown = min(6, len(seen.frames))
    pictures["frames"] = _row(list(seen.frames[:shown, 0]), [""] * shown)
    net = copy.deepcopy(trainer.model.net)  # the run's own statistics must not move
    recalibrate_batch_norm(net, smallest_architecture(net.space), [seen.frames])
    found = net(seen.frames, smallest_architecture(net.space)).mask_logits.cpu()
    if found.numel():
        pictures["masks"] = _row(list(torch.sigmoid(found[:shown])), [""] * shown)
    return pictures


def _row(images: list[Tensor], titles: list[str]) -> bytes:
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
    """Least standard deviation, in mm, of a reader of the blur of one window, on axis,
    over the depth.

    Of a window of 1/f texture as wide as the PSFs, with noise of a thousandth of its
    power: see
    :func:`codesign.train.separability.depth_information`.

    Args:
        run: run with its model.
    """
    made = lens.lens_psf_stack(run.trainer.optics, run.trainer.model.coefficients_rad)
    information = depth_information(made)
    middle = (made.depths_um[1:] + made.depths_um[:-1]) / 2
    return {
        "depth_mm": (1e-3 * middle).tolist(),
        "window_depth_mm": information.clamp_min(1e-12).rsqrt().tolist(),
    }


def predictions_of_frames(ends: list[BudgetResult], count: int) -> dict[str, Array]:
    """The first test frames and what each network said of them.

    Args:
        ends: one a compute budget. count: how many.

    Returns:
        frames (n, y, x) as the network sees them; pupil (n, y, x) and slip_um (n, 3),
        true; told_pupil (networks, n, y,
        x) share of the pixel, told_slip_um (networks, n, 3); interval_um (networks, n)
        half width of the 90 % interval
        of the distance, nan where none is given; window_um (n, windows, windows) true
        depth and told_window_um
        (networks, n, windows, windows). What no network tells is left out.
    """
    seen, networks = ends[0].seen, [end.answers for end in ends]
    pixels = int(seen.frames.shape[-1])
    out = {"frames": seen.frames[:count, 0], "slip_um": 1e3 * seen.slip_mm[:count]}
    out["told_slip_um"] = torch.stack([1e3 * a.slip_mm[:count] for a in networks])
    none = torch.full((min(count, len(seen.frames)),), torch.nan)
    wide = [
        none if end.interval_mm is None else 1e3 * end.interval_mm[:count]
        for end in ends
    ]
    out["interval_um"] = torch.stack(wide)
    logits = [a.mask for a in networks if a.mask is not None]
    if len(logits) == len(networks):
        both = [
            losses.at_pixels(mask[:count], seen.mask[:count], pixels) for mask in logits
        ]
        out |= {
            "pupil": both[0][1],
            "told_pupil": torch.stack([torch.sigmoid(found) for found, _ in both]),
        }
    windows = [a.depth[:count, 0] for a in networks if a.depth is not None]
    if seen.vergence is not None and len(windows) == len(networks):
        out["window_um"] = 1e3 * blur.depth_mm(seen.vergence[:count])
        out["told_window_um"] = 1e3 * blur.depth_mm(torch.stack(windows))
    return {
        name: np.asarray(value.cpu().numpy(), np.float32) for name, value in out.items()
    }
