"""How well a network reads frames that it never saw: slippage and pupil mask."""

from dataclasses import dataclass

import torch

from codesign import losses
from codesign import optics as lens
from codesign.architecture import Architecture
from codesign.eye_scenes import EyeScenes
from codesign.formation import read_out
from codesign.inner import InnerConfig, Trainer
from codesign.optics import Stack
from codesign.supernet import Supernet, recalibrate
from metalens.scene import image

Tensor = torch.Tensor


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
def frames(trainer: Trainer, scenes: EyeScenes, batches: int, *, stack: Stack | None = None) -> Seen:
    """Frames through the lens (or the PSFs of ``stack``) and sensor as they are now, with fixed noise."""
    made = stack or lens.stack(trainer.optics, trainer.model.coefficients_rad)
    pixels, masks, slips = [], [], []
    for number in range(batches):
        batch = scenes.batch(number, trainer.inner.batch)
        prepared = lens.prepared(trainer.optics, made, batch.frames.radiance.shape[-1], margin=scenes.margin)
        irradiance = image(batch.frames, prepared, margin=scenes.margin)
        noise = torch.Generator().manual_seed(1_000_003 * (scenes.stream + 1) + number)
        pitch = trainer.model.pitch_um
        pixels.append(read_out(irradiance, trainer.optics.sample_um, pitch, trainer.sensor, generator=noise))
        masks.append(batch.mask)
        slips.append(batch.slip_mm)
    return Seen(torch.cat(pixels), torch.cat(masks), torch.cat(slips), trainer.inner.batch)


@torch.no_grad()
def assess(net: Supernet, architecture: Architecture, seen: Seen, inner: InnerConfig) -> Assessment:
    """Errors of one architecture, with its own batch statistics measured on the first half of the frames."""
    parts = [seen.frames[i : i + seen.batch] for i in range(0, len(seen.frames), seen.batch)]
    recalibrate(net, architecture, parts[: max(1, len(parts) // 2)])
    scale = torch.tensor(inner.slip_scale_mm)
    found = [net(part, architecture) for part in parts]
    slip = torch.cat([f.slip for f in found]) * scale
    error = (slip - seen.slip_mm).abs().mean(0)
    shared = losses.overlap(torch.cat([f.mask_logits for f in found]), seen.mask)
    net.train()
    return Assessment(float(error[2]), float(error[:2].mean()), float(shared.mean()))
