"""A co-design run from its config: joint training, search over architectures under
budgets, and what is kept of it.
"""
# ruff: noqa: RUF009  (records of settings are frozen)

import functools
import math
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from codesign.batches import (
    TRAINING,
    EyeScenes,
    FramePool,
    PoolScenes,
    SceneConfig,
    SceneSource,
    parallel,
    render_pool,
)
from codesign.network import Architecture, SearchSpace, cost, smallest_architecture
from codesign.optics import OpticsConfig
from codesign.settings import LARGEST, LEAST, Part, check_ranges
from codesign.train import checkpoint, evolution
from codesign.train.evolution import EvolutionSettings, EvolutionState
from codesign.train.trainer import (
    InnerConfig,
    LearningRateSchedule,
    LogRecord,
    Trainer,
    make_model,
)
from metalens.core import config
from metalens.core.errors import ConfigError, TrainingError
from metalens.image import Sensor
from metalens.psf import pixel_count

Preset = Literal["none", "smoke", "laptop", "paper"]


@dataclass(frozen=True, slots=True)
class RunBudgets:
    """Where the run starts, and what it is searched under.

    pitch_um: pixel pitch at the start; it moves where ``inner.pitch`` has a rate.
    budgets_mmacs: one search each; the results together are the Pareto set. Training
    keeps to them in turn.
    frozen: parts that stay as they start (the paper's ablations); a frozen architecture
    is the largest
        uniform one, at the resolution that each budget allows, trained alone.
    finetune_steps: of further training of the weights of each budget's network, on its
    own.
    """

    pitch_um: float = 9.0
    budgets_mmacs: tuple[float, ...] = (12.0,)
    frozen: tuple[Part, ...] = ()
    finetune_steps: int = 0

    def __post_init__(self) -> None:
        above_0 = (LEAST, LARGEST)
        check_ranges(
            self, pitch_um=above_0, budgets_mmacs=above_0, finetune_steps=(0, LARGEST)
        )
        if len({f"{budget:g}" for budget in self.budgets_mmacs}) < len(
            self.budgets_mmacs
        ):
            raise ConfigError(
                f"budgets_mmacs = {self.budgets_mmacs}: two are alike, and so would be their files' names"
            )


@dataclass(frozen=True, slots=True)
class RunConfig:
    """The content of RUN.toml; a preset gives every value that the file leaves out.

    checkpoint_every: steps. validation_batches: judge architectures. test_batches:
    judge the result.
    preset: of what RUN.toml does not give: smoke (a minute), laptop (half an hour;
    without the key), paper (GPUs); none: the defaults of this record.
    scenes: what is looked at. optics: the lens and how its images are formed. sensor:
    noise and exposure.
    space: networks trained together. inner: training of weights and lens. search: of
    architecture and pitch.
    run: budgets, steps and seed.
    """

    preset: Preset = "none"
    checkpoint_every: int = 50
    validation_batches: int = 8
    test_batches: int = 32
    scenes: SceneConfig = SceneConfig()
    optics: OpticsConfig = OpticsConfig()
    sensor: Sensor = Sensor()
    space: SearchSpace = SearchSpace()
    inner: InnerConfig = InnerConfig()
    search: EvolutionSettings = EvolutionSettings()
    run: RunBudgets = RunBudgets()

    def __post_init__(self) -> None:
        counts = ("checkpoint_every", "validation_batches", "test_batches")
        check_ranges(self, **dict.fromkeys(counts, (1, LARGEST)))
        if 0 < self.scenes.pool < self.inner.batch:
            raise ConfigError(
                f"scenes.pool = {self.scenes.pool}, inner.batch = {self.inner.batch}: need a pool of a batch or more, "
                "or 0"
            )
        near, far = (1e-3 * depth for depth in self.scenes.pupil_depths_um)
        if not self.optics.depths_mm[0] <= near <= far <= self.optics.depths_mm[1]:
            raise ConfigError(
                f"optics.depths_mm = {self.optics.depths_mm} does not hold the eyes, {near:g} to {far:g} mm before the "
                "lens (scenes.slip_mm, scenes.depth_sd_mm): widen it, beyond them too, for the faces about the eyes"
            )
        for resolution in (self.space.resolution[0], 1.0):
            cost.input_size(
                self.scenes.pixels * self.optics.sample_um,
                self.run.pitch_um,
                resolution,
            )


def load_run_settings(path: str | Path) -> RunConfig:
    """Read RUN.toml over its preset.

    Args:
        path: of the file.

    Raises:
        ConfigError: see :func:`metalens.core.config.load`; an unknown preset.
    """
    table = config.read(path, RunConfig, empty=False)
    preset = preset_table(table.get("preset", "laptop"))
    return config.from_table(
        config.merge_tables(preset, table), RunConfig, where=str(path)
    )


def preset_table(name: str) -> dict[str, Any]:
    """The settings of a preset; empty for "none" and for an unknown name.

    :func:`load_run_settings` refuses unknown names.
    """
    if name == "none" or name not in get_args(Preset):
        return {}
    text = (
        resources.files("codesign").joinpath("data", f"{name}.toml").read_text("utf-8")
    )
    return {"preset": name, **tomllib.loads(text)}


@dataclass(eq=False)
class CodesignRun:
    """A run and its progress: ``trainer`` first, then a search for every budget."""

    settings: RunConfig
    trainer: Trainer
    searches: list[EvolutionState]

    @property
    def window_um(self) -> float:
        """Side of the image, um."""
        return self.settings.scenes.pixels * self.settings.optics.sample_um

    def macs(self, architecture: Architecture) -> float:
        """Multiply-accumulates for a frame of whole pixels at the present pitch.

        Training counts smoothly with the pitch
        (:func:`codesign.network.cost.macs_of_size`), up to a row of pixels less.

        Args:
            architecture: member of the search space.
        """
        pitch = float(self.trainer.model.pitch_um.detach())
        cost.input_size(self.window_um, pitch, architecture.resolution)
        return self.counted(architecture, pitch)

    def counted(self, architecture: Architecture, pitch_um: float) -> float:
        """Multiply-accumulates of an architecture for the whole pixels of any pitch.

        Args:
            architecture: member of the search space. pitch_um: of the pixels.
        """
        pixels = pixel_count(
            self.settings.scenes.pixels, self.settings.optics.sample_um, pitch_um
        )
        size = np.array([round(pixels * architecture.resolution)])
        return float(cost.network_cost(self.settings.space, architecture).at(size)[0])

    def scenes(self, stream: int) -> EyeScenes:
        """Frames of another stream than training's."""
        return eye_scenes(self.settings, stream)


def start_run(settings: RunConfig) -> CodesignRun:
    """A new run with an untrained model.

    Its pool of frames, where there is one, is rendered when the first batch is
    requested.

    Args:
        settings: of the run.

    Raises:
        TrainingError: a budget is below the smallest network at the pitch that the run
            begins with.
    """
    seed = settings.inner.seed
    frozen = settings.run.frozen
    frozen_rates: dict[str, Any] = {
        part: LearningRateSchedule(0.0)
        for part in ("optics", "pitch")
        if part in frozen
    }
    inner = replace(settings.inner, **frozen_rates)
    model = make_model(
        settings.optics, pitch_um=settings.run.pitch_um, seed=seed, space=settings.space
    )
    eyes = eye_scenes(settings, TRAINING)
    scenes: SceneSource = eyes
    if settings.scenes.pool:
        pool = functools.partial(_pool, eyes)
        scenes = PoolScenes(pool, eyes.margin, settings.scenes.scale, seed)
    trainer = Trainer(
        inner,
        settings.optics,
        settings.sensor,
        scenes,
        model,
        budgets_mmacs=settings.run.budgets_mmacs,
        largest_only="architecture" in frozen,
        triplets=eyes,
    )
    run = CodesignRun(settings, trainer, [])
    model.finest_um = _finest_affordable_pitch_um(run, moves=inner.pitch.rate > 0)
    return run


def eye_scenes(settings: RunConfig, stream: int) -> EyeScenes:
    """Frames of one stream of a run.

    Args:
        settings: of the run. stream: of the random generator.
    """
    optics, seed = settings.optics, settings.inner.seed
    distance_um = optics.sensor_distance_mm * 1e3
    return EyeScenes(settings.scenes, optics.sample_um, distance_um, seed, stream)


@functools.lru_cache(maxsize=1)
def _pool(scenes: EyeScenes) -> FramePool:
    """Rendered frames of a run, a gigabyte; cached in this process until another run
    asks.
    """
    return render_pool(scenes, scenes.settings.pool)


def _finest_affordable_pitch_um(run: CodesignRun, *, moves: bool) -> float:
    """:func:`finest_pitch_um` of the smallest network under the least budget.

    0 where the pitch does not move.

    Raises:
        TrainingError: it is coarser than the pitch that the run begins with.
    """
    settings = run.settings
    smallest = smallest_architecture(settings.space)
    budget = min(settings.run.budgets_mmacs) * 1e6
    start_um = settings.run.pitch_um
    macs = _macs_by_pitch(run, smallest)(start_um)
    if macs > budget:
        raise TrainingError(
            f"budget of {budget / 1e6:g} MMACs is below the smallest network, "
            f"{macs / 1e6:.2f} MMACs at run.pitch_um = {start_um:g}: raise "
            "run.budgets_mmacs, or begin with coarser pixels"
        )
    return finest_pitch_um(run, smallest, budget, begins_um=start_um) if moves else 0.0


def _macs_by_pitch(
    run: CodesignRun, architecture: Architecture
) -> Callable[[float], float]:
    """Multiply-accumulates of an architecture as a function of the pitch in um.

    The larger of the smooth count, which training uses, and that of whole pixels, which
    the search uses.
    """

    def count(pitch_um: float) -> float:
        size = run.window_um / pitch_um * architecture.resolution
        smooth = float(cost.macs_of_size(run.settings.space, architecture, size))
        return max(smooth, run.counted(architecture, pitch_um))

    return count


def finest_pitch_um(
    run: CodesignRun, architecture: Architecture, budget: float, *, begins_um: float
) -> float:
    """The finest pitch in um at which an architecture is within its budget, by
    geometric bisection.

    0 where it is within it even at the sampling of the image; at most ``begins_um``.

    Args:
        run: run with its model. architecture: member of the search space.
        budget: multiply-accumulates. begins_um: pitch that training begins with.
    """
    count = _macs_by_pitch(run, architecture)
    finest = min(run.settings.optics.sample_um, begins_um)
    if count(finest) <= budget:
        return 0.0
    affordable = begins_um
    for _ in range(40):
        middle = math.sqrt(finest * affordable)
        if count(middle) <= budget:
            affordable = middle
        else:
            finest = middle
    return affordable


def save_run(path: Path, run: CodesignRun) -> None:
    """Write a checkpoint of the training state and the searches so far; by process 0
    alone.

    Args:
        path: of the file. run: run with its model.
    """
    if parallel.process_rank():
        return
    state = {
        "trainer": run.trainer.state(),
        "searches": [evolution.state_to_json(s) for s in run.searches],
    }
    checkpoint.save_checkpoint(path, state, settings=run.settings)


def resume_run(path: Path, settings: RunConfig) -> CodesignRun:
    """The run of a checkpoint, ready to continue.

    Args:
        path: of the file. settings: of the run.

    Raises:
        TrainingError: no checkpoint, a damaged one, or one of other settings (the
            difference is named).
    """
    state = checkpoint.load_checkpoint(path, settings=settings)
    run = start_run(settings)
    run.trainer.restore(state["trainer"])
    run.searches = [evolution.state_from_json(table) for table in state["searches"]]
    return run


def train_run(run: CodesignRun, path: Path) -> Iterator[LogRecord]:
    """Train a run to its end with checkpoints, yielding a record a step.

    A step is yielded before its checkpoint, so that the caller's log contains every
    saved step.

    Args:
        run: run with its model. path: of the checkpoint.
    """
    for record in run.trainer.run():
        yield record
        if (
            record.step % run.settings.checkpoint_every == 0
            or record.step == run.settings.inner.steps
        ):
            save_run(path, run)
