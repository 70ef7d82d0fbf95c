"""A lens trained with the branch of the reference reader, on the true image and dense
labels of depth.

Lens and branch go down one loss, the likelihood of the depths of the windows, in turns:
the branch for ``hold`` steps
behind a lens that stands, while the light at the nodes of the field gathers the
gradient of its loss; then the lens one
step along the exact gradient of all field points, depths and wavelengths. A few drawn
points a step would cost as much
and leave a gradient of mostly noise: of 81 points four are drawn, and differ from the
mean by as much as it is long.

Frames leave noise in it too. A step of fixed length for every term, as Adam has it, is
then in part a walk at random,
whose aberrations cost more than the gradient wins. So the lens moves along the part of
the running mean that is longer
than noise alone would leave (:class:`ShrunkDescent`), and stands where there is none.

On an image to 0.2 of the contrast the lens learns the errors of that image: its loss
falls and what it is worth on
another image does too. On one to 0.05, 63 terms, 3 to 29 degrees and 30 nm, windows are
read 3 % better after 24 turns
with a step of 0.15 rad, and 5 % with 0.6 rad (one seed).

The branch is thrown away: what the lens is worth says a reader that begins anew
(:func:`codesign.evaluate.reader.train_reader`), and of the lenses passed, the start
among them,
the best is kept
(:func:`best_round`).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Protocol

import torch
from torch import Tensor, nn

from codesign.batches import SceneSource, depth_um, frame_samples, sensor_irradiance
from codesign.evaluate.reader import ReaderConfig
from codesign.network import blur, losses
from codesign.network.blur import BlurBranch
from codesign.optics import OpticsConfig, formed
from codesign.train import LearningRateSchedule, read_out
from metalens.core import threads
from metalens.core.errors import ConfigError, TrainingError
from metalens.image import (
    Imager,
    UniformImager,
    node_light,
    normalised,
    term,
    with_psfs,
)


@dataclass(frozen=True, slots=True)
class LensTraining:
    """How lens and branch move.

    turns: of the lens. hold: steps of the branch to one of the lens, of ``batch``
    frames each. phase: length of a
    lens's step where all gradients agree, rad of root-mean-square phase; the lens
    stands while it is 0. anew: turns
    after which nodes and kernels of the image are planned anew; between them they hold
    the PSFs of the lens that has
    moved. rate: of the branch. seed: of branch and noise.
    """

    turns: int = 24
    hold: int = 20
    batch: int = 32
    phase: LearningRateSchedule = field(
        default_factory=lambda: LearningRateSchedule(0.6, 0.25, 1.0)
    )
    anew: int = 8
    rate: float = 3e-3
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.turns, self.hold, self.batch, self.anew) < 1 or not self.rate > 0:
            raise ConfigError(
                f"turns {self.turns}, hold {self.hold}, batch {self.batch}, anew {self.anew}, rate {self.rate}: need "
                "counts of 1 or more and a rate above 0"
            )


@dataclass(slots=True)
class ShrunkDescent:
    """Steps along the running mean of gradients, shrunk by what noise alone would leave
    of it.

    The terms are of one unit, rad of root-mean-square phase, so one length serves them
    all. Of independent gradients
    without a mean, of mean square length q, a mean with weights w has the square length
    q Σ w²; that share is taken off
    (James and Stein's estimate of a mean, its positive part). A step is of length 1 - Σ
    w² where gradients agree, 0 for
    the first, 0.95 after many, and about 0 where they are noise.
    """

    mean: Tensor
    square: float = 0.0
    turns: int = 0
    MEAN: ClassVar[float] = 0.9
    SQUARE: ClassVar[float] = 0.99

    def step(self, gradient: Tensor) -> Tensor:
        """Where the lens goes, (polynomials,)."""
        self.turns += 1
        keep, n = self.MEAN, self.turns
        self.mean = keep * self.mean + (1 - keep) * gradient
        self.square = self.SQUARE * self.square + (1 - self.SQUARE) * float(
            gradient @ gradient
        )
        size = math.sqrt(self.square / (1 - self.SQUARE**n))
        unit = self.mean / ((1 - keep**n) * max(size, 1e-300))
        noise = (1 - keep) / (1 + keep) * (1 - keep ** (2 * n)) / (1 - keep**n) ** 2
        return -unit * max(0.0, 1 - noise / max(float(unit @ unit), 1e-300))


class LensImaging(Protocol):
    """What images frames of ``frame`` samples, margin included, through a lens of these
    coefficients.
    """

    def __call__(
        self,
        settings: OpticsConfig,
        coefficients_rad: Tensor,
        frame: int,
        *,
        margin: int,
    ) -> UniformImager | Imager: ...


def train_lens(
    optics: OpticsConfig,
    start_rad: Tensor,
    scenes: SceneSource,
    config: ReaderConfig,
    training: LensTraining,
    *,
    forms: LensImaging = formed.make_imager,
) -> tuple[Tensor, list[float]]:
    """Coefficients at the start and after every turn, (turns + 1, polynomials) in rad,
    and the mean loss of every turn.

    The same every time.

    Args:
        optics: whose ``sample_um`` is the reader's pitch. start_rad: (polynomials,)
            coefficients to start from.
        scenes: to learn from, with the reader's margin.
        forms: the image, by default the true one of the settings.

    Raises:
        ConfigError: another pitch, an image that is not the true one, or no
            coefficients to train.
        TrainingError: the loss is not finite.
    """
    if (
        optics.sample_um != config.pitch_um
        or not optics.polynomials
        or optics.image != "true"
    ):
        raise ConfigError(
            f"optics: sample_um = {optics.sample_um}, polynomials = {optics.polynomials}, image = {optics.image!r}; "
            f"reader: pitch_um = {config.pitch_um}: need samples of the pitch, 1 polynomial or more, and 'true'"
        )
    threads.keep_memory()
    state = torch.get_rng_state()
    torch.manual_seed(training.seed)
    try:
        return _descended(optics, start_rad, scenes, config, training, forms)
    finally:
        torch.set_rng_state(state)


def _descended(
    optics: OpticsConfig,
    start_rad: Tensor,
    scenes: SceneSource,
    config: ReaderConfig,
    training: LensTraining,
    forms: LensImaging,
) -> tuple[Tensor, list[float]]:
    branch = BlurBranch(nn.BatchNorm2d(blur.FEATURES)).train()
    path, descent = (
        [start_rad.detach().double()],
        ShrunkDescent(torch.zeros_like(start_rad, dtype=torch.float64)),
    )
    reads = torch.optim.AdamW(branch.parameters(), lr=training.rate, weight_decay=0.01)
    frame, told = frame_samples(scenes.batch(0, 1).frames), []
    planned: Imager | None = None
    for turn in range(training.turns):
        place, rate = path[-1], training.phase.at(turn / training.turns)
        if planned is None or turn % training.anew == 0:
            whole = planned = _planned(forms, optics, place, frame, scenes.margin)
        elif not torch.equal(place, path[-2]):
            whole = moved_image(optics, planned, place)
        mean, gathered = 0.0, torch.zeros_like(whole.stack)
        for step in range(turn * training.hold, (turn + 1) * training.hold):
            reads.param_groups[0]["lr"] = LearningRateSchedule(training.rate).at(
                step / (training.turns * training.hold)
            )
            reads.zero_grad(set_to_none=True)
            value, slope = gone_backward(
                branch,
                optics,
                whole,
                scenes,
                config,
                training,
                step=step,
                live=rate > 0,
            )
            reads.step()
            mean += value / training.hold
            gathered += slope / training.hold
        way = (
            descent.step(lens_gradient(optics, whole, place, gathered))
            if rate > 0
            else torch.zeros_like(place)
        )
        path.append(place + rate * way)
        told.append(mean)
    return torch.stack(path), told


def _planned(
    forms: LensImaging, optics: OpticsConfig, place: Tensor, frame: int, margin: int
) -> Imager:
    whole = forms(optics, place, frame, margin=margin)
    if not isinstance(whole, Imager):
        raise TypeError("the true image needs a field of PSFs")
    return whole


@torch.no_grad()
def moved_image(optics: OpticsConfig, planned: Imager, place: Tensor) -> Imager:
    """The image of a lens that has moved, its PSFs at the nodes and through the
    kernels' weights that were planned.
    """
    plane = formed.optics_of(optics, place)
    return with_psfs(
        planned, *normalised(node_light(plane, planned.plan), plane, planned.plan)
    )


def best_round(
    path: Tensor, turns: Sequence[int], error_mm: Callable[[Tensor], float]
) -> tuple[int, dict[int, float]]:
    """The turn of the least error, and {turn: error} of the start and of these turns;
    the first of equal ones.

    Args:
        path: (turns + 1, polynomials) of :func:`train_lens`. error_mm: of a lens on
            frames
            that trained nothing.
    """
    told = {turn: error_mm(path[turn]) for turn in dict.fromkeys((0, *turns))}
    return min(told, key=lambda turn: told[turn]), told


def gone_backward(
    branch: BlurBranch,
    optics: OpticsConfig,
    whole: Imager,
    scenes: SceneSource,
    config: ReaderConfig,
    training: LensTraining,
    *,
    step: int,
    live: bool,
) -> tuple[float, Tensor]:
    """Loss of one step, whose gradient is added to the branch's, and its gradient to
    the light of the nodes.

    Returns:
        The loss, and (rows, columns, depths, h, w); zeros without ``live``.
    """
    batch = scenes.batch(step, training.batch)
    moved = formed.make_differentiable_imager(optics, whole) if live else None
    with torch.set_grad_enabled(live):
        light = sensor_irradiance(
            batch.frames, moved.ready if moved else whole, margin=scenes.margin
        )
        noise = torch.Generator().manual_seed(6_000_101 * (training.seed + 1) + step)
        pitch = torch.tensor(config.pitch_um, dtype=torch.float64)
        seen = read_out(
            light, config.pitch_um, pitch, config.sensor, generator=noise, exact=False
        )
    found, _ = branch(seen)
    loss = losses.depth_loss(
        found, blur.window_vergence(depth_um(batch.frames, margin=scenes.margin))
    )
    if not bool(torch.isfinite(loss.detach())):
        raise TrainingError(
            f"the loss of step {step} is not finite: lower the rate of the phase"
        )
    loss.backward()  # type: ignore[no-untyped-call]
    slope = (
        torch.zeros_like(whole.stack)
        if moved is None or moved.light.grad is None
        else moved.light.grad
    )
    return float(loss.detach()), slope


def lens_gradient(
    optics: OpticsConfig, whole: Imager, place: Tensor, gathered: Tensor
) -> Tensor:
    """(polynomials,) gradient to the coefficients of the lens, from that to the light
    of all nodes.

    One field point and wavelength after the other: their graphs are not held together.
    """
    plan, leaf = whole.plan, place.detach().clone().requires_grad_()
    share = torch.as_tensor(plan.waves.weights)
    points = gathered.shape[0] * gathered.shape[1]
    for wave, weight in enumerate(share / share.sum()):
        for point in range(points):
            plane = formed.optics_of(optics, leaf)
            each = term(plane, plan, gathered, point, wave) * (float(weight) / points)
            each.backward()  # type: ignore[no-untyped-call]
    return torch.zeros_like(leaf) if leaf.grad is None else leaf.grad
