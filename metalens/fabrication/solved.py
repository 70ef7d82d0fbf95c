"""t of pillars as a cell solver has it, over the diameter and in powers of each cause:
no slope stands for a curve.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from metalens.core.arrays import Array


@dataclass(frozen=True, eq=False, slots=True)
class Solved:
    """Complex t at some diameters, as power series of single causes; cubic between the
    diameters.

    wavelength_um: that it was solved at. diameter_um: (n,) rising.
    powers: (causes, orders, n) of t in powers of the amount of each pillar-response
    error
    (um, rad, 1), in the table's order;
        the first is the designed t, the others are 0 for a cause that was not solved.
        Between the amounts that were
        solved a series misses resonances that move by: up to 0.03 of t beside them.
    """

    wavelength_um: float
    diameter_um: Array
    powers: Array

    def series(self, diameter_um: Array) -> Array:
        """(causes, orders, *shape) at diameters between the ends."""
        return np.asarray(
            CubicSpline(self.diameter_um, self.powers, axis=-1)(diameter_um)
        )
