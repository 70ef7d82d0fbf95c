"""Reduced order in the diameter: t(D) and r(D) of one wavelength and angle from a few
dozen exact solves.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from metalens.cell import Response
from metalens.core.arrays import Array
from metalens.core.errors import DomainError
from metalens.library import rational
from metalens.library.rational import RationalFunction

Solver = Callable[[float], Response]
FIT_SHARE = 0.2  # of the tolerance: residual of the rational fit
CALM = 2  # new nodes in a row that the fit must predict within the tolerance
FIRST = 13  # Chebyshev points that a search begins with
# no two nodes are closer: no lithography resolves 20 pm, and solvers place sharp poles
# no better
FINEST_UM = 2e-5


@dataclass(frozen=True, eq=False, slots=True)
class SolvedNodes:
    """Exact solves of one curve, in the order they were made.

    diameter_um: (n,). response: (n, 2) t and r. error: (n,) of the solver.
    converged: whether the last nodes were predicted within the tolerance; reason: why
        the search stopped.
    """

    diameter_um: Array
    response: Array
    error: Array
    converged: bool = True
    reason: str = ""

    def to_json(self) -> list[Any]:
        """Lists of numbers, whose text gives the same numbers back."""
        columns = self.diameter_um, self.response.view(float), self.error
        return [*(one.tolist() for one in columns), self.converged, self.reason]

    @classmethod
    def from_json(cls, row: list[Any]) -> "SolvedNodes":
        """Inverse of :meth:`to_json`.

        Raises:
            ValueError: columns of different lengths.
        """
        diameters, parts, errors, converged, reason = row
        if not len(diameters) == len(parts) == len(errors):
            raise ValueError("columns of different lengths")
        response = np.array(parts).view(complex)
        return cls(np.array(diameters), response, np.array(errors), converged, reason)


@dataclass(frozen=True, eq=False, slots=True)
class ResponseCurve:
    """t(D) and r(D) between the nodes, with an error estimate.

    nodes: the exact solves.
    best: the rational fit of all nodes; rivals: fits of fewer nodes or fewer poles.
    tolerance: that the nodes were chosen for.
    """

    nodes: SolvedNodes
    best: RationalFunction
    rivals: tuple[RationalFunction, ...]
    tolerance: float

    def __call__(self, diameter_um: Array) -> tuple[Array, Array]:
        """(..., 2) t and r, and (...) error estimate of t, not below the true error.

        The estimate adds the largest disagreement with a rival fit, the residual of the
        fit, a tenth of the tolerance, and the solver's error: mostly a small shift of
        the diameter, it is carried from the neighbouring nodes in proportion to the
        slope of t, no farther than any passive pillar can be. At a node the estimate is
        the solver's own.

        Raises:
            DomainError: outside the nodes.
        """
        d = np.asarray(diameter_um, float)
        order, right = self._around(d)
        x = self.nodes.diameter_um[order]
        if d.size and not (d.min() >= x[0] - 1e-12 and d.max() <= x[-1] + 1e-12):
            raise DomainError(
                f"diameters {d.min():.6g} to {d.max():.6g} um, the curve holds {x[0]:.6g} to {x[-1]:.6g}"
            )
        solver = self.nodes.error[order]
        shift = solver / self._steepness(x)
        value = self.best(d)
        error = self._doubt(d) + np.maximum(
            shift[right - 1], shift[right]
        ) * self._steepness(d)
        for side in (right - 1, right):
            hit = x[side] == d
            value[hit], error[hit] = (
                self.nodes.response[order[side[hit]]],
                solver[side[hit]],
            )
        return value, np.minimum(error, 1 + np.maximum(1.0, np.abs(value[..., 0])))

    def solver_error(self, diameter_um: Array) -> Array:
        """(...) of the solver at the better of the two nodes around."""
        order, right = self._around(diameter_um)
        error = self.nodes.error[order]
        return np.asarray(np.minimum(error[right - 1], error[right]))

    def _around(self, diameter_um: Array) -> tuple[Array, Array]:
        """The nodes from thin to thick, and the place among them of the thicker of the
        two around each diameter.
        """
        order = np.argsort(self.nodes.diameter_um)
        right = np.searchsorted(self.nodes.diameter_um[order], diameter_um)
        return order, np.clip(right, 1, len(order) - 1)

    def _doubt(self, d: Array) -> Array:
        value = self.best(d)
        doubt = np.max(
            [np.abs(rival(d) - value)[..., 0] for rival in self.rivals], axis=0
        )
        floor = 0.1 * self.tolerance  # for what no rival shows
        return np.asarray(doubt + self.best.residual + floor)

    def _steepness(self, d: Array) -> Array:
        """|dt/dD| and what a curve without features would have, 1/um."""
        low = self.nodes.diameter_um.min()
        high = self.nodes.diameter_um.max()
        step = FINEST_UM / 100
        rise = np.abs(self.best(d + step)[..., 0] - self.best(d - step)[..., 0]) / (
            2 * step
        )
        return np.asarray(rise + 2 / (high - low))

    def resonances(self, half_width_um: float = 0.02) -> Array:
        """(k, 2) diameter and half-width of the poles nearer to the real axis than
        ``half_width_um``, um.

        Poles that a rival fit does not share (within a fifth of their width) carry no
        meaning and are left out.
        """
        low = self.nodes.diameter_um.min()
        high = self.nodes.diameter_um.max()
        poles = self.best.poles()
        poles = poles[
            (poles.real > low)
            & (poles.real < high)
            & (np.abs(poles.imag) < half_width_um)
        ]
        for rival in self.rivals:
            others = rival.poles()
            if len(poles) and len(others):
                distance = np.abs(poles[:, None] - others).min(1)
                poles = poles[distance < 0.2 * np.abs(poles.imag) + 1e-9]
        poles = poles[np.argsort(poles.real)]
        return np.column_stack([poles.real, np.abs(poles.imag)])


def starting_diameters(
    low_um: float, high_um: float, count: int = FIRST
) -> list[float]:
    """Diameters that :func:`sample_adaptively` solves first: Chebyshev points with both
    ends.

    Args:
        low_um: least size, um.
        high_um: largest size, um.
        count: of points.
    """
    middle, half = (low_um + high_um) / 2, (high_um - low_um) / 2
    start = middle - half * np.cos(np.pi * np.arange(count) / (count - 1))
    start[[0, -1]] = low_um, high_um
    return [float(v) for v in start]


def sample_adaptively(
    solve: Solver,
    low_um: float,
    high_um: float,
    *,
    tolerance: float,
    first: int = FIRST,
    most: int = 80,
    cheaper_um: Array | None = None,
) -> SolvedNodes:
    """Choose diameters one by one and solve them, until the rational fit predicts what
    comes.

    Args:
        solve: exact response at a diameter, on one discretisation (jumps look like
            resonances).
        first: Chebyshev points to begin with.
        most: solves at most; where they do not suffice ``converged`` is False.
        cheaper_um: (any,) diameters that cost less, taken where they tell half as much
            as the best, or more.
        low_um: least size, um.
        high_um: largest size, um.
        tolerance: deviation at which predictions are accepted.
    """
    cheaper = np.array([] if cheaper_um is None else cheaper_um, float)
    cheaper = cheaper[(cheaper > low_um) & (cheaper < high_um)]
    x = starting_diameters(low_um, high_um, first)
    made = [solve(v) for v in x]
    past: list[RationalFunction] = []
    calm = 0
    while calm < CALM and len(x) < most:
        fit, simpler = _fits(np.array(x), _responses(made), tolerance)
        where, doubt = _suspect(fit, [simpler, *past[-2:]], np.array(x), cheaper)
        enough = simpler.residual <= FIT_SHARE * tolerance and len(fit.support) > len(
            simpler.support
        )
        still = enough and doubt < tolerance / 2
        where = _widest_gap(x, cheaper) if still and calm == 0 else where
        response = solve(where)
        missed = np.abs(fit(np.array([where]))[0] - (response.t, response.r)).max()
        x.append(where)
        made.append(response)
        past.append(fit)
        calm = calm + 1 if still and missed < tolerance else 0
    reason = (
        f"the last {CALM} of {len(x)} solves were predicted within {tolerance:g}"
        if calm == CALM
        else f"{most} solves do not meet {tolerance:g}"
    )
    errors = np.array([m.t_error for m in made])
    return SolvedNodes(np.array(x), _responses(made), errors, calm == CALM, reason)


def fit_response_curve(nodes: SolvedNodes, *, tolerance: float) -> ResponseCurve:
    """The rational curve through exact solves, and the rivals that judge it.

    Args:
        nodes: the exact solves.
        tolerance: that the nodes were chosen for.
    """
    x, y = nodes.diameter_um, nodes.response
    best, simpler = _fits(x, y, tolerance)
    shorter = tuple(
        rational.fit_rational_aaa(x[:-k], y[:-k], tolerance=FIT_SHARE * tolerance)
        for k in (1, 2)
    )
    return ResponseCurve(nodes, best, (simpler, *shorter), tolerance)


def _fits(
    x: Array, y: Array, tolerance: float
) -> tuple[RationalFunction, RationalFunction]:
    """A fit with a pole more than the data ask for, and the fit of least degree that
    meets them.
    """
    simpler = rational.fit_rational_aaa(x, y, tolerance=FIT_SHARE * tolerance)
    best = rational.fit_rational_aaa(
        x, y, tolerance=0.0, terms=len(simpler.support) + 1, start=simpler.support
    )
    return best, simpler


def _suspect(
    fit: RationalFunction, rivals: list[RationalFunction], x: Array, cheaper: Array
) -> tuple[float, float]:
    """Where the fits disagree most, or nearly so at a cheaper place, and by how much at
    most; narrow resonances are looked at on their own scale.
    """
    low, high = x.min(), x.max()
    poles = fit.poles()
    poles = poles[
        (poles.real > low)
        & (poles.real < high)
        & (np.abs(poles.imag) < 0.1 * (high - low))
    ]
    around = [poles.real + side * np.abs(poles.imag) for side in (-3, -1, 0, 1, 3)]
    even = np.concatenate([np.linspace(low, high, 1201), cheaper])
    near = np.concatenate(around)
    even = even[_distance(even, x) > (high - low) / (5 * len(x))]
    near = near[(near > low) & (near < high) & (_distance(near, x) > FINEST_UM)]
    places = np.concatenate([even, near])
    value = fit(places)[:, 0]
    doubt = np.max([np.abs(rival(places)[:, 0] - value) for rival in rivals], axis=0)
    worst = int(np.argmax(doubt))
    cheap = np.flatnonzero(np.isin(places, cheaper) & (doubt >= doubt[worst] / 2))
    chosen = cheap[np.argmax(doubt[cheap])] if len(cheap) else worst
    return float(places[chosen]), float(doubt[worst])


def _distance(places: Array, x: Array) -> Array:
    return np.asarray(np.abs(places[:, None] - x).min(axis=1, initial=np.inf))


def _widest_gap(x: list[float], cheaper: Array) -> float:
    """The middle of the widest gap, or the cheaper place nearest to it in the middle
    half.
    """
    ordered = np.sort(x)
    widest = int(np.argmax(np.diff(ordered)))
    middle = (ordered[widest] + ordered[widest + 1]) / 2
    quarter = (ordered[widest + 1] - ordered[widest]) / 4
    away = np.abs(cheaper - middle)
    return float(
        cheaper[np.argmin(away)] if away.min(initial=np.inf) < quarter else middle
    )


def _responses(made: list[Response]) -> Array:
    return np.array([(m.t, m.r) for m in made])
