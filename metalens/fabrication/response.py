"""What the pillar-response errors do to every pillar: derivatives of ln t over the
diameter, and t itself under a change.
"""

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.polynomial import chebyshev, polynomial

from metalens.cell import Cell, Index
from metalens.core.arrays import Array
from metalens.core.errors import LensError
from metalens.fabrication.own import own_rates
from metalens.fabrication.perturbations import Guide, response_errors, with_missing
from metalens.fabrication.two_sizes import PairSensitivities
from metalens.lens import Lens
from metalens.library import Proxy

# steps in the wavelengths of a proxy, of which the last one gives the tangent at its
# end
_END = 64
# |T| that a tangent beyond a proxy falls to at most: what a solver has there is a
# multiple of it
_DARKEST = 1e-3
_NODES, _DEGREE = (
    9,
    5,
)  # sizes that own shapes are solved at, and of the polynomials through them


@dataclass(frozen=True, eq=False, slots=True)
class Solved:
    """Complex t at some diameters, as power series of single causes; cubic between the
    diameters.

    wavelength_um: that it was solved at. diameter_um: (n,) rising.
    powers: (causes, orders, n) of t in powers of the amount of each pillar-response
        error (um, rad, 1), in the table's order; the first is the designed t, the
        others are 0 for a cause that was not solved. Between the amounts that were
        solved a series misses resonances that move by: up to 0.03 of t near them.
    """

    wavelength_um: float
    diameter_um: Array
    powers: Array

    def series(self, diameter_um: Array) -> Array:
        """(causes, orders, *shape) at diameters between the ends."""
        from scipy.interpolate import CubicSpline

        return np.asarray(
            CubicSpline(self.diameter_um, self.powers, axis=-1)(diameter_um)
        )


@dataclass(frozen=True, eq=False, slots=True)
class Sensitivity:
    """First-order change of ln t with the pillar-response errors, as polynomials of the
    diameter.

    coefficients: (pillar-response errors, degree + 1) complex power series in (D -
        center_um) of d ln t by the base unit (um, rad, 1) of each; a row of zeros
        switches a cause off, and so does a row that is not there.
    error: of the slopes, relative to their change across the lens; nan where not known.
    low_um, high_um: diameters that the polynomials were made for; beyond them they go
        on along their tangents.
    solved: t itself under large changes, where a solver was asked; it stands for the
        proxy then.
    edges: (1, degree + 1) likewise of d ln t by a bias of all edges less that by the size,
        per um: a proxy knows pillars that keep their form as they grow, which a biased
        rectangle does not; None for those that do.
    pairs: of pillars of two sizes, in place of all polynomials; None of those of one.
    """

    coefficients: Array
    center_um: float
    error: float = math.nan
    low_um: float = -math.inf
    high_um: float = math.inf
    solved: Solved | None = None
    edges: Array | None = None
    pairs: PairSensitivities | None = None

    @classmethod
    def of_pairs(cls, pairs: PairSensitivities) -> "Sensitivity":
        """Of pillars of two sizes."""
        return cls(np.zeros((0, 1)), 0.0, pairs.error, pairs=pairs)

    def at(self, diameter_um: Array) -> Array:
        """(pillar-response errors, *shape) derivatives of ln t.

        Raises:
            LensError: of pillars of two sizes.
        """
        if self.pairs is not None:
            raise LensError(
                "pillars of two sizes: their derivatives are no function of one size"
            )
        return with_missing(self._series(self.coefficients, diameter_um))

    def by_edges(self, diameter_um: Array) -> Array | None:
        """(*shape) what a bias of all edges changes ln t by beyond the same change of
        the size; None for nothing.
        """
        return None if self.edges is None else self._series(self.edges, diameter_um)[0]

    def _series(self, coefficients: Array, diameter_um: Array) -> list[Array]:
        inside = np.clip(diameter_um, self.low_um, self.high_um)
        offset = inside - self.center_um
        beyond = np.asarray(diameter_um - inside)
        values = [polynomial.polyval(offset, row) for row in coefficients]
        if beyond.any():
            slopes = [
                polynomial.polyval(offset, polynomial.polyder(row))
                for row in coefficients
            ]
            values = [
                value + beyond * slope
                for value, slope in zip(values, slopes, strict=True)
            ]
        return values


@dataclass(frozen=True, eq=False, slots=True)
class Answer:
    """Pillars of given diameters under the pillar-response errors: t over that of the
    proxy at the design's wavelength.

    slopes: (causes, *shape) d ln t by the causes that act linearly. series: (causes,
        orders, *shape) of t in powers of the others, the designed t first; None where
        all are linear. proxy: (*shape) t of the proxy.
    """

    slopes: Array
    series: Array | None
    proxy: Array

    def factor(self, amounts: Array) -> Array:
        """(*shape) t under the change over the proxy's: prod_c t(a_c) / t(0) times
        exp(sum_c a_c s_c).
        """
        change = np.exp(np.tensordot(amounts, self.slopes, 1))
        if self.series is None:
            return np.asarray(change)
        change = change * self.series[0, 0] / self.proxy
        for amount, row in zip(amounts, self.series, strict=False):
            if amount:
                change = change * (polynomial.polyval(amount, row) / row[0])
        return np.asarray(change)

    def rates(self, amounts: Array) -> Array:
        """(causes, *shape) d ln t by every cause at the change."""
        out = self.slopes.astype(complex)
        if self.series is not None:
            for n, (amount, row) in enumerate(zip(amounts, self.series, strict=False)):
                if row[1:].any():
                    out[n] = polynomial.polyval(
                        amount, polynomial.polyder(row)
                    ) / polynomial.polyval(amount, row)
        return out


class Slopes(Protocol):
    """Anything that knows d ln t by the answering perturbations."""

    def at(self, diameter_um: Array) -> Array:
        """(pillar-response errors, *shape) derivatives of ln t by the base unit of
        each.
        """
        ...

    def by_edges(self, diameter_um: Array) -> Array | None:
        """(*shape) per um, beyond what the size says; None for nothing."""
        ...


def proxy_sensitivity(lens: Lens, *, degree: int = 5) -> Sensitivity:
    """Derivatives from the effective index of the pillars that the proxy's phase
    implies; of pillars that are not round on a square lattice those of their own shape,
    by exact derivatives of a solver (seconds a lens).

    Args:
        degree: of the polynomials over the diameter.

    Accuracy: of an effective index, 10 % of the slopes by height, 50 % of those by
        index; interference between foot and top is left out. The cell solvers say it
        better, at seconds a lens. For other shapes: ``error`` of the result.

    Raises:
        CellError, MaterialError, LensError: pillars that are not round and that the
            solver does not take.
    """
    if not lens.cell.round:
        return _of_its_own(lens)
    d = lens.diameters.diameter_um[lens.diameters.diameter_um > 0]
    low = max(float(d.min()), lens.proxy.domain_um[0])
    high = min(float(d.max()), lens.proxy.domain_um[1])
    seen = effective_indices(
        lens.cell,
        lens.proxy,
        lens.wavelength_um,
        np.linspace(low, high, 61),
        degree=degree,
    )
    center = float(seen.diameter_um.mean())
    rows = [
        polynomial.polyfit(seen.diameter_um - center, acts.quick(seen), degree)
        for _, acts in response_errors()
    ]
    return Sensitivity(np.array(rows), center, 0.5, low, high)


def _of_its_own(lens: Lens) -> Sensitivity:
    """From :func:`metalens.fabrication.own.own_rates` at Chebyshev sizes, as
    polynomials of degree 5.
    """
    low, high = lens.proxy.domain_um
    unit = np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)
    found = own_rates(lens, (low + high) / 2 + (high - low) / 2 * unit)
    rows = np.vstack([found.rates, found.edges])
    series = chebyshev.chebfit(unit, rows.T, _DEGREE)
    off = np.linalg.norm(chebyshev.chebval(unit, series) - rows, axis=1) / np.maximum(
        np.linalg.norm(rows, axis=1), 1e-9
    )
    known = np.abs(rows).max(1) > 1e-6 * np.abs(rows).max()
    scale = (2 / (high - low)) ** np.arange(_DEGREE + 1)
    made = (
        np.array(
            [
                np.pad(c, (0, _DEGREE + 1 - len(c)))
                for c in map(chebyshev.cheb2poly, series.T)
            ]
        )
        * scale
    )
    error = found.error + float((off * known).max())
    return Sensitivity(
        made[:-1],
        (low + high) / 2,
        error,
        low,
        high,
        None,
        made[-1:] if known[-1] else None,
    )


def effective_indices(
    cell: Cell,
    proxy: Proxy,
    wavelength_um: float,
    diameter_um: Array,
    *,
    degree: int = 5,
) -> Guide:
    """Effective indices of pillars: phase(D) = k n_eff(D) h, smoothed by a polynomial.

    Anchored at the thinnest pillar by the effective medium of thin cylinders across the
    field (Rayleigh 1892, two dimensions).

    Args:
        cell: unit cell with its materials, shape and lattice.
        proxy: phase and |T| over the diameter.
        wavelength_um: vacuum wavelength, um.
        diameter_um: (n,) diameters at which it is evaluated, um.
        degree: of the polynomials over the diameter.
    """
    from metalens.cell import materials

    index, outer = (
        m.n if isinstance(m, Index) else materials.index(m, wavelength_um).real
        for m in (cell.pillar, cell.fill)
    )
    k, h = 2 * math.pi / wavelength_um, cell.height_um
    fill = math.pi * diameter_um[0] ** 2 / 4 / cell.pitch_um**2
    inside, around = index**2, outer**2
    thin = (
        around
        * (inside * (1 + fill) + around * (1 - fill))
        / (inside * (1 - fill) + around * (1 + fill))
    )
    phase = proxy.phase_rad(diameter_um, wavelength_um)
    offset = diameter_um - diameter_um.mean()
    fit = np.polynomial.Polynomial.fit(
        offset, math.sqrt(thin) + (phase - phase[0]) / (k * h), degree
    )
    return Guide(
        k,
        diameter_um,
        fit(offset),
        fit.deriv()(offset),
        fit.deriv(2)(offset),
        index,
        outer,
        h,
        cell.sidewall_rad,
    )


def designed_transmission(
    proxy: Proxy, d_um: Array, wavelength_um: float, *, angle_rad: float = 0.0
) -> Array:
    """Complex t of pillars of diameter ``d_um`` (any shape) as the proxy has them, at
    an angle of incidence.

    Beyond the ends of the proxy's domain phase and |T| go on along their tangents (|T|
    held within 1e-3 to 1): by diameter, and by wavelength as far again as the proxy
    reaches, then held; of one wavelength they hold at all.

    Args:
        wavelength_um: vacuum wavelength, um.
        angle_rad: angle of incidence in air, rad.
    """
    low, high = proxy.wavelengths_um
    inside = min(max(wavelength_um, low), high)
    phase, level = _levels(proxy, d_um, low if high == low else inside, angle_rad)
    away = min(max(wavelength_um - inside, low - high), high - low)
    if away:
        step = math.copysign((high - low) / _END, away)
        before = _levels(proxy, d_um, inside - step, angle_rad)
        phase = phase + (phase - before[0]) * (away / step)
        level = level + (level - before[1]) * (away / step)
    return np.asarray(np.clip(level, _DARKEST, 1) * np.exp(1j * phase))


def _levels(
    proxy: Proxy, d_um: Array, wavelength_um: float, angle_rad: float
) -> tuple[Array, Array]:
    """Phase and |T| at a wavelength that the proxy knows, along their tangents beyond
    its diameters.
    """
    at = wavelength_um, angle_rad
    inside = np.clip(d_um, *proxy.domain_um)
    beyond = d_um - inside
    phase = proxy.phase_rad(inside, *at) + beyond * proxy.dphase_ddiameter(inside, *at)
    level = proxy.transmission(inside, *at) + beyond * proxy.dtransmission_ddiameter(
        inside, *at
    )
    return np.asarray(phase), np.asarray(level)


def prepare_response(proxy: Proxy, response: Slopes, diameter_um: Array) -> Answer:
    """What pillars of these diameters (any shape) do under any change of the process,
    made ready once for many.

    Beyond the diameters that a solver was asked for, its last word goes on with the
    proxy.

    Args:
        response: derivatives of ln t by the pillar-response errors.
        diameter_um: (*shape) diameters, um.
    """
    slopes = np.asarray(response.at(diameter_um))
    solved = response.solved if isinstance(response, Sensitivity) else None
    if solved is None:
        return Answer(slopes, None, np.ones(1))
    inside = np.clip(diameter_um, solved.diameter_um[0], solved.diameter_um[-1])
    series = solved.series(inside)
    slopes[np.flatnonzero(solved.powers[:, 1:].any((1, 2)))] = 0.0
    return Answer(
        slopes, series, designed_transmission(proxy, inside, solved.wavelength_um)
    )


def bias_ratio(response: Slopes, d_um: Array, bias_um: Array | float) -> Array | float:
    """t of pillars whose edges have moved by a bias to sizes ``d_um``, over that of
    pillars designed so.

    Of second order: the derivative is taken half-way. 1 for shapes that keep their
    form.

    Args:
        response: derivatives of ln t by the pillar-response errors.
        bias_um: displacement of the diameter by moved edges, um.
    """
    rate = response.by_edges(np.asarray(d_um - np.asarray(bias_um) / 2))
    return 1.0 if rate is None else np.exp(bias_um * rate)


def perturbed_transmission(
    proxy: Proxy,
    response: Slopes,
    d_um: Array,
    wavelength_um: float,
    answers: Array,
    *,
    bias_um: Array | float = 0.0,
    angle_rad: float = 0.0,
) -> Array:
    """:func:`designed_transmission` under a change of the process: t exp(sum_c a_c d ln t / dc), or
    as the solver has it.

    Args:
        answers: (pillar-response errors,) amounts in base units: :meth:`State.answers`.
            bias_um: what of the diameters is bias, of all edges equally, and no size of
            the design (:func:`bias_ratio`).
        proxy: phase and |T| over the diameter.
        d_um: (*shape) diameters, um.
        wavelength_um: vacuum wavelength, um.
        angle_rad: angle of incidence in air, rad.
    """
    changed = prepare_response(proxy, response, d_um).factor(answers) * bias_ratio(
        response, d_um, bias_um
    )
    return np.asarray(
        designed_transmission(proxy, d_um, wavelength_um, angle_rad=angle_rad) * changed
    )
