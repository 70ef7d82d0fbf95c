"""The regressor of one hidden layer at its optimum: the gradient of squared errors plus
penalty is zero there.
"""

import numpy as np
import pytest

from codesign.gaze import regressor

RNG = np.random.default_rng(3)
X = RNG.uniform(-1, 1, (90, 3)) * [2.0, 0.3, 11.0] + [5.0, -1.0, 40.0]
Y = np.stack(
    [np.sin(X[:, 0]) + 0.1 * X[:, 2], X[:, 1] * X[:, 0]], 1
) + 0.05 * RNG.standard_normal((90, 2))


@pytest.mark.parametrize("penalty", [1e-3, 0.05])
def test_penalty_is_of_squared_weights_relative_to_the_squared_error_of_a_point(
    penalty,
):
    made = regressor.fit_regressor(X, Y, hidden=4, penalty=penalty, steps=20_000)
    x, y = (X - X.mean(0)) / X.std(0), (Y - Y.mean(0)) / Y.std(0)
    weights = np.concatenate([made.inside.ravel(), made.outside.ravel()])

    def loss(v):
        inside, outside = v[:16].reshape(4, 4), v[16:].reshape(5, 2)
        found = np.tanh(x @ inside[:-1] + inside[-1]) @ outside[:-1] + outside[-1]
        return ((found - y) ** 2).sum() + penalty * len(x) * (v**2).sum()

    steps = np.eye(len(weights)) * 1e-5
    slope = np.array([(loss(weights + s) - loss(weights - s)) / 2e-5 for s in steps])
    parts = 2 * penalty * len(x) * np.abs(weights)  # what the penalty alone pulls with
    assert np.abs(slope).max() < 1e-2 * parts.max()
    unit = (
        np.tanh(x @ made.inside[:-1] + made.inside[-1]) @ made.outside[:-1]
        + made.outside[-1]
    )
    assert made(X) == pytest.approx(unit * Y.std(0) + Y.mean(0))
