"""The outer problem of Eq. 10: regularised evolution of architectures under budgets."""

import functools
from collections.abc import Iterator
from pathlib import Path

from torch import Tensor

from codesign.batches import VALIDATION
from codesign.gaze.bench import PeopleFrames
from codesign.network import Architecture, recalibrate_batch_norm
from codesign.train import assess, evolution, specialise
from codesign.train.evolution import EvaluatedCandidate, EvolutionSettings
from codesign.train.inner import Trainer
from codesign.train.run import CodesignRun, save_run


def search(run: CodesignRun, path: Path) -> Iterator[tuple[float, EvaluatedCandidate]]:
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
    people = specialise.people_of(run, VALIDATION, settings.validation_batches)
    shared = None if settings.search.inner_steps else _looks(run.trainer, people)
    plan = settings.search
    if "architecture" in settings.run.frozen:
        plan = EvolutionSettings(
            population=1, tournament=1, rounds=1, inner_steps=plan.inner_steps
        )

    def error(architecture: Architecture, budget: float) -> float:
        if shared is None:
            trainer = specialise.specialise_candidate(run, architecture, budget)
            measured, seen = _looks(trainer, people)
        else:
            trainer, (measured, seen) = run.trainer, shared
        recalibrate_batch_norm(trainer.model.net, architecture, measured)
        found = specialise.gaze_error_deg(trainer, architecture, people, seen)
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
        told = len(before.history) if before else 0
        for state in states:
            yield from ((budget, born) for born in state.history[told:])
            told = len(state.history)
            run.searches[i:] = [state]
            save_run(path, run)


def _looks(
    trainer: Trainer, people: PeopleFrames
) -> tuple[list[Tensor], assess.SensorFrames]:
    """Training frames that batch statistics are measured on, and frames of people."""
    return assess.training_frames(trainer), specialise.frames_of(trainer, people)
