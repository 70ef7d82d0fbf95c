"""How well a network reads frames that it never saw: slippage and pupil mask."""

from dataclasses import dataclass

import torch
from torch import Tensor

from codesign.batches import irradiance, samples
from codesign.network import Architecture, Baseline, Supernet, losses, recalibrate
from codesign.optics import Stack
from codesign.optics import stack as lens
from codesign.train.formation import read_out
from codesign.train.inner import InnerConfig, Scenes, Trainer


@dataclass(frozen=True, eq=False, slots=True)
class Seen:
    """Frames as the sensor gave them, with their truth.

    frames: (n, 1, y, x) standardised. mask: (n, y, x). slip_mm: (n, 3). batch: frames at a time.
    """

    frames: Tensor
    mask: Tensor
    slip_mm: Tensor
    batch: int


@dataclass(frozen=True, slots=True)
class Assessment:
    """Mean absolute errors of the slippage in mm, and mean intersection over union of the pupil."""

    axial_mm: float
    lateral_mm: float
    iou: float

    @property
    def slip_mm(self) -> float:
        """Mean over the three axes: what architectures are chosen by."""
        return (self.axial_mm + 2 * self.lateral_mm) / 3


@torch.no_grad()
def frames(trainer: Trainer, scenes: Scenes, batches: int, *, stack: Stack | None = None) -> Seen:
    """Frames through the lens (or the PSFs of ``stack``) and sensor as they are now, with fixed noise."""
    made = stack or lens.stack(trainer.optics, trainer.model.coefficients_rad)
    pixels, masks, slips = [], [], []
    for number in range(batches):
        batch = scenes.batch(number, trainer.inner.batch)
        prepared = lens.prepared(trainer.optics, made, samples(batch.frames), margin=scenes.margin)
        light = irradiance(batch.frames, prepared, margin=scenes.margin)
        noise = torch.Generator().manual_seed(1_000_003 * (int(getattr(scenes, "stream", 0)) + 1) + number)
        pitch = trainer.model.pitch_um
        pixels.append(read_out(light, trainer.optics.sample_um, pitch, trainer.sensor, generator=noise))
        masks.append(batch.mask)
        slips.append(batch.slip_mm)
    return Seen(torch.cat(pixels), torch.cat(masks), torch.cat(slips), trainer.inner.batch)


@dataclass(frozen=True, eq=False, slots=True)
class Answers:
    """What a network said of frames.

    slip_mm: (n, 3). centre: (n, 2) of the pupil, fraction of the image from its middle. iou: (n,) of the pupil.
    """

    slip_mm: Tensor
    centre: Tensor
    iou: Tensor


@torch.no_grad()
def predict(net: Supernet | Baseline, architecture: Architecture, seen: Seen, inner: InnerConfig) -> Answers:
    """Answers with the batch statistics that the network holds (see :func:`codesign.network.supernet.recalibrate`)."""
    training = net.training
    net.eval()
    found = [net(seen.frames[i : i + seen.batch], architecture) for i in range(0, len(seen.frames), seen.batch)]
    net.train(training)
    slip = torch.cat([f.slip for f in found]) * torch.tensor(inner.slip_scale_mm)
    shared = losses.overlap(torch.cat([f.mask_logits for f in found]), seen.mask)
    return Answers(slip, torch.cat([f.centre for f in found]), shared)


def parts(seen: Seen) -> list[Tensor]:
    """Frames a batch at a time."""
    return [seen.frames[i : i + seen.batch] for i in range(0, len(seen.frames), seen.batch)]


@torch.no_grad()
def assess(net: Supernet | Baseline, architecture: Architecture, seen: Seen, inner: InnerConfig) -> Assessment:
    """Errors of one architecture, with its own batch statistics measured on the first half of the frames."""
    batches = parts(seen)
    recalibrate(net, architecture, batches[: max(1, len(batches) // 2)])
    answers = predict(net, architecture, seen, inner)
    error = (answers.slip_mm - seen.slip_mm).abs().mean(0)
    net.train()
    return Assessment(float(error[2]), float(error[:2].mean()), float(answers.iou.mean()))
