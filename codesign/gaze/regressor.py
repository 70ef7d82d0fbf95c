"""The gaze regressor of the paper's experiment: one hidden layer of ten neurons, fitted
to one person's points.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from metalens.core.arrays import Array
from metalens.core.errors import TrainingError


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
    """Least squares with a penalty on the weights, by Levenberg-Marquardt with exact
    derivatives.

    Args:
        features: (n, f). targets: (n, t). penalty: of the squared weights, relative to
            the squared error of a point.
        steps: evaluations that the search may take.
        hidden: neurons of the hidden layer. seed: of the random generator.

    Raises:
        TrainingError: fewer than 3 points.
    """
    if len(features) < 3:
        raise TrainingError(f"a regressor from {len(features)} points, need 3 or more")
    scales = [
        np.stack([a.mean(0), np.maximum(a.std(0), 1e-9)]) for a in (features, targets)
    ]
    x, y = ((a - s[0]) / s[1] for a, s in zip((features, targets), scales, strict=True))
    f, t = x.shape[1], y.shape[1]
    rng = np.random.default_rng(seed)
    start = np.concatenate(
        [
            (rng.standard_normal((f + 1, hidden)) * 0.3).ravel(),
            np.zeros((hidden + 1) * t),
        ]
    )
    weight = np.sqrt(penalty * len(x)) * np.ones(len(start))

    def parts(v: Array) -> tuple[Array, Array]:
        return v[: (f + 1) * hidden].reshape(f + 1, hidden), v[
            (f + 1) * hidden :
        ].reshape(hidden + 1, t)

    def residual(v: Array) -> Array:
        return np.concatenate([(_forward(*parts(v), x) - y).ravel(), weight * v])

    def slope(v: Array) -> Array:
        inside, outside = parts(v)
        return np.concatenate([_jacobian(inside, outside, x), np.diag(weight)])

    found = least_squares(residual, start, slope, method="lm", max_nfev=steps)
    return ResidualRegressor(*parts(found.x), *scales)


def _forward(inside: Array, outside: Array, x: Array) -> Array:
    return np.asarray(
        np.tanh(x @ inside[:-1] + inside[-1]) @ outside[:-1] + outside[-1]
    )


def _jacobian(inside: Array, outside: Array, x: Array) -> Array:
    """(n t, parameters) derivatives of the outputs."""
    n, t = len(x), outside.shape[1]
    level = np.tanh(x @ inside[:-1] + inside[-1])
    rise = (1 - level**2)[:, None, :] * outside[:-1].T  # (n, t, hidden)
    wide = np.concatenate([x, np.ones((n, 1))], 1)
    by_inside = np.einsum("nf,nth->ntfh", wide, rise).reshape(n * t, -1)
    tall = np.concatenate([level, np.ones((n, 1))], 1)
    by_outside = np.einsum("nh,tu->nthu", tall, np.eye(t)).reshape(n * t, -1)
    return np.concatenate([by_inside, by_outside], 1)
