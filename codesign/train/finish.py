"""What a run reached: the network of every budget on test frames, on frames where only blur tells depth, and why."""

import copy
import json
from dataclasses import replace
from typing import Any

from codesign.batches import TEST
from codesign.network import Architecture, Baseline, recalibrate, smallest
from codesign.train import ambiguity, assess, evolution
from codesign.train.assess import Answers, Seen
from codesign.train.depth_test import depth_response
from codesign.train.evolution import Candidate, Search
from codesign.train.inner import Model, Schedule, Trainer
from codesign.train.run import Run
from metalens.ground.errors import TrainingError


def finish(run: Run) -> list[dict[str, Any]]:
    """The best of every budget on the test frames: one row a budget; one row for a baseline network.

    Raises:
        TrainingError: a search has not ended.
    """
    return [row for row, _ in finished(run)]


def finished(run: Run) -> list[tuple[dict[str, Any], Model]]:
    """Rows of :func:`finish`, each with the model that reached it (fine-tuned where that is asked for).

    ``effective_pitch_um``: distance of the cells that the network sees: of pixels binned to its resolution.
    Batch statistics are measured on training frames through the final lens, never on those that are judged.
    """
    settings = run.settings
    chosen = _chosen(run)
    tests = {"": assess.frames(run.trainer, run.scenes(TEST), settings.test_batches)}
    pairs = None
    if settings.ambiguity_pairs:
        pairs = ambiguity.ambiguous(run.scenes(TEST), settings.ambiguity_pairs, settings.inner.seed)
        tests["ambiguous_"] = assess.frames(run.trainer, pairs, max(1, len(pairs) // settings.inner.batch))
    measured = assess.frames(run.trainer, run.trainer.scenes, min(8, settings.test_batches))
    out = []
    for i, (budget, best) in enumerate(chosen):
        trainer = _tuned(run, best.architecture, i)
        net, architecture = trainer.model.net, best.architecture
        recalibrate(net, architecture, assess.parts(measured))
        row: dict[str, Any] = {"budget_mmacs": budget, "mmacs": best.macs / 1e6}
        row["effective_pitch_um"] = float(run.trainer.model.pitch_um.detach()) / architecture.resolution
        for name, seen in tests.items():
            row |= _errors(name, assess.predict(net, architecture, seen, settings.inner), seen)
        response = depth_response(
            trainer, pairs or run.scenes(TEST), net, architecture, batches=max(1, settings.test_batches // 4)
        )
        row["depth_response_mm_per_mm"] = response.mean
        row["depth_response_error"] = response.standard_error
        row["architecture"] = json.loads(evolution.dumps(Search((best,))))["history"][0] if budget else None
        out.append((row, trainer.model))
    return out


def _chosen(run: Run) -> list[tuple[float | None, Candidate]]:
    settings, net = run.settings, run.trainer.model.net
    if isinstance(net, Baseline):
        only = smallest(net.space)
        return [(None, Candidate(only, 0.0, run.macs(only)))]
    if len(run.searches) < len(settings.run.budgets_mmacs):
        raise TrainingError(
            f"{len(run.searches)} of {len(settings.run.budgets_mmacs)} searches are done; resume the run"
        )
    return [(b, evolution.best(s.history)) for b, s in zip(settings.run.budgets_mmacs, run.searches, strict=True)]


def _errors(name: str, answers: Answers, seen: Seen) -> dict[str, float | None]:
    error = (answers.slip_mm - seen.slip_mm).abs().mean(0)
    shared = float(answers.iou.mean())
    return {
        f"{name}axial_slip_mm": float(error[2]),
        f"{name}lateral_slip_mm": float(error[:2].mean()),
        f"{name}iou": shared if shared == shared else None,  # a network without a mask has none
    }


def _tuned(run: Run, architecture: Architecture, number: int) -> Trainer:
    """A copy of the trainer whose weights were trained on for one architecture, lens and pitch as they are."""
    steps = run.settings.run.finetune_steps
    source = run.trainer
    made = copy.deepcopy(source.model)
    rate = source.inner.weights.rate / 4
    inner = replace(
        source.inner,
        steps=max(steps, 1),
        seed=source.inner.seed + 1000 * (number + 1),
        weights=replace(source.inner.weights, rate=rate),
        optics=Schedule(0.0),
        pitch=Schedule(0.0),
    )
    going = Trainer(
        inner, source.optics, source.sensor, source.scenes, made, architecture=architecture, stacks=source.stacks
    )
    for _ in going.run() if steps else ():
        pass
    return going
