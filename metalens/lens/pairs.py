"""Pillars of two sizes in a lens: a table of t in place of a proxy, and the distances
of light polarised along y.
"""

import math
from dataclasses import dataclass

import numpy as np

from metalens.core.arrays import Array
from metalens.core.errors import DomainError, LensError
from metalens.library import Proxy


@dataclass(frozen=True, eq=False, slots=True)
class TwoSizeTable:
    """Transmission of pillars over the size along x and that along y, for light
    polarised along x and along y.

    wavelength_um: (w,). x_um: (m,), y_um: (n,) evenly spaced sizes. t: (w, m, n, 2)
        power-normalised amplitudes that keep the polarisation, exp(-iwt).
    focus_y_um: (sensor, source) distance of the light polarised along y; that of the
        lens is of light along x.
    entry_error: root mean square of the error bars of the pillars that stand in the
        lens, relative to |t|; nan where it is not known (older files).
    """

    wavelength_um: Array
    x_um: Array
    y_um: Array
    t: Array
    focus_y_um: tuple[float, float]
    entry_error: float = math.nan

    def __post_init__(self) -> None:
        shape = (len(self.wavelength_um), len(self.x_um), len(self.y_um), 2)
        if self.t.shape != shape or min(shape) < 1 or not np.isfinite(self.t).all():
            raise LensError(
                f"table of pillars of two sizes has shape {self.t.shape}, need finite values of {shape}"
            )

    def amplitude(
        self, x_um: Array, y_um: Array, wavelength_um: float, light: str
    ) -> Array:
        """(...) t of pillars that stand in the table; sizes of 0 are no pillar and give
        0.

        Raises:
            DomainError: a wavelength or a size that the table does not hold.
        """
        found = np.flatnonzero(np.abs(self.wavelength_um - wavelength_um) <= 1e-9)
        if not len(found):
            held = ", ".join(f"{w:g}" for w in self.wavelength_um)
            raise DomainError(
                f"wavelength {wavelength_um:g} um: pillars of two sizes are known at {held} um alone"
            )
        there = np.asarray(x_um) > 0
        row, column = (
            _place(axis, np.where(there, v, axis[0]))
            for axis, v in ((self.x_um, x_um), (self.y_um, y_um))
        )
        return np.asarray(
            np.where(there, self.t[found[0], row, column, "xy".index(light)], 0)
        )

    @property
    def proxy(self) -> Proxy:
        """A proxy without a curve: domain, wavelengths and entry error alone."""
        domain = float(self.x_um[0]), float(self.x_um[-1]) + 1e-9
        ends = float(self.wavelength_um[0]), float(self.wavelength_um[-1])
        known = 0.0 if math.isnan(self.entry_error) else self.entry_error
        none = np.zeros((1, 0))
        return Proxy(none, none, domain, ends, 0.0, 0.0, entry_error=known)


def _place(axis: Array, size_um: Array) -> Array:
    """Index of sizes that the axis holds.

    Raises:
        DomainError: one that it does not hold, to a twentieth of a step.
    """
    step = float(axis[1] - axis[0]) if len(axis) > 1 else 1.0
    exact = (np.asarray(size_um, float) - float(axis[0])) / step
    place = np.clip(np.rint(exact), 0, len(axis) - 1)
    if np.abs(exact - place).max(initial=0.0) > 0.05:
        wrong = float(np.asarray(size_um).ravel()[np.abs(exact - place).argmax()])
        raise DomainError(
            f"a pillar of {wrong:.6g} um: the table of this lens does not hold that size"
        )
    return np.asarray(place.astype(int))
