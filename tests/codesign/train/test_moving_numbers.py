"""What training moves, at its very ends: bounds of the pitch, gradients that are no
numbers, moments in memory.
"""

import math

import pytest
import torch

from codesign.network import Space, Supernet
from codesign.optics import OpticsConfig
from codesign.train import moving
from codesign.train.moving import Schedule


def model_at(pitch_um):
    log = torch.nn.Parameter(torch.tensor(math.log(pitch_um), dtype=torch.float64))
    return moving.Model(None, torch.nn.Parameter(torch.zeros(2)), log)


def test_a_pitch_at_its_bound_is_not_held():
    made = model_at(7.0)
    pitch = float(made.pitch_um.detach())
    assert made.hold(pitch, 40.0) is None
    assert made.hold(3.0, pitch) is None
    assert made.hold(pitch * (1 + 1e-12), 40.0) == pitch * (1 + 1e-12)
    assert made.hold(3.0, pitch * (1 - 1e-12)) == pitch * (1 - 1e-12)
    assert made.finest_um == 0.0


def test_a_group_moves_over_the_whole_run_and_at_a_clip_of_one_where_nothing_is_said():
    plain = Schedule(0.02)
    assert (plain.start, plain.end, plain.clip) == (0.0, 1.0, 1.0)
    assert plain.at(0.0) == pytest.approx(0.02 * 0.01, rel=1e-12)
    assert plain.at(1.0) == 0.0
    assert plain.at(0.5) == pytest.approx(0.01, rel=1e-12)  # half-way down the cosine
    assert plain.at(0.05) == pytest.approx(
        0.02 * 0.51 * math.cos(0.025 * math.pi) ** 2, rel=1e-12
    )


@pytest.mark.parametrize(
    ("network", "kind"), [("supernet", "Supernet"), ("popovic", "Baseline")]
)
def test_a_fresh_model_is_a_network_of_its_seed_and_a_lens_without_phase(network, kind):
    space = Space(widths=(0.25,), depths=(2,), expansions=(3,), kernels=(3,))
    settings = OpticsConfig(aperture_mm=0.3, polynomials=5)
    one, same, other = (
        moving.model(settings, pitch_um=8.3, seed=seed, space=space, network=network)
        for seed in (4, 4, 5)
    )
    assert isinstance(one.net, Supernet) == (kind == "Supernet")
    if kind == "Supernet":
        assert one.net.space == space
    assert one.coefficients_rad.tolist() == [0.0] * 5
    assert one.coefficients_rad.dtype == one.log_pitch.dtype == torch.float64
    assert float(one.pitch_um.detach()) == pytest.approx(8.3, rel=1e-12)
    first, again, apart = (next(iter(m.net.parameters())) for m in (one, same, other))
    assert torch.equal(first, again)
    assert not torch.equal(first, apart)


@pytest.mark.parametrize(
    ("odd", "well"),
    [
        (3.0, True),
        (-3e38, True),
        (math.inf, False),
        (-math.inf, False),
        (math.nan, False),
    ],
)
def test_one_gradient_that_is_no_number_is_enough(odd, well):
    parameters = [torch.nn.Parameter(torch.zeros(2, 3)) for _ in range(3)]
    parameters[0].grad, parameters[2].grad = torch.ones(2, 3), torch.ones(2, 3)
    parameters[2].grad[1, 2] = odd
    assert moving.finite(parameters) is well
    assert moving.finite(parameters[:2])
    assert moving.finite(parameters[1:2])  # none at all


def test_moments_lie_as_their_parameters_and_what_is_no_moment_stays():
    weight = torch.nn.Parameter(
        torch.zeros(3, 4, 5, 2).to(memory_format=torch.channels_last)
    )
    scalar = torch.nn.Parameter(torch.zeros(()))
    optimiser = torch.optim.Adam([weight, scalar], lr=0.1)
    values = torch.arange(120.0).view(3, 4, 5, 2)
    turn, step = torch.eye(3), torch.tensor(7.0)
    optimiser.state[weight] = {"step": step, "exp_avg": values.clone(), "turn": turn}
    optimiser.state[scalar] = {"step": step, "exp_avg": torch.tensor(0.3)}
    moving.laid_out(optimiser)
    kept = optimiser.state[weight]
    assert torch.equal(kept["exp_avg"], values)
    assert kept["exp_avg"].stride() == weight.stride()
    assert kept["turn"] is turn
    assert kept["step"] is step
    assert optimiser.state[scalar]["step"] is step
    assert float(optimiser.state[scalar]["exp_avg"]) == pytest.approx(0.3)
