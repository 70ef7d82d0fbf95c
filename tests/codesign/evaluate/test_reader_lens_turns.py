"""Turns of a lens and its branch by stand-ins: rates by the share done, means over a turn, sums over a field."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from codesign.evaluate import reader_lens
from codesign.evaluate.reader_lens import LensTraining
from codesign.train import Schedule

TRAINING = LensTraining(turns=4, hold=3, batch=2, phase=Schedule(0.04, 0.3, 1.0), rate=5e-3)
SHAPE = (2, 3, 1, 4, 4)  # rows and columns of the field, depths, window


class Whole:
    """In place of the true image."""

    stack = torch.zeros(SHAPE, dtype=torch.float64)


@pytest.fixture
def told(monkeypatch):
    """What the loop asks of its parts; the loss of step s is s squared, its slope s + 1 everywhere."""
    said = SimpleNamespace(rates=[], steps=[], gathered=[])

    class Reads:
        def __init__(self, parameters, lr, weight_decay):
            self.param_groups = [{"lr": lr}]

        def zero_grad(self, set_to_none):
            pass

        def step(self):
            said.rates.append(self.param_groups[0]["lr"])

    def gone(branch, optics, whole, scenes, config, training, *, step, live):
        said.steps.append((step, live))
        return step**2, torch.full(SHAPE, step + 1.0, dtype=torch.float64)

    def gradient(optics, whole, place, gathered):
        said.gathered.append(gathered)
        return torch.tensor([0.7, -0.2, 5.0], dtype=torch.float64)

    monkeypatch.setattr(torch.optim, "AdamW", Reads)
    monkeypatch.setattr(reader_lens, "Imager", Whole)
    monkeypatch.setattr(reader_lens, "samples", lambda frames: 8)

    def forms(optics, place, frame, *, margin):
        assert (frame, margin) == (8, 2)
        return Whole()

    monkeypatch.setattr(reader_lens, "gone_backward", gone)
    monkeypatch.setattr(reader_lens, "lens_gradient", gradient)
    scenes = SimpleNamespace(batch=lambda step, size: SimpleNamespace(frames=None), margin=2)
    start = torch.tensor([0.1, 0.2, -0.3], dtype=torch.float64)
    said.end, said.losses = reader_lens._descended(None, start, scenes, None, TRAINING, forms)
    said.moved = said.end - start
    return said


def test_steps_run_on_through_the_turns_and_a_turn_tells_their_mean(told):
    live = [TRAINING.phase.at(turn / 4) > 0 for turn in range(4)]
    assert live == [False, False, True, True]
    assert told.steps == [(step, live[step // 3]) for step in range(12)]
    assert told.losses == pytest.approx([(0 + 1 + 4) / 3, (9 + 16 + 25) / 3, (36 + 49 + 64) / 3, (81 + 100 + 121) / 3])


def test_the_lens_goes_against_the_mean_slope_by_the_rate_of_its_turn(told):
    """A gradient that stays is a step of the rate itself for Adam, whatever its size: here of two turns."""
    assert [float(one.flatten()[0]) for one in told.gathered] == pytest.approx([(7 + 8 + 9) / 3, (10 + 11 + 12) / 3])
    way = TRAINING.phase.at(2 / 4) + TRAINING.phase.at(3 / 4)
    assert told.moved.tolist() == pytest.approx([-way, way, -way], rel=1e-6)  # Adam's 1e-8 beside 0.2


def test_the_branch_s_rate_follows_the_steps_of_the_whole_training(told):
    assert told.rates == pytest.approx([Schedule(5e-3).at(step / 12) for step in range(12)], rel=1e-12)
    assert len(set(told.rates)) > 6


def test_the_gradient_is_the_mean_over_the_field_and_the_weighted_one_over_the_waves(monkeypatch):
    """Every node and wavelength with a slope of its own."""
    weights, slopes = np.array([0.3, 1.1, 0.4]), np.random.default_rng(6).normal(size=(3, 6, 2))
    asked = []

    def term(plane, plan, gathered, point, wave):
        asked.append((point, wave))
        return (plane * torch.from_numpy(slopes[wave, point])).sum() * gathered[0, 0, 0, 0, 0]

    monkeypatch.setattr(reader_lens, "term", term)
    monkeypatch.setattr(reader_lens.formed, "optics_of", lambda optics, leaf: leaf)
    whole = SimpleNamespace(plan=SimpleNamespace(waves=SimpleNamespace(weights=weights)))
    place = torch.tensor([0.4, -0.9], dtype=torch.float64)
    got = reader_lens.lens_gradient(None, whole, place, torch.full(SHAPE, 2.5, dtype=torch.float64))
    want = 2.5 * np.einsum("w,wpk->k", weights / 1.8, slopes) / 6
    assert got.numpy() == pytest.approx(want, rel=1e-12)
    assert sorted(asked) == [(point, wave) for point in range(6) for wave in range(3)]
    assert place.grad is None
