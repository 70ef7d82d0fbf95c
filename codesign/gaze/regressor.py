"""The gaze regressor of the paper's experiment: one hidden layer of ten neurons, fitted
to one person's points.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from metalens.core.arrays import Array


@dataclass(frozen=True, eq=False, slots=True)
class ResidualRegressor:
    """tanh layer and linear layer on standardised features and targets.

    inside: (features + 1, hidden). outside: (hidden + 1, targets). features, targets:
    (2, count) mean and spread.
    """

    inside: Array
    outside: Array
    features: Array
    targets: Array

    def __call__(self, features: Array) -> Array:
        """(n, targets) for (n, features)."""
        unit = (features - self.features[0]) / self.features[1]
        return np.asarray(
            _forward(self.inside, self.outside, unit) * self.targets[1]
            + self.targets[0]
        )


def fit_regressor(
    features: Array,
    targets: Array,
    *,
    hidden: int = 10,
    penalty: float = 3e-4,
    seed: int = 0,
    steps: int = 200,
) -> ResidualRegressor:
    """Fit a one-hidden-layer tanh network by penalised least squares.

    Minimises |outputs - targets|² + penalty n |weights|² on standardised data, by
    Levenberg-Marquardt with the exact Jacobian.

    Args:
        features: (n, f). targets: (n, t).
        hidden: neurons of the hidden layer.
        penalty: of the squared weights, relative to the squared error of a point.
        seed: of the initial weights. steps: evaluations at most.
    """
    scales = [
        np.stack([a.mean(0), np.maximum(a.std(0), 1e-9)]) for a in (features, targets)
    ]
    x, y = ((a - s[0]) / s[1] for a, s in zip((features, targets), scales, strict=True))
    f = x.shape[1]
    t = y.shape[1]
    rng = np.random.default_rng(seed)
    start = np.concatenate(
        [
            (rng.standard_normal((f + 1, hidden)) * 0.3).ravel(),
            np.zeros((hidden + 1) * t),
        ]
    )
    weight = np.sqrt(penalty * len(x)) * np.ones(len(start))

    def weights_of(v: Array) -> tuple[Array, Array]:
        inside, outside = np.split(v, [(f + 1) * hidden])
        return inside.reshape(f + 1, hidden), outside.reshape(hidden + 1, t)

    def residual(v: Array) -> Array:
        return np.concatenate([(_forward(*weights_of(v), x) - y).ravel(), weight * v])

    def jacobian(v: Array) -> Array:
        inside, outside = weights_of(v)
        return np.concatenate([_jacobian(inside, outside, x), np.diag(weight)])

    fit = least_squares(residual, start, jacobian, method="lm", max_nfev=steps)
    return ResidualRegressor(*weights_of(fit.x), *scales)


def _forward(inside: Array, outside: Array, x: Array) -> Array:
    """(n, targets) outputs tanh(x A + a) B + b; the last rows of the weights are a
    and b.
    """
    return np.asarray(
        np.tanh(x @ inside[:-1] + inside[-1]) @ outside[:-1] + outside[-1]
    )


def _jacobian(inside: Array, outside: Array, x: Array) -> Array:
    """(n t, parameters) derivatives of the outputs by the weights of both layers."""
    n, t = len(x), outside.shape[1]
    activation = np.tanh(x @ inside[:-1] + inside[-1])
    slope = (1 - activation**2)[:, None, :] * outside[:-1].T  # (n, t, hidden)
    inputs = np.concatenate([x, np.ones((n, 1))], 1)
    by_inside = np.einsum("nf,nth->ntfh", inputs, slope).reshape(n * t, -1)
    hidden = np.concatenate([activation, np.ones((n, 1))], 1)
    by_outside = np.einsum("nh,tu->nthu", hidden, np.eye(t)).reshape(n * t, -1)
    return np.concatenate([by_inside, by_outside], 1)
