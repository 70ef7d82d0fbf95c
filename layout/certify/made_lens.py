"""The lens that the simulator predicts, for PSFs and the tolerance study."""

import dataclasses

import numpy as np

from layout.certify.certificate import Certificate
from layout.mask import MaskPlan
from metalens.ground.errors import ProcessError
from metalens.ground.units import nm
from metalens.lens import DiameterMap, Lens


def as_made(designed: Lens, plan: MaskPlan, found: Certificate) -> Lens:
    """``designed`` with the diameters at half height that the written mask makes; profile ``as-written``.

    Args:
        plan: that was written; its first lattice is the lens, on the layer numbers of its pillars.

    Raises:
        ProcessError: a predicted pillar off the lattice, or as wide as the pitch.
    """
    lattice, unit = plan.lattices[0], plan.unit_nm * nm
    kinds = {made.layer[0] for made in plan.classes if made.name[0] not in "TW"}
    lens = np.isin(found.layer, sorted(kinds))
    column = (found.x_um[lens] / unit - lattice.x0) / lattice.pitch
    row = (found.y_um[lens] / unit - lattice.y0) / lattice.pitch + lattice.rows - 1  # the map's first row is the lowest
    i, j = np.rint(row).astype(int), np.rint(column).astype(int)
    made_um = found.made_nm[lens] * nm
    inside = (i >= 0) & (i < lattice.rows) & (j >= 0) & (j < lattice.columns)
    if not inside.all() or max(abs(row - i).max(), abs(column - j).max()) > 0.01:
        raise ProcessError("pillars of the written file do not stand on the lattice of the lens")
    if made_um.max() >= designed.diameters.pitch_um:
        raise ProcessError(f"a pillar is predicted {made_um.max():.3f} um wide, as wide as the pitch; check the doses")
    diameters = np.zeros((lattice.rows, lattice.columns), np.float32)
    diameters[i, j] = made_um
    return dataclasses.replace(
        designed, diameters=DiameterMap(diameters, designed.diameters.pitch_um), profile="as-written"
    )
