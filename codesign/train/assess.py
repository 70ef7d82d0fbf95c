"""How well a network reads frames that it never saw: slippage and pupil mask."""

import itertools
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from codesign.batches import depth_um, frame_samples, sensor_irradiance
from codesign.network import (
    Architecture,
    Supernet,
    blur,
    losses,
    recalibrate_batch_norm,
)
from codesign.optics import OpticsConfig, PixelPsfStack, formed
from codesign.train.formation import frame_wide, read_out
from codesign.train.inner import InnerConfig, SceneSource, Trainer
from metalens.core.errors import PropagationError, SceneError
from metalens.image import Imager


@dataclass(frozen=True, eq=False, slots=True)
class SensorFrames:
    """Frames as the sensor gave them, with their truth.

    frames: (n, 1, y, x) standardised. mask: (n, y, x) over the whole frame. slip_mm:
    (n, 3). batch: frames at a time.
    wide: the frame's width over the image's (:func:`frame_wide`).
    vergence: (n, windows, windows) of :func:`codesign.network.blur.window_vergence`;
    None where it is not known.
    above: why the error of their images is above ``optics.image_tolerance``
    (:func:`codesign.optics.formed.image_tolerance_problem`);
        empty where it is not.
    """

    frames: Tensor
    mask: Tensor
    slip_mm: Tensor
    batch: int
    vergence: Tensor | None = None
    wide: float = 1.0
    above: str = ""


SAME = 1.05  # ratio of errors up to which a result does not depend on the tolerance
FINER = 4  # by which the image that checks a result is formed more precisely


def finer_image(settings: OpticsConfig) -> OpticsConfig | None:
    """The image that checks whether a result depends on the image's tolerance: a
    quarter of the tolerance of training; None of the uniform image, which has none.

    Args:
        settings: of the lens and its image.
    """
    if settings.image == "uniform":
        return None
    return replace(settings, image_tolerance=settings.image_tolerance / FINER)


def finer_frames(
    trainer: Trainer,
    scenes: SceneSource,
    batches: int,
    *,
    stack: PixelPsfStack | None = None,
) -> SensorFrames | None:
    """:func:`sensor_frames` of the same scenes and noise on the :func:`finer_image`
    image; None
    where there is none, or this lens cannot be imaged so precisely.

    Args:
        trainer: with lens, sensor and network as they are. batches: how many batches.
        stack: PSFs of a made lens in place of the trainer's own.
    """
    optics = finer_image(trainer.optics)
    if optics is None:
        return None
    try:
        return sensor_frames(trainer, scenes, batches, stack=stack, optics=optics)
    except (SceneError, PropagationError):
        return None


@torch.no_grad()
def sensor_frames(
    trainer: Trainer,
    scenes: SceneSource,
    batches: int,
    *,
    stack: PixelPsfStack | None = None,
    optics: OpticsConfig | None = None,
    first: int = 0,
) -> SensorFrames:
    """Frames through the lens (or the PSFs of ``stack``) and sensor as they are now,
    with fixed noise.

    Args:
        optics: how the image is formed; as in training without it. first: number of
            the first batch.
        trainer: with lens, sensor and network as they are. scenes: frames by number.
        batches: how many batches.
    """
    optics = optics or trainer.optics
    prepared: Imager | None = None
    pitch, wide, above = trainer.model.pitch_um, 1.0, ""
    pixels, masks, slips, depths = [], [], [], []
    for number in range(first, first + batches):
        batch = scenes.batch(number, trainer.inner.batch)
        if prepared is None:
            given = (
                optics,
                trainer.model.coefficients_rad,
                frame_samples(batch.frames),
            )
            prepared = formed.make_imager(
                *given, margin=scenes.margin, made=stack, device=trainer.light.device
            )
            above = formed.image_tolerance_problem(optics, prepared)
        light = sensor_irradiance(batch.frames, prepared).cpu()
        noise = torch.Generator().manual_seed(
            1_000_003 * (int(getattr(scenes, "stream", 0)) + 1) + number
        )
        wide = frame_wide(
            light.shape[-1], trainer.optics.sample_um, float(pitch.detach())
        )
        pixels.append(
            read_out(
                light, trainer.optics.sample_um, pitch, trainer.sensor, generator=noise
            )
        )
        masks.append(losses.mask_in_frame(batch.mask, wide))
        slips.append(batch.slip_mm)
        depths.append(
            blur.window_vergence(depth_um(batch.frames, margin=scenes.margin))
        )
    shown = torch.cat(pixels), torch.cat(masks), torch.cat(slips)
    return SensorFrames(*shown, trainer.inner.batch, torch.cat(depths), wide, above)


@dataclass(frozen=True, eq=False, slots=True)
class Predictions:
    """What a network said of frames.

    slip_mm: (n, 3). centre: (n, 2) of the pupil, fraction of the image from its middle.
    iou: (n,) of the pupil's mask, at the sensor's pixels.
    slip_sd_mm: (n, 3) standard deviation that the network gives its slippage; None of
    one that gives none.
    depth: (n, 2, windows, windows) vergence of the windows and the logarithm of its
    spread; likewise.
    mask: (n, y, x) logits of the pupil on the network's own grid; likewise.
    axis: (n, 3) optic axis in the camera's frame, a unit vector; likewise, and where
    training gave it no weight.
    """

    slip_mm: Tensor
    centre: Tensor
    iou: Tensor
    slip_sd_mm: Tensor | None = None
    depth: Tensor | None = None
    mask: Tensor | None = None
    axis: Tensor | None = None


@torch.no_grad()
def predict_frames(
    net: Supernet, architecture: Architecture, seen: SensorFrames, inner: InnerConfig
) -> Predictions:
    """Answers with the batch statistics that the network holds (see
    :func:`codesign.network.supernet.recalibrate_batch_norm`).

    Args:
        net: elastic network. architecture: member of the search space.
        seen: frames of the sensor with their truth. inner: settings of training.
    """
    training = net.training
    net.eval()
    found = [
        net(seen.frames[i : i + seen.batch], architecture)
        for i in range(0, len(seen.frames), seen.batch)
    ]
    net.train(training)
    slip = torch.cat([f.slip for f in found]) * torch.tensor(inner.slip_scale_mm)
    pixels = int(seen.frames.shape[-1])
    mask = torch.cat([f.mask_logits for f in found])
    shared = losses.mask_iou(mask, seen.mask, pixels=pixels)
    spread = [f.slip_log_sd for f in found if f.slip_log_sd is not None]
    depth = [f.depth for f in found if f.depth is not None]
    axis = [f.axis for f in found if f.axis is not None and inner.axis_weight]
    return Predictions(
        slip,
        torch.cat([f.centre for f in found]) * seen.wide,
        shared,
        torch.cat(spread).exp() * torch.tensor(inner.slip_scale_mm) if spread else None,
        torch.cat(depth) if depth else None,
        mask if mask.numel() else None,
        torch.nn.functional.normalize(torch.cat(axis), dim=1) if axis else None,
    )


def batched_frames(seen: SensorFrames) -> list[Tensor]:
    """Frames a batch at a time.

    Args:
        seen: frames of the sensor with their truth.
    """
    return [
        seen.frames[i : i + seen.batch] for i in range(0, len(seen.frames), seen.batch)
    ]


def training_frames(trainer: Trainer, *, batches: int = 8) -> list[Tensor]:
    """Training frames through the lens as it is, or through the made lenses that
    training draws: what batch statistics are measured on, never frames that are scored.

    Args:
        trainer: with lens, sensor and network as they are. batches: how many.
    """
    stacks = trainer.light.stacks
    if not stacks:
        return batched_frames(sensor_frames(trainer, trainer.scenes, batches))
    return [
        sensor_frames(trainer, trainer.scenes, 1, stack=made, first=number).frames
        for number, made in zip(range(batches), itertools.cycle(stacks), strict=False)
    ]


def recalibrate_network(trainer: Trainer, architecture: Architecture) -> None:
    """Measure the batch statistics of one architecture on :func:`training_frames`.

    Args:
        trainer: with lens, sensor and network. architecture: whose statistics.
    """
    frames = training_frames(trainer)
    recalibrate_batch_norm(trainer.model.net, architecture, frames)
