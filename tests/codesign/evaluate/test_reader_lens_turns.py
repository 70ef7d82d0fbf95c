"""Turns of a lens and its branch by stand-ins: rates by the share done, means over a
turn, sums over a field.

Steps of a descent by hand, and in noise; the lens of a path that is kept.
"""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from codesign.evaluate import reader_lens
from codesign.evaluate.reader_lens import LensTraining, ShrunkDescent
from codesign.train import LearningRateSchedule

TRAINING = LensTraining(
    turns=4,
    hold=3,
    batch=2,
    phase=LearningRateSchedule(0.04, 0.3, 1.0),
    anew=3,
    rate=5e-3,
)
SLOPE = torch.tensor([0.7, -0.2, 5.0], dtype=torch.float64)
SHAPE = (2, 3, 1, 4, 4)  # rows and columns of the field, depths, window


class Whole:
    """In place of the true image."""

    stack = torch.zeros(SHAPE, dtype=torch.float64)


@pytest.fixture
def told(monkeypatch):
    return _told(monkeypatch, TRAINING)


def _told(monkeypatch, training):
    """What the loop asks of its parts; the loss of step s is s squared, its slope s + 1
    everywhere.
    """
    said = SimpleNamespace(rates=[], steps=[], gathered=[], planned=[], moved=[])

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
        return SLOPE

    monkeypatch.setattr(torch.optim, "AdamW", Reads)
    monkeypatch.setattr(reader_lens, "Imager", Whole)
    monkeypatch.setattr(reader_lens, "frame_samples", lambda frames: 8)

    def forms(optics, place, frame, *, margin):
        assert (frame, margin) == (8, 2)
        said.planned.append(place)
        return Whole()

    def moved(optics, planned, place):
        said.moved.append(place)
        return planned

    monkeypatch.setattr(reader_lens, "moved_image", moved)
    monkeypatch.setattr(reader_lens, "gone_backward", gone)
    monkeypatch.setattr(reader_lens, "lens_gradient", gradient)
    scenes = SimpleNamespace(
        batch=lambda step, size: SimpleNamespace(frames=None), margin=2
    )
    start = torch.tensor([0.1, 0.2, -0.3], dtype=torch.float64)
    said.path, said.losses = reader_lens._descended(
        None, start, scenes, None, training, forms
    )
    return said


def test_steps_run_on_through_the_turns_and_a_turn_tells_their_mean(told):
    live = [TRAINING.phase.at(turn / 4) > 0 for turn in range(4)]
    assert live == [False, False, True, True]
    assert told.steps == [(step, live[step // 3]) for step in range(12)]
    assert told.losses == pytest.approx(
        [(0 + 1 + 4) / 3, (9 + 16 + 25) / 3, (36 + 49 + 64) / 3, (81 + 100 + 121) / 3]
    )


def test_the_lens_goes_against_the_mean_slope_by_the_rate_of_its_turn(told):
    """Not by the first; two that are equal have weights 9/19 and 10/19: 1 - Σ w² of the
    rate, whatever their size.
    """
    assert [float(one.flatten()[0]) for one in told.gathered] == pytest.approx(
        [(7 + 8 + 9) / 3, (10 + 11 + 12) / 3]
    )
    steps = (told.path[1:] - told.path[:-1]).numpy()
    rates = np.array([0, 0, 0, TRAINING.phase.at(3 / 4) * (1 - 181 / 361)])
    assert steps == pytest.approx(
        -rates[:, None] * (SLOPE / SLOPE.norm()).numpy(), rel=1e-9, abs=1e-15
    )


def test_the_image_is_planned_anew_after_its_turns_and_follows_a_lens_that_moved_between(
    told,
):
    """Planned before turns 0 and 3; before turn 1 and 2 the lens had not moved yet."""
    assert [one.tolist() for one in told.planned] == [
        told.path[0].tolist(),
        told.path[3].tolist(),
    ]
    assert told.moved == []


def test_between_plans_the_image_is_that_of_the_lens_where_it_stands(monkeypatch):
    """The first gradient moves nothing; turn 3 is planned anew, so the image follows
    before turns 2, 4 and 5.
    """
    training = LensTraining(
        turns=6, hold=1, batch=2, phase=LearningRateSchedule(0.04), anew=3
    )
    told = _told(monkeypatch, training)
    places = told.path.tolist()
    assert places[1] == places[0]
    assert [one.tolist() for one in told.planned] == [places[0], places[3]]
    assert [one.tolist() for one in told.moved] == [places[2], places[4], places[5]]


def _steps(gradients):
    descent = ShrunkDescent(torch.zeros(gradients.shape[1], dtype=torch.float64))
    return torch.stack([descent.step(one) for one in gradients])


def test_a_step_is_the_mean_gradient_less_the_share_of_noise_of_one_length_for_all_terms():
    """3, 4 and -3, 4 of length 5: mean -0.03 and 0.76 over 0.95, of which (1 - 181/361
    / 0.641) stays.
    """
    first, second = _steps(
        torch.tensor([[3.0, 4.0], [-3.0, 4.0]], dtype=torch.float64)
    ).tolist()
    assert first == pytest.approx([0.0, 0.0], abs=1e-12)
    x, y = -0.03 / 0.95, 0.76 / 0.95
    stays = 1 - 181 / 361 / (x * x + y * y)
    assert second == pytest.approx([-stays * x, -stays * y], rel=1e-9)
    assert not _steps(torch.zeros(3, 2, dtype=torch.float64)).any()


def test_gradients_of_unlike_lengths_are_measured_by_their_mean_square():
    """5 and 13 long: (0.99 · 25 + 169) / 1.99 the mean square; 9 and 10 nineteenths the
    shares of the mean.
    """
    given = torch.tensor([[3.0, 4.0], [5.0, 12.0]], dtype=torch.float64)
    square = (0.99 * 25 + 169) / 1.99
    x, y = (9 * 3 + 10 * 5) / 19, (9 * 4 + 10 * 12) / 19
    stays = 1 - 181 / 361 / ((x * x + y * y) / square)
    _, second = _steps(given).tolist()
    assert second == pytest.approx(
        [-stays * x / square**0.5, -stays * y / square**0.5], rel=1e-9
    )


def test_a_lens_stands_in_noise_and_goes_where_gradients_agree():
    """300 gradients of 63 terms without a mean, and with one as long as the noise.

    Of noise the running mean's square is within 18 % (√(2 / 63)) of its share, so
    little passes; Adam's steps are √63 =
    7.9 times 0.23 long there. Of the sum half of the square is noise, a nineteenth of
    it stays: cos² = 19/20, and
    the length is √(1/2 · 20/19) (1 - 20/19 / 10 ...) = 0.65.
    """
    draws = torch.Generator().manual_seed(3)
    noise = torch.randn(400, 63, generator=draws, dtype=torch.float64) / 63**0.5
    way = torch.randn(63, generator=draws, dtype=torch.float64)
    way = way / way.norm()
    assert (
        float(_steps(noise)[100:].norm(dim=1).mean()) < 0.03
    )  # 0.23 with nothing taken off
    moved = -_steps(way + noise)[100:]
    assert float(torch.cosine_similarity(moved, way[None]).mean()) == pytest.approx(
        (19 / 20) ** 0.5, abs=0.02
    )
    assert 0.55 < float(moved.norm(dim=1).mean()) < 0.75


def test_a_wrong_turn_is_not_kept():
    """The start is read whether asked for or not; the first of equal lenses stays."""
    path = torch.tensor([[0.0], [1.0], [2.0], [3.0]], dtype=torch.float64)
    errors = {0.0: 0.7, 1.0: 0.1, 2.0: 0.8, 3.0: 0.7}
    worse = reader_lens.best_round(path, (2, 3), lambda place: errors[float(place)])
    assert worse == (0, {0: 0.7, 2: 0.8, 3: 0.7})
    assert reader_lens.best_round(path, (0, 1), lambda place: errors[float(place)]) == (
        1,
        {0: 0.7, 1: 0.1},
    )


def test_the_branch_s_rate_follows_the_steps_of_the_whole_training(told):
    assert told.rates == pytest.approx(
        [LearningRateSchedule(5e-3).at(step / 12) for step in range(12)], rel=1e-12
    )
    assert len(set(told.rates)) > 6


def test_the_gradient_is_the_mean_over_the_field_and_the_weighted_one_over_the_waves(
    monkeypatch,
):
    """Every node and wavelength with a slope of its own."""
    weights, slopes = (
        np.array([0.3, 1.1, 0.4]),
        np.random.default_rng(6).normal(size=(3, 6, 2)),
    )
    asked = []

    def term(plane, plan, gathered, point, wave):
        asked.append((point, wave))
        return (plane * torch.from_numpy(slopes[wave, point])).sum() * gathered[
            0, 0, 0, 0, 0
        ]

    monkeypatch.setattr(reader_lens, "term", term)
    monkeypatch.setattr(reader_lens.formed, "optics_of", lambda optics, leaf: leaf)
    whole = SimpleNamespace(
        plan=SimpleNamespace(waves=SimpleNamespace(weights=weights))
    )
    place = torch.tensor([0.4, -0.9], dtype=torch.float64)
    got = reader_lens.lens_gradient(
        None, whole, place, torch.full(SHAPE, 2.5, dtype=torch.float64)
    )
    want = 2.5 * np.einsum("w,wpk->k", weights / 1.8, slopes) / 6
    assert got.numpy() == pytest.approx(want, rel=1e-12)
    assert sorted(asked) == [(point, wave) for point in range(6) for wave in range(3)]
    assert place.grad is None


def test_every_step_of_every_seed_has_noise_of_its_own(monkeypatch):
    """As far as steps go: a million of one seed before those of the next."""
    made, weight = [], torch.ones(1, requires_grad=True)
    for name in ("sensor_irradiance", "depth_um"):
        monkeypatch.setattr(reader_lens, name, lambda *_, **__: torch.ones(1))
    monkeypatch.setattr(reader_lens.blur, "window_vergence", lambda depth: depth)
    monkeypatch.setattr(
        reader_lens.losses, "depth_loss", lambda found, true: (found - true).sum()
    )

    def read_out(light, sample_um, pitch_um, sensor, *, generator, exact):
        assert not exact
        made.append(generator.initial_seed())
        return light

    monkeypatch.setattr(reader_lens, "read_out", read_out)
    scenes = SimpleNamespace(
        batch=lambda step, size: SimpleNamespace(frames=None), margin=2
    )
    config = SimpleNamespace(pitch_um=9.0, sensor=None)
    for seed in (0, 1, 2):
        for step in (0, 1, 7):
            training = LensTraining(seed=seed)
            reader_lens.gone_backward(
                lambda seen: (seen * weight, None),
                None,
                Whole(),
                scenes,
                config,
                training,
                step=step,
                live=False,
            )
    steps = np.reshape(made, (3, 3))
    assert (steps - steps[:, :1]).tolist() == [[0, 1, 7]] * 3
    assert np.diff(steps[:, 0]).min() > 1e6
