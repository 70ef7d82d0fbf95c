"""Errors of what a network said, frame by frame, so that they come with intervals."""

from dataclasses import dataclass

import numpy as np
from scipy import stats
from torch import Tensor

from codesign.train import Predictions, SensorFrames
from metalens.core.arrays import Array


@dataclass(frozen=True, eq=False, slots=True)
class NetworkAccuracy:
    """Errors of one network on one lens: (n,) absolute errors of the slippage, mean
    over axes and along each, in mm.

    The error that the studies speak of is ``slip_mm``, the mean over the three axes.

    above: why the error of the images that were read is above what their run asks for;
    empty where it is not.
    finer: the same on images formed at a quarter of the tolerance; None where they are
    not known.
    """

    error_mm: Tensor
    iou: Tensor
    above: str = ""
    finer: "NetworkAccuracy | None" = None

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
        """95 % interval of ``slip_mm`` by a bootstrap over frames.

        Args:
            draws: resamples of the bootstrap. seed: of the random generator.
        """
        low, high = bootstrap_interval(
            self.error_mm.mean(1).double().numpy(), draws=draws, seed=seed
        )
        return low, high

    def _beside(self, fine: "NetworkAccuracy") -> dict[str, float]:
        return {
            "finer_slip_mm": fine.slip_mm,
            "finer_axial_mm": fine.axial_mm,
            "finer_ratio": fine.slip_mm / self.slip_mm,
        }

    def values(self) -> dict[str, float]:
        """The numbers by name, for tables and JSON."""
        low, high = self.interval_mm()
        fine = {} if self.finer is None else self._beside(self.finer)
        return fine | {
            "slip_mm": self.slip_mm,
            "slip_low_mm": low,
            "slip_high_mm": high,
            "axial_mm": self.axial_mm,
            "lateral_mm": self.lateral_mm,
            "iou": float(self.iou.mean()),
        }


def measure_accuracy(answers: Predictions, seen: SensorFrames) -> NetworkAccuracy:
    """Errors of answers against the truth of their frames.

    Args:
        seen: frames of the sensor with their truth.
    """
    return NetworkAccuracy(
        (answers.slip_mm - seen.slip_mm).abs(), answers.iou, seen.above
    )


def bootstrap_interval(
    values: Array, *, draws: int = 1000, seed: int = 0
) -> tuple[float, float]:
    """95 % percentile interval of the mean of (n,) values by the bootstrap; of a single
    value the value itself.

    Args:
        values: to average. draws: resamples. seed: of them.
    """
    if len(values) < 2:
        return float(values[0]), float(values[0])
    ends = stats.bootstrap(
        (values,), np.mean, n_resamples=draws, method="percentile", rng=seed
    ).confidence_interval
    return float(ends.low), float(ends.high)


def bootstrap_ratio(
    values: Array, reference: Array, *, draws: int = 2000, seed: int = 0
) -> tuple[float, float, float]:
    """Ratio of two means and its 95 % percentile interval by the paired bootstrap; of a
    single pair the ratio itself.

    Args:
        values, reference: (n,) of the same n subjects or scenes. draws: resamples.
            seed: of them.
    """

    def ratio(one: Array, other: Array, axis: int = -1) -> Array:
        return np.asarray(one.mean(axis) / other.mean(axis))

    whole = float(ratio(values, reference))
    if len(values) < 2:
        return whole, whole, whole
    ends = stats.bootstrap(
        (values, reference), ratio, n_resamples=draws, paired=True,
        method="percentile", rng=seed,
    ).confidence_interval  # fmt: skip
    return whole, float(ends.low), float(ends.high)
