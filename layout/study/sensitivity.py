"""How the transmission of a pillar answers to height, index, wall and every other cause
of the table, by a solver.
"""

from dataclasses import dataclass

import numpy as np

from metalens.core.arrays import Array
from metalens.fabrication import own_rates, with_missing
from metalens.lens import Lens


@dataclass(frozen=True, eq=False, slots=True)
class LogSensitivities:
    """Logarithmic derivatives of t: the real part changes |t|, the imaginary part is a
    phase in rad.

    diameter_um: (n,) rising. rates: (answering causes, n) complex, by the base unit of
    each (um, rad, 1); rows that are
        not there are 0.
    error: largest relative change (rms over the diameters) of one of them from a
    coarser truncation.
    edges: (n,) by a bias of all edges less that by the size, per um; None where that is
    nothing.
    """

    diameter_um: Array
    rates: Array
    error: float
    edges: Array | None = None

    def at(self, diameter_um: Array) -> Array:
        """(answering causes, *shape) derivatives of ln t; beyond the ends the end value
        holds.
        """
        return with_missing(
            [np.interp(diameter_um, self.diameter_um, row) for row in self.rates]
        )

    def by_edges(self, diameter_um: Array) -> Array | None:
        """(*shape) what a bias of all edges changes ln t by beyond the same change of
        the size; None for nothing.
        """
        if self.edges is None or not self.edges.any():
            return None
        return np.asarray(np.interp(diameter_um, self.diameter_um, self.edges))


def compute_sensitivities(lens: Lens, *, count: int = 15) -> LogSensitivities:
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
    rates = own_rates(lens, diameters)
    return LogSensitivities(diameters, rates.rates, rates.error, rates.edges)
