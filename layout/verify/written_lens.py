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
        """The designed lens with the predicted sizes, profile ``as-written``.

        The length of pillars of two sizes changes by as much as the width.

        Args:
            designed: lens of the plan.

        Raises:
            ProcessError: a predicted pillar as wide as the pitch.
        """
        size_um = self._size_um
        sizes = designed.diameters
        if sizes.plain and size_um.max() >= sizes.pitch_um:
            raise ProcessError(
                f"a pillar is predicted {size_um.max():.3f} um wide, as wide as the "
                "pitch; check the doses"
            )
        length_um = sizes.length_um
        if length_um is not None:  # all edges move equally
            length_um = np.where(
                size_um > 0, length_um + (size_um - sizes.diameter_um), 0
            ).astype(np.float32)
        written = dataclasses.replace(sizes, diameter_um=size_um, length_um=length_um)
        return dataclasses.replace(designed, diameters=written, profile="as-written")
