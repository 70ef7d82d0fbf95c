"""Polynomial proxy of the pillar library: diameter, wavelength and angle to phase and
transmission (paper Eq. 2).
"""

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.polynomial import chebyshev

from metalens.core.arrays import Array
from metalens.core.errors import DomainError
from metalens.library import polynomial
from metalens.library.polynomial import Values

# largest error of t: the tolerance of a library, and for the pillars of a lens the
# root mean square of their error bars over |t|
MOST_ERROR = 0.1


def map_to_unit(values: Any, low: float, high: float) -> Any:
    """``values`` mapped linearly from [``low``, ``high``] to [-1, 1]; 0 where the ends
    are equal.
    """
    return (2 * values - low - high) / (high - low) if high > low else 0 * values


def height_hint(height_um: float, turns: float) -> str:
    """Advice where pillars of this height cover less than a turn of phase: the height
    or material that would.

    Args:
        height_um: of the pillars today, um.
        turns: of phase that they cover.
    """
    return (
        f"take pillars of about {height_um / max(turns, 0.05):.3g} um ({height_um:g} um now; phase grows with the "
        "height as long as no resonance comes in), or a material of higher index"
    )


@dataclass(frozen=True, eq=False, slots=True)
class Proxy:
    """Surrogate of t (Eq. 2): phase and |T| as polynomials of diameter, wavelength and
    angle, with the error on held-out entries.

    phase_coefficients: ([angle degree + 1,] wavelength degree + 1, diameter degree + 1)
        Chebyshev coefficients of the phase in rad.
    transmission_coefficients: as above, of |T|; certified to stay within [0, 1] on the
        domain.
    domain_um: (least, largest) diameter.
    wavelengths_um: (least, largest) wavelength; equal where the proxy holds at one
        wavelength.
    max_phase_error_rad, max_transmission_error: largest deviation from held-out library
        entries.
    power: the polynomials run in diameter^power.
    max_angle_rad: largest angle of incidence in air; the polynomials run in the square
        of its sine.
    entry_error: what the entries may be wrong by themselves, relative to |t|: their
        error bars' root mean square.
    gaps_um: (least, largest) diameters around narrow resonances inside the domain,
        which :meth:`diameter_um` never returns.

    Raises:
        DomainError: |T| leaves [0, 1] inside the domain, or an empty domain.
    """

    phase_coefficients: Array
    transmission_coefficients: Array
    domain_um: tuple[float, float]
    wavelengths_um: tuple[float, float]
    max_phase_error_rad: float
    max_transmission_error: float
    power: int = 1
    max_angle_rad: float = 0.0
    entry_error: float = 0.0
    gaps_um: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        """Refuse an empty domain, and |T| outside [0, 1] by its certified bounds."""
        low, high = self.domain_um
        if not 0 <= low < high < math.inf:
            raise DomainError(
                f"proxy domain is {self.domain_um} um, need 0 <= least < largest"
            )
        if not self.phase_coefficients.size:
            return
        least, most = polynomial.certified_bounds(self.transmission_coefficients)
        # the bounds are wider than the polynomial by up to this
        slack = 3e-3 * (most - least) + 1e-12
        if not (least >= -slack and most <= 1 + slack):
            raise DomainError(
                f"|T| of the proxy runs from {least:.6f} to {most:.6f}, need 0 to 1: fit it again"
            )

    def phase_rad(
        self, diameter_um: Values, wavelength_um: float, angle_rad: float = 0.0
    ) -> Values:
        """Phase of pillars in rad, unwrapped along the diameter; shape, dtype and
        device of ``diameter_um``.

        Torch tensors carry exact derivatives in the diameter, of any order.

        Raises:
            DomainError: a diameter, the wavelength or the angle lies outside the
                proxy's domain.
        """
        curve = self.at(wavelength_um, angle_rad)
        return polynomial.evaluate_curve(curve, diameter_um)

    def transmission(
        self, diameter_um: Values, wavelength_um: float, angle_rad: float = 0.0
    ) -> Values:
        """Magnitude |T| in [0, 1]; otherwise as :meth:`phase_rad`."""
        curve = self.level_at(wavelength_um, angle_rad)
        return polynomial.evaluate_curve(curve, diameter_um)

    def dphase_ddiameter(
        self, diameter_um: Values, wavelength_um: float, angle_rad: float = 0.0
    ) -> Values:
        """Slope of the phase, rad/um; otherwise as :meth:`phase_rad`."""
        curve = self.at(wavelength_um, angle_rad)
        return polynomial.evaluate_slope(curve, diameter_um)

    def dtransmission_ddiameter(
        self, diameter_um: Values, wavelength_um: float, angle_rad: float = 0.0
    ) -> Values:
        """Slope of |T|, 1/um; otherwise as :meth:`phase_rad`."""
        curve = self._curve(self.transmission_coefficients, wavelength_um, angle_rad)
        return polynomial.evaluate_slope(curve, diameter_um)

    def diameter_um(
        self,
        phase_rad: Values,
        wavelength_um: float,
        *,
        angle_rad: float = 0.0,
        within_um: tuple[float, float] | None = None,
        gap: Literal["refuse", "nearest"] = "refuse",
    ) -> Values:
        """Diameter of the pillar with a given phase modulo 2 pi, um; shape, dtype and
        device of ``phase_rad``.

        Args:
            phase_rad: (*shape) rad, array, tensor or number.
            wavelength_um: within the proxy's range.
            angle_rad: of incidence in air.
            within_um: (least, largest) diameter to use; the whole domain without it.
                Where it covers more than a turn the end with the lesser phase is used:
                move ``within_um`` to choose the branch.
            gap: what to do with a phase that no pillar has (less than a turn covered).

        Accuracy: phase of the returned diameter within 1e-10 rad in float64, 1e-5 rad in float32.
            Torch gradients are exact. A diameter in one of ``gaps_um`` moves to its
            closer end.

        Raises:
            DomainError: the phase is not monotone within ``within_um``, or no pillar
                has a phase.
        """
        return polynomial.invert_phase(
            self.at(wavelength_um, angle_rad),
            phase_rad,
            within_um=within_um,
            gap=gap,
            excluded_um=self.gaps_um,
        )

    def coverage_rad(
        self,
        wavelength_um: float,
        angle_rad: float = 0.0,
        within_um: tuple[float, float] | None = None,
    ) -> float:
        """Phase range between the ends of ``within_um`` (the whole domain without it),
        rad.
        """
        phases = self.phase_rad(
            np.array(within_um or self.domain_um), wavelength_um, angle_rad
        )
        return float(abs(phases[1] - phases[0]))

    def error(self, wavelength_um: float) -> float:
        """Error estimate of t relative to the mean |T|: root sum of squares of the
        phase error, the |T| error and that of the entries.
        """
        level = np.asarray(
            self.transmission(np.linspace(*self.domain_um, 65), wavelength_um)
        ).mean()
        return math.hypot(
            self.max_phase_error_rad,
            self.max_transmission_error / float(level),
            self.entry_error,
        )

    @property
    def doubt(self) -> str:
        """Message that the pillars' own error bars are too large for a lens; empty
        where they are not.

        The deviation of the curve is not counted: it is for the tolerances of a fit.
        """
        if self.entry_error <= MOST_ERROR:
            return ""
        return (
            f"the pillars' own error bars are {self.entry_error:.2g} of |t| (root mean square), {MOST_ERROR:g} at the "
            "most for a lens: take lower pillars, a smaller pitch, or a shape with fewer corners and with mirrors "
            "along x and y, which its solver knows better"
        )

    def monotone(
        self,
        wavelength_um: float,
        angle_rad: float = 0.0,
        within_um: tuple[float, float] | None = None,
    ) -> bool:
        """Whether the phase rises or falls throughout the diameters: its slope has no
        root inside, by the roots of the polynomial, not by sampling.
        """
        return polynomial.is_monotonic(
            self.at(wavelength_um, angle_rad), within_um or self.domain_um
        )

    def at(
        self, wavelength_um: float, angle_rad: float = 0.0
    ) -> polynomial.ChebyshevCurve:
        """The phase as a curve of the diameter alone."""
        return self._curve(self.phase_coefficients, wavelength_um, angle_rad)

    def level_at(
        self, wavelength_um: float, angle_rad: float = 0.0
    ) -> polynomial.ChebyshevCurve:
        """|T| as a curve of the diameter alone."""
        return self._curve(
            self.transmission_coefficients, wavelength_um, angle_rad, ceiling=1.0
        )

    def _curve(
        self,
        coefficients: Array,
        wavelength_um: float,
        angle_rad: float,
        ceiling: float = math.inf,
    ) -> polynomial.ChebyshevCurve:
        """Curve of the diameter at one wavelength and angle, by Chebyshev sums in sin²
        angle and then wavelength.

        Args:
            coefficients: of the phase or of |T|.
            wavelength_um: within the proxy's range.
            angle_rad: of incidence in air.
            ceiling: largest value of the curve.

        Raises:
            DomainError: the wavelength or angle lies outside, or there are no
                coefficients.
        """
        if not coefficients.size:
            raise DomainError(
                "pillars of two sizes (width and length) have a table, no proxy of one "
                "diameter; design, psf, layout, export (arrays) and view take such lenses"
            )
        if coefficients.ndim == 3:
            coefficients = np.asarray(
                chebyshev.chebval(self._angle_unit(angle_rad), coefficients)
            )
        elif angle_rad:
            raise DomainError(
                f"angle {angle_rad} rad, but the proxy holds at normal incidence only"
            )
        low, high = self.wavelengths_um
        if not low - 1e-9 <= wavelength_um <= high + 1e-9:
            raise DomainError(
                f"wavelength {wavelength_um:.7g} um, but the proxy holds from {low:.7g} to {high:.7g} um: sweep a "
                "library over the wavelengths ([sweep] wavelengths_um)"
            )
        diameter_coefficients = np.asarray(
            chebyshev.chebval(map_to_unit(wavelength_um, low, high), coefficients)
        )
        return polynomial.chebyshev_curve(
            diameter_coefficients, self.domain_um, self.power, ceiling
        )

    def _angle_unit(self, angle_rad: float) -> float:
        """Angle mapped to [-1, 1]: 2 (sin angle / sin largest angle)² - 1."""
        if not abs(angle_rad) <= self.max_angle_rad + 1e-9:
            raise DomainError(
                f"angle {angle_rad} rad, but the proxy holds up to {self.max_angle_rad} rad"
            )
        sines = math.sin(angle_rad) ** 2, math.sin(self.max_angle_rad) ** 2
        return float(min(1.0, map_to_unit(sines[0], 0.0, sines[1])))
