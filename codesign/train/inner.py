"""The inner loop: lens, pixel pitch and network weights move together against one loss
(paper Eqs. 8 and 10).
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np
import torch
from pytorch_optimizer import SOAP
from torch import Tensor, nn

from codesign.batches import (
    EyePose,
    EyeScenes,
    FrameBatch,
    SceneSource,
    SingleSurfaceFrames,
    depth_um,
    frame_samples,
    parallel,
    sensor_irradiance,
)
from codesign.network import Architecture, Prediction, blur, cost, losses, running
from codesign.optics import LensError, OpticsConfig, PixelPsfStack
from codesign.optics import stack as lens
from codesign.train import moving
from codesign.train.ahead import prefetch, renderer_threads
from codesign.train.evolution import Count, sample_sandwich
from codesign.train.formation import depth_loss, frame_wide, network_macs, read_out
from codesign.train.light import StepImaging
from codesign.train.moving import LearningRateSchedule, TrainedModel, make_model
from codesign.train.separability import (
    SeparabilityConfig,
    fisher_separability,
    triplet_frames,
)
from metalens.core import threads
from metalens.core.errors import ConfigError, TrainingError
from metalens.image import Frames, Imager, Sensor, encircled_energy


@dataclass(frozen=True, slots=True)
class InnerConfig:
    """Settings of the inner loop.

    steps, batch, seed: of the run. subnets: sampled beside the largest and the smallest
    (sandwich rule); with
        ``architecture`` fixed, that one alone is trained.
    weights, optics, pitch: schedules of the three groups. The pitch never gets finer
    than the samples of the image or
        than the run's budgets allow, nor so coarse that least resolution leaves a
        network less than 16 pixels.
    slip_weight, optics_weight, budget_weight: of Eq. 10. separability: Eq. 6, the
    optics loss; while it is off, a bound on the depth in blurred texture stands for it.
    depth_weight: of the depths of
    windows.
    axis_weight, point_weight: of the optic axis and the landmarks, which gaze is read
    from; 0 where slippage alone
        counts: they cost a tenth of what is read along the axis.
    energy: encircled share that the optics loss keeps.
    budget_mmacs: C_budget; 0 for those of the run, in turn. Members lower their
    resolution to keep it
        (:func:`sandwich`); the hinge acts on those that cannot.
    slip_scale_mm: spread of the slippage, the unit of the network's answer.
    refresh: steps after which the true image is formed anew while the lens moves.
    draws: field points and wavelengths a
        step through which its gradient goes; few are noisier and quicker.
    patience: steps without a finite gradient, one after the other, that end the run.
    """

    steps: int = 1000
    batch: int = 32
    seed: int = 0
    subnets: int = 1
    weights: LearningRateSchedule = field(
        default_factory=lambda: LearningRateSchedule(4e-3, clip=2.0)
    )
    optics: LearningRateSchedule = field(
        default_factory=lambda: LearningRateSchedule(0.02, 0.1, 0.8, clip=1.0)
    )
    pitch: LearningRateSchedule = field(
        default_factory=lambda: LearningRateSchedule(0.0, 0.1, 0.8, clip=1.0)
    )
    slip_weight: float = 2.0
    depth_weight: float = 0.5
    axis_weight: float = 0.5
    point_weight: float = 0.2
    optics_weight: float = 0.05
    budget_weight: float = 1.0
    energy: float = field(default=0.4, metadata={"most": 1.0})
    budget_mmacs: float = 0.0
    slip_scale_mm: tuple[float, float, float] = (1.4, 1.2, 2.3)
    refresh: int = 50
    draws: int = 4
    patience: int = 20
    separability: SeparabilityConfig = field(default_factory=SeparabilityConfig)

    def __post_init__(self) -> None:
        if (
            min(self.steps, self.batch, self.patience, self.refresh, self.draws) < 1
            or min(self.slip_scale_mm) <= 0
        ):
            raise ConfigError(
                f"steps {self.steps}, batch {self.batch}, patience {self.patience}, refresh {self.refresh}, draws "
                f"{self.draws}: need 1 or more; slip_scale_mm {self.slip_scale_mm}: need all above 0"
            )


def _reading_layers(net: nn.Module) -> list[nn.Parameter]:
    """Weights of the dense layers that read blur and slippage, which every member of an
    elastic network uses whole, in the order of its parameters.
    """
    rooms = [
        getattr(net, name) for name in ("blur", "calibration") if hasattr(net, name)
    ]
    layers = [
        m
        for room in rooms
        for m in room.modules()
        if isinstance(m, nn.Linear | nn.Conv2d)
    ]
    weights: list[nn.Parameter] = [cast("nn.Parameter", m.weight) for m in layers]
    return [w for w in weights if w[0].numel() == w.shape[1] and min(w.shape[:2]) >= 8]


class _Soap(SOAP):
    """SOAP whose axes lie in memory as a checkpoint gives them back: products of
    other layouts round otherwise, and a resumed run would part from the whole one.
    """

    @staticmethod
    def get_orthogonal_matrix(mat: Any) -> list[Any]:
        return _contiguous(SOAP.get_orthogonal_matrix(mat))

    def get_orthogonal_matrix_qr(self, *given: Any, **named: Any) -> list[Any]:
        return _contiguous(super().get_orthogonal_matrix_qr(*given, **named))


def _contiguous(axes: list[Any]) -> list[Any]:
    return [one.contiguous() if isinstance(one, Tensor) else one for one in axes]


def _soap(weights: list[nn.Parameter]) -> torch.optim.Optimizer:
    """SOAP; sides above 600 keep their own axes, whose moments would cost too much."""
    made: torch.optim.Optimizer = _Soap(
        weights, betas=(0.9, 0.98), weight_decay=0.01, max_precondition_dim=600
    )
    return made


@dataclass(frozen=True, eq=False, slots=True)
class StepInputs:
    """What a step trains on.

    light: (batch, y, x) on the sensor. vergence: (batch, windows, windows) of
    :func:`blur.window_vergence`.
    seen: (batch, 1, rows, columns) frames of the sensor; None where the pitch moves,
    and members see it differently.
    """

    step: int
    batch: FrameBatch
    light: Tensor
    optics_loss: Tensor
    vergence: Tensor
    seen: Tensor | None


@dataclass(frozen=True, slots=True)
class LogRecord:
    """One line of the log.

    skipped: steps so far whose gradient was not finite.
    """

    step: int
    loss: float
    task: float
    optics: float
    pitch_um: float
    mmacs: float
    skipped: int


class Trainer:
    """The loop with its optimisers; ``state`` and ``restore`` keep everything that a
    resume needs.
    """

    def __init__(
        self,
        inner: InnerConfig,
        optics: OpticsConfig,
        sensor: Sensor,
        scenes: SceneSource,
        made: TrainedModel,
        *,
        architecture: Architecture | None = None,
        stacks: Sequence[PixelPsfStack] = (),
        budgets_mmacs: Sequence[float] = (),
        largest_only: bool = False,
        triplets: EyeScenes | None = None,
    ) -> None:
        """One training.

        Args:
            stacks: PSFs of a lens that is already made; every step draws one of them,
                and no optics move.
            budgets_mmacs: one a step, in turn, where ``inner`` names none.
            largest_only: of a step's members.
            triplets: scenes that the triplets of Eq. 6 are drawn from.
        """
        self.largest_only, self.triplets = largest_only, triplets
        self.budgets_mmacs = (
            (inner.budget_mmacs,) if inner.budget_mmacs else tuple(budgets_mmacs)
        )
        self.inner, self.optics, self.sensor, self.scenes, self.model = (
            inner,
            optics,
            sensor,
            scenes,
            made,
        )
        self.architecture = architecture
        self.light = StepImaging(
            optics,
            stacks,
            refresh=inner.refresh,
            draws=inner.draws,
            seed=inner.seed,
            draw=self._lens_error,
        )
        reading = _reading_layers(made.net)
        others = [p for p in made.net.parameters() if all(p is not q for q in reading)]
        self.groups: dict[str, tuple[LearningRateSchedule, list[nn.Parameter]]] = {
            "weights": (inner.weights, others),
            "reading": (inner.weights, reading),
            "optics": (
                inner.optics,
                [made.coefficients_rad] if made.coefficients_rad.numel() else [],
            ),
            "pitch": (inner.pitch, [made.log_pitch]),
        }
        self.optimisers: dict[str, torch.optim.Optimizer] = {
            name: _soap(parameters)
            if name == "reading"
            else torch.optim.AdamW(
                parameters, weight_decay=0.01 if name == "weights" else 0.0, fused=True
            )
            for name, (_, parameters) in self.groups.items()
            if parameters
        }
        self.step, self.skipped, self.bad_run = 0, 0, 0
        self.pitch_held_um: float | None = (
            None  # where the last step was held back from a finer or coarser pitch
        )
        self._begins_um = float(made.pitch_um.detach())
        self._coarsest_um = math.inf  # until the first frames say how wide they are

    def run(self, *, until: int | None = None) -> Iterator[LogRecord]:
        """Train to ``until`` (the end of the run without it), yielding a record a step.

        Raises:
            TrainingError: no finite gradient for ``patience`` steps, with the cause.
        """
        threads.keep_memory()
        self.model.net.train()
        end = min(until or self.inner.steps, self.inner.steps)
        workers = renderer_threads(self.light.device)
        for batch in prefetch(self._batch, range(self.step, end), workers=workers):
            yield self._advance(batch)

    def state(self) -> dict[str, object]:
        """Everything that the next step depends on."""
        return {
            "net": self.model.net.state_dict(),
            "coefficients_rad": self.model.coefficients_rad.detach(),
            "log_pitch": self.model.log_pitch.detach(),
            "optimisers": {name: o.state_dict() for name, o in self.optimisers.items()},
            "light": self.light.state(),
            "pitch_held_um": self.pitch_held_um,
            "counters": [self.step, self.skipped, self.bad_run],
        }

    def restore(self, state: dict[str, object]) -> None:
        """Go on from what :meth:`state` gave."""
        self.model.net.load_state_dict(state["net"])  # type: ignore[arg-type]
        with torch.no_grad():
            self.model.coefficients_rad.copy_(state["coefficients_rad"])  # type: ignore[arg-type]
            self.model.log_pitch.copy_(state["log_pitch"])  # type: ignore[arg-type]
        for name, optimiser in self.optimisers.items():
            optimiser.load_state_dict(state["optimisers"][name])  # type: ignore[index]
            moving.laid_out(optimiser)
        self.step, self.skipped, self.bad_run = state["counters"]  # type: ignore[misc]
        self.light.restore(state["light"])  # type: ignore[arg-type]
        self.pitch_held_um = state["pitch_held_um"]  # type: ignore[assignment]

    def _advance(self, batch: FrameBatch) -> LogRecord:
        progress = self.step / self.inner.steps
        rates = {
            name: schedule.at(progress) for name, (schedule, _) in self.groups.items()
        }
        for optimiser in self.optimisers.values():
            optimiser.zero_grad(set_to_none=True)
        moves, live = (
            rates["pitch"] > 0,
            rates["optics"] > 0 and "optics" in self.optimisers,
        )
        return self._stepped(
            self._given(self.step, batch, live=live, seen=not moves), rates
        )

    def _stepped(self, given: StepInputs, rates: dict[str, float]) -> LogRecord:
        """A step of every optimiser on what is given."""
        means = running.keep_running_means(self.model.net)
        task, each = self._losses(given, pitch_moves=rates["pitch"] > 0)
        optics_loss = given.optics_loss
        total, macs = (
            task + self.inner.optics_weight * optics_loss.to(self.light.device),
            each.mean(),
        )
        if self._budget:
            over = losses.over_budget(each, self._budget).mean()
            total = total + self.inner.budget_weight * over.to(self.light.device)
        total.backward()  # type: ignore[no-untyped-call]
        self.light.pass_on(self.model.coefficients_rad)
        parallel.average_gradients(p for _, ps in self.groups.values() for p in ps)
        finite = math.isfinite(parallel.mean_of([float(total.detach())])[0])
        finite = finite and moving.has_finite_gradients(
            p for _, ps in self.groups.values() for p in ps
        )
        if not finite:
            running.put_back(means)
        self._apply(rates, finite=finite)
        self.step += 1
        values = (total, task, optics_loss, self.model.pitch_um, macs / 1e6)
        loss, task_loss, optics_value, pitch_um, mmacs = parallel.mean_of(
            [float(v.detach()) for v in values]
        )
        return LogRecord(
            self.step, loss, task_loss, optics_value, pitch_um, mmacs, self.skipped
        )

    def _batch(self, step: int) -> FrameBatch:
        """The frames of a step, by its number alone."""
        return parallel.part_of(self.scenes.batch(step, self.inner.batch))

    def _given(
        self, step: int, batch: FrameBatch, *, live: bool, seen: bool
    ) -> StepInputs:
        """What a step trains on; ``seen``: as the pixels give it, which takes a pitch
        that does not move.
        """
        margin, pitch = self.scenes.margin, self.model.pitch_um.detach()
        with torch.set_grad_enabled(live):
            optics, optics_loss = self._light(step, batch.frames, live)
            light = sensor_irradiance(batch.frames, optics)
        vergence = blur.window_vergence(
            depth_um(batch.frames, margin=margin, device=self.light.device)
        )
        frames = self._read(step, light, pitch, False) if seen else None
        return StepInputs(
            step, batch.to(self.light.device), light, optics_loss, vergence, frames
        )

    def _read(self, step: int, light: Tensor, pitch: Tensor, resized: bool) -> Tensor:
        """Frames of the sensor. All readings of a step begin the same noise: networks
        differ by what they see.
        """
        noise = self._generator(1, step)
        return read_out(
            light,
            self.optics.sample_um,
            pitch,
            self.sensor,
            generator=noise,
            exact=False,
            resized=resized,
        )

    def _losses(self, given: StepInputs, *, pitch_moves: bool) -> tuple[Tensor, Tensor]:
        """Mean task loss of the step's members, and the multiply-accumulates of each."""
        pitch = self.model.pitch_um if pitch_moves else self.model.pitch_um.detach()
        scale = torch.tensor(self.inner.slip_scale_mm, device=self.light.device)
        size = given.light.shape[-1] * self.optics.sample_um
        self._coarsest_um = cost.coarsest_um(size, self.model.net.space.resolution[0])
        members = self._members(
            lambda a: float(network_macs(self.model.net, a, size, pitch.detach()))
        )
        finer = {a: pitch_moves and a.resolution < 1 for a in members}
        frames = {False: given.seen} if given.seen is not None else {
            resized: self._read(given.step, given.light, pitch, resized) for resized in set(finer.values())
        }  # fmt: skip
        batch, pose, parts = given.batch, given.batch.pose, []
        wide = frame_wide(
            given.light.shape[-1], self.optics.sample_um, float(pitch.detach())
        )
        mask = losses.mask_in_frame(batch.mask, wide)
        shift = batch.slip_mm if pose is None else pose.shift_mm
        for a in members:
            answer = self.model.net(frames[finer[a]], a)
            loss = losses.task_loss(
                answer, mask, shift, scale, slip_weight=self.inner.slip_weight
            )
            loss = loss + losses.depth_reading_loss(
                answer,
                given.vergence,
                shift,
                scale,
                depth_weight=self.inner.depth_weight,
            )
            parts.append(
                loss if pose is None else loss + self._pose(answer, pose, wide)
            )
        macs = torch.stack(
            [network_macs(self.model.net, a, size, pitch) for a in members]
        )
        return torch.stack(parts).mean(), macs

    def _pose(self, answer: Prediction, pose: EyePose, wide: float) -> Tensor:
        weights = {
            "axis_weight": self.inner.axis_weight,
            "point_weight": self.inner.point_weight,
        }
        return losses.pose_loss(answer, pose.axis, pose.points / wide, **weights)

    def _light(
        self, step: int, frames: Frames | SingleSurfaceFrames, live: bool
    ) -> tuple[Imager, Tensor]:
        """What images this step's frames, and the optics loss."""
        coefficients = self.model.coefficients_rad
        optics = self.light.at(
            step, coefficients, frame_samples(frames), self.scenes.margin, live=live
        )
        if self.light.stacks or not (live and self.inner.optics_weight):
            return optics, torch.zeros(())
        config, every = self.inner.separability, self.inner.separability.every
        if every and (self.triplets is None or step % every):
            return optics, torch.zeros(())
        made = lens.lens_psf_stack(
            self.optics, coefficients, error=self._lens_error(step)
        )
        if not every or self.triplets is None:
            return optics, depth_loss(made, self.optics, energy=self.inner.energy)
        found = fisher_separability(
            triplet_frames(self.triplets, config, step),
            lambda one: sensor_irradiance(one, optics),
            encircled_energy(
                made.intensity,
                self.optics.sample_um,
                radius_um=2 * self.optics.sample_um,
            ),
            config,
            sensor=replace(self.sensor, pitch_um=float(self.model.pitch_um.detach())),
            sample_um=self.optics.sample_um,
        )
        return optics, every * found.loss.value  # of weight optics_weight on average

    def _lens_error(self, step: int | None = None) -> LensError | None:
        return self.optics.spread.draw(self._generator(2, step))

    def _members(self, count: Count) -> Sequence[Architecture]:
        if self.architecture is not None:
            return [self.architecture]
        space = self.model.net.space
        generator = np.random.default_rng([self.inner.seed, self.step, 3])
        members = sample_sandwich(
            space, count, self._budget, generator, subnets=self.inner.subnets
        )
        return (
            members[:1] if self.largest_only else list(dict.fromkeys(members))
        )  # equal ones count once

    @property
    def _budget(self) -> float:
        """Multiply-accumulates that this step's members may take; 0 for any."""
        return (
            self.budgets_mmacs[self.step % len(self.budgets_mmacs)] * 1e6
            if self.budgets_mmacs
            else 0.0
        )

    def _generator(self, stream: int, step: int | None = None) -> torch.Generator:
        at = self.step if step is None else step
        seed = int(
            np.random.SeedSequence([self.inner.seed, at, stream]).generate_state(
                1, np.uint64
            )[0]
        )
        return torch.Generator().manual_seed(seed >> 1)

    def _apply(self, rates: dict[str, float], *, finite: bool) -> None:
        if not finite:
            self.skipped, self.bad_run = self.skipped + 1, self.bad_run + 1
            if self.bad_run >= self.inner.patience:
                raise TrainingError(
                    f"no finite gradient in {self.bad_run} steps up to step {self.step}; {self._culprits()}; "
                    "lower the learning rates or resume from an earlier checkpoint"
                )
            return
        self.bad_run = 0
        for name, optimiser in self.optimisers.items():
            schedule, parameters = self.groups[name]
            if rates[name] > 0:
                nn.utils.clip_grad_norm_(parameters, schedule.clip)
                for group in optimiser.param_groups:
                    group["lr"] = rates[name]
                optimiser.step()
        if rates["pitch"] > 0:  # pixels finer than the image's samples show nothing new
            finest = min(
                max(self.optics.sample_um, self.model.finest_um), self._begins_um
            )
            self.pitch_held_um = self.model.hold(
                finest, max(self._coarsest_um, self._begins_um)
            )

    def _culprits(self) -> str:
        bad = [
            name
            for name, (_, parameters) in self.groups.items()
            if not moving.has_finite_gradients(parameters)
        ]
        return "not finite: " + (" and ".join(bad) if bad else "the loss itself")


__all__ = [
    "FrameBatch",
    "InnerConfig",
    "LearningRateSchedule",
    "LogRecord",
    "SceneSource",
    "TrainedModel",
    "Trainer",
    "make_model",
]
