"""The lens that the simulator predicts, for PSFs and the tolerance study."""

import dataclasses

import numpy as np

from layout.certify.exposed import Band
from layout.mask import MaskPlan
from layout.process import compiled
from metalens.ground.arrays import Array
from metalens.ground.errors import ProcessError
from metalens.ground.units import nm
from metalens.lens import Lens

_OFF = 0.01  # pitches that a pillar may stand off its site


class MadeRows:
    """Diameters at half height of the lens of a plan, filled in band by band; of shapes
    the sizes that they go by.

    plan: that was written; its first lattice is the lens, on the layer numbers of its
    pillars.
    """

    def __init__(self, plan: MaskPlan) -> None:
        self._lattice, self._unit = plan.lattices[0], plan.unit_nm * nm
        self._layers = sorted(
            {made.layer[0] for made in plan.classes if made.role == "pillar"}
        )
        self._diameter_um = np.zeros(
            (self._lattice.rows, self._lattice.columns), np.float32
        )

    def take(self, band: Band, layer: Array) -> None:
        """Take in the pillars of a band with their layer numbers.

        Raises:
            ProcessError: a pillar off the lattice.
        """
        self.place(band.x_um, band.y_um, band.made_nm, layer)

    def place(self, x_um: Array, y_um: Array, made_nm: Array, layer: Array) -> None:
        """As :meth:`take`, from arrays (n,)."""
        l = self._lattice
        lens = np.zeros(1 << 16, bool)
        lens[self._layers] = True
        site = l.x0, l.y0, l.pitch, l.down, self._unit
        if _fill(x_um, y_um, made_nm, layer, lens, *site, self._diameter_um):
            raise ProcessError(
                "pillars of the written file do not stand on the lattice of the lens"
            )

    def lens(self, designed: Lens) -> Lens:
        """``designed`` with these diameters; profile ``as-written``.

        Raises:
            ProcessError: a predicted pillar as wide as the pitch.
        """
        made, was = self._diameter_um, designed.diameters
        if was.plain and made.max() >= was.pitch_um:
            raise ProcessError(
                f"a pillar is predicted {made.max():.3f} um wide, as wide as the pitch; check the doses"
            )
        long = was.length_um
        if long is not None:  # all edges move alike
            long = np.where(made > 0, long + (made - was.diameter_um), 0).astype(
                np.float32
            )
        found = dataclasses.replace(was, diameter_um=made, length_um=long)
        return dataclasses.replace(designed, diameters=found, profile="as-written")


@compiled
def _fill(
    x: Array,
    y: Array,
    made_nm: Array,
    layer: Array,
    lens: Array,
    x0: int,
    y0: int,
    pitch: int,
    down: int,
    unit: float,
    diameter_um: Array,
) -> int:
    """Put diameters on their sites, the map's first row the lowest; number of pillars
    that stand on none.
    """
    rows, columns, wrong = diameter_um.shape[0], diameter_um.shape[1], 0
    for n in range(x.shape[0]):
        if not lens[layer[n]]:
            continue
        column, row = (x[n] / unit - x0) / pitch, (y[n] / unit - y0) / down + rows - 1
        i, j = int(np.rint(row)), int(np.rint(column))
        if (
            0 <= i < rows
            and 0 <= j < columns
            and abs(row - i) <= _OFF
            and abs(column - j) <= _OFF
        ):
            diameter_um[i, j] = made_nm[n] * 1e-3
        else:
            wrong += 1
    return wrong
