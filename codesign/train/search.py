"""Eq. 10: regularised evolution of architectures under budgets, and for each the inner
problem of its own optics, pitch and weights.
"""

import copy
import functools
import zlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from torch import Tensor

from codesign.batches import VALIDATION, parallel
from codesign.gaze import bench
from codesign.network import Architecture, recalibrate_batch_norm
from codesign.train import assess, evolution
from codesign.train.evolution import EvaluatedCandidate, EvolutionSettings
from codesign.train.run import CodesignRun, finest_pitch_um, save_run
from codesign.train.trainer import InnerConfig, LearningRateSchedule, Trainer

PEOPLE_EACH = 20  # frames of a person, of which a fifth calibrates
SLOWER = 4  # rates of the inner optimisation are those of training over this


def specialise_candidate(
    run: CodesignRun, architecture: Architecture, budget_mmacs: float
) -> Trainer:
    """A trainer whose model is θ*(α): a copy of the supernet's, trained on for this
    architecture alone, then its weights alone (``finetune_steps``).

    The same run, architecture and budget give the same result.

    Args:
        budget_mmacs: compute budget, million multiply-accumulates a frame.
    """
    settings, source = run.settings, run.trainer
    model = copy.deepcopy(source.model)
    place = repr((architecture, budget_mmacs)).encode()
    seed = source.inner.seed + 1000 + zlib.crc32(place) % 1_000_003
    joint = _slower(source.inner, settings.search.inner_steps, seed)
    joint = replace(joint, budget_mmacs=budget_mmacs)
    weights = replace(
        _slower(source.inner, settings.run.finetune_steps, seed + 1),
        optics=LearningRateSchedule(0.0),
        pitch=LearningRateSchedule(0.0),
    )
    if settings.search.inner_steps:
        model.finest_um = finest_pitch_um(
            run,
            architecture,
            budget_mmacs * 1e6,
            begins_um=float(model.pitch_um.detach()),
        )
    with parallel.single_process():
        for inner, steps in (
            (joint, settings.search.inner_steps),
            (weights, settings.run.finetune_steps),
        ):
            going = Trainer(
                inner,
                source.optics,
                source.sensor,
                source.scenes,
                model,
                architecture=architecture,
                stacks=source.light.stacks,
                triplets=source.triplets,
            )
            going.light.device = source.light.device  # where the network lies already
            for _ in going.run() if steps else ():
                pass
    return going


def _slower(inner: InnerConfig, steps: int, seed: int) -> InnerConfig:
    """Settings of a fine-tuning: all groups from its first step on, at lower rates."""
    groups = {
        name: replace(schedule, rate=schedule.rate / SLOWER, start=0.0, end=1.0)
        for name, schedule in (
            ("weights", inner.weights),
            ("optics", inner.optics),
            ("pitch", inner.pitch),
        )
    }
    return replace(inner, steps=max(steps, 1), seed=seed, **groups)  # type: ignore[arg-type]


def people_of(run: CodesignRun, stream: int, batches: int) -> bench.PeopleFrames:
    """People of a stream, as many as fill these batches; two or more.

    Args:
        run: run with its model.
    """
    frames = batches * run.settings.inner.batch
    count = max(2, frames // PEOPLE_EACH)
    seed = run.settings.inner.seed + 31 * (stream + 1)
    return bench.simulate_people(run.scenes(stream), count, PEOPLE_EACH, seed=seed)


def search_architectures(
    run: CodesignRun, path: Path
) -> Iterator[tuple[float, EvaluatedCandidate]]:
    """Advance the searches to their end, budget by budget, with a checkpoint after
    every round of births: the outer problem of Eq. 10.

    Candidates are judged by their gaze error in degrees, with the supernet's optics,
    pitch and weights, or with their own (``search.inner_steps``).

    Args:
        run: run with its model. path: of the file.

    Yields:
        (budget in MMACs, the candidate that was born).
    """
    settings = run.settings
    people = people_of(run, VALIDATION, settings.validation_batches)
    shared = None if settings.search.inner_steps else _looks(run.trainer, people)
    plan = settings.search
    if "architecture" in settings.run.frozen:
        plan = EvolutionSettings(
            population=1, tournament=1, rounds=1, inner_steps=plan.inner_steps
        )

    def error(architecture: Architecture, budget: float) -> float:
        if shared is None:
            trainer = specialise_candidate(run, architecture, budget)
            measured, seen = _looks(trainer, people)
        else:
            trainer, (measured, seen) = run.trainer, shared
        recalibrate_batch_norm(trainer.model.net, architecture, measured)
        found = assess.gaze_error_deg(trainer, architecture, people, seen)
        trainer.model.net.train()
        return found

    for i, budget in enumerate(settings.run.budgets_mmacs):
        before = run.searches[i] if i < len(run.searches) else None
        states = evolution.evolve_population(
            settings.space,
            plan,
            functools.partial(error, budget=budget),
            run.macs,
            budget=budget * 1e6,
            seed=settings.inner.seed + i,
            start=before,
        )
        reported = len(before.history) if before else 0
        for state in states:
            yield from ((budget, born) for born in state.history[reported:])
            reported = len(state.history)
            run.searches[i:] = [state]
            save_run(path, run)


def _looks(
    trainer: Trainer, people: bench.PeopleFrames
) -> tuple[list[Tensor], assess.SensorFrames]:
    """Training frames that batch statistics are measured on, and frames of people."""
    return assess.training_frames(trainer), assess.frames_of(trainer, people)
