"""The regressor of one hidden layer: its slopes by differences, its scales, and what it
starts from.
"""

import numpy as np
import pytest

from codesign.gaze import regressor
from codesign.gaze.regressor import ResidualRegressor
from metalens.core.errors import TrainingError

RNG = np.random.default_rng(8)


def test_an_answer_is_tanh_of_standardised_features_brought_back_to_targets():
    """One feature of mean 3 and spread 2, two neurons, two targets, by hand."""
    inside = np.array([[0.5, -1.0], [0.2, 0.3]])
    outside = np.array([[2.0, -0.4], [1.5, 0.7], [-0.1, 0.6]])
    made = ResidualRegressor(
        inside, outside, np.array([[3.0], [2.0]]), np.array([[10.0, -20.0], [4.0, 0.5]])
    )
    one, other = np.tanh(0.5 * 1.5 + 0.2), np.tanh(-1.5 + 0.3)
    want = [
        10 + 4 * (2 * one + 1.5 * other - 0.1),
        -20 + 0.5 * (-0.4 * one + 0.7 * other + 0.6),
    ]
    assert made(np.array([[6.0]]))[0] == pytest.approx(want, rel=1e-12)


def test_exact_slopes_are_those_of_differences():
    inside, outside = RNG.normal(size=(4, 5)), RNG.normal(size=(6, 2))
    x, step = RNG.normal(size=(7, 3)), 1e-6
    got = regressor._jacobian(inside, outside, x)
    assert got.shape == (14, 32)

    def at(v):
        return regressor._forward(v[:20].reshape(4, 5), v[20:].reshape(6, 2), x).ravel()

    v = np.concatenate([inside.ravel(), outside.ravel()])
    want = np.stack(
        [(at(v + e) - at(v - e)) / (2 * step) for e in np.eye(32) * step], 1
    )
    assert got == pytest.approx(want, abs=1e-8)  # step^2, and rounding over the step


def test_a_steady_feature_and_a_steady_target_keep_their_value():
    """A spread of 0 is taken as 1e-9: what never moved divides nothing by zero."""
    x = np.stack([np.linspace(-1, 2, 9), np.full(9, 7.0)], 1)
    y = np.stack([0.3 * x[:, 0] - 0.8, np.full(9, -3.0)], 1)
    made = regressor.fit_regressor(x, y, hidden=3, penalty=1e-6)
    assert made.features[1, 1] == made.targets[1, 1] == 1e-9
    assert made.features[0] == pytest.approx([0.5, 7.0])
    assert made.targets[0] == pytest.approx([-0.65, -3.0])
    assert made.features[1, 0] == pytest.approx(x[:, 0].std())
    assert made(x)[:, 1] == pytest.approx([-3.0] * 9, abs=1e-8)
    assert made(x)[:, 0] == pytest.approx(
        y[:, 0], abs=0.01
    )  # tanh of a straight line under a penalty of 1e-6


def loss(made, x, y, penalty):
    unit = (
        np.tanh(x @ made.inside[:-1] + made.inside[-1]) @ made.outside[:-1]
        + made.outside[-1]
    )
    return ((unit - y) ** 2).sum() + penalty * len(x) * (
        (made.inside**2).sum() + (made.outside**2).sum()
    )


def test_the_search_starts_from_small_weights_of_its_seed_and_an_answer_of_nothing():
    """With one evaluation the start is what is kept: normal numbers times 0.3, outer
    weights 0.
    """
    x, y = RNG.normal(size=(20, 3)), RNG.normal(size=(20, 2))
    for about, seed, hidden in (({}, 0, 10), ({"seed": 6, "hidden": 4}, 6, 4)):
        made = regressor.fit_regressor(x, y, steps=1, **about)
        want = 0.3 * np.random.default_rng(seed).standard_normal((4, hidden))
        assert made.inside == pytest.approx(want, rel=1e-12)
        assert not made.outside.any()
        assert made.outside.shape == (hidden + 1, 2)
        assert made(x) == pytest.approx(np.tile(y.mean(0), (20, 1)))


@pytest.mark.parametrize("penalty", [0.02, None])
def test_at_the_end_no_way_leads_down(penalty):
    """Squared errors of standardised points plus the penalty of a point times the
    squared weights: 30 ways of 1e-3.
    """
    x = RNG.normal(size=(25, 2)) * [3.0, 0.2] + [5.0, -1.0]
    y = np.stack([np.sin(x[:, 0]), x[:, 1] * x[:, 0], x[:, 1]], 1) + 0.1 * RNG.normal(
        size=(25, 3)
    )
    made = regressor.fit_regressor(
        x, y, hidden=2, steps=5_000, **({} if penalty is None else {"penalty": penalty})
    )
    units = [(a - a.mean(0)) / a.std(0) for a in (x, y)]
    price = 3e-4 if penalty is None else penalty
    least = loss(made, *units, price)
    for _ in range(30):
        moved = ResidualRegressor(
            made.inside + 1e-3 * RNG.normal(size=made.inside.shape),
            made.outside + 1e-3 * RNG.normal(size=made.outside.shape), made.features, made.targets,
        )  # fmt: skip
        assert loss(moved, *units, price) > least


def test_three_points_are_enough_and_two_are_not():
    x, y = np.array([[0.1], [0.5], [1.2]]), np.array([[1.0], [2.0], [2.5]])
    assert regressor.fit_regressor(x, y, hidden=2)(x).shape == (3, 1)
    with pytest.raises(
        TrainingError, match="a regressor from 2 points, need 3 or more"
    ):
        regressor.fit_regressor(x[:2], y[:2])
