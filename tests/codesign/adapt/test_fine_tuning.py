"""Settings of training on: the weights alone move, for all of the run, and no two draw
the same frames.
"""

from dataclasses import replace

from codesign.adapt import train
from codesign.settings import RetrainConfig
from codesign.train import InnerConfig
from codesign.train.trainer import LearningRateSchedule


def test_weights_alone_move_at_the_rate_asked_from_the_first_step_to_the_last():
    run = InnerConfig(
        steps=900,
        seed=5,
        weights=LearningRateSchedule(3e-3, 0.25, 0.75, clip=0.4),
        pitch=LearningRateSchedule(0.01),
    )
    made = train.fine_tuning(run, RetrainConfig(steps=30, rate=7e-4))
    assert made.weights == LearningRateSchedule(7e-4, 0.0, 1.0, clip=0.4)
    assert made.optics.rate == made.pitch.rate == 0.0
    assert made.steps == 30
    kept = replace(
        made, steps=900, seed=5, weights=run.weights, optics=run.optics, pitch=run.pitch
    )
    assert kept == run


def test_seeds_of_retrainings_lie_apart_from_each_other_and_from_the_run():
    """By multiples of 7919, so that no retraining repeats the run's own draws."""
    run = InnerConfig(seed=5)
    seeds = [
        run.seed,
        *(train.fine_tuning(run, RetrainConfig(seed=seed)).seed for seed in (0, 1, 4)),
    ]
    assert seeds == [5, 5 + 7919, 5 + 2 * 7919, 5 + 5 * 7919]
