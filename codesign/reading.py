"""What one network says of frames, frame by frame: slippage, pupil centre and mask, for errors with intervals."""

from dataclasses import dataclass

import numpy as np
import torch

from codesign import losses
from codesign.architecture import Architecture
from codesign.assess import Seen
from codesign.supernet import Supernet, recalibrate
from metalens.store import Array

Tensor = torch.Tensor


@dataclass(frozen=True, eq=False, slots=True)
class Readings:
    """slip_mm: (n, 3) as read. centre: (n, 2) pupil, fraction of the image. iou: (n,) of the pupil's mask."""

    slip_mm: Tensor
    centre: Tensor
    iou: Tensor


@torch.no_grad()
def read(net: Supernet, architecture: Architecture, seen: Seen, scale_mm: tuple[float, float, float]) -> Readings:
    """Read all frames, with batch statistics of the architecture measured on the first half of them.

    Labels are not used but for the overlap of the masks.
    """
    parts = [seen.frames[i : i + seen.batch] for i in range(0, len(seen.frames), seen.batch)]
    recalibrate(net, architecture, parts[: max(1, len(parts) // 2)])
    found = [net(part, architecture) for part in parts]
    net.train()
    return Readings(
        torch.cat([f.slip for f in found]) * torch.tensor(scale_mm),
        torch.cat([f.centre for f in found]),
        losses.overlap(torch.cat([f.mask_logits for f in found]), seen.mask),
    )


@dataclass(frozen=True, eq=False, slots=True)
class Accuracy:
    """Errors of one network on one lens: (n,) absolute errors of the slippage, mean over axes and along each, in mm.

    The error that the studies speak of is ``slip_mm``, the mean over the three axes.
    """

    error_mm: Tensor
    iou: Tensor

    @property
    def slip_mm(self) -> float:
        """Mean over frames and axes."""
        return float(self.error_mm.mean())

    @property
    def axial_mm(self) -> float:
        """Mean error of the distance."""
        return float(self.error_mm[:, 2].mean())

    @property
    def lateral_mm(self) -> float:
        """Mean error across."""
        return float(self.error_mm[:, :2].mean())

    def interval_mm(self, *, draws: int = 1000, seed: int = 0) -> tuple[float, float]:
        """95 % interval of ``slip_mm`` by a bootstrap over frames."""
        low, high = bootstrap(self.error_mm.mean(1).double().numpy(), draws=draws, seed=seed)
        return low, high

    def values(self) -> dict[str, float]:
        """The numbers by name, for tables and JSON."""
        low, high = self.interval_mm()
        return {
            "slip_mm": self.slip_mm,
            "slip_low_mm": low,
            "slip_high_mm": high,
            "axial_mm": self.axial_mm,
            "lateral_mm": self.lateral_mm,
            "iou": float(self.iou.mean()),
        }


def accuracy(readings: Readings, seen: Seen) -> Accuracy:
    """Errors of readings against the truth of their frames."""
    return Accuracy((readings.slip_mm - seen.slip_mm).abs(), readings.iou)


def bootstrap(values: Array, *, draws: int = 1000, seed: int = 0) -> tuple[float, float]:
    """95 % interval of the mean of (n,) values."""
    rows = np.random.default_rng(seed).integers(0, len(values), (draws, len(values)))
    low, high = np.quantile(np.asarray(values)[rows].mean(1), [0.025, 0.975])
    return float(low), float(high)
