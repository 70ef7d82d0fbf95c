"""Rational interpolation in barycentric form: adaptive choice of support points (AAA),
values and poles.
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from metalens.core.arrays import Array


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
