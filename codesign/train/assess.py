"""Accuracy of a network on frames that it never saw: slippage, pupil mask, gaze,
response to depth.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from scipy import stats
from torch import Tensor

from codesign.batches import (
    FrameBatch,
    SceneSource,
    SingleSurfaceFrames,
    depth_um,
    frame_samples,
    sensor_irradiance,
)
from codesign.gaze import bench
from codesign.network import (
    Architecture,
    Supernet,
    blur,
    losses,
    recalibrate_batch_norm,
)
from codesign.optics import OpticsConfig, PixelPsfStack, image_formation
from codesign.train.imaging import frame_wide, read_out
from codesign.train.trainer import InnerConfig, Trainer
from metalens.core.arrays import Array
from metalens.core.errors import PropagationError, SceneError
from metalens.image import Frames, Imager, Sensor


@dataclass(frozen=True, eq=False, slots=True)
class SensorFrames:
    """Frames of the sensor with their labels.

    frames: (n, 1, y, x) standardised. mask: (n, y, x) pupil over the whole frame.
    slip_mm: (n, 3). batch: frames at a time.
    wide: the frame's width over the image's (:func:`frame_wide`).
    vergence: (n, windows, windows) of :func:`codesign.network.blur.window_vergence`.
    above: why the error of their images is above ``optics.image_tolerance``
    (:func:`codesign.optics.image_formation.image_tolerance_problem`); empty where it is not.
    """

    frames: Tensor
    mask: Tensor
    slip_mm: Tensor
    batch: int
    vergence: Tensor
    wide: float = 1.0
    above: str = ""


SAME = 1.05  # ratio of errors up to which a result does not depend on the tolerance
FINER = 4  # by which the image that checks a result is formed more precisely
SHIFT_UM = 1000.0  # of the depth of the PSFs, to see whether a network reads them


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
    image.

    None where there is none, or this lens cannot be imaged so precisely.

    Args:
        trainer: with lens, sensor and network as they are. scenes: frames by number.
        batches: number of batches.
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
def read_batch(
    trainer: Trainer,
    batch: FrameBatch,
    imager: Imager,
    *,
    seed: int,
    sensor: Sensor | None = None,
    quiet: bool = False,
) -> SensorFrames:
    """Sensor frames of one batch through an imager and a trainer's pixels.

    Args:
        trainer: with pitch and sensor as they are. batch: rendered frames.
        imager: what forms the images. seed: of the noise.
        sensor: in place of the trainer's. quiet: expected electrons, without noise.
    """
    sample_um = trainer.optics.sample_um
    pitch_um = trainer.model.pitch_um
    light = sensor_irradiance(batch.frames, imager).cpu()
    noise = torch.Generator().manual_seed(seed)
    sensor = sensor or trainer.sensor
    pixels = read_out(light, sample_um, pitch_um, sensor, generator=noise, quiet=quiet)
    frame_width = frame_wide(light.shape[-1], sample_um, float(pitch_um.detach()))
    return SensorFrames(
        pixels,
        losses.mask_in_frame(batch.mask, frame_width),
        batch.slip_mm,
        trainer.inner.batch,
        blur.window_vergence(depth_um(batch.frames, margin=imager.grid.margin)),
        frame_width,
    )


@torch.no_grad()
def sensor_frames(
    trainer: Trainer,
    scenes: SceneSource,
    batches: int,
    *,
    stack: PixelPsfStack | None = None,
    optics: OpticsConfig | None = None,
    first: int = 0,
    shift_um: float = 0.0,
) -> SensorFrames:
    """Frames of batches through a trainer's lens (or ``stack``) and sensor, with fixed
    noise.

    The noise depends on the stream and number of the batch alone.

    Args:
        trainer: with lens, sensor and network as they are. scenes: frames by number.
        batches: number of batches.
        stack: PSFs of a made lens in place of the trainer's own.
        optics: how the image is formed; as in training without it.
        first: number of the first batch.
        shift_um: added to the depth of the blur; positions and sizes do not change.
    """
    optics = optics or trainer.optics
    imager: Imager | None = None
    stream = int(getattr(scenes, "stream", 0)) + 1
    parts: list[SensorFrames] = []
    for number in range(first, first + batches):
        batch = scenes.batch(number, trainer.inner.batch)
        if shift_um:
            batch = replace(batch, frames=displace_frames(batch.frames, shift_um))
        imager = imager or image_formation.make_imager(
            optics,
            trainer.model.coefficients_rad,
            frame_samples(batch.frames),
            margin=scenes.margin,
            made=stack,
            device=trainer.light.device,
        )
        seed = 1_000_003 * stream + number
        parts.append(read_batch(trainer, batch, imager, seed=seed))
    joined: dict[str, Any] = {
        name: torch.cat([getattr(part, name) for part in parts])
        for name in ("frames", "mask", "slip_mm", "vergence")
    }
    above = image_formation.image_tolerance_problem(optics, imager) if imager else ""
    return replace(parts[0], **joined, above=above)


def displace_frames(
    frames: Frames | SingleSurfaceFrames, shift_um: float
) -> Frames | SingleSurfaceFrames:
    """Frames with ``shift_um`` added to all depths.

    Depths of one layer are stored at unit scale in whole um, 0 to 65535.

    Args:
        frames: rendered frames of two layers or of one.
    """
    if isinstance(frames, Frames):
        return replace(frames, depth_um=frames.depth_um + shift_um)
    steps = shift_um / frames.scale[:, None, None]
    depth = (frames.depth_um + steps).clip(0, 65535).round().astype(np.uint16)
    return replace(frames, depth_um=depth)


@dataclass(frozen=True, eq=False, slots=True)
class FramePredictions:
    """Predictions of a network for n frames.

    slip_mm: (n, 3). centre: (n, 2) of the pupil, fraction of the image from its centre.
    iou: (n,) of the pupil's mask, at the sensor's pixels.
    slip_sd_mm: (n, 3) predicted standard deviation of the slippage.
    depth: (n, 2, windows, windows) vergence of the windows and the logarithm of its
    standard deviation.
    mask: (n, y, x) logits of the pupil on the network's own grid.
    axis: (n, 3) optic axis in the camera's frame, a unit vector; None where training
    gave it no weight.
    """

    slip_mm: Tensor
    centre: Tensor
    iou: Tensor
    slip_sd_mm: Tensor
    depth: Tensor
    mask: Tensor
    axis: Tensor | None


@torch.no_grad()
def predict_frames(
    net: Supernet, architecture: Architecture, frames: SensorFrames, inner: InnerConfig
) -> FramePredictions:
    """Predictions of a network for frames, in evaluation mode, in mm.

    The batch statistics must be those of this architecture; see
    :func:`codesign.network.supernet.recalibrate_batch_norm`.

    Args:
        net: elastic network. architecture: member of the search space.
        frames: frames of the sensor with their labels. inner: settings of training.
    """
    was_training = net.training
    net.eval()
    device = next(net.parameters()).device
    predictions = [
        net(part.to(device), architecture)
        for part in torch.split(frames.frames, frames.batch)
    ]
    net.train(was_training)
    slip, centre, mask, log_sd, depth, axis = (
        torch.cat([getattr(prediction, name) for prediction in predictions]).cpu()
        for name in ("slip", "centre", "mask_logits", "slip_log_sd", "depth", "axis")
    )
    scale = torch.tensor(inner.slip_scale_mm)
    pixels = int(frames.frames.shape[-1])
    return FramePredictions(
        slip * scale,
        centre * frames.wide,
        losses.mask_iou(mask, frames.mask, pixels=pixels),
        log_sd.exp() * scale,
        depth,
        mask,
        torch.nn.functional.normalize(axis, dim=1) if inner.axis_weight else None,
    )


def training_frames(trainer: Trainer, *, batches: int = 8) -> list[Tensor]:
    """Training frames in batches, to measure batch statistics on; never frames for
    scores.

    Through the lens as it is, or in turn through the made lenses that training draws.

    Args:
        trainer: with lens, sensor and network as they are. batches: how many.
    """
    stacks = trainer.light.stacks
    if not stacks:
        frames = sensor_frames(trainer, trainer.scenes, batches)
        return list(torch.split(frames.frames, frames.batch))
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


def depth_response(at_rest_mm: Tensor, shifted_mm: Tensor) -> tuple[float, float]:
    """Change of the predicted axial slippage per mm of added blur depth: mean over
    frames, and its standard error.

    1 for a network that measures by the blur alone; 0 for one that reads depth from
    apparent size, at any score on natural frames.

    Args:
        at_rest_mm, shifted_mm: (n,) axial slippage predicted from the same frames with
            the same noise, in the latter with the PSFs shifted by SHIFT_UM in depth
            (:func:`sensor_frames`).
    """
    response = (shifted_mm - at_rest_mm) / (SHIFT_UM * 1e-3)
    return float(response.mean()), float(response.std() / len(response) ** 0.5)


def frames_of(trainer: Trainer, people: bench.PeopleFrames) -> SensorFrames:
    """Sensor frames of people through a trainer's lens.

    Args:
        people: people, their frames and gaze.
    """
    size = trainer.inner.batch
    return sensor_frames(trainer, people, math.ceil(len(people.states) / size))


def gaze_error_deg(
    trainer: Trainer,
    architecture: Architecture,
    people: bench.PeopleFrames,
    frames: SensorFrames,
) -> float:
    """Mean gaze error, deg, after a personal calibration from the network's readings.

    The batch statistics must be measured.

    Args:
        trainer: with lens, sensor and network as they are.
        architecture: member of the search space.
        people: people, their frames and gaze. frames: their frames on the sensor.
    """
    predictions = predict_frames(trainer.model.net, architecture, frames, trainer.inner)
    read = bench.read_of(people, predictions.centre, predictions.slip_mm)
    return bench.calibrated_error_deg(people, read)


def bootstrap_interval(values: Array) -> tuple[float, float]:
    """(low, high) 95 % interval of the mean of (n,) values by the bootstrap.

    Args:
        values: to average.
    """
    return _percentile_interval((values,), np.mean)


def bootstrap_ratio(values: Array, reference: Array) -> tuple[float, float, float]:
    """(ratio, low, high): ratio of two means and its 95 % interval by the paired
    bootstrap.

    Args:
        values, reference: (n,) of the same n subjects or scenes.
    """

    def ratio_of_means(top: Array, bottom: Array, axis: int = -1) -> Array:
        return np.asarray(top.mean(axis) / bottom.mean(axis))

    pair = values, reference
    return float(ratio_of_means(*pair)), *_percentile_interval(pair, ratio_of_means)


def _percentile_interval(
    samples: tuple[Array, ...], statistic: Callable[..., Any]
) -> tuple[float, float]:
    """95 % percentile interval of a statistic over 2000 resamples, paired; of single
    values the statistic itself, twice.
    """
    if len(samples[0]) < 2:
        estimate = float(statistic(*samples))
        return estimate, estimate
    ends = stats.bootstrap(
        samples, statistic, n_resamples=2000, paired=len(samples) > 1,
        method="percentile", rng=0,
    ).confidence_interval  # fmt: skip
    return float(ends.low), float(ends.high)
