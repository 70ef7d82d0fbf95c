"""The inner problem of Eq. 10: optics, pitch and weights of one architecture."""

import copy
import math
import zlib
from dataclasses import replace

import torch

from codesign.batches import parallel
from codesign.gaze import bench
from codesign.network import Architecture
from codesign.train import assess
from codesign.train.formation import network_macs
from codesign.train.inner import InnerConfig, Trainer
from codesign.train.moving import LearningRateSchedule
from codesign.train.run import CodesignRun, finest_within

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
        model.finest_um = _finest_um(run, architecture, budget_mmacs)
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


def _finest_um(
    run: CodesignRun, architecture: Architecture, budget_mmacs: float
) -> float:
    """The finest pitch at which an architecture keeps its budget."""
    begins = float(run.trainer.model.pitch_um.detach())

    def count(pitch_um: float) -> float:
        pitch = torch.tensor(pitch_um, dtype=torch.float64)
        net = run.trainer.model.net
        smooth = float(network_macs(net, architecture, run.window_um, pitch))
        return max(smooth, run.counted(architecture, pitch_um))

    finest = min(run.settings.optics.sample_um, begins)
    if count(finest) <= budget_mmacs * 1e6:
        return 0.0
    return finest_within(count, budget_mmacs * 1e6, finest, begins) or begins


def people_of(run: CodesignRun, stream: int, batches: int) -> bench.PeopleFrames:
    """People of a stream, as many as fill these batches; two or more.

    Args:
        run: run with its model.
    """
    frames = batches * run.settings.inner.batch
    count = max(2, frames // PEOPLE_EACH)
    seed = run.settings.inner.seed + 31 * (stream + 1)
    return bench.simulate_people(run.scenes(stream), count, PEOPLE_EACH, seed=seed)


def frames_of(trainer: Trainer, people: bench.PeopleFrames) -> assess.SensorFrames:
    """Their frames through a trainer's lens and sensor.

    Args:
        people: people, their frames and where they look.
    """
    size = trainer.inner.batch
    return assess.sensor_frames(trainer, people, math.ceil(len(people.states) / size))


def gaze_error_deg(
    trainer: Trainer,
    architecture: Architecture,
    people: bench.PeopleFrames,
    seen: assess.SensorFrames,
) -> float:
    """Mean gaze error of a network whose batch statistics are measured.

    Args:
        trainer: with lens, sensor and network as they are.
        architecture: member of the search space.
        people: people, their frames and where they look.
        seen: their frames on the sensor.
    """
    answers = assess.predict_frames(
        trainer.model.net, architecture, seen, trainer.inner
    )
    read = bench.read_of(people, answers.centre, answers.slip_mm)
    return bench.calibrated_error_deg(people, read)
