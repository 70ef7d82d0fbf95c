"""One-dimensional shape functions of the curl-conforming elements, and the rules that
integrate them.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

# s = t**10 makes s**0.7 and s**1.3, their slopes and their products polynomials of t
RIM_POWER = 10


@dataclass(frozen=True, eq=False, slots=True)
class IntervalBasis:
    """Functions of one element axis at quadrature points.

    point, weight: (n,) of the rule on [0, 1].
    value: (degree + 1, n) nodal functions and bubbles; slope: (degree, n) their
    derivatives, see the module.
    """

    point: np.ndarray
    weight: np.ndarray
    value: np.ndarray
    slope: np.ndarray

    @property
    def degree(self) -> int:
        """Highest degree of the polynomials."""
        return len(self.slope)


def gauss_rule(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Legendre quadrature: ``n`` points and weights on [0, 1]."""
    x, w = np.polynomial.legendre.leggauss(n)
    return (x + 1) / 2, w / 2


def graded_rule(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Quadrature of ``n`` points on [0, 1] for integrands that are polynomials of
    ``s**(1 / RIM_POWER)`` and vary smoothly in s.
    """
    t, w = gauss_rule(n)
    return t**RIM_POWER, w * RIM_POWER * t ** (RIM_POWER - 1)


def polynomial_basis(degree: int, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values (degree + 1, n) and slopes (degree, n) of the polynomial basis at points
    s.
    """
    legendre = np.polynomial.legendre.legvander(2 * s - 1, degree + 1).T
    norm = np.sqrt(2 * np.arange(degree) + 1)[:, None]
    value = np.empty((degree + 1, len(s)))
    value[0], value[1] = 1 - s, s
    value[2:] = (legendre[2 : degree + 1] - legendre[: degree - 1]) / (2 * norm[1:])
    return value, legendre[:degree] * norm


@lru_cache(maxsize=64)
def interval_basis(
    degree: int, points: int, exponents: tuple[float, ...] = (), at_end: bool = False
) -> IntervalBasis:
    """Integrated Legendre polynomials, and singular functions ``d**tau - d`` of the
    distance d to s = 0, or to s = 1 if ``at_end``.

    The slope of each singular function is orthonormal to the slopes before it,
    which keeps the matrices well conditioned.

    Args:
        degree: of the polynomials. points: of the rule, graded where functions are
            singular. exponents: tau of each singular function.
        at_end: where they are singular.
    """
    d, w = graded_rule(points) if exponents else gauss_rule(points)
    value, slope = polynomial_basis(degree, 1 - d if at_end else d)
    fine, fine_weight = graded_rule(80)
    fine_slope = polynomial_basis(degree, 1 - fine if at_end else fine)[1]
    side = -1.0 if at_end else 1.0
    for tau in exponents:
        bubble, rate = d**tau - d, side * (tau * d ** (tau - 1) - 1)
        fine_rate = side * (tau * fine ** (tau - 1) - 1)
        for _ in range(2):  # twice is enough (Kahan) for orthogonality to rounding
            overlap = (fine_slope[1:] * fine_weight) @ fine_rate
            bubble = bubble - overlap @ value[2:]
            rate = rate - overlap @ slope[1:]
            fine_rate = fine_rate - overlap @ fine_slope[1:]
        norm = np.sqrt(fine_weight @ fine_rate**2)
        value = np.vstack([value, bubble / norm])
        slope = np.vstack([slope, rate / norm])
        fine_slope = np.vstack([fine_slope, fine_rate / norm])
    return IntervalBasis(1 - d if at_end else d, w, value, slope)


@dataclass(frozen=True, eq=False, slots=True)
class SquareBasis:
    """Tensor products on the unit square, flattened: functions first, then quadrature
    points (xi slow, eta fast).

    along_xi, along_eta: covariant components of the vector functions; scalar: of the
    scalar ones.
    turn: the functions that span the curls. weight: of the points.
    curl: (turns, vectors), gradient: (vectors, scalars): exact relations between the
    coefficients.
    """

    weight: np.ndarray
    along_xi: np.ndarray
    along_eta: np.ndarray
    scalar: np.ndarray
    turn: np.ndarray
    curl: np.ndarray
    gradient: np.ndarray


def derivative_matrix(degree: int) -> np.ndarray:
    """(degree, degree + 1): derivative of values in terms of slopes."""
    d = np.zeros((degree, degree + 1))
    d[0, 0] = -1.0
    d[np.arange(degree), np.arange(1, degree + 1)] = 1.0
    return d


@lru_cache(maxsize=64)
def square_basis(xi: IntervalBasis, eta: IntervalBasis) -> SquareBasis:
    """Curl-conforming element basis, tensor products of interval bases ``xi`` and ``eta``; vector
    functions along xi come first.
    """

    def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        flat: np.ndarray = np.einsum("ia,jb->ijab", a, b).reshape(len(a) * len(b), -1)
        return flat

    px, py = xi.degree, eta.degree
    dx = derivative_matrix(px)
    dy = derivative_matrix(py)
    one_x = np.eye(px)
    one_y = np.eye(py)
    return SquareBasis(
        weight=np.outer(xi.weight, eta.weight).ravel(),
        along_xi=product(xi.slope, eta.value),
        along_eta=product(xi.value, eta.slope),
        scalar=product(xi.value, eta.value),
        turn=product(xi.slope, eta.slope),
        curl=np.hstack([-np.kron(one_x, dy), np.kron(dx, one_y)]),
        gradient=np.vstack([np.kron(dx, np.eye(py + 1)), np.kron(np.eye(px + 1), dy)]),
    )
