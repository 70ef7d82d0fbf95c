"""Adam along the eigenvectors of a layer's gradients: what turning buys, what it leaves
alone, and that it resumes.
"""

import copy
import math

import numpy as np
import pytest
import torch
from torch import nn

from codesign.network import soap
from codesign.network.architecture import Space
from codesign.network.soap import LEAST, TURN, Soap
from codesign.network.supernet import Supernet


def _gradients(count, shape=(9, 13), seed=3):
    """Gradients whose rows and columns go together, of no symmetry."""
    draw = np.random.default_rng(seed)
    left, right = (draw.normal(size=(n, n)) * np.geomspace(1, 0.05, n) for n in shape)
    made = [
        left @ draw.normal(size=shape) @ right.T + 0.3 * draw.normal(size=shape)
        for _ in range(count)
    ]
    return [torch.tensor(g, dtype=torch.float32) for g in made]


def _moved(gradients, weight, **settings):
    optimiser = Soap([weight], **settings)
    for gradient in gradients:
        weight.grad = gradient.clone()
        optimiser.step()
    return optimiser


def test_it_moves_as_the_formulas_of_its_heading_by_numpy_in_double_precision():
    """Directions by orthogonal iteration, written anew: of a conv's weight too, whose
    trailing sides are 1.
    """
    gradients, lr, decay = [g.double() for g in _gradients(2 * TURN + 3)], 0.013, 0.21
    weight = nn.Parameter(
        torch.linspace(-1.3, 2.1, 117, dtype=torch.float64).view(9, 13, 1, 1).clone()
    )
    want = weight.detach().numpy()[..., 0, 0].copy()
    _moved([g[..., None, None] for g in gradients], weight, lr=lr, weight_decay=decay)
    mean, square = np.zeros((9, 13)), np.zeros((9, 13))
    moments, turns = [np.zeros((n, n)) for n in (9, 13)], [np.eye(n) for n in (9, 13)]
    for count, one in enumerate(gradients, start=1):
        g = one.numpy()
        moments = [
            0.98 * m + 0.02 * new
            for m, new in zip(moments, (g @ g.T, g.T @ g), strict=True)
        ]
        if count in (1, 1 + TURN, 1 + 2 * TURN):
            turns = [
                np.linalg.qr(
                    (m + LEAST**2 * np.trace(m) / len(m) * np.eye(len(m))) @ q
                )[0]
                for m, q in zip(moments, turns, strict=True)
            ]
        mean = 0.9 * mean + 0.1 * g
        square = 0.98 * square + 0.02 * (turns[0].T @ g @ turns[1]) ** 2
        spread = np.sqrt(square / (1 - 0.98**count))
        spread = spread + LEAST * np.sqrt(np.mean(spread**2)) + 1e-8
        along = turns[0].T @ (mean / (1 - 0.9**count)) @ turns[1] / spread
        want = want * (1 - lr * decay) - lr * turns[0] @ along @ turns[1].T
    found = weight.detach().numpy()[..., 0, 0]
    assert found == pytest.approx(
        want, abs=1e-9
    )  # rounding: moments of few gradients have a condition of 1 / LEAST^2


def test_a_regression_on_inputs_that_rise_and_fall_together_is_learned_in_fewer_steps_than_by_adam():
    """Inputs of condition 400 and an answer across the common direction: the least
    error there is, is 0.
    """
    draw = torch.Generator().manual_seed(5)
    common = torch.randn(4000, 1, generator=draw) * 10
    inputs = common + torch.randn(4000, 24, generator=draw) * torch.linspace(
        0.3, 0.6, 24
    )
    mix = torch.randn(24, 8, generator=draw)
    wanted = (inputs - inputs.mean(1, keepdim=True)) @ mix

    def error(make):
        weight = nn.Parameter(torch.zeros(8, 24))
        optimiser = make([weight])
        for i in range(200):
            part = slice(20 * i, 20 * i + 20)
            optimiser.param_groups[0]["lr"] = 0.1 * (1 - i / 200)
            optimiser.zero_grad()
            (inputs[part] @ weight.T - wanted[part]).square().mean().backward()
            optimiser.step()
        return float(
            (inputs @ weight.detach().T - wanted).square().mean()
            / wanted.square().mean()
        )

    turned, plain = (
        error(Soap),
        error(lambda w: torch.optim.AdamW(w, betas=(0.9, 0.98), weight_decay=0.0)),
    )
    assert turned < 0.25 * plain


def _left_over(omega_rad, seed):
    """Error that 200 steps leave of a linear map, where what inputs have in common
    turns by an angle a step.
    """
    draw = torch.Generator().manual_seed(seed)
    mix, axes = (
        torch.randn(24, 8, generator=draw),
        torch.linalg.qr(torch.randn(24, 24, generator=draw)).Q,
    )
    weight = nn.Parameter(torch.zeros(8, 24))
    optimiser = Soap([weight])
    for i in range(200):
        common = (
            math.cos(omega_rad * i) * axes[:, 0] + math.sin(omega_rad * i) * axes[:, 1]
        )
        inputs = torch.randn(20, 1, generator=draw) * 10 * common
        inputs = inputs + torch.randn(20, 24, generator=draw) * torch.linspace(
            0.3, 0.6, 24
        )
        optimiser.param_groups[0]["lr"] = 0.1 * (1 - i / 200)
        optimiser.zero_grad()
        (inputs @ weight.T - inputs @ mix).square().mean().backward()
        optimiser.step()
    return math.log(
        float((weight.detach().T - mix).square().mean() / mix.square().mean())
    )


def test_directions_follow_what_turns_by_a_degree_a_step():
    """Geometric mean of four regressions: 0.05, 0.07, 0.14 with 5, 10, 20 steps from
    turn to turn.
    """
    assert math.exp(np.mean([_left_over(0.02, seed) for seed in range(4)])) < 0.1


def test_one_step_in_ten_pays_for_a_turn():
    """A QR of the widest side, 541, takes a third of a step of eight frames."""
    weight, turned = nn.Parameter(torch.zeros(9, 13)), 0
    optimiser, before = Soap([weight]), None
    for gradient in _gradients(100):
        weight.grad = gradient
        optimiser.step()
        now = optimiser.state[weight]["turn_right"]
        turned, before = (
            turned + (before is None or not torch.equal(now, before)),
            now.clone(),
        )
    assert turned == 10


def test_a_step_along_every_direction_is_as_long_as_the_rate():
    """Gradients of one direction a side, and a million times stronger: the step is the
    rate all the same.
    """
    one = (
        torch.outer(torch.linspace(0.5, -1.7, 11), torch.linspace(1.9, 0.3, 12))
        * 3.7e-6
    )
    for scale in (1.0, 1e6):
        weight = nn.Parameter(torch.zeros(11, 12))
        _moved([scale * one] * 3, weight, lr=0.02)
        assert float(weight.detach().norm()) == pytest.approx(
            3 * 0.02, rel=2e-3
        )  # LEAST: 1e-4; 1e-8 beside 1e-5: 1e-3


def test_directions_are_orthogonal_and_found_from_fewer_gradients_than_a_side_has():
    weight = nn.Parameter(torch.zeros(40, 90))
    optimiser = _moved(_gradients(TURN + 1, (40, 90)), weight)
    for side, size in (("left", 40), ("right", 90)):
        turn = optimiser.state[weight][f"turn_{side}"]
        assert (turn.T @ turn).numpy() == pytest.approx(np.eye(size), abs=1e-5)


def test_a_weight_whose_gradients_are_zero_stays_and_a_wide_side_keeps_its_axes():
    still, wide = (
        nn.Parameter(torch.full((8, 9), 0.7)),
        nn.Parameter(torch.zeros(8, soap.WIDEST + 1)),
    )
    _moved([torch.zeros(8, 9)] * (TURN + 2), still, weight_decay=0.0)
    assert torch.equal(still.detach(), torch.full((8, 9), 0.7))
    optimiser = _moved(_gradients(2, wide.shape), wide)
    assert "turn_left" in optimiser.state[wide]
    assert "turn_right" not in optimiser.state[wide]


def test_it_goes_on_to_the_same_bytes_from_what_it_tells():
    gradients = _gradients(TURN + 9)
    whole, part = (
        nn.Parameter(torch.linspace(0, 1, 117).view(9, 13).clone()) for _ in range(2)
    )
    _moved(gradients, whole, lr=0.01)
    state = copy.deepcopy(_moved(gradients[:9], part, lr=0.01).state_dict())
    going = Soap([part])
    going.load_state_dict(state)
    for gradient in gradients[9:]:
        part.grad = gradient.clone()
        going.step()
    assert torch.equal(part, whole)


def test_the_layers_are_the_dense_ones_that_every_member_uses_whole():
    net = Supernet(
        Space(
            widths=(0.5,), depths=(2,), expansions=(3,), kernels=(3,), resolution=(1.0,)
        )
    )
    names = {id(p): name for name, p in net.named_parameters()}
    assert [names[id(p)] for p in soap.layers(net)] == [
        "blur.first.weight", "blur.together.0.mix.weight", "blur.together.1.take.weight",
        "blur.together.1.give.weight", "blur.together.2.mix.weight", "blur.together.3.take.weight",
        "blur.together.3.give.weight", "blur.second.weight",
        "blur.depth.weight", "blur.content.weight", "calibration.hidden.weight", "calibration.depths.weight",
        "calibration.points.weight", "calibration.joined.weight", "calibration.turned.weight",
    ]  # fmt: skip
    assert soap.layers(nn.Linear(20, 20)) == []  # no part of it reads blur


def test_a_closure_is_refused():
    with pytest.raises(ValueError, match="no closure"):
        Soap([nn.Parameter(torch.zeros(8, 8))]).step(lambda: 0.0)


@pytest.mark.parametrize(
    ("layer", "turned"),
    [
        (nn.Linear(8, 11), True),
        (nn.Linear(11, 7), False),
        (nn.Linear(7, 11), False),
        (nn.Conv2d(12, 8, 1), True),
        (nn.Conv2d(12, 8, 3), False),
    ],
)
def test_dense_layers_of_eight_on_either_side_and_more_are_turned(layer, turned):
    assert soap._dense(layer) is turned
