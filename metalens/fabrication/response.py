"""What the pillar-response errors do to every pillar: derivatives of ln t over the
diameter, and t itself under a change.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import polynomial
from numpy.polynomial.chebyshev import chebpts1

from metalens.cell import Cell, index
from metalens.core.arrays import Array
from metalens.core.errors import LensError
from metalens.fabrication.perturbations import (
    LEAST_TRANSMISSION,
    WaveguideModel,
    response_errors,
    with_missing,
)
from metalens.fabrication.solved_rates import (
    ResponseRates,
    largest_row_error,
    own_rates,
)
from metalens.lens import Lens
from metalens.library import Proxy

_END = 64  # the tangent at an end of a proxy: over 1/64 of its wavelength range
_DEGREE = 5  # of polynomials over the diameter


@dataclass(frozen=True, eq=False, slots=True)
class SolvedResponse:
    """Complex t of pillars as power series in single fabrication errors.

    Cubic splines between the diameters. Between the solved amounts a series misses
    resonances that pass: up to 0.03 of t near them.

    wavelength_um: at which it was solved. diameter_um: (n,) rising.
    powers: (causes, orders, n) coefficients of t in powers of the amount of each
        pillar-response error (um, rad, 1), in the table's order. The first is the
        designed t; the others are 0 for a cause that was not solved.
    """

    wavelength_um: float
    diameter_um: Array
    powers: Array


@dataclass(frozen=True, eq=False, slots=True)
class Sensitivity:
    """First-order change of ln t with the pillar-response errors, over the diameter.

    coefficients: (pillar-response errors, degree + 1) complex power series in
        (D - center_um) of d ln t by the base unit (um, rad, 1) of each. A row of zeros,
        or a row that is missing, switches a cause off.
    center_um: origin of the power series.
    error: of the slopes, relative to their change across the lens; nan where not known.
    low_um, high_um: diameters of the fit; beyond them the polynomials continue along
        their tangents.
    solved: t itself under large changes from a solver, in place of the proxy.
    edges: (1, degree + 1) likewise of d ln t by a bias of all edges less that by the
        size, per um. A proxy has pillars that keep their form as they grow, which a
        biased rectangle does not. None for shapes that do.
    pairs: of pillars of two sizes, in place of all polynomials; None of those of one.
    """

    coefficients: Array
    center_um: float
    error: float = math.nan
    low_um: float = -math.inf
    high_um: float = math.inf
    solved: SolvedResponse | None = None
    edges: Array | None = None
    pairs: ResponseRates | None = None

    @classmethod
    def of_pairs(cls, pairs: ResponseRates) -> "Sensitivity":
        """Of pillars of two sizes."""
        return cls(np.zeros((0, 1)), 0.0, pairs.error, pairs=pairs)

    def at(self, diameter_um: Array) -> Array:
        """(pillar-response errors, *shape) derivatives of ln t.

        Raises:
            LensError: of pillars of two sizes.
        """
        return with_missing(self._series(self.coefficients, diameter_um))

    def change(self, amounts: Array, diameter_um: Array) -> Array:
        """(*shape) change of ln t by (pillar-response errors,) ``amounts``, to first
        order.
        """
        rows = self.coefficients
        (total,) = self._series(amounts[None, : len(rows)] @ rows, diameter_um)
        return np.asarray(total)

    def by_edges(self, diameter_um: Array) -> Array | None:
        """(*shape) change of ln t per um of a bias of all edges, beyond that of the
        size.

        None for pillars that keep their form.
        """
        return None if self.edges is None else self._series(self.edges, diameter_um)[0]

    def _series(self, coefficients: Array, diameter_um: Array) -> Array:
        """(rows, *shape) polynomials at diameters.

        Beyond ``low_um`` and ``high_um`` they continue along their tangents.

        Args:
            coefficients: (rows, degree + 1) power series in D - ``center_um``.
            diameter_um: (*shape) diameters, um.
        """
        if self.pairs is not None:
            raise LensError(
                "pillars of two sizes: their derivatives are no function of one size"
            )
        inside = np.clip(diameter_um, self.low_um, self.high_um)
        offset = inside - self.center_um
        slopes = polynomial.polyval(offset, polynomial.polyder(coefficients.T))
        values = polynomial.polyval(offset, coefficients.T)
        return np.asarray(values + slopes * (diameter_um - inside))


@dataclass(frozen=True, eq=False, slots=True)
class RelativeResponse:
    """Response of pillars of given diameters to the pillar-response errors.

    t over that of the proxy at the design wavelength.

    slopes: (causes, *shape) d ln t by the causes that act linearly.
    series: (causes, orders, *shape) of t in powers of the others, the designed t first;
        None where all are linear.
    proxy: (*shape) t of the proxy.
    """

    slopes: Array
    series: Array | None
    proxy: Array

    def factor(self, amounts: Array) -> Array:
        """(*shape) t under the change over the proxy's t.

        t_solved / t_proxy times prod_c t_c(a_c) / t_c(0) over causes with a series,
        times exp(sum_c a_c s_c) over the others.

        Args:
            amounts: (causes,) a_c in base units (um, rad, 1).
        """
        change: Array = np.exp(np.tensordot(amounts, self.slopes, 1))
        if self.series is not None:
            change = change * self.series[0, 0] / self.proxy
            for amount, row in zip(amounts, self.series, strict=False):
                if amount:
                    change = change * (polynomial.polyval(amount, row) / row[0])
        return change

    def rates(self, amounts: Array) -> Array:
        """(causes, *shape) d ln t by every cause at the change: s_c, or t_c'(a_c) /
        t_c(a_c).

        Args:
            amounts: (causes,) a_c in base units (um, rad, 1).
        """
        out = self.slopes.astype(complex)
        if self.series is not None:
            for n, (amount, row) in enumerate(zip(amounts, self.series, strict=False)):
                if row[1:].any():
                    slope = polynomial.polyval(amount, polynomial.polyder(row))
                    out[n] = slope / polynomial.polyval(amount, row)
        return out


def proxy_sensitivity(lens: Lens) -> Sensitivity:
    """Derivatives of ln t by the pillar-response errors, as polynomials of the
    diameter.

    Of round pillars on a square lattice: from the effective index n_eff that the phase
    of the proxy implies, phase = k n_eff h. Of other shapes: by central differences of
    RCWA for the shape itself (seconds a lens).

    Args:
        lens: the lens, with its cell and proxy.

    Accuracy: of an effective index, 10 % of the slopes by height, 50 % of those by
        index; interference between foot and top is left out. The cell solvers are
        more exact, at seconds a lens. For other shapes: ``error`` of the result.

    Raises:
        CellError, MaterialError, LensError: pillars that are not round and that the
            solver does not take.
    """
    if not lens.cell.round:
        return _own_shape_sensitivity(lens)
    diameters = lens.diameters.diameter_um[lens.diameters.diameter_um > 0]
    low = max(float(diameters.min()), lens.proxy.domain_um[0])
    high = min(float(diameters.max()), lens.proxy.domain_um[1])
    guide = effective_indices(
        lens.cell, lens.proxy, lens.wavelength_um, np.linspace(low, high, 61)
    )
    center = float(guide.diameter_um.mean())
    rows = np.stack([acts.quick(guide) for _, acts in response_errors()])
    coefficients = polynomial.polyfit(guide.diameter_um - center, rows.T, _DEGREE).T
    return Sensitivity(coefficients, center, 0.5, low, high)


def _own_shape_sensitivity(lens: Lens) -> Sensitivity:
    """Derivatives of ln t of a lens's own pillar shape, as polynomials of degree 5.

    RCWA rates (:func:`metalens.fabrication.solved_rates.own_rates`) at the nine
    Chebyshev sizes of the proxy's domain are fitted by least squares. ``error``:
    truncation of the solver plus the largest relative residual of the fit.
    """
    low, high = lens.proxy.domain_um
    center = (low + high) / 2
    offset = (high - low) / 2 * chebpts1(2 * _DEGREE - 1)
    solved = own_rates(lens, center + offset)
    rows = np.vstack([solved.rates, solved.edges])
    series = polynomial.polyfit(offset, rows.T, _DEGREE)
    fit_error = largest_row_error(polynomial.polyval(offset, series), rows)
    return Sensitivity(
        series.T[:-1],
        center,
        solved.error + fit_error,
        low,
        high,
        edges=series.T[-1:] if solved.edges.any() else None,
    )


def effective_indices(
    cell: Cell, proxy: Proxy, wavelength_um: float, diameter_um: Array
) -> WaveguideModel:
    """Effective index n_eff of pillars over the diameter, with two derivatives.

    phase(D) - phase(D_0) = k h (n_eff(D) - n_eff(D_0)), smoothed by a polynomial. At
    the thinnest pillar D_0, n_eff is that of thin cylinders across the field (Rayleigh
    1892, two dimensions).

    Args:
        cell: unit cell with its materials, shape and lattice.
        proxy: phase and |T| over the diameter.
        wavelength_um: vacuum wavelength, um.
        diameter_um: (n,) rising diameters, um.
    """
    n_pillar, n_around = (
        index(material, wavelength_um).real for material in (cell.pillar, cell.fill)
    )
    k = 2 * math.pi / wavelength_um
    fill = math.pi * diameter_um[0] ** 2 / 4 / cell.pitch_um**2
    eps_pillar = n_pillar**2
    eps_around = n_around**2
    part = fill * (eps_pillar - eps_around) / (eps_pillar + eps_around)
    eps_thin = eps_around * (1 + part) / (1 - part)
    phase = proxy.phase_rad(diameter_um, wavelength_um)
    offset = diameter_um - diameter_um.mean()
    n_eff = np.polynomial.Polynomial.fit(
        offset, math.sqrt(eps_thin) + (phase - phase[0]) / (k * cell.height_um), _DEGREE
    )
    return WaveguideModel(
        k,
        diameter_um,
        n_eff(offset),
        n_eff.deriv()(offset),
        n_eff.deriv(2)(offset),
        n_pillar,
        n_around,
        cell.height_um,
        cell.sidewall_rad,
    )


def designed_transmission(
    proxy: Proxy, d_um: Array, wavelength_um: float, *, angle_rad: float = 0.0
) -> Array:
    """Complex t of pillars by their proxy, extrapolated along tangents beyond its
    domain.

    By diameter, phase and |T| continue along their tangents without end. By wavelength
    they do so over one more range of the proxy, then stay constant. With a proxy of one
    wavelength they are constant over wavelength. |T| stays within 1e-3 to 1.

    Args:
        proxy: phase and |T| over the diameter.
        d_um: diameters of any shape, um.
        wavelength_um: vacuum wavelength, um.
        angle_rad: angle of incidence in air, rad.
    """
    low, high = proxy.wavelengths_um
    inside = min(max(wavelength_um, low), high)
    phase, level = _phase_and_level(proxy, d_um, inside, angle_rad)
    beyond = min(max(wavelength_um - inside, low - high), high - low)
    if beyond:
        step = math.copysign((high - low) / _END, beyond)
        phase_in, level_in = _phase_and_level(proxy, d_um, inside - step, angle_rad)
        phase = phase + (phase - phase_in) * (beyond / step)
        level = level + (level - level_in) * (beyond / step)
    return np.asarray(np.clip(level, LEAST_TRANSMISSION, 1) * np.exp(1j * phase))


def _phase_and_level(
    proxy: Proxy, d_um: Array, wavelength_um: float, angle_rad: float
) -> tuple[Array, Array]:
    """Phase in rad and |T| of pillars, along tangents beyond the proxy's diameters.

    Args:
        proxy: phase and |T| over the diameter.
        d_um: diameters of any shape, um.
        wavelength_um: within the proxy's range, um.
        angle_rad: angle of incidence in air, rad.
    """
    at = wavelength_um, angle_rad
    inside = np.clip(d_um, *proxy.domain_um)
    beyond = d_um - inside
    phase = proxy.phase_rad(inside, *at) + beyond * proxy.dphase_ddiameter(inside, *at)
    level = proxy.transmission(inside, *at) + beyond * proxy.dtransmission_ddiameter(
        inside, *at
    )
    return phase, level


def prepare_response(
    proxy: Proxy, response: Sensitivity | ResponseRates, diameter_um: Array
) -> RelativeResponse:
    """Response of pillars to the pillar-response errors, for many amounts of these.

    Where ``response`` has solved series of t, these replace the linear slopes of their
    causes. Beyond the solved diameters, solved t over the proxy's t is that at the end.

    Args:
        proxy: phase and |T| over the diameter.
        response: derivatives of ln t by the pillar-response errors.
        diameter_um: (*shape) diameters, um.
    """
    from scipy.interpolate import CubicSpline

    slopes = response.at(diameter_um)
    solved = response.solved if isinstance(response, Sensitivity) else None
    if solved is None:
        return RelativeResponse(slopes, None, np.ones(1))
    inside = np.clip(diameter_um, solved.diameter_um[0], solved.diameter_um[-1])
    series = CubicSpline(solved.diameter_um, solved.powers, axis=-1)(inside)
    slopes[np.flatnonzero(solved.powers[:, 1:].any((1, 2)))] = 0.0
    return RelativeResponse(
        slopes, series, designed_transmission(proxy, inside, solved.wavelength_um)
    )


def bias_ratio(
    response: Sensitivity | ResponseRates, d_um: Array, bias_um: Array | float
) -> Array | float:
    """t of pillars whose edges moved by a bias to sizes ``d_um``, over t of that
    design.

    exp(bias d ln t / d bias), the derivative taken half-way (second order). 1 for
    shapes that keep their form.

    Args:
        response: derivatives of ln t by the pillar-response errors.
        d_um: (*shape) sizes after the bias, um.
        bias_um: displacement of the diameter by moved edges, um.
    """
    rate = response.by_edges(d_um - bias_um / 2)
    return 1.0 if rate is None else np.exp(bias_um * rate)


def perturbed_transmission(
    proxy: Proxy,
    response: Sensitivity | ResponseRates,
    d_um: Array,
    wavelength_um: float,
    amounts: Array,
    *,
    bias_um: Array | float = 0.0,
    angle_rad: float = 0.0,
) -> Array:
    """Complex t of pillars under fabrication errors: t exp(sum_c a_c d ln t / dc).

    For causes with solved series, the series takes the place of the exponential. The
    unperturbed t is :func:`designed_transmission`.

    Args:
        proxy: phase and |T| over the diameter.
        response: derivatives of ln t by the pillar-response errors.
        d_um: (*shape) diameters, um.
        wavelength_um: vacuum wavelength, um.
        amounts: (pillar-response errors,) in base units, as
            :meth:`State.response_amounts` gives them.
        bias_um: part of the diameters that is a bias of all edges
            (:func:`bias_ratio`).
        angle_rad: angle of incidence in air, rad.
    """
    if isinstance(response, Sensitivity) and response.solved is None:
        factor = np.exp(response.change(amounts, d_um))
    else:
        factor = prepare_response(proxy, response, d_um).factor(amounts)
    factor = factor * bias_ratio(response, d_um, bias_um)
    return factor * designed_transmission(
        proxy, d_um, wavelength_um, angle_rad=angle_rad
    )
