"""Training on a GPU beside the processor of the same machine: ``python -m benchmarks
gpu_training``.

The error of a row is the largest relative difference of its first two losses from what
it is measured against.
"""

import itertools
import statistics
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import torch

from benchmarks import Row
from benchmarks.gpu import row
from codesign.batches import Batch, Scenes
from codesign.network import Prediction
from codesign.train import Trainer, device_of, place, run
from codesign.train.ahead import renderers
from metalens.ground import config

COMPARED, SECONDS = (
    2,
    30.0,
)  # losses that are compared; of steps, of which the second half is timed
PAPER = (480.0, 2500.0)  # MMACs of the planned runs


def rows() -> Iterator[Row]:
    """A step of the presets, lens and pitch moving with the network; of ``paper`` the
    cost of the whole training.

    Raises:
        ConfigError: there is no GPU.
    """
    there = device_of("cuda")
    spent: dict[str, _Spent] = {}
    next(_trainer("smoke", {"scenes": {"pool": 16}}).run())  # compiles
    for device in (torch.device("cpu"), there):
        trainer = _trainer("laptop", {"scenes": {"pool": 256}})
        spent[device.type] = one = _trained(trainer, device)
        method = f"{trainer.inner.batch / one.step:.0f} frames/s; image formed in {one.forming:.1f} s"
        yield row(
            "a training step, preset laptop",
            method,
            device,
            one.step,
            _apart(spent["cpu"], one),
        )
    workers, threads = renderers(there), torch.get_num_threads()
    kept = _Kept(_trainer("paper", {}).scenes, workers)
    torch.set_num_threads(threads)  # the workers' 1 was for all
    frames = len(kept.one.slip_mm)
    case, method = (
        f"rendering {frames} frames of preset paper, beside a step",
        f"{workers} threads, one a step",
    )
    method = f"{method}: {frames / kept.seconds:.0f} frames/s"
    yield row(case, method, torch.device("cpu"), kept.seconds, 0.0)
    for budget in PAPER:
        for kind in ("single precision", "network in bfloat16"):
            trainer = _trainer("paper", {"run": {"budgets_mmacs": [budget]}})
            trainer.scenes = kept
            if kind != "single precision":
                trainer.model.net.forward = _halved(trainer.model.net.forward, there)
            spent[kind] = one = _trained(trainer, there)
            error = _apart(spent["single precision"], one)
            told = f"{trainer.inner.batch / one.step:.0f} frames/s; image formed in {one.forming:.1f} s"
            method = f"{kind}, frames at hand: {told}; {one.hours(trainer, kept.seconds):.0f} h with rendering"
            made = row(
                f"a training step, preset paper, {budget:g} MMACs",
                method,
                there,
                one.step,
                error,
            )
            yield replace(made, against="the same in single precision")


def _apart(one: "_Spent", other: "_Spent") -> float:
    return max(
        abs(b / a - 1)
        for a, b in zip(one.losses[:COMPARED], other.losses[:COMPARED], strict=True)
    )


def _halved(
    forward: Callable[..., Prediction], device: torch.device
) -> Callable[..., Prediction]:
    """Products of the network in bfloat16; what it predicts, and with it the losses, in
    single precision.
    """

    def rounded(*given: Any) -> Prediction:
        with torch.autocast(device.type, torch.bfloat16):
            answer = forward(*given)
        parts = (getattr(answer, name) for name in Prediction.__slots__)
        return Prediction(*(part if part is None else part.float() for part in parts))

    return rounded


class _Kept:
    """One rendered batch, again and again: a step without waiting for its frames.

    seconds: of rendering one where ``workers`` threads render one each.
    """

    def __init__(self, scenes: Scenes, workers: int) -> None:
        self.margin = scenes.margin
        scenes.batch(0, 2)  # compiles
        start = time.perf_counter()
        with ThreadPoolExecutor(
            workers, "renders", torch.set_num_threads, (1,)
        ) as pool:
            self.one, *_ = pool.map(lambda step: scenes.batch(step, 64), range(workers))
        self.seconds = (time.perf_counter() - start) / workers

    def batch(self, step: int, size: int) -> Batch:
        """The batch, whatever the step; of 64 frames."""
        return self.one


def _trainer(preset: str, change: dict[str, Any]) -> Trainer:
    table = config.merged(run.preset_table(preset), change)
    made = run.start(
        config.from_table(table, run.RunConfig, where="benchmarks gpu_training")
    ).trainer
    schedules = {
        name: replace(getattr(made.inner, name), start=0.0)
        for name in ("optics", "pitch")
    }
    made.inner = replace(made.inner, **schedules)  # from the first step
    made.groups |= {
        name: (schedule, made.groups[name][1]) for name, schedule in schedules.items()
    }
    return made


@dataclass(frozen=True, slots=True)
class _Spent:
    """Of a training: median seconds of a step, what the first took beyond it (forming
    the true image), the losses.
    """

    step: float
    forming: float
    losses: list[float]

    def hours(self, trainer: Trainer, rendering: float) -> float:
        """Of the whole training, with an image formed anew every ``refresh`` steps."""
        return (
            trainer.inner.steps
            * (max(self.step, rendering) + self.forming / trainer.inner.refresh)
            / 3600
        )


def _trained(trainer: Trainer, device: torch.device) -> _Spent:
    """Steps for so many seconds, ten at least: on a GPU whatever has a new size costs
    more the first time.
    """
    place(trainer, device)
    marks, losses = [time.perf_counter()], []
    for record in trainer.run():
        marks.append(time.perf_counter())
        losses.append(record.loss)
        if len(losses) > 10 and marks[-1] - marks[1] > SECONDS:
            break
    spent = [b - a for a, b in itertools.pairwise(marks)]
    step = statistics.median(spent[len(spent) // 2 :])
    return _Spent(step, spent[0] - step, losses)
