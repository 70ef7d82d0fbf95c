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
from codesign.train.trainer import Trainer

PEOPLE_EACH = 20  # frames of a person, of which a fifth calibrates


def specialise_candidate(
    run: CodesignRun, architecture: Architecture, budget_mmacs: float
) -> Trainer:
    """Trainer of a copy of the supernet, fine-tuned for one architecture: θ*(α) of Eq.
    10.

    First ``inner_steps`` of optics, pitch and weights, then ``finetune_steps`` of the
    weights alone. The same run, architecture and budget give the same result.

    Args:
        run: run with its model. architecture: member of the search space.
        budget_mmacs: compute budget, million multiply-accumulates a frame.
    """
    settings, source = run.settings, run.trainer
    model = copy.deepcopy(source.model)
    key = repr((architecture, budget_mmacs)).encode()
    seed = source.inner.seed + 1000 + zlib.crc32(key) % 1_000_003
    steps = settings.search.inner_steps, settings.run.finetune_steps
    # a quarter of those of training
    rates = {
        name: getattr(source.inner, name).rate / 4
        for name in ("weights", "optics", "pitch")
    }
    joint = source.inner.fine_tuning(steps[0], seed, **rates)
    weights = source.inner.fine_tuning(steps[1], seed + 1, weights=rates["weights"])
    if settings.search.inner_steps:
        model.finest_um = finest_pitch_um(
            run,
            architecture,
            budget_mmacs * 1e6,
            begins_um=float(model.pitch_um.detach()),
        )
    with parallel.single_process():
        for inner, count in zip(
            (replace(joint, budget_mmacs=budget_mmacs), weights), steps, strict=True
        ):
            trainer = replace(
                source,
                inner=inner,
                model=model,
                architecture=architecture,
                budgets_mmacs=(),
            )
            trainer.light.device = source.light.device
            for _ in trainer.run() if count else ():
                pass
    return trainer


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
    """Search architectures for every budget in turn: the outer problem of Eq. 10.

    Candidates are ranked by gaze error in degrees, with the supernet's optics, pitch
    and weights, or with their own (``search.inner_steps``). A checkpoint is written
    after every round of births.

    Args:
        run: run with its model. path: of the checkpoint.

    Yields:
        (budget in MMACs, the candidate that was born).
    """
    settings = run.settings
    people = people_of(run, VALIDATION, settings.validation_batches)

    def frames_through(trainer: Trainer) -> tuple[list[Tensor], assess.SensorFrames]:
        """Training frames to measure batch statistics on, and frames of people."""
        return assess.training_frames(trainer), assess.frames_of(trainer, people)

    plan = settings.search
    shared = None if plan.inner_steps else frames_through(run.trainer)
    if "architecture" in settings.run.frozen:
        plan = EvolutionSettings(
            population=1, tournament=1, rounds=1, inner_steps=plan.inner_steps
        )

    def gaze_error(architecture: Architecture, budget: float) -> float:
        trainer = run.trainer
        if shared is None:
            trainer = specialise_candidate(run, architecture, budget)
        measured, of_people = shared or frames_through(trainer)
        recalibrate_batch_norm(trainer.model.net, architecture, measured)
        error_deg = assess.gaze_error_deg(trainer, architecture, people, of_people)
        trainer.model.net.train()
        return error_deg

    for i, budget in enumerate(settings.run.budgets_mmacs):
        previous = run.searches[i] if i < len(run.searches) else None
        states = evolution.evolve_population(
            settings.space,
            plan,
            functools.partial(gaze_error, budget=budget),
            run.macs,
            budget=budget * 1e6,
            seed=settings.inner.seed + i,
            start=previous,
        )
        reported = len(previous.history) if previous else 0
        for state in states:
            yield from ((budget, candidate) for candidate in state.history[reported:])
            reported = len(state.history)
            run.searches[i:] = [state]
            save_run(path, run)
