"""What training takes a step: frames and what is true of them."""

from dataclasses import dataclass

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
