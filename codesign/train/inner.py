"""The inner loop: lens, pixel pitch and network weights move together against one loss (paper Eqs. 8 and 10).

Every step draws its frames, architectures, noise and lens errors from the seed and the step's number alone, so a run
that is stopped anywhere goes on bit for bit. Optics, pitch and weights have their own rates, clips and schedules: the
gradients of phase coefficients are a hundred times smaller than those of weights, and one shared clip never acts.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import torch
from torch import Tensor, nn

from codesign.batches import Batch, Flat, depth_um, irradiance, parallel, samples
from codesign.network import Architecture, Baseline, Name, Space, Supernet, blur, cost, losses, make, smallest
from codesign.optics import LensError, OpticsConfig, Stack
from codesign.optics import stack as lens
from codesign.train.evolution import Count, sandwich
from codesign.train.formation import depth_loss, network_macs, read_out
from codesign.train.light import Light
from metalens.ground.errors import ConfigError, TrainingError
from metalens.image import Frames, Imager, Sensor, UniformImager


class Scenes(Protocol):
    """Where frames come from: the same step gives the same frames."""

    @property
    def margin(self) -> int:
        """Samples around the frames that are blurred in but not seen."""

    def batch(self, step: int, size: int) -> Batch:
        """``size`` frames of training step ``step``."""


@dataclass(frozen=True, slots=True)
class Schedule:
    """How one group of parameters moves: Adam with warm-up, cosine decay, and its own clip.

    rate: largest learning rate; 0 keeps the group fixed.
    start, end: part of the run in which it moves.
    clip: largest norm of its gradient.
    """

    rate: float
    start: float = 0.0
    end: float = 1.0
    clip: float = 1.0

    def __post_init__(self) -> None:
        if not (self.rate >= 0 and 0 <= self.start < self.end <= 1 and self.clip > 0):
            raise ConfigError(f"{self}: need rate >= 0, 0 <= start < end <= 1, clip > 0")

    def at(self, progress: float) -> float:
        """Learning rate at this part of the run."""
        if not self.start <= progress < self.end:
            return 0.0
        inside = (progress - self.start) / (self.end - self.start)
        return self.rate * min(1.0, inside / 0.1 + 0.01) * (0.5 + 0.5 * math.cos(math.pi * inside))


@dataclass(frozen=True, slots=True)
class InnerConfig:
    """Settings of the inner loop.

    steps, batch, seed: of the run. subnets: sampled beside the largest and the smallest (sandwich rule); with
        ``architecture`` fixed, that one alone is trained.
    weights, optics, pitch: schedules of the three groups. The pitch never gets finer than the samples of the image, nor
        so coarse that least resolution leaves a network less than 16 pixels.
    slip_weight, optics_weight, budget_weight: of Eq. 10. depth_weight: of the depths of windows.
    energy: encircled share that the optics loss keeps.
    budget_mmacs: C_budget; 0 for those of the run, in turn. Members lower their resolution to keep it
        (:func:`sandwich`); the hinge acts on those that cannot.
    slip_scale_mm: spread of the slippage, the unit of the network's answer.
    refresh: steps after which the true image is formed anew while the lens moves. draws: field points and wavelengths a
        step through which its gradient goes; few are noisier and quicker.
    patience: steps without a finite gradient, one after the other, that end the run.
    """

    steps: int = 1000
    batch: int = 32
    seed: int = 0
    subnets: int = 1
    weights: Schedule = field(default_factory=lambda: Schedule(4e-3, clip=2.0))
    optics: Schedule = field(default_factory=lambda: Schedule(0.02, 0.1, 0.8, clip=1.0))
    pitch: Schedule = field(default_factory=lambda: Schedule(0.0, 0.1, 0.8, clip=1.0))
    slip_weight: float = 2.0
    depth_weight: float = 0.5
    optics_weight: float = 0.05
    budget_weight: float = 1.0
    energy: float = 0.4
    budget_mmacs: float = 0.0
    slip_scale_mm: tuple[float, float, float] = (1.4, 1.2, 2.3)
    refresh: int = 50
    draws: int = 4
    patience: int = 20

    def __post_init__(self) -> None:
        if min(self.steps, self.batch, self.patience, self.refresh, self.draws) < 1 or self.subnets < 0:
            raise ConfigError(
                f"steps {self.steps}, batch {self.batch}, patience {self.patience}, refresh {self.refresh}, draws "
                f"{self.draws}: need 1 or more"
            )


@dataclass(eq=False)
class Model:
    """What training moves.

    coefficients_rad: (polynomials,) of the lens. log_pitch: logarithm of the pixel pitch in um.
    """

    net: Supernet | Baseline
    coefficients_rad: nn.Parameter
    log_pitch: nn.Parameter

    @property
    def pitch_um(self) -> Tensor:
        """Pixel pitch, always above 0."""
        return self.log_pitch.exp()


@dataclass(frozen=True, slots=True)
class Record:
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


def model(
    settings: OpticsConfig, *, pitch_um: float, seed: int, space: Space | None = None, network: Name = "supernet"
) -> Model:
    """A fresh model: network weights from the seed, a lens without added phase."""
    torch.manual_seed(seed)
    net = Supernet(space) if network == "supernet" else make(network)
    net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # twice as fast on a processor
    return Model(
        net,
        nn.Parameter(torch.zeros(settings.polynomials, dtype=torch.float64)),
        nn.Parameter(torch.tensor(math.log(pitch_um), dtype=torch.float64)),
    )


class Trainer:
    """The loop with its optimisers; ``state`` and ``restore`` keep everything that a resume needs."""

    def __init__(
        self,
        inner: InnerConfig,
        optics: OpticsConfig,
        sensor: Sensor,
        scenes: Scenes,
        made: Model,
        *,
        architecture: Architecture | None = None,
        stacks: Sequence[Stack] = (),
        budgets_mmacs: Sequence[float] = (),
        largest_only: bool = False,
    ) -> None:
        """``stacks``: PSFs of a lens that is already made; every step draws one of them, and no optics move.

        ``budgets_mmacs``: one a step, in turn, where ``inner`` names none. ``largest_only``: of a step's members.
        """
        self.largest_only = largest_only
        self.budgets_mmacs = (inner.budget_mmacs,) if inner.budget_mmacs else tuple(budgets_mmacs)
        self.inner, self.optics, self.sensor, self.scenes, self.model = inner, optics, sensor, scenes, made
        self.architecture = architecture
        self.light = Light(
            optics, stacks, refresh=inner.refresh, draws=inner.draws, seed=inner.seed, draw=self._lens_error
        )
        self.groups: dict[str, tuple[Schedule, list[nn.Parameter]]] = {
            "weights": (inner.weights, list(made.net.parameters())),
            "optics": (inner.optics, [made.coefficients_rad] if made.coefficients_rad.numel() else []),
            "pitch": (inner.pitch, [made.log_pitch]),
        }
        self.optimisers = {
            name: torch.optim.AdamW(parameters, weight_decay=0.01 if name == "weights" else 0.0, fused=True)
            for name, (_, parameters) in self.groups.items()
            if parameters
        }
        self.step, self.skipped, self.bad_run = 0, 0, 0
        self.pitch_held_um: float | None = None  # where the last step was held back from a finer or coarser pitch
        self._begins_um = float(made.pitch_um.detach())
        self._coarsest_um = math.inf  # until the first frames say how wide they are

    def run(self, *, until: int | None = None) -> Iterator[Record]:
        """Train to ``until`` (the end of the run without it), yielding a record a step.

        Raises:
            TrainingError: no finite gradient for ``patience`` steps, with the cause.
        """
        self.model.net.train()
        while self.step < min(until or self.inner.steps, self.inner.steps):
            yield self._advance()

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
        self.step, self.skipped, self.bad_run = state["counters"]  # type: ignore[misc]
        self.light.restore(state["light"])  # type: ignore[arg-type]
        self.pitch_held_um = state["pitch_held_um"]  # type: ignore[assignment]

    def _advance(self) -> Record:
        progress = self.step / self.inner.steps
        rates = {name: schedule.at(progress) for name, (schedule, _) in self.groups.items()}
        for optimiser in self.optimisers.values():
            optimiser.zero_grad(set_to_none=True)
        task, optics_loss, each = self._losses(
            live=rates["optics"] > 0 and "optics" in self.optimisers, pitch_moves=rates["pitch"] > 0
        )
        total, macs = task + self.inner.optics_weight * optics_loss, each.mean()
        if self._budget:
            total = total + self.inner.budget_weight * losses.over_budget(each, self._budget).mean()
        total.backward()  # type: ignore[no-untyped-call]
        self.light.pass_on(self.step, self.model.coefficients_rad)
        parallel.average(p for _, ps in self.groups.values() for p in ps)
        self._apply(rates, finite=math.isfinite(parallel.mean_of([float(total.detach())])[0]) and self._finite())
        self.step += 1
        values = (total, task, optics_loss, self.model.pitch_um, macs / 1e6)
        loss, task_loss, optics_value, pitch_um, mmacs = parallel.mean_of([float(v.detach()) for v in values])
        return Record(self.step, loss, task_loss, optics_value, pitch_um, mmacs, self.skipped)

    def _losses(self, *, live: bool, pitch_moves: bool) -> tuple[Tensor, Tensor, Tensor]:
        batch = parallel.part_of(self.scenes.batch(self.step, self.inner.batch))
        with torch.set_grad_enabled(live):
            optics, optics_loss = self._light(batch.frames, live)
            light = irradiance(batch.frames, optics, margin=self.scenes.margin)
        pitch = self.model.pitch_um if pitch_moves else self.model.pitch_um.detach()
        scale = torch.tensor(self.inner.slip_scale_mm)
        size = light.shape[-1] * self.optics.sample_um
        self._coarsest_um = cost.coarsest_um(size, self.model.net.space.resolution[0])
        members = self._members(lambda a: float(network_macs(self.model.net, a, size, pitch.detach())))

        seen = {}  # every reading starts the same stream of noise: networks differ by what they see, not by luck
        for resized in {pitch_moves and a.resolution < 1 for a in members}:
            noise = self._generator(1)
            seen[resized] = read_out(
                light, self.optics.sample_um, pitch, self.sensor, generator=noise, exact=False, resized=resized
            )
        vergence = blur.window_vergence(depth_um(batch.frames, margin=self.scenes.margin))
        parts = []
        for a in members:
            answer = self.model.net(seen[pitch_moves and a.resolution < 1], a)
            parts.append(losses.task(answer, batch.mask, batch.slip_mm, scale, slip_weight=self.inner.slip_weight))
            parts[-1] = parts[-1] + losses.reading(
                answer, vergence, batch.slip_mm, scale, depth_weight=self.inner.depth_weight
            )
        macs = torch.stack([network_macs(self.model.net, a, size, pitch) for a in members])
        return torch.stack(parts).mean(), optics_loss, macs

    def _light(self, frames: Frames | Flat, live: bool) -> tuple[UniformImager | Imager, Tensor]:
        """What images this step's frames, and the optics loss."""
        coefficients = self.model.coefficients_rad
        optics = self.light.at(self.step, coefficients, samples(frames), self.scenes.margin, live=live)
        if self.light.stacks or not (live and self.inner.optics_weight):
            return optics, torch.zeros(())
        made = lens.stack(self.optics, coefficients, error=self._lens_error())
        return optics, depth_loss(made, self.optics, energy=self.inner.energy)

    def _lens_error(self, step: int | None = None) -> LensError | None:
        return self.optics.spread.draw(self._generator(2, step))

    def _members(self, count: Count) -> Sequence[Architecture]:
        if self.architecture is not None:
            return [self.architecture]
        space = self.model.net.space
        if isinstance(self.model.net, Baseline):
            return [smallest(space)]
        generator = np.random.default_rng([self.inner.seed, self.step, 3])
        members = sandwich(space, count, self._budget, generator, subnets=self.inner.subnets)
        return members[:1] if self.largest_only else list(dict.fromkeys(members))  # equal ones count once

    @property
    def _budget(self) -> float:
        """Multiply-accumulates that this step's members may take; 0 for any."""
        return self.budgets_mmacs[self.step % len(self.budgets_mmacs)] * 1e6 if self.budgets_mmacs else 0.0

    def _generator(self, stream: int, step: int | None = None) -> torch.Generator:
        at = self.step if step is None else step
        seed = int(np.random.SeedSequence([self.inner.seed, at, stream]).generate_state(1, np.uint64)[0])
        return torch.Generator().manual_seed(seed >> 1)

    def _finite(self) -> bool:
        grads = [p.grad for _, ps in self.groups.values() for p in ps if p.grad is not None]
        return all(bool(torch.isfinite(g).all()) for g in grads)

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
            finest, coarsest = min(self.optics.sample_um, self._begins_um), max(self._coarsest_um, self._begins_um)
            wanted = float(self.model.pitch_um.detach())
            self.pitch_held_um = finest if wanted < finest else coarsest if wanted > coarsest else None
            with torch.no_grad():
                self.model.log_pitch.clamp_(math.log(finest), math.log(coarsest))

    def _culprits(self) -> str:
        bad = [
            name
            for name, (_, parameters) in self.groups.items()
            if any(p.grad is not None and not bool(torch.isfinite(p.grad).all()) for p in parameters)
        ]
        return "not finite: " + (" and ".join(bad) if bad else "the loss itself")


__all__ = ["Batch", "InnerConfig", "Model", "Record", "Scenes", "Schedule", "Trainer", "model"]
