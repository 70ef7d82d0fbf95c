"""The lens that comes out of a written mask, for PSFs and the tolerance study."""

import dataclasses

import numpy as np

from layout.mask.plan import MaskPlan
from layout.verify.exposure import ExposedRows
from metalens.core.arrays import Array
from metalens.core.errors import ProcessError
from metalens.core.units import nm
from metalens.lens import Lens


class LensRows:
    """Sizes at half height of the lens of a plan, its first lattice, filled in by rows."""

    def __init__(self, plan: MaskPlan) -> None:
        lattice = plan.lattices[0]
        self._size_um: Array = np.zeros((lattice.rows, lattice.columns), np.float32)

    def take(self, rows: ExposedRows) -> None:
        """Take in rows; the first row of a mask is the last of the map."""
        if rows.number == 0:
            end = len(self._size_um) - rows.first
            first = end - len(rows.made_nm)
            self._size_um[first:end] = rows.made_nm[::-1] * nm

    def lens(self, designed: Lens) -> Lens:
        """``designed`` with these sizes; profile ``as-written``.

        Raises:
            ProcessError: a predicted pillar as wide as the pitch.
        """
        made = self._size_um
        was = designed.diameters
        if was.plain and made.max() >= was.pitch_um:
            raise ProcessError(
                f"a pillar is predicted {made.max():.3f} um wide, as wide as the "
                "pitch; check the doses"
            )
        long = was.length_um
        if long is not None:  # all edges move alike
            long = np.where(made > 0, long + (made - was.diameter_um), 0).astype(
                np.float32
            )
        found = dataclasses.replace(was, diameter_um=made, length_um=long)
        return dataclasses.replace(designed, diameters=found, profile="as-written")
