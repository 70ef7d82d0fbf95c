"""How evenly the edges of all shapes are exposed."""

from dataclasses import dataclass

import numpy as np

from metalens.core.arrays import Array


@dataclass(frozen=True, slots=True)
class DoseUniformity:
    """Relative error of the exposure at the pillar edges, over all pillars.

    worst, rms: of exposure / wanted - 1.
    diameter_nm: the largest change of a made diameter that follows from it, through the
    slope of the exposure.
    """

    worst: float
    rms: float
    diameter_nm: float


class ErrorTally:
    """Running extremes and squares of relative errors."""

    def __init__(self) -> None:
        self._low, self._high, self._square, self._count = np.inf, -np.inf, 0.0, 0.0

    def merge(self, ends: Array) -> None:
        """Take in (least, most, sum of squares, count)."""
        low, high, square, count = ends.tolist()
        self._low, self._high = min(self._low, low), max(self._high, high)
        self._square, self._count = self._square + square, self._count + count

    @property
    def worst(self) -> float:
        """Largest error; 0 where nothing was taken in."""
        return max(self._high, -self._low) if self._count else 0.0

    def result(self, slope: float, shift: float) -> DoseUniformity:
        """Over all that was taken in, of edges that fall by ``slope`` per um, in units
        of the wanted exposure.

        shift: largest error of the background that was taken in; it is added to all
            numbers.
        """
        worst = self.worst + shift
        return DoseUniformity(
            worst,
            (self._square / max(self._count, 1)) ** 0.5 + shift,
            2e3 * worst / slope,
        )
