"""The lens that the simulator predicts, for PSFs and the tolerance study."""

import dataclasses

import numpy as np

from layout.certify.certificate import Certificate
from layout.certify.exposed import Band
from layout.mask import MaskPlan
from metalens.ground.arrays import Array
from metalens.ground.errors import ProcessError
from metalens.ground.units import nm
from metalens.lens import DiameterMap, Lens


class MadeRows:
    """Diameters at half height of the lens of a plan, filled in band by band.

    plan: that was written; its first lattice is the lens, on the layer numbers of its pillars.
    """

    def __init__(self, plan: MaskPlan) -> None:
        self._lattice, self._unit = plan.lattices[0], plan.unit_nm * nm
        self._layers = sorted({made.layer[0] for made in plan.classes if made.name[0] not in "TW"})
        self._diameter_um = np.zeros((self._lattice.rows, self._lattice.columns), np.float32)

    def take(self, band: Band, layer: Array) -> None:
        """Take in the pillars of a band with their layer numbers.

        Raises:
            ProcessError: a pillar off the lattice.
        """
        self.place(band.x_um, band.y_um, band.made_nm, layer)

    def place(self, x_um: Array, y_um: Array, made_nm: Array, layer: Array) -> None:
        """As :meth:`take`, from arrays (n,)."""
        lens, l = np.isin(layer, self._layers), self._lattice
        column = (x_um[lens] / self._unit - l.x0) / l.pitch
        row = (y_um[lens] / self._unit - l.y0) / l.pitch + l.rows - 1  # the map's first row is the lowest
        i, j = np.rint(row).astype(np.int32), np.rint(column).astype(np.int32)
        inside = (i >= 0) & (i < l.rows) & (j >= 0) & (j < l.columns)
        off = max(np.abs(row - i).max(initial=0.0), np.abs(column - j).max(initial=0.0))
        if not inside.all() or off > 0.01:
            raise ProcessError("pillars of the written file do not stand on the lattice of the lens")
        self._diameter_um[i, j] = made_nm[lens] * np.float32(nm)

    def lens(self, designed: Lens) -> Lens:
        """``designed`` with these diameters; profile ``as-written``.

        Raises:
            ProcessError: a predicted pillar as wide as the pitch.
        """
        made, pitch = self._diameter_um, designed.diameters.pitch_um
        if made.max() >= pitch:
            raise ProcessError(f"a pillar is predicted {made.max():.3f} um wide, as wide as the pitch; check the doses")
        return dataclasses.replace(designed, diameters=DiameterMap(made, pitch), profile="as-written")


def as_made(designed: Lens, plan: MaskPlan, found: Certificate) -> Lens:
    """``designed`` with the diameters at half height that the written mask makes; profile ``as-written``.

    Args:
        plan: that was written; its first lattice is the lens, on the layer numbers of its pillars.

    Raises:
        ProcessError: a predicted pillar off the lattice, or as wide as the pitch.
    """
    rows = MadeRows(plan)
    rows.place(found.x_um, found.y_um, found.made_nm, found.layer)
    return rows.lens(designed)
