"""A step by its numbers: random streams, weights of the loss, clips and rates, bounds
of the pitch, fine-tuning.
"""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from codesign.network.architecture import Space, largest, sample, smallest
from codesign.optics import formed
from codesign.optics.lens_errors import LensErrors
from codesign.optics.stack import OpticsConfig
from codesign.train import evolution, finish, formation, inner
from codesign.train.evolution import Candidate, Plan, Search
from codesign.train.inner import InnerConfig, Schedule, Trainer
from codesign.train.light import Light
from metalens.image import Imager, Sensor, UniformImager

OPTICS = OpticsConfig(
    aperture_mm=0.3, sensor_distance_mm=1.0, polynomials=6, depth_count=4, window_samples=9, depths_mm=(14.0, 30.0),
    image="uniform",
)  # fmt: skip
CONFIG = InnerConfig(
    steps=9, batch=2, seed=31, weights=Schedule(0.012, clip=1.7), optics=Schedule(0.02, clip=0.6),
    pitch=Schedule(0.02, clip=0.3),
)  # fmt: skip


def trainer(config=CONFIG, *, pitch_um=10.0):
    made = inner.model(OPTICS, pitch_um=pitch_um, seed=config.seed)
    return Trainer(
        config, OPTICS, Sensor(pitch_um=9.0), SimpleNamespace(margin=4), made
    )


@pytest.fixture(scope="module")
def plain():
    return trainer()


def seed_of(step, stream, seed=31):
    return (
        int(
            np.random.SeedSequence([seed, step, stream]).generate_state(1, np.uint64)[0]
        )
        >> 1
    )


def test_each_use_of_chance_has_a_stream_of_its_own_that_stays(plain, monkeypatch):
    """Noise 1, lens errors 2, members 3, given stacks 4, field points 9: what a run of
    an earlier day goes on with.
    """
    seen = []
    monkeypatch.setattr(
        inner,
        "read_out",
        lambda *_, generator, **__: seen.append(generator.initial_seed()),
    )
    plain._read(5, None, None, False)
    spread = SimpleNamespace(draw=lambda generator: generator.initial_seed())
    monkeypatch.setattr(plain, "optics", SimpleNamespace(spread=spread))
    seen += [plain._lens_error(5), plain._lens_error()]
    assert seen == [seed_of(5, 1), seed_of(5, 2), seed_of(0, 2)]

    def sandwich(space, count, budget, generator, *, subnets):
        seen.append(generator.random())
        return [smallest(space)]

    monkeypatch.setattr(inner, "sandwich", sandwich)
    monkeypatch.setattr(plain, "step", 6)
    plain._members(lambda _: 1.0)
    assert seen[-1] == np.random.default_rng([31, 6, 3]).random()
    light = Light(
        OPTICS,
        ("a", "b", "c", "d", "e"),
        refresh=3,
        draws=2,
        seed=31,
        draw=lambda _: None,
    )
    assert light._generator(5).initial_seed() == seed_of(5, 9)
    monkeypatch.setattr(formed, "imager", lambda *_, made, **__: made)
    drawn = [light.at(step, None, 30, 4, live=False) for step in range(40)]
    assert drawn == [
        "abcde"[np.random.default_rng([31, step, 4]).integers(5)] for step in range(40)
    ]


def test_the_loss_of_a_step_is_the_sum_of_its_parts_by_their_weights(
    plain, monkeypatch
):
    """Members of 1.5 and 0.7 of their budget: half of it too many for one, none for the
    other.
    """
    task, optics = (torch.tensor(v, requires_grad=True) for v in (0.83, -1.9))
    each = torch.tensor([1.5e6, 0.7e6], requires_grad=True)
    monkeypatch.setattr(
        plain, "inner", replace(CONFIG, optics_weight=0.37, budget_weight=2.6)
    )
    monkeypatch.setattr(plain, "budgets_mmacs", (9.0, 1.0))
    monkeypatch.setattr(plain, "step", 7)
    monkeypatch.setattr(plain, "_losses", lambda given, *, pitch_moves: (task, each))
    record = plain._stepped(
        SimpleNamespace(optics_loss=optics), dict.fromkeys(plain.groups, 0.0)
    )
    assert record.loss == pytest.approx(0.83 - 0.37 * 1.9 + 2.6 * 0.25, rel=1e-6)
    assert (record.task, record.optics) == pytest.approx((0.83, -1.9))
    assert (record.step, record.mmacs, record.pitch_um) == (
        8,
        pytest.approx(1.1),
        pytest.approx(10.0),
    )
    assert (float(task.grad), float(optics.grad)) == pytest.approx((1.0, 0.37))
    assert each.grad.tolist() == pytest.approx([2.6 / 2 / 1e6, 0.0])


def test_gradients_are_clipped_group_by_group_before_a_step_of_the_rate():
    made = trainer()
    for _, parameters in made.groups.values():
        for parameter in parameters:
            parameter.grad = torch.full_like(parameter, 3.0)
    pitch = float(made.model.log_pitch.detach())
    made._apply(
        {"weights": 2e-3, "reading": 1e-3, "optics": 3e-3, "pitch": 4e-3}, finite=True
    )
    for name, clip in (
        ("weights", 1.7),
        ("reading", 1.7),
        ("optics", 0.6),
        ("pitch", 0.3),
    ):
        grads = [p.grad.double().flatten() for p in made.groups[name][1]]
        assert float(torch.cat(grads).norm()) == pytest.approx(clip, rel=1e-4), name
    assert made.model.coefficients_rad.tolist() == pytest.approx(
        [-3e-3] * 6, rel=1e-5
    )  # Adam's first step
    assert float(made.model.log_pitch.detach()) == pytest.approx(pitch - 4e-3, rel=1e-6)


@pytest.mark.parametrize(
    ("begins", "least_um", "coarsest", "low", "high"),
    [
        (10.0, 0.0, 20.0, 9.0, 20.0),
        (12.0, 10.5, 11.0, 10.5, 12.0),
        (3.0, 10.5, 20.0, 3.0, 20.0),
    ],
)
def test_a_pitch_is_held_within_samples_budgets_and_where_it_began(
    plain, monkeypatch, begins, least_um, coarsest, low, high
):
    """No finer than the samples of 9 um."""
    monkeypatch.setattr(plain, "_begins_um", begins)
    monkeypatch.setattr(plain, "_coarsest_um", coarsest)
    monkeypatch.setattr(plain.model, "finest_um", least_um)
    monkeypatch.setattr(plain, "optimisers", {})
    for start, want in ((0.1, low), (400.0, high)):
        with torch.no_grad():
            plain.model.log_pitch.fill_(math.log(start))
        plain._apply({"pitch": 1e-9}, finite=True)
        assert float(plain.model.pitch_um.detach()) == pytest.approx(want, rel=1e-9)
        assert plain.pitch_held_um == pytest.approx(want, rel=1e-9)


def test_fine_tuning_takes_a_quarter_of_the_rate_and_chance_of_its_own(plain):
    run = SimpleNamespace(
        settings=SimpleNamespace(run=SimpleNamespace(finetune_steps=0)), trainer=plain
    )
    made = finish._tuned(run, smallest(Space()), 2)
    assert made.inner.weights.rate == pytest.approx(0.003)
    assert (made.inner.seed, made.inner.steps) == (3031, 1)
    assert (made.inner.optics.rate, made.inner.pitch.rate) == (0.0, 0.0)
    assert made.architecture == smallest(Space())
    own, first = (next(iter(one.model.net.parameters())) for one in (made, plain))
    assert torch.equal(own, first)
    assert own is not first


SPACE = replace(Space(), resolution=(0.6, 1.0))


@pytest.mark.parametrize("step", [1, 37, 90, 127])
def test_a_resolution_is_found_to_a_128th_of_its_range(step):
    """Cost that is the resolution itself: the step below the budget, odd ones too; of
    64 or 256 steps another.
    """
    found = evolution.fitted(
        SPACE, largest(SPACE), lambda a: a.resolution, 0.6 + 0.4 * (step + 0.7) / 128
    )
    assert found.resolution == pytest.approx(0.6 + 0.4 * step / 128, abs=1e-12)


def test_two_hundred_draws_are_tried_for_one_within_the_budget():
    asked = []
    assert (
        evolution._within(
            lambda: asked.append(1) or smallest(SPACE), lambda a: 2.0, 1.0
        )
        is None
    )
    assert len(asked) == 200
    asked.clear()
    monkey = iter(range(10**6))
    cheap = smallest(SPACE)
    found = evolution._within(
        lambda: cheap, lambda a: 2.0 if next(monkey) < 199 else 1.0, 1.0
    )
    assert found is cheap


def test_the_parent_is_the_best_of_its_rivals_and_of_equals_the_cheapest(monkeypatch):
    """All three compete once the population is whole; the oldest, best of all, is dead."""
    monkeypatch.setattr(
        evolution, "mutate", lambda space, parent, generator, *, rate: parent
    )
    random = np.random.default_rng(4)
    bad, dear, cheap, old = (sample(SPACE, random) for _ in range(4))
    history = (
        Candidate(old, 0.01, 1.0), Candidate(bad, math.nan, 1.0), Candidate(dear, 0.3, 9.0), Candidate(cheap, 0.3, 5.0)
    )  # fmt: skip
    plan = Plan(population=3, tournament=3, rounds=9)
    child = evolution._next(
        SPACE, plan, Search(history), lambda a: 1.0, 2.0, np.random.default_rng(0)
    )
    assert child == cheap
    fresh = evolution._next(
        SPACE, plan, Search(history[:2]), lambda a: 1.0, 2.0, np.random.default_rng(0)
    )
    assert fresh == sample(
        SPACE, np.random.default_rng(0)
    )  # of a population that grows nobody is a parent


@pytest.mark.parametrize(("electrons", "normal"), [(20.4, True), (19.6, False)])
def test_noise_is_drawn_as_a_normal_one_from_twenty_electrons_on(
    electrons, normal, monkeypatch
):
    asked = []
    monkeypatch.setattr(
        formation, "_normal", lambda mean, *_: asked.append(float(mean.mean())) or mean
    )
    sensor = Sensor(8.0, 8.0, electrons, 0.0, 1e4, 0.0)
    light = torch.ones(2, 32, 32)
    formation.read_out(
        light,
        1.0,
        torch.tensor(8.0),
        sensor,
        generator=torch.Generator().manual_seed(1),
        exact=False,
    )
    assert asked == ([pytest.approx(electrons, rel=1e-6)] if normal else [])


def test_quiet_frames_stop_at_the_full_well_of_their_pixels():
    """Wells of (8 / 4)² x 250 e: half of a frame lies at 400 electrons, a quarter at
    999 and a quarter beyond.
    """
    sensor = Sensor(8.0, 4.0, 100.0, 0.0, 250.0, 0.0, 16)
    light = torch.ones(1, 64, 64)
    light[0, :, 32:] = 999 / 400
    light[0, 32:, 32:] = 40.0
    frames = formation.read_out(
        light, 1.0, torch.tensor(8.0), sensor, generator=None, quiet=True
    )[0, 0]
    seen = frames[[1, 1, 6], [1, 6, 6]]  # clear of the edges
    assert float((seen[1] - seen[0]) / (seen[2] - seen[0])) == pytest.approx(
        599 / 600, abs=1e-3
    )  # 16 bits


def test_one_psf_a_depth_is_kept_while_the_lens_stands_without_errors():
    off = LensErrors(focus_um=5.0, tilt_waves=0.1).draw(
        torch.Generator().manual_seed(3)
    )
    light = Light(OPTICS, (), refresh=3, draws=2, seed=0, draw={4: off, 5: off}.get)
    still = torch.zeros(6, dtype=torch.float64)
    first = light.at(0, still, 20, 4, live=False)
    assert isinstance(first, UniformImager)
    assert light.at(1, still, 20, 4, live=False) is first
    moved = light.at(2, still, 20, 4, live=True)
    assert moved is not first
    rested = light.at(3, still, 20, 4, live=False)
    assert rested is not moved
    with_error = [light.at(step, still, 20, 4, live=False) for step in (4, 5)]
    assert with_error[0] is not with_error[1]
    assert rested not in with_error


def test_a_still_lens_with_errors_is_formed_anew_with_those_of_its_time(monkeypatch):
    made = []

    def imager(settings, coefficients, frame, *, margin, error, device):
        made.append(error)
        return object.__new__(Imager)

    monkeypatch.setattr(formed, "imager", imager)
    light = Light(
        replace(OPTICS, image="true"),
        (),
        refresh=3,
        draws=2,
        seed=0,
        draw=lambda step: f"of {step}",
    )
    for step in range(8):
        light.at(step, torch.zeros(6), 30, 4, live=False)
    assert made == ["of 0", "of 3", "of 6"]
