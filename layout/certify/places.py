"""Where the pillars stand, strip by strip from bottom to top: lattices in bands of
rows.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from layout.mask import Lattice
from layout.process import compiled
from metalens.ground.arrays import Array
from metalens.ground.units import nm

Box = tuple[float, float, float, float]  # left, bottom, right, top
_SITES = 1 << 17  # of a strip of lattices
_LEAST_ROWS = 8


def strip_of(places: "OnLattices", y_um: Array) -> Array:
    """(n,) strips that hold some heights; those beyond the ends belong to the outer
    ones.
    """
    found = np.floor((np.asarray(y_um) - places.box_um[1]) / places.height_um).astype(
        np.int64
    )
    return np.asarray(np.clip(found, 0, places.strips - 1))


@dataclass(frozen=True, eq=False, slots=True)
class OnLattices:
    """Places on lattices of a plan, never all in memory; each pillar in one of the
    strips 0 to ``strips`` - 1.

    kinds: (classes + 1,) kind of each class number, -1 for those that are passed over.
    centre_um: (kinds, 2) of the
    shape, from its site. height: of a strip, in database units.
    """

    lattices: Sequence[Lattice]
    kinds: Array
    centre_um: Array
    unit_nm: float
    count: int
    height: int

    @classmethod
    def of(
        cls,
        lattices: Sequence[Lattice],
        kinds: Array,
        centre_um: Array,
        *,
        unit_nm: float,
        count: int,
    ) -> "OnLattices":
        """With strips of some 130 000 sites."""
        down, columns = max(l.down for l in lattices), max(l.columns for l in lattices)
        return cls(
            lattices,
            kinds,
            centre_um,
            unit_nm,
            count,
            down * max(_LEAST_ROWS, _SITES // columns),
        )

    @property
    def _ends(self) -> tuple[int, int]:
        """Bottom and top row, database units."""
        return min(l.y0 - (l.rows - 1) * l.down for l in self.lattices), max(
            l.y0 for l in self.lattices
        )

    @property
    def box_um(self) -> Box:
        """Around all sites."""
        unit, (bottom, top) = self.unit_nm * nm, self._ends
        left, right = (
            min(l.x0 for l in self.lattices),
            max(l.x0 + (l.columns - 1) * l.pitch for l in self.lattices),
        )
        return left * unit, bottom * unit, right * unit, top * unit

    @property
    def strips(self) -> int:
        """Number of strips."""
        bottom, top = self._ends
        return (top - bottom) // self.height + 1

    @property
    def height_um(self) -> float:
        """Height of a strip."""
        return self.height * self.unit_nm * nm

    def part(self, first: int, end: int) -> tuple[Array, Array, Array]:
        """(n,) x, y and kind of the pillars of some strips."""
        bottom = self._ends[0]
        low, high = bottom + max(first, 0) * self.height, bottom + end * self.height
        found = [self._of(l, low, high) for l in self.lattices]
        x, y, kind = (np.concatenate([each[k] for each in found]) for k in range(3))
        return x, y, kind

    def _of(self, lattice: Lattice, low: int, high: int) -> tuple[Array, Array, Array]:
        """Pillars of a lattice whose sites have low <= y < high."""
        top = max(0, math.floor((lattice.y0 - high) / lattice.down) + 1)
        end = min(lattice.rows, math.floor((lattice.y0 - low) / lattice.down) + 1)
        if end <= top:
            return np.empty(0), np.empty(0), np.empty(0, np.int32)
        block, unit = np.ascontiguousarray(lattice.source(top, end)), self.unit_nm * nm
        x, y, kind = (
            np.empty(block.size),
            np.empty(block.size),
            np.empty(block.size, np.int32),
        )
        at = lattice.x0, lattice.y0 - top * lattice.down, lattice.pitch, lattice.down
        count = _sites(block, self.kinds, self.centre_um, *at, unit, x, y, kind)
        return x[:count], y[:count], kind[:count]


@compiled
def _sites(
    block: Array,
    kinds: Array,
    centre: Array,
    x0: int,
    y0: int,
    pitch: int,
    down: int,
    unit: float,
    x: Array,
    y: Array,
    kind: Array,
) -> int:
    """Places and kinds of the pillars of a block of rows; how many there are."""
    count = 0
    for row in range(block.shape[0]):
        for column in range(block.shape[1]):
            k = kinds[block[row, column]]
            if k >= 0:
                x[count] = (x0 + column * pitch) * unit + centre[k, 0]
                y[count] = (y0 - row * down) * unit + centre[k, 1]
                kind[count] = k
                count += 1
    return count
