"""Sensitivities of a pillar's transmission to every fabrication error, by RCWA."""

import numpy as np

from metalens.fabrication import ResponseRates, own_rates
from metalens.lens import Lens


def compute_sensitivities(lens: Lens, *, count: int = 15) -> ResponseRates:
    """Derivatives of ln t by every cause of the table, from RCWA at a fixed truncation.

    Args:
        lens: of pillars of one size.
        count: diameters over the domain of its proxy; half of them where walls lean.

    Raises:
        CellError, MaterialError: from the solver.

    Accuracy:
        ``error`` of the result, the change from a coarser truncation: a few percent.
    """
    diameters = np.linspace(*lens.proxy.domain_um, count)
    diameters = diameters[:: 2 if lens.cell.sidewall_rad else 1]
    return own_rates(lens, diameters)
