"""The inner loop: lens, pixel pitch and network weights trained with one loss
(paper Eqs. 8 and 10).
"""
# ruff: noqa: RUF009  (records of settings are frozen)

import math
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Any, TypeVar, cast

import numpy as np
import torch
from pytorch_optimizer import SOAP
from torch import Tensor, nn

from codesign.batches import (
    EyeScenes,
    FrameBatch,
    SceneSource,
    SingleSurfaceFrames,
    depth_um,
    frame_samples,
    parallel,
    sensor_irradiance,
)
from codesign.network import Architecture, SearchSpace, Supernet, blur, cost, losses
from codesign.optics import DrawnLensErrors, OpticsConfig, PixelPsfStack
from codesign.optics import stack as lens
from codesign.settings import LARGEST, LEAST, Place, check_ranges
from codesign.train.evolution import Count, sample_sandwich
from codesign.train.imaging import StepImaging, frame_wide, read_out, seeded_generator
from codesign.train.separability import (
    SeparabilityConfig,
    fisher_separability,
    texture_depth_loss,
    triplet_frames,
)
from metalens.core.errors import ConfigError, TrainingError
from metalens.image import Frames, Imager, Sensor, encircled_energy

Made = TypeVar("Made")


@dataclass(frozen=True, slots=True)
class LearningRateSchedule:
    """How one group of parameters moves: Adam with warm-up, cosine decay, and its own
    clip.

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
            raise ConfigError(
                f"{self}: need rate >= 0, 0 <= start < end <= 1, clip > 0"
            )

    def at(self, progress: float) -> float:
        """Learning rate: linear warm-up, then cosine decay; 0 outside [start, end).

        rate * min(1, x / 0.1 + 0.01) * (1 + cos(pi x)) / 2, x = (progress - start) /
        (end - start).

        Args:
            progress: fraction of the run that is done, 0 to 1.
        """
        if not self.start <= progress < self.end:
            return 0.0
        x = (progress - self.start) / (self.end - self.start)
        return (
            self.rate * min(1.0, x / 0.1 + 0.01) * (0.5 + 0.5 * math.cos(math.pi * x))
        )


@dataclass(eq=False)
class TrainedModel:
    """Trainable parameters: network, lens coefficients and pixel pitch.

    coefficients_rad: (polynomials,) of the lens. log_pitch: logarithm of the pixel
    pitch in um. finest_um: pitch below which no network of the run keeps its budget;
    0 for none.
    """

    net: Supernet
    coefficients_rad: nn.Parameter
    log_pitch: nn.Parameter
    finest_um: float = 0.0

    @property
    def pitch_um(self) -> Tensor:
        """Pixel pitch, always above 0."""
        return self.log_pitch.exp()

    def state(self) -> dict[str, Any]:
        """Weights, lens and pitch, for :meth:`restore`."""
        return {
            "net": self.net.state_dict(),
            "coefficients_rad": self.coefficients_rad.detach(),
            "log_pitch": self.log_pitch.detach(),
        }

    @torch.no_grad()
    def restore(self, state: dict[str, Any]) -> None:
        """Copy what :meth:`state` returned into this model."""
        self.net.load_state_dict(state["net"])
        self.coefficients_rad.copy_(state["coefficients_rad"])
        self.log_pitch.copy_(state["log_pitch"])


def make_model(
    settings: OpticsConfig,
    *,
    pitch_um: float,
    seed: int,
    space: SearchSpace | None = None,
) -> TrainedModel:
    """A fresh model: network weights from the seed, a lens without added phase.

    Args:
        settings: of the lens and its image. pitch_um: of the pixels.
        space: architectures to choose from; the default space without it.
    """
    torch.manual_seed(seed)
    net = Supernet(space)
    net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # twice as fast on a processor
    return TrainedModel(
        net,
        nn.Parameter(torch.zeros(lens.count_parameters(settings), dtype=torch.float64)),
        nn.Parameter(torch.tensor(math.log(pitch_um), dtype=torch.float64)),
    )


def has_finite_gradients(parameters: Iterable[nn.Parameter]) -> bool:
    """Whether every gradient is finite; parameters without one are left out.

    Args:
        parameters: with gradients.
    """
    grads = [p.grad for p in parameters if p.grad is not None]
    return bool(torch.isfinite(nn.utils.get_total_norm(grads)))


def align_moments(optimiser: torch.optim.Optimizer) -> None:
    """Copy the optimiser's moments to the memory layout of their parameters, in place.

    A fused step then walks both in the same order.

    Args:
        optimiser: with its moments.
    """
    for parameter, moments in optimiser.state.items():
        for name, value in moments.items():
            if (
                isinstance(value, Tensor)
                and name != "step"  # the count of a scalar is no moment of it
                and value.shape == parameter.shape
            ):
                moments[name] = torch.empty_like(parameter).copy_(value)


@dataclass(frozen=True, slots=True)
class InnerConfig:
    """Settings of the inner loop.

    steps, batch, seed: of the run. subnets: sampled with the largest and the smallest
    (sandwich rule); with
        ``architecture`` fixed, that one alone is trained.
    weights, optics, pitch: schedules of the three groups. The pitch never gets finer
    than the samples of the image or
        than the run's budgets allow, nor so coarse that least resolution leaves a
        network less than 16 pixels.
    slip_weight, optics_weight, budget_weight: of Eq. 10. separability: Eq. 6, the
    optics loss; while it is off, a bound on the depth in blurred texture stands for it.
    depth_weight: of the depths of windows.
    axis_weight, point_weight: of the optic axis and the landmarks, which gaze is read
    from; 0 where slippage alone
        counts: they cost a tenth of what is read along the axis.
    energy: encircled share that the loss by texture keeps.
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
    weights: LearningRateSchedule = LearningRateSchedule(4e-3, clip=2.0)
    optics: LearningRateSchedule = LearningRateSchedule(0.02, 0.1, 0.8, clip=1.0)
    pitch: LearningRateSchedule = LearningRateSchedule(0.0, 0.1, 0.8, clip=1.0)
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
    separability: SeparabilityConfig = SeparabilityConfig()

    def __post_init__(self) -> None:
        counts = ("steps", "batch", "patience", "refresh", "draws")
        check_ranges(self, **dict.fromkeys(counts, (1, LARGEST)))
        check_ranges(self, slip_scale_mm=(LEAST, LARGEST))

    def fine_tuning(self, steps: int, seed: int, **rates: float) -> "InnerConfig":
        """These settings for training on: groups move over all of it, others not.

        Args:
            steps: of the training, 1 at least. seed: of the training.
            rates: largest learning rate by name of a group.
        """
        groups = {
            name: replace(
                getattr(self, name), rate=rates.get(name, 0.0), start=0, end=1
            )
            for name in ("weights", "optics", "pitch")
        }
        return replace(self, steps=max(steps, 1), seed=seed, **groups)


def _reading_layers(net: nn.Module) -> list[nn.Parameter]:
    """Weight matrices of the linear and 1x1 layers of ``net.blur`` and
    ``net.calibration``.

    Every member of an elastic network uses these whole. Only layers whose two sides are
    8 or more, in the order of the network's parameters.
    """
    branches = [
        getattr(net, name) for name in ("blur", "calibration") if hasattr(net, name)
    ]
    layers = [
        m
        for branch in branches
        for m in branch.modules()
        if isinstance(m, nn.Linear | nn.Conv2d)
    ]
    weights: list[nn.Parameter] = [cast("nn.Parameter", m.weight) for m in layers]
    return [w for w in weights if w[0].numel() == w.shape[1] and min(w.shape[:2]) >= 8]


class _Soap(SOAP):
    """SOAP with contiguous preconditioner axes, as a checkpoint restores them.

    Products of other layouts round differently, and a resumed run would differ from an
    uninterrupted one.
    """

    @staticmethod
    def get_orthogonal_matrix(mat: Any) -> list[Any]:
        return _contiguous(SOAP.get_orthogonal_matrix(mat))

    def get_orthogonal_matrix_qr(self, *args: Any, **kwargs: Any) -> list[Any]:
        return _contiguous(super().get_orthogonal_matrix_qr(*args, **kwargs))


def _contiguous(axes: list[Any]) -> list[Any]:
    return [a.contiguous() if isinstance(a, Tensor) else a for a in axes]


def _soap(weights: list[nn.Parameter]) -> torch.optim.Optimizer:
    """SOAP optimiser of weight matrices; sides above 600 are not preconditioned.

    The preconditioner of a longer side would cost too much.
    """
    optimiser: torch.optim.Optimizer = _Soap(
        weights, betas=(0.9, 0.98), weight_decay=0.01, max_precondition_dim=600
    )
    return optimiser


@dataclass(frozen=True, slots=True)
class LogRecord:
    """One line of the log: losses, pitch in um and million multiply-accumulates of a
    step.

    loss: total. task, optics: terms of it, before weights. skipped: steps so far whose
    gradient was not finite.
    """

    step: int
    loss: float
    task: float
    optics: float
    pitch_um: float
    mmacs: float
    skipped: int


@dataclass(eq=False)
class Trainer:
    """The loop with its optimisers; ``state`` and ``restore`` keep everything that a
    resume needs.

    inner: settings of the loop. optics: of the lens and its image. sensor: its pixels
    and noise. scenes: frames by step number. model: network, lens and pitch to train.
    architecture: the only member that is trained; None trains sampled members.
    stacks: PSFs of a fabricated lens; every step draws one of them, and no optics move.
    budgets_mmacs: one a step, in turn, where ``inner`` names none.
    largest_only: train the largest member alone.
    triplets: scenes that the triplets of Eq. 6 are drawn from.
    """

    inner: InnerConfig
    optics: OpticsConfig
    sensor: Sensor
    scenes: SceneSource
    model: TrainedModel
    _: KW_ONLY
    architecture: Architecture | None = None
    stacks: Sequence[PixelPsfStack] = ()
    budgets_mmacs: Sequence[float] = ()
    largest_only: bool = False
    triplets: EyeScenes | None = None

    def __post_init__(self) -> None:
        inner, model = self.inner, self.model
        if inner.budget_mmacs:
            self.budgets_mmacs = (inner.budget_mmacs,)
        self.light = StepImaging(
            self.optics,
            self.stacks,
            refresh=inner.refresh,
            draws=inner.draws,
            seed=inner.seed,
            draw=self._lens_error,
        )
        reading = _reading_layers(model.net)
        others = [p for p in model.net.parameters() if all(p is not q for q in reading)]
        self.groups: dict[str, tuple[LearningRateSchedule, list[nn.Parameter]]] = {
            "weights": (inner.weights, others),
            "reading": (inner.weights, reading),
            "optics": (
                inner.optics,
                [model.coefficients_rad] if model.coefficients_rad.numel() else [],
            ),
            "pitch": (inner.pitch, [model.log_pitch]),
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
        self.step = 0
        self.skipped = 0
        self.bad_run = 0  # consecutive steps without a finite gradient
        self._begins_um = float(model.pitch_um.detach())
        self._coarsest_um = math.inf  # until the first frames say how wide they are

    def run(self, *, until: int | None = None) -> Iterator[LogRecord]:
        """Train up to step ``until`` (the end of the run without it), yielding a record
        a step.

        Raises:
            TrainingError: no finite gradient for ``patience`` steps, with the cause.
        """
        self.model.net.train()
        end = min(until or self.inner.steps, self.inner.steps)

        def batch_of(step: int) -> FrameBatch:
            return parallel.batch_share(self.scenes.batch(step, self.inner.batch))

        # on a processor training uses all cores, behind a GPU they render ahead
        ahead = map if self.light.device.type == "cpu" else compute_ahead
        for batch in ahead(batch_of, range(self.step, end)):
            yield self._advance(batch)

    def state(self) -> dict[str, Any]:
        """Everything that the next step depends on, for :meth:`restore`."""
        return {
            **self.model.state(),
            "optimisers": {name: o.state_dict() for name, o in self.optimisers.items()},
            "light": self.light.state(),
            "counters": [self.step, self.skipped, self.bad_run],
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state` returned: parameters, moments, counters and the
        image.
        """
        self.model.restore(state)
        for name, optimiser in self.optimisers.items():
            saved = state["optimisers"][name]
            moments = {int(k): v for k, v in saved["state"].items()}
            optimiser.load_state_dict({**saved, "state": moments})
            align_moments(optimiser)
        self.step, self.skipped, self.bad_run = state["counters"]
        self.light.restore(state["light"])

    def _advance(self, batch: FrameBatch) -> LogRecord:
        """Backward pass of Eq. 10 on a batch, and one step of every optimiser.

        L = L_task + w_optics L_optics + w_budget mean [C / C_budget - 1]_+. Gradients
        are averaged over the processes. A step without finite gradients changes no
        parameter.
        """
        progress = self.step / self.inner.steps
        rates = {
            name: schedule.at(progress) for name, (schedule, _) in self.groups.items()
        }
        for optimiser in self.optimisers.values():
            optimiser.zero_grad(set_to_none=True)
        buffers = [(buffer, buffer.clone()) for buffer in self.model.net.buffers()]
        lens_moves = rates["optics"] > 0 and "optics" in self.optimisers
        with torch.set_grad_enabled(lens_moves):
            imager, optics_loss = self._form_images(batch.frames, lens_moves)
            light = sensor_irradiance(batch.frames, imager)
        task, macs = self._losses(batch, light, pitch_moves=rates["pitch"] > 0)
        device = self.light.device
        total = task + self.inner.optics_weight * optics_loss.to(device)
        if self._budget:
            excess = losses.over_budget(macs, self._budget).mean()
            total = total + self.inner.budget_weight * excess.to(device)
        total.backward()  # type: ignore[no-untyped-call]
        self.light.pass_on(self.model.coefficients_rad)
        parameters = [p for _, ps in self.groups.values() for p in ps]
        parallel.average_gradients(parameters)
        finite = math.isfinite(parallel.mean_of(total.detach()))
        finite = finite and has_finite_gradients(parameters)
        for buffer, before in () if finite else buffers:  # running means
            buffer.copy_(before)
        self._apply(rates, finite=finite)
        self.step += 1
        values = (total, task, optics_loss, self.model.pitch_um, macs.mean() / 1e6)
        loss, task_loss, optics_value, pitch_um, mmacs = parallel.mean_of(
            torch.tensor([float(v.detach()) for v in values], dtype=torch.float64)
        ).tolist()
        return LogRecord(
            self.step, loss, task_loss, optics_value, pitch_um, mmacs, self.skipped
        )

    def _losses(
        self, batch: FrameBatch, light: Tensor, *, pitch_moves: bool
    ) -> tuple[Tensor, Tensor]:
        """Mean task loss of the step's members, and (members,) multiply-accumulates of
        each.

        The loss of a member is L_seg + w_slip L_calib, plus the losses of depth and
        pose.

        Args:
            light: (batch, y, x) irradiance on the sensor.
            pitch_moves: the frames are differentiable in the pitch.
        """
        pitch = self.model.pitch_um if pitch_moves else self.model.pitch_um.detach()
        device = self.light.device
        scale = torch.tensor(self.inner.slip_scale_mm, device=device)
        size_um = light.shape[-1] * self.optics.sample_um
        space = self.model.net.space
        self._coarsest_um = cost.coarsest_um(size_um, space.resolution[0])

        def macs_at(member: Architecture, pitch_um: Tensor) -> Tensor:
            pixels = size_um / pitch_um * member.resolution
            return cost.macs_of_size(space, member, pixels)

        pixels = size_um / float(pitch.detach())
        members = self._members(
            lambda a: cost.count_macs(space, a, pixels * a.resolution)
        )
        resized = {a: pitch_moves and a.resolution < 1 for a in members}
        # all readings draw the same noise, so that members differ by their weights alone
        frames = {
            coarser: read_out(
                light,
                self.optics.sample_um,
                pitch,
                self.sensor,
                generator=seeded_generator(self.inner.seed, self.step, 1),
                exact=False,
                resized=coarser,
            )
            for coarser in set(resized.values())
        }
        depths = depth_um(batch.frames, margin=self.scenes.margin, device=device)
        vergence = blur.window_vergence(depths)
        batch = batch.to(device)
        pose = batch.pose
        member_losses = []
        frame_width = frame_wide(
            light.shape[-1], self.optics.sample_um, float(pitch.detach())
        )
        mask = losses.mask_in_frame(batch.mask, frame_width)
        is_open = (batch.mask.amax((1, 2)) > 0)[:, None]
        shift_mm = batch.slip_mm if pose is None else pose.shift_mm
        for a in members:
            prediction = self.model.net(frames[resized[a]], a)
            loss = losses.task_loss(
                prediction, mask, shift_mm, scale, slip_weight=self.inner.slip_weight
            )
            loss = loss + losses.depth_reading_loss(
                prediction,
                vergence,
                shift_mm,
                scale,
                depth_weight=self.inner.depth_weight,
            )
            if pose is not None:
                # behind closed lids the pose is not known: no error, no gradient
                axis = torch.where(is_open, pose.axis, prediction.axis.detach())
                points = pose.points / frame_width
                loss = loss + losses.pose_loss(
                    prediction,
                    axis,
                    torch.where(is_open[:, None], points, prediction.points.detach()),
                    axis_weight=self.inner.axis_weight,
                    point_weight=self.inner.point_weight,
                )
            member_losses.append(loss)
        macs = torch.stack([macs_at(a, pitch) for a in members])
        return torch.stack(member_losses).mean(), macs

    def _form_images(
        self, frames: Frames | SingleSurfaceFrames, live: bool
    ) -> tuple[Imager, Tensor]:
        """Imager of this step's frames, and the optics loss.

        The loss is n times Eq. 6 at every n-th step, n = ``separability.every``, so that
        its weight is ``optics_weight`` on average. With n = 0 it is that of blurred
        texture at every step; 0 where the lens is fixed.
        """
        step, coefficients = self.step, self.model.coefficients_rad
        imager = self.light.at(
            step, coefficients, frame_samples(frames), self.scenes.margin, live=live
        )
        config = self.inner.separability
        weighs = live and not self.light.stacks and self.inner.optics_weight
        is_due = not config.every or (self.triplets and step % config.every == 0)
        if not weighs or not is_due:
            return imager, torch.zeros(())
        stack = lens.lens_psf_stack(
            self.optics, coefficients, error=self._lens_error(step)
        )
        if not config.every or self.triplets is None:
            return imager, texture_depth_loss(
                stack, self.optics, energy=self.inner.energy
            )
        separability = fisher_separability(
            triplet_frames(self.triplets, config, step),
            lambda scenes: sensor_irradiance(scenes, imager),
            encircled_energy(
                stack.intensity,
                self.optics.sample_um,
                radius_um=2 * self.optics.sample_um,
            ),
            config,
            sensor=replace(self.sensor, pitch_um=float(self.model.pitch_um.detach())),
            sample_um=self.optics.sample_um,
        )
        return imager, config.every * separability.loss.value

    def _lens_error(self, step: int) -> DrawnLensErrors | None:
        """Assembly and process error of one lens, drawn by step number; None for no
        spread.
        """
        return self.optics.spread.draw(seeded_generator(self.inner.seed, step, 2))

    def _members(self, count: Count) -> Sequence[Architecture]:
        """Architectures trained in this step: the fixed one, or a sandwich within the
        budget.

        Each architecture once. ``count``: multiply-accumulates of an architecture.
        """
        if self.architecture is not None:
            return [self.architecture]
        space = self.model.net.space
        generator = np.random.default_rng([self.inner.seed, self.step, 3])
        members = sample_sandwich(
            space, count, self._budget, generator, subnets=self.inner.subnets
        )
        return members[:1] if self.largest_only else list(dict.fromkeys(members))

    @property
    def _budget(self) -> float:
        """Multiply-accumulates that this step's members may take; 0 for any."""
        if not self.budgets_mmacs:
            return 0.0
        return self.budgets_mmacs[self.step % len(self.budgets_mmacs)] * 1e6

    def _apply(self, rates: dict[str, float], *, finite: bool) -> None:
        """Clip the gradients and step every optimiser of a rate above 0; clamp the
        pitch.

        Without finite gradients the step is skipped and counted.

        Raises:
            TrainingError: ``patience`` steps without a finite gradient in a row.
        """
        if not finite:
            self.skipped += 1
            self.bad_run += 1
            if self.bad_run >= self.inner.patience:
                bad = [
                    name
                    for name, (_, parameters) in self.groups.items()
                    if not has_finite_gradients(parameters)
                ]
                raise TrainingError(
                    f"no finite gradient in {self.bad_run} steps up to step {self.step}; not finite: "
                    f"{' and '.join(bad or ['the loss itself'])}; lower the rates, or resume from an earlier checkpoint"
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
            coarsest = max(self._coarsest_um, self._begins_um)
            with torch.no_grad():
                self.model.log_pitch.clamp_(math.log(finest), math.log(coarsest))


def compute_ahead(work: Callable[[int], Made], steps: range) -> Iterator[Made]:
    """Results of ``work`` for every step in order, each computed while the one before
    it is used.

    Args:
        work: depends on the step alone. steps: their numbers.
    """
    with ThreadPoolExecutor(1, "prefetch") as pool:
        pending = None
        for step in steps:
            following = pool.submit(work, step)
            if pending is not None:
                yield pending.result()
            pending = following
        if pending is not None:
            yield pending.result()


def device_of(place: Place) -> torch.device:
    """Torch device of a ``--device`` choice; "auto" is the GPU where there is one.

    Under ``torchrun`` each process takes the GPU of its local number.

    Args:
        place: "auto", "cpu" or "cuda".

    Raises:
        ConfigError: a GPU is requested where PyTorch finds none.
    """
    has_gpu = torch.cuda.is_available()
    if place == "cuda" and not has_gpu:
        raise ConfigError(
            "device 'cuda': PyTorch finds no GPU here; install a build of torch with CUDA, or give --device cpu"
        )
    if place == "cpu" or not has_gpu:
        return torch.device("cpu")
    return torch.device(
        "cuda", int(os.environ.get("LOCAL_RANK", "0")) % torch.cuda.device_count()
    )


def place_on_device(trainer: Trainer, device: torch.device) -> None:
    """Move a trainer's images, network and moments to a device; nothing for a
    processor.

    Loading an optimiser's own state casts it to the devices of its parameters.
    """
    if device.type == "cpu":
        return
    trainer.light.device = device
    torch.backends.cudnn.deterministic = True
    net = trainer.model.net
    net.to(device)
    for optimiser in trainer.optimisers.values():
        optimiser.load_state_dict(optimiser.state_dict())
