"""A co-design run from its config: joint training, search over architectures under budgets, and what is kept of it."""

import json
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any, Literal

import torch

from codesign import assess, checkpoint, cost, evolution
from codesign.architecture import Architecture, Space
from codesign.evolution import Candidate, Plan, Search
from codesign.eye_scenes import TEST, VALIDATION, EyeScenes, SceneConfig
from codesign.inner import InnerConfig, Record, Trainer, model
from codesign.optics import OpticsConfig
from metalens import config
from metalens.errors import ConfigError, TrainingError
from metalens.sensor import Sensor

Preset = Literal["smoke", "laptop"]


@dataclass(frozen=True, slots=True)
class Budgets:
    """Where the run starts, and what it is searched under.

    pitch_um: effective pixel pitch at the start; it moves where ``inner.pitch`` has a rate.
    budgets_mmacs: one search each; the results together are the Pareto set.
    """

    pitch_um: float = 9.0
    budgets_mmacs: tuple[float, ...] = (12.0,)

    def __post_init__(self) -> None:
        if not self.pitch_um > 0 or not self.budgets_mmacs or min(self.budgets_mmacs) <= 0:
            raise ConfigError(f"pitch_um = {self.pitch_um}, budgets_mmacs = {self.budgets_mmacs}: need all above 0")


@dataclass(frozen=True, slots=True)
class RunConfig:
    """The content of RUN.toml; a preset gives every value that the file leaves out.

    checkpoint_every: steps. validation_batches: judge architectures. test_batches: judge the result.
    """

    preset: Preset = "laptop"
    checkpoint_every: int = 50
    validation_batches: int = 8
    test_batches: int = 32
    scenes: SceneConfig = field(default_factory=SceneConfig)
    optics: OpticsConfig = field(default_factory=OpticsConfig)
    sensor: Sensor = field(default_factory=Sensor)
    space: Space = field(default_factory=Space)
    inner: InnerConfig = field(default_factory=InnerConfig)
    search: Plan = field(default_factory=Plan)
    run: Budgets = field(default_factory=Budgets)

    def __post_init__(self) -> None:
        if min(self.checkpoint_every, self.validation_batches, self.test_batches) < 1:
            raise ConfigError("checkpoint_every, validation_batches and test_batches must be 1 or more")
        for resolution in (self.space.resolution[0], 1.0):
            cost.input_size(self.scenes.pixels * self.optics.sample_um, self.run.pitch_um, resolution)


def load(path: str | Path) -> RunConfig:
    """Read RUN.toml over its preset.

    Raises:
        ConfigError: see :func:`metalens.config.load`; an unknown preset.
    """
    table = config.read(path, RunConfig)
    preset = preset_table(table.get("preset", "laptop"))
    return config.from_table(config.merged(preset, table), RunConfig, where=str(path))


def preset_table(name: str) -> dict[str, Any]:
    """The settings of a preset; of laptop for a name that is none, which :func:`load` then refuses."""
    known = name if name in ("smoke", "laptop") else "laptop"
    return tomllib.loads(resources.files("codesign").joinpath("data", f"{known}.toml").read_text(encoding="utf-8"))


@dataclass(eq=False)
class Run:
    """A run and where it stands: ``trainer`` first, then a search for every budget."""

    settings: RunConfig
    trainer: Trainer
    searches: list[Search]

    @property
    def window_um(self) -> float:
        """Edge of the image."""
        return self.settings.scenes.pixels * self.settings.optics.sample_um

    def macs(self, architecture: Architecture) -> float:
        """Multiply-accumulates of an architecture at the pitch that was found."""
        pitch = self.trainer.model.pitch_um.detach()
        return float(cost.macs(architecture, pitch, window_um=self.window_um, space=self.settings.space))

    def scenes(self, stream: int) -> EyeScenes:
        """Frames of another stream than training's."""
        s = self.settings
        return EyeScenes(s.scenes, s.optics.sample_um, s.optics.sensor_distance_mm * 1e3, s.inner.seed, stream)


def start(settings: RunConfig) -> Run:
    """A fresh run."""
    made = model(settings.optics, pitch_um=settings.run.pitch_um, seed=settings.inner.seed, space=settings.space)
    scenes = EyeScenes(
        settings.scenes, settings.optics.sample_um, settings.optics.sensor_distance_mm * 1e3, settings.inner.seed
    )
    return Run(settings, Trainer(settings.inner, settings.optics, settings.sensor, scenes, made), [])


def save(path: Path, run: Run) -> None:
    """Checkpoint: training state and the searches so far."""
    state = {"trainer": run.trainer.state(), "searches": [evolution.dumps(s) for s in run.searches]}
    checkpoint.save(path, state, settings=run.settings)


def resume(path: Path, settings: RunConfig) -> Run:
    """Go on from a checkpoint.

    Raises:
        TrainingError: no checkpoint, a damaged one, or one of other settings (the difference is named).
    """
    state = checkpoint.load(path, settings=settings)
    run = start(settings)
    run.trainer.restore(state["trainer"])
    run.searches = [evolution.loads(text, settings.space) for text in state["searches"]]
    return run


def train(run: Run, path: Path) -> Iterator[Record]:
    """Advance the training to its end, with checkpoints; a record a step."""
    for record in run.trainer.run():
        yield record  # first the caller's log, then the checkpoint: a log never lacks a step that is kept
        if record.step % run.settings.checkpoint_every == 0 or record.step == run.settings.inner.steps:
            save(path, run)


def search(run: Run, path: Path) -> Iterator[tuple[float, Candidate]]:
    """Advance the searches to their end, budget by budget, with a checkpoint after every birth.

    Yields:
        (budget in MMACs, the candidate that was born).
    """
    settings = run.settings
    frames = assess.frames(run.trainer, run.scenes(VALIDATION), settings.validation_batches)

    def error(architecture: Architecture) -> float:
        return assess.assess(run.trainer.model.net, architecture, frames, settings.inner).slip_mm

    for i, budget in enumerate(settings.run.budgets_mmacs):
        before = run.searches[i] if i < len(run.searches) else None
        states = evolution.evolve(
            settings.space,
            settings.search,
            error,
            run.macs,
            budget=budget * 1e6,
            seed=settings.inner.seed + i,
            start=before,
        )
        for state in states:
            yield budget, state.history[-1]
            run.searches[i:] = [state]
            save(path, run)


def finish(run: Run) -> list[dict[str, Any]]:
    """The best of every budget on the test frames: one row a budget.

    Raises:
        TrainingError: a search has not ended.
    """
    settings = run.settings
    if len(run.searches) < len(settings.run.budgets_mmacs):
        raise TrainingError(
            f"{len(run.searches)} of {len(settings.run.budgets_mmacs)} searches are done; resume the run"
        )
    frames = assess.frames(run.trainer, run.scenes(TEST), settings.test_batches)
    rows = []
    for budget, state in zip(settings.run.budgets_mmacs, run.searches, strict=True):
        best = evolution.best(state.history)
        found = assess.assess(run.trainer.model.net, best.architecture, frames, settings.inner)
        rows.append(
            {
                "budget_mmacs": budget,
                "mmacs": best.macs / 1e6,
                "axial_slip_mm": found.axial_mm,
                "lateral_slip_mm": found.lateral_mm,
                "iou": found.iou,
                "architecture": json.loads(evolution.dumps(Search((best,))))["history"][0],
            }
        )
    return rows


def coefficients(run: Run) -> torch.Tensor:
    """Polynomial coefficients of the trained lens, rad."""
    return run.trainer.model.coefficients_rad.detach().clone()
