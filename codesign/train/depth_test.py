"""Does a network read the optics? Its answer to PSFs of another depth while the
picture's geometry stays.
"""

from dataclasses import dataclass, replace

import numpy as np
from torch import Tensor

from codesign.batches import FrameBatch, SingleSurfaceFrames
from codesign.network import Architecture, Supernet
from codesign.train import assess
from codesign.train.inner import SceneSource, Trainer
from metalens.image import Frames


@dataclass(frozen=True, eq=False, slots=True)
class DisplacedFrames:
    """Frames that are blurred as if everything stood ``shift_um`` farther away; places
    and sizes stay.
    """

    scenes: SceneSource
    shift_um: float

    @property
    def margin(self) -> int:
        """Samples around the frames that are blurred in but not seen."""
        return self.scenes.margin

    @property
    def stream(self) -> int:
        """The noise is that of the frames in their true place."""
        return int(getattr(self.scenes, "stream", 0))

    def batch(self, step: int, size: int) -> FrameBatch:
        """Frames of a step; the labels are the old ones.

        Args:
            size: frames of a batch.
        """
        plain = self.scenes.batch(step, size)
        return replace(plain, frames=displace_frames(plain.frames, self.shift_um))


def displace_frames(
    frames: Frames | SingleSurfaceFrames, shift_um: float
) -> Frames | SingleSurfaceFrames:
    """Frames with all depths larger by ``shift_um``.

    Args:
        frames: rendered frames of two layers or of one.
    """
    if isinstance(frames, Frames):
        return Frames(frames.radiance, frames.coverage, frames.depth_um + shift_um)
    far = frames.depth_um * frames.scale[:, None, None] + shift_um
    return SingleSurfaceFrames(
        frames.light,
        (far / frames.scale[:, None, None]).clip(0, 65535).round().astype(np.uint16),
        frames.scale,
    )


@dataclass(frozen=True, slots=True)
class DepthResponse:
    """mm of predicted axial slippage per mm of PSF depth: 1 for a network that measures
    by the blur alone.

    mean, standard_error: over frames. frames: how many.
    """

    mean: float
    standard_error: float
    frames: int


def depth_response(
    trainer: Trainer,
    scenes: SceneSource,
    net: Supernet,
    architecture: Architecture,
    *,
    batches: int,
    shift_um: float = 1000.0,
) -> DepthResponse:
    """Shift the depth of the PSFs alone and see how far the prediction follows; the
    noise is the same in both.

    A network that guesses depth from the size of what it sees answers 0, however well
    it scores on natural frames.
    The batch statistics must be measured
    (:func:`codesign.network.supernet.recalibrate_batch_norm`).

    Args:
        trainer: with lens, sensor and network as they are. scenes: frames by number.
        net: elastic network. architecture: member of the search space.
        batches: how many batches. shift_um: of the depth of the PSFs.
    """
    here = _axial(trainer, scenes, net, architecture, batches)
    there = _axial(
        trainer, DisplacedFrames(scenes, shift_um), net, architecture, batches
    )
    change = (there - here) / (shift_um * 1e-3)
    return DepthResponse(
        float(change.mean()), float(change.std() / len(change) ** 0.5), len(change)
    )


def _axial(
    trainer: Trainer,
    scenes: SceneSource,
    net: Supernet,
    architecture: Architecture,
    batches: int,
) -> Tensor:
    seen = assess.sensor_frames(trainer, scenes, batches)
    return assess.predict_frames(net, architecture, seen, trainer.inner).slip_mm[:, 2]
