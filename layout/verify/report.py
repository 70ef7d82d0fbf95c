"""Report on the exposure of a written mask: extremes and a map over millions of
pillars.
"""

from dataclasses import dataclass

import numpy as np

from layout.process.process import LayerNumber
from metalens.core.arrays import Array

Box = tuple[float, float, float, float]  # left, bottom, right, top

MOST_NM = 1.0  # by which a width in the resist may differ from the drawn one
# Doses step along the edges of marks: this share of the points keeps the tolerance, and
# all keep so many times it.
EDGE_SHARE, EDGE_TIMES = 0.99, 2.0


@dataclass(frozen=True, eq=False)
class EdgeErrors:
    """Edges of marks, labels and other shapes that are no pillars.

    x_um, y_um: (n,) samples. exposure: (n,) relative to dose to size. shift_nm: (n,)
    distance of the edge in the resist outside the drawn edge. layer: (n,) layer
    numbers.
    """

    x_um: Array
    y_um: Array
    exposure: Array
    shift_nm: Array
    layer: Array


@dataclass(eq=False)
class VerificationTally:
    """Sums over judged pillars (the dose test is not judged) of a part of the mask.

    worst: largest |exposure - 1|, largest |resist - drawn| in nm. total, count: (y, x)
    map: sum of resist less drawn, and number of pillars.
    """

    worst: Array
    total: Array
    count: Array

    @classmethod
    def empty(cls, side: int = 160) -> "VerificationTally":
        """A tally of nothing, with a map of ``side`` points each way."""
        return cls(np.zeros(2), *np.zeros((2, side, side)))

    def take(
        self,
        place: tuple[Array, Array],
        judged: Array,
        values: tuple[Array, Array, Array],
        box_um: Box,
    ) -> None:
        """Add pillars at x, y; values: (n,) exposure, drawn and resist diameter."""
        x, y = (positions[judged] for positions in place)
        exposure, drawn, resist = (each[judged] for each in values)
        if not len(x):
            return
        difference = resist - drawn
        errors = np.abs(exposure - 1).max(), np.abs(difference).max()
        self.worst = np.maximum(self.worst, errors)
        side = len(self.count)
        column, row = (
            np.clip(
                (positions - low) / max(high - low, 1e-9) * side, 0, side - 1
            ).astype(np.int64)
            for positions, low, high in zip((x, y), box_um[:2], box_um[2:], strict=True)
        )
        point = row * side + column
        for sums, weights in ((self.total, difference), (self.count, None)):
            sums += np.bincount(point, weights, side**2).reshape(side, side)


@dataclass(frozen=True, eq=False)
class ExposureReport:
    """The verdict over everything that is written.

    pillars: number, with the dose test. tally: sums over those that are judged. box_um:
    left, bottom, right, top of the map. edges: of the other shapes. tolerance: of the exposure, relative. undosed:
    layers with shapes and no dose. sampled: largest |exposure - 1| by direct sums at
    sample pillars. error: largest difference of the exposure of all pillars from these.
    """

    pillars: int
    tally: VerificationTally
    box_um: Box
    edges: EdgeErrors
    tolerance: float = 0.01
    undosed: tuple[LayerNumber, ...] = ()
    sampled: float = 0.0
    error: float = 0.0

    @property
    def worst_exposure(self) -> float:
        """Largest |exposure - 1| of the judged pillars and of all edges."""
        return float(
            max(
                self.tally.worst[0],
                self.sampled,
                np.abs(self.edges.exposure - 1).max(initial=0.0),
            )
        )

    @property
    def worst_nm(self) -> float:
        """Largest |width in the resist - drawn|: diameters, and twice the shift of an
        edge.
        """
        return float(
            max(self.tally.worst[1], 2 * np.abs(self.edges.shift_nm).max(initial=0.0))
        )

    @property
    def ok(self) -> bool:
        """Whether every shape has a dose, and the exposure is within the tolerance of
        dose to size and within 1 nm.

        Along the edges of marks and labels 99 of 100 points keep the tolerance, and all
        of them twice that.
        """
        deviation = np.abs(self.edges.exposure - 1)
        edges_ok = not len(deviation) or (
            float((deviation <= self.tolerance).mean()) >= EDGE_SHARE
            and float(deviation.max()) <= EDGE_TIMES * self.tolerance
        )
        return (
            not self.undosed
            and max(float(self.tally.worst[0]), self.sampled) <= self.tolerance
            and edges_ok
            and self.worst_nm <= MOST_NM
        )

    @property
    def map_nm(self) -> Array:
        """(y, x) mean of resist less drawn diameter, the first row lowest; NaN where no
        pillar is judged.
        """
        tally = self.tally
        return np.divide(
            tally.total,
            tally.count,
            out=np.full_like(tally.total, np.nan),
            where=tally.count > 0,
        )
