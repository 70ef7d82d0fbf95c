"""What training takes a step: frames and what is true of them."""

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from codesign.batches.flat import Flat
from metalens.image import Frames


@dataclass(frozen=True, eq=False, slots=True)
class Batch:
    """Rendered frames with what is true of them.

    frames: on the image grid, ``margin`` samples wider on every side.
    mask: (batch, y, x) pupil coverage without the margin. slip_mm: (batch, 3).
    """

    frames: Frames | Flat
    mask: Tensor
    slip_mm: Tensor


class Scenes(Protocol):
    """Where frames come from: the same step gives the same frames."""

    @property
    def margin(self) -> int:
        """Samples around the frames that are blurred in but not seen."""

    def batch(self, step: int, size: int) -> Batch:
        """``size`` frames of training step ``step``."""
