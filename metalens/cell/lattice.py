"""How pillars repeat: square, rectangular or hexagonal lattice."""

import math
from dataclasses import dataclass
from typing import Literal

from metalens.core.errors import CellError


@dataclass(frozen=True, slots=True)
class Lattice:
    """A lattice on the pitch of the cell, the period along x.

    kind: square; rectangular, with ``ratio`` times the pitch along y; hexagonal, with
        a row spacing of sqrt(3)/2 pitches, every other row shifted by half a pitch.
    ratio: period along y over the pitch, of a rectangular lattice.
    """

    kind: Literal["square", "rectangular", "hexagonal"] = "square"
    ratio: float = 1.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.ratio) and 0.05 <= self.ratio <= 20):
            raise CellError(
                f"lattice ratio = {self.ratio}: need the period along y over the pitch, 0.05 to 20"
            )
        if self.kind != "rectangular" and self.ratio != 1.0:
            raise CellError(
                f"lattice ratio = {self.ratio} on a {self.kind} lattice: only rectangular ones take a ratio"
            )

    @property
    def centred(self) -> bool:
        """Whether the rectangle of :meth:`periods_um` holds a second site at its
        middle.
        """
        return self.kind == "hexagonal"

    @property
    def least_order(self) -> float:
        """Wave number of the shortest reciprocal vector times pitch / (2 pi)."""
        return 2 / math.sqrt(3) if self.centred else min(1.0, 1 / self.ratio)

    def periods_um(self, pitch_um: float) -> tuple[float, float]:
        """Edges of the smallest rectangle along x and y that repeats."""
        if self.kind == "hexagonal":
            return pitch_um, math.sqrt(3) * pitch_um
        return pitch_um, self.ratio * pitch_um

    def area_um2(self, pitch_um: float) -> float:
        """Of the cell of one pillar."""
        x, y = self.periods_um(pitch_um)
        return x * y / (2 if self.centred else 1)

    def steps_um(self, pitch_um: float) -> tuple[tuple[float, float], ...]:
        """(x, y) of the sites around one, nearest shells first."""
        x, y = self.periods_um(pitch_um)
        sites = [(i * x, j * y) for i in range(-2, 3) for j in range(-2, 3)]
        if self.centred:
            sites += [
                ((i + 0.5) * x, (j + 0.5) * y)
                for i in range(-2, 2)
                for j in range(-2, 2)
            ]
        sites.sort(key=lambda site: math.hypot(*site))
        return tuple(sites[1:])
