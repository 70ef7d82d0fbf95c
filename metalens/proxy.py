"""Polynomial proxy of the pillar library: diameter and wavelength to phase and transmission (paper Eq. 2)."""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev

from metalens.errors import DomainError
from metalens.store import Array


@dataclass(frozen=True, eq=False, slots=True)
class Proxy:
    """Phase and |T| as polynomials of diameter and wavelength, with the error seen on held-out entries.

    phase_coefficients: (wavelength degree + 1, diameter degree + 1) Chebyshev coefficients of the phase in rad.
    transmission_coefficients: as above, of |T|.
    domain_um: (least, largest) diameter.
    wavelengths_um: (least, largest) wavelength; equal where the proxy holds at one wavelength.
    """

    phase_coefficients: Array
    transmission_coefficients: Array
    domain_um: tuple[float, float]
    wavelengths_um: tuple[float, float]
    max_phase_error_rad: float
    max_transmission_error: float

    def phase_rad(self, diameter_um: Array, wavelength_um: float) -> Array:
        """Phase of pillars, rad, unwrapped along the diameter; shape of ``diameter_um``."""
        return chebyshev.chebval(self._unit(diameter_um), self._at(self.phase_coefficients, wavelength_um))

    def transmission(self, diameter_um: Array, wavelength_um: float) -> Array:
        """Magnitude |T| in [0, 1]; shape of ``diameter_um``."""
        value = chebyshev.chebval(self._unit(diameter_um), self._at(self.transmission_coefficients, wavelength_um))
        return np.clip(value, 0, 1)

    def _unit(self, diameter_um: Array) -> Array:
        low, high = self.domain_um
        return (2 * np.asarray(diameter_um) - low - high) / (high - low)

    def _at(self, coefficients: Array, wavelength_um: float) -> Array:
        low, high = self.wavelengths_um
        if not low - 1e-9 <= wavelength_um <= high + 1e-9:
            raise DomainError(f"wavelength {wavelength_um} um, but the proxy holds from {low} to {high} um")
        unit = 0.0 if high == low else (2 * wavelength_um - low - high) / (high - low)
        return np.asarray(chebyshev.chebval(unit, coefficients))

    def to_arrays(self) -> dict[str, Array]:
        """Everything as arrays, for a store file."""
        return {
            "phase_coefficients": self.phase_coefficients,
            "transmission_coefficients": self.transmission_coefficients,
            "domain_um": np.array(self.domain_um),
            "wavelengths_um": np.array(self.wavelengths_um),
            "max_error": np.array([self.max_phase_error_rad, self.max_transmission_error]),
        }

    @classmethod
    def from_arrays(cls, arrays: dict[str, Array]) -> "Proxy":
        """Inverse of :meth:`to_arrays`."""
        domain, waves, error = (arrays[k].tolist() for k in ("domain_um", "wavelengths_um", "max_error"))
        return cls(
            arrays["phase_coefficients"],
            arrays["transmission_coefficients"],
            (domain[0], domain[1]),
            (waves[0], waves[1]),
            *error,
        )
