"""Steps of the turned directions by closed forms: one gradient, many like it, layers at
the limits of size.
"""

import math

import numpy as np
import pytest
import torch
from torch import nn

from codesign.network import soap
from codesign.network.soap import Soap


@pytest.mark.parametrize(
    ("shape", "turned"),
    [
        ((8, 9), True),
        ((9, 8, 1, 1), True),
        ((8, 12, 1, 3), False),
        ((8, 12, 2, 1), False),
        ((7, 20), False),
        ((20, 7), False),
    ],
)
def test_a_dense_layer_has_one_weight_for_every_pair(shape, turned):
    layer = nn.Linear(2, 2)
    layer.weight = nn.Parameter(torch.zeros(shape))
    assert soap._dense(layer) is turned


@pytest.mark.parametrize("about", [{}, {"betas": (0.7, 0.9)}])
def test_the_first_step_divides_a_gradient_by_its_own_size(about):
    """A gradient of one direction a side, s u v': moments lead to u v' at once, mean
    and square are its own whatever
    their betas, so the step is lr s / (s + LEAST s / sqrt(n m) + epsilon) along u v'.
    """
    u, v = np.linspace(-1.1, 2.3, 8), np.linspace(0.7, -1.9, 10)
    u, v, s = u / np.linalg.norm(u), v / np.linalg.norm(v), 0.037
    weight = nn.Parameter(torch.full((8, 10), 0.6, dtype=torch.float64))
    optimiser = Soap([weight], lr=0.02, epsilon=0.011, weight_decay=0.5, **about)
    weight.grad = torch.tensor(s * np.outer(u, v))
    optimiser.step()
    size = s / (s + 1e-3 * s / math.sqrt(80) + 0.011)
    want = 0.6 * (1 - 0.02 * 0.5) - 0.02 * size * np.outer(u, v)
    assert weight.detach().numpy() == pytest.approx(
        want, abs=1e-6
    )  # LEAST^2 of what is not in the moments


def test_what_is_usual_is_told_by_one_step_and_the_second():
    """lr 1e-3, no decay, epsilon 1e-8, betas 0.9 and 0.98: with 2 s after s the mean is
    (0.9 + 2) / 1.9 s, the mean
    square (0.98 + 4) / 1.98 s^2."""
    pattern = torch.from_numpy(
        np.outer(np.linspace(0.4, 1.2, 9), np.linspace(-0.5, 1.5, 11))
    )
    size = float(pattern.norm())
    weight = nn.Parameter(torch.ones(9, 11, dtype=torch.float64))
    optimiser = Soap([weight])
    weight.grad = pattern.clone()
    optimiser.step()
    first = weight.detach().clone()
    along = float(
        ((first - 1) * pattern / size).sum()
    )  # what rounding of LEAST^2 moves across is no part of it
    assert along == pytest.approx(-1e-3 / (1 + 1e-3 / math.sqrt(99)), rel=2e-6)
    weight.grad = 2 * pattern
    optimiser.step()
    share = (2.9 / 1.9) / (math.sqrt(4.98 / 1.98) * (1 + 1e-3 / math.sqrt(99)))
    along = float(((weight.detach() - first) * pattern / size).sum())
    assert along == pytest.approx(-1e-3 * share, rel=2e-6)


def test_a_side_of_600_is_turned_and_one_of_601_is_not():
    for size, turned in ((600, True), (601, False)):
        names = [name for name, _ in soap._sides(torch.zeros(size, 8))]
        assert names == ["left", "right"][1 - turned :]
        state = soap._fresh(torch.zeros(8, size))
        assert ("turn_right" in state) is turned
        assert state["turn_left"].shape == (8, 8)
        assert float(state["step"]) == 0.0


def test_moments_are_means_of_products_and_directions_turn_at_steps_1_11_and_21():
    draw = torch.Generator().manual_seed(6)
    weight = nn.Parameter(torch.zeros(8, 12, dtype=torch.float64))
    optimiser, moment = (
        Soap([weight], betas=(0.8, 0.95)),
        [np.zeros((8, 8)), np.zeros((12, 12))],
    )
    turns, before = [], torch.eye(8, dtype=torch.float64)
    for count in range(1, 24):
        weight.grad = torch.randn(8, 12, generator=draw, dtype=torch.float64)
        g = weight.grad.numpy()
        moment = [
            0.95 * m + 0.05 * new
            for m, new in zip(moment, (g @ g.T, g.T @ g), strict=True)
        ]
        optimiser.step()
        state = optimiser.state[weight]
        if not torch.equal(state["turn_left"], before):
            turns.append(count)
        before = state["turn_left"].clone()
    assert turns == [1, 11, 21]
    assert state["moment_left"].numpy() == pytest.approx(moment[0], rel=1e-12)
    assert state["moment_right"].numpy() == pytest.approx(moment[1], rel=1e-12)
    assert int(state["step"]) == 23


def test_directions_are_those_of_an_iteration_that_leaves_alone_what_was_never_excited():
    """A moment of one direction and a basis about it: its first column turns there, the
    rest stays where it is, to the
    share of LEAST^2 of the mean eigenvalue."""
    u = torch.tensor([0.6, 0.0, -0.8, 0.0], dtype=torch.float64)
    moment = 5.0 * torch.outer(u, u)
    own = 1e-6 * 5.0 / 4
    want = np.linalg.qr((moment + own * torch.eye(4, dtype=torch.float64)).numpy())[0]
    got = soap._nearer(moment, torch.eye(4, dtype=torch.float64))
    assert got.numpy() == pytest.approx(want, abs=1e-9)
    assert abs(float(got[:, 0] @ u)) == pytest.approx(1.0, abs=1e-6)
    assert abs(float(got[1, 1])) == pytest.approx(
        1.0, abs=1e-9
    )  # the axis that nothing excites


def test_turning_there_and_back_is_nothing():
    draw = torch.Generator().manual_seed(2)
    left, right = (
        torch.linalg.qr(torch.randn(n, n, generator=draw, dtype=torch.float64)).Q
        for n in (5, 7)
    )
    g = torch.randn(5, 7, generator=draw, dtype=torch.float64)
    for state in (
        {"turn_left": left, "turn_right": right},
        {"turn_left": left},
        {"turn_right": right},
        {},
    ):
        there = soap._turned(state, g)
        one, other = (
            state.get("turn_left", torch.eye(5).double()),
            state.get("turn_right", torch.eye(7).double()),
        )
        assert there.numpy() == pytest.approx((one.T @ g @ other).numpy(), abs=1e-12)
        assert soap._back(state, there).numpy() == pytest.approx(g.numpy(), abs=1e-12)
