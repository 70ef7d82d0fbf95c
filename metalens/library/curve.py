"""Reduced order in the diameter: t(D) and r(D) of one wavelength and angle from a few
dozen exact solves.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg

from metalens.cell import Response
from metalens.core.arrays import Array
from metalens.core.errors import DomainError

Solver = Callable[[float], Response]
FIT_SHARE = 0.2  # residual of the rational fit, as a share of the tolerance
# least spacing of nodes: no lithography resolves 20 pm, and solvers place narrow poles
# no better
FINEST_UM = 2e-5


@dataclass(frozen=True, eq=False, slots=True)
class RationalFunction:
    """r(x) = sum_j w_j f_j / (x - z_j) over sum_j w_j / (x - z_j); all components share
    their poles.

    support: (m,) real points z.
    values: (m, components) f at the support.
    weights: (m,) complex.
    residual: largest deviation from the data of the fit.
    """

    support: Array
    values: Array
    weights: Array
    residual: float

    def __call__(self, x: Array) -> Array:
        """(*shape of x, components) values of r; those of the support where ``x`` meets
        a support point.
        """
        points = np.asarray(x, float).reshape(-1)
        distance = points[:, None] - self.support
        row, column = np.nonzero(distance == 0)
        distance[row] = 1.0
        cauchy = self.weights / distance
        cauchy[row] = 1.0  # replaced below; the weights themselves may add up to 0
        out = (cauchy @ self.values) / cauchy.sum(1)[:, None]
        out[row] = self.values[column]
        return np.asarray(out.reshape(*np.shape(x), self.values.shape[1]))

    def poles(self) -> Array:
        """Complex poles, (m - 1,) at most: the finite generalised eigenvalues of the
        arrowhead pencil [[0, w], [1, diag(z)]] against diag(0, 1, ..., 1).
        """
        m = len(self.support)
        if m < 2:
            return np.empty(0, complex)
        pencil = np.zeros((m + 1, m + 1), complex)
        pencil[0, 1:] = self.weights
        pencil[1:, 0] = 1
        pencil[1:, 1:] = np.diag(self.support)
        mass = np.eye(m + 1)
        mass[0, 0] = 0
        poles = scipy.linalg.eigvals(pencil, mass)
        return np.asarray(poles[np.isfinite(poles)])

    def poles_near(self, low: float, high: float, half_width: float) -> Array:
        """Poles over the interval from ``low`` to ``high`` whose imaginary part is less
        than ``half_width``.
        """
        z = self.poles()
        over_interval = (z.real > low) & (z.real < high)
        return np.asarray(z[over_interval & (np.abs(z.imag) < half_width)])


def fit_rational_aaa(
    x: Array, y: Array, *, tolerance: float, terms: int | None = None
) -> RationalFunction:
    """Rational function of least degree that meets the data within ``tolerance``, by
    the AAA algorithm.

    Nakatsukasa, Sète and Trefethen, "The AAA algorithm for rational approximation",
    SIAM J. Sci. Comput. 40, A1494 (2018): support points are taken where the fit is
    worst, weights from the last right singular vector of the Loewner matrix.

    Args:
        x: (n,) distinct real points.
        y: (n, components) values.
        tolerance: largest deviation that is accepted; below the noise of the data poles
            without meaning appear.
        terms: most support points; n // 2 + 1 without it, where all data can be met.
    """
    limit = min(terms or len(x), len(x) // 2 + 1)
    support = [int(np.argmax(np.abs(y - y.mean(0)).max(1)))]
    while True:
        weights, error = _weights(x, y, support)
        worst = int(np.argmax(error))
        if error[worst] <= tolerance or len(support) >= limit:
            return RationalFunction(
                x[support], y[support], weights, float(error[worst])
            )
        support.append(worst)


def _weights(x: Array, y: Array, support: list[int]) -> tuple[Array, Array]:
    """(weights, error): (m,) barycentric weights on the support, and the (n,) deviation
    at every data point, 0 on the support.

    Args:
        x: (n,) points.
        y: (n, components) values.
        support: indices of the m support points.
    """
    others = np.ones(len(x), bool)
    others[support] = False
    error = np.zeros(len(x))
    if not others.any():
        return np.ones(len(support), complex), error
    cauchy = 1 / (x[others, None] - x[support])
    loewner = (y[others, None, :] - y[support]) * cauchy[..., None]
    loewner = loewner.transpose(0, 2, 1).reshape(-1, len(support))
    underdetermined = loewner.shape[0] < loewner.shape[1]
    weights = np.linalg.svd(loewner, full_matrices=underdetermined)[2][-1].conj()
    denominator = cauchy @ weights
    with np.errstate(divide="ignore", invalid="ignore"):
        deviation = np.abs(
            (cauchy @ (weights[:, None] * y[support])) / denominator[:, None]
            - y[others]
        ).max(1)
    error[others] = np.where(np.isfinite(deviation), deviation, np.inf)
    return weights, error


@dataclass(frozen=True, eq=False, slots=True)
class SolvedNodes:
    """Exact solves of one curve, in the order in which they were computed.

    diameter_um: (n,) of the pillars.
    response: (n, 2) complex t and r.
    error: (n,) error estimate of the solver.
    converged: whether the last nodes were predicted within the tolerance.
    """

    diameter_um: Array
    response: Array
    error: Array
    converged: bool = True

    def to_json(self) -> list[Any]:
        """Rows of numbers from which :meth:`from_json` restores the nodes exactly."""
        columns = self.diameter_um, self.response.view(float), self.error
        return [np.column_stack(columns).tolist(), self.converged]

    @classmethod
    def from_json(cls, row: list[Any]) -> "SolvedNodes":
        """Inverse of :meth:`to_json`.

        Raises:
            ValueError: rows that are not six numbers.
        """
        rows, converged = row
        diameter, *parts, error = np.array(rows, float).reshape(-1, 6).T
        return cls(diameter, np.stack(parts, 1).view(complex), error, converged)

    @classmethod
    def of(
        cls,
        diameter_um: Sequence[float],
        responses: list[Response],
        converged: bool = True,
    ) -> "SolvedNodes":
        """Nodes from the responses at diameters, um.

        Args:
            diameter_um, responses: as they were solved.
            converged: see the class.
        """
        pairs = np.array([(response.t, response.r) for response in responses])
        error = np.array([response.t_error for response in responses])
        return cls(np.array(diameter_um), pairs, error, converged)


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
        """(..., 2) t and r at diameters in um, and (...) error estimate of t, not below
        the true error.

        The estimate adds the largest disagreement with a rival fit, the residual of the
        fit, a tenth of the tolerance, and the solver's error. The last is mostly a
        small shift of the diameter: it is carried from the neighbouring nodes in
        proportion to the slope of t. The estimate is capped at 1 + max(1, |t|), as a
        pillar is passive. At a node it is the solver's own.

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
        node_error = self.nodes.error[order]
        shift = node_error / self._steepness(x)
        value = self.best(d)
        larger_shift = np.maximum(shift[right - 1], shift[right])
        error = self._doubt(d) + larger_shift * self._steepness(d)
        for side in (right - 1, right):
            at_node = x[side] == d
            value[at_node] = self.nodes.response[order[side[at_node]]]
            error[at_node] = node_error[side[at_node]]
        return value, np.minimum(error, 1 + np.maximum(1.0, np.abs(value[..., 0])))

    def solver_error(self, diameter_um: Array) -> Array:
        """(...) error of the solver at the better of the two nodes around each
        diameter.
        """
        order, right = self._around(diameter_um)
        error = self.nodes.error[order]
        return np.asarray(np.minimum(error[right - 1], error[right]))

    def _around(self, diameter_um: Array) -> tuple[Array, Array]:
        """(order, right): the order of the nodes by diameter, and the place in that
        order of the node above each diameter.
        """
        order = np.argsort(self.nodes.diameter_um)
        right = np.searchsorted(self.nodes.diameter_um[order], diameter_um)
        return order, np.clip(right, 1, len(order) - 1)

    def _doubt(self, d: Array) -> Array:
        """(...) largest disagreement of t with a rival fit, plus the residual and a
        tenth of the tolerance.
        """
        value = self.best(d)
        doubt = np.max(
            [np.abs(rival(d) - value)[..., 0] for rival in self.rivals], axis=0
        )
        floor = 0.1 * self.tolerance  # for errors that all fits share
        return np.asarray(doubt + self.best.residual + floor)

    def _steepness(self, d: Array) -> Array:
        """|dt/dD| plus the slope 2 / (largest - least diameter) of a curve without
        features, 1/um.
        """
        low = self.nodes.diameter_um.min()
        high = self.nodes.diameter_um.max()
        step = FINEST_UM / 100
        rise = np.abs(self.best(d + step)[..., 0] - self.best(d - step)[..., 0]) / (
            2 * step
        )
        return np.asarray(rise + 2 / (high - low))

    def resonances(self, half_width_um: float = 0.02) -> Array:
        """(k, 2) diameter and half-width of the poles of t(D) with |imaginary part|
        below ``half_width_um``, um.

        Poles that a rival fit does not share (within a fifth of their width) are noise
        and are left out.
        """
        low = self.nodes.diameter_um.min()
        high = self.nodes.diameter_um.max()
        poles = self.best.poles_near(low, high, half_width_um)
        for rival in self.rivals:
            others = rival.poles()
            if len(poles) and len(others):
                distance = np.abs(poles[:, None] - others).min(1)
                poles = poles[distance < 0.2 * np.abs(poles.imag) + 1e-9]
        poles = poles[np.argsort(poles.real)]
        return np.column_stack([poles.real, np.abs(poles.imag)])


def starting_diameters(low_um: float, high_um: float, count: int = 13) -> list[float]:
    """(count,) Chebyshev points with both ends, um: the diameters that
    :func:`sample_adaptively` solves first.

    Args:
        low_um: least size, um.
        high_um: largest size, um.
        count: of the points.
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
    most: int = 80,
    calm: int = 2,
) -> SolvedNodes:
    """Solve diameters one by one, each where rational fits disagree most, until the fit
    predicts new solves within the tolerance.

    Stops after ``calm`` consecutive predicted solves, or after ``most``.

    Args:
        solve: exact response at a diameter, on one discretisation (jumps look like
            resonances).
        low_um: least size, um.
        high_um: largest size, um.
        tolerance: deviation at which predictions are accepted.
        most: solves at most; where they do not suffice ``converged`` is False.
        calm: predicted solves in a row: one may agree by chance.
    """
    x = starting_diameters(low_um, high_um)
    responses = [solve(v) for v in x]
    earlier_fits: list[RationalFunction] = []
    predicted = 0
    while predicted < calm and len(x) < most:
        nodes = SolvedNodes.of(x, responses)
        fit, simpler = _fits(nodes.diameter_um, nodes.response, tolerance)
        place, doubt = _most_doubtful(fit, [simpler, *earlier_fits[-2:]], nodes)
        meets_data = simpler.residual <= FIT_SHARE * tolerance
        has_spare_pole = len(fit.support) > len(simpler.support)
        agreed = meets_data and has_spare_pole and doubt < tolerance / 2
        if agreed and predicted == 0:
            ordered = np.sort(x)
            widest = int(np.argmax(np.diff(ordered)))
            place = float(ordered[widest] + ordered[widest + 1]) / 2
        response = solve(place)
        error = np.abs(fit(np.array([place]))[0] - (response.t, response.r)).max()
        x.append(place)
        responses.append(response)
        earlier_fits.append(fit)
        predicted = predicted + 1 if agreed and error < tolerance else 0
    return SolvedNodes.of(x, responses, converged=predicted == calm)


def fit_response_curve(nodes: SolvedNodes, *, tolerance: float) -> ResponseCurve:
    """Rational curve through exact solves, and three rival fits for its error estimate:
    one of least degree, two without the last nodes.

    Args:
        nodes: the exact solves.
        tolerance: that the nodes were chosen for.
    """
    x, y = nodes.diameter_um, nodes.response
    best, simpler = _fits(x, y, tolerance)
    shorter = tuple(
        fit_rational_aaa(x[:-k], y[:-k], tolerance=FIT_SHARE * tolerance)
        for k in (1, 2)
    )
    return ResponseCurve(nodes, best, (simpler, *shorter), tolerance)


def _fits(
    x: Array, y: Array, tolerance: float
) -> tuple[RationalFunction, RationalFunction]:
    """(best, simpler) rational fits: simpler is that of least degree which meets the
    data, best has one pole more.
    """
    simpler = fit_rational_aaa(x, y, tolerance=FIT_SHARE * tolerance)
    terms = len(simpler.support) + 1
    return fit_rational_aaa(x, y, tolerance=0.0, terms=terms), simpler


def _most_doubtful(
    fit: RationalFunction, rivals: list[RationalFunction], nodes: SolvedNodes
) -> tuple[float, float]:
    """(diameter in um, disagreement): the best next diameter, and the largest
    disagreement of t between the fits.

    Candidates are 1201 even diameters, and points around the poles of the fit on the
    scale of their width. Those too close to a node are left out.

    Args:
        fit: the present fit.
        rivals: fits that it is compared with.
        nodes: that are solved.
    """
    x = nodes.diameter_um
    low, high = x.min(), x.max()
    poles = fit.poles_near(low, high, 0.1 * (high - low))
    offsets = [poles.real + side * np.abs(poles.imag) for side in (-3, -1, 0, 1, 3)]
    even = np.linspace(low, high, 1201)
    near_poles = np.concatenate(offsets)
    even = even[_distance(even, x) > (high - low) / (5 * len(x))]
    near_poles = near_poles[
        (near_poles > low)
        & (near_poles < high)
        & (_distance(near_poles, x) > FINEST_UM)
    ]
    candidates = np.concatenate([even, near_poles])
    value = fit(candidates)[:, 0]
    doubt = np.max(
        [np.abs(rival(candidates)[:, 0] - value) for rival in rivals], axis=0
    )
    worst = int(np.argmax(doubt))
    return float(candidates[worst]), float(doubt[worst])


def _distance(places: Array, x: Array) -> Array:
    """(n,) distance of each place from the closest node."""
    return np.asarray(np.abs(places[:, None] - x).min(axis=1, initial=np.inf))
