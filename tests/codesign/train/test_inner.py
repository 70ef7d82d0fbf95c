"""The inner loop: bit-identical from a seed and after a stop, moves only what is
scheduled, survives bad gradients.
"""

import math
from dataclasses import replace

import pytest
import torch

from codesign.batches import FrameBatch
from codesign.network.architecture import SearchSpace, smallest_architecture
from codesign.optics.stack import OpticsConfig
from codesign.train import trainer as training
from codesign.train.trainer import InnerConfig, LearningRateSchedule, Trainer
from metalens.core.errors import ConfigError, TrainingError
from metalens.image.scene import Frames
from metalens.image.sensor import Sensor

OPTICS = OpticsConfig(
    aperture_mm=0.3, sensor_distance_mm=1.0, polynomials=6, depth_count=4, window_samples=9, depths_mm=(14.0, 30.0),
    image="uniform",
)  # fmt: skip
SENSOR = Sensor(pitch_um=9.0)
SIZE = 48


class Discs:
    """A dark pupil on a rough iris at a depth that the slip changes: the smallest scene
    with all labels.
    """

    margin = 4

    def batch(self, step, size):
        generator = torch.Generator().manual_seed(step + 1)
        full = SIZE + 2 * self.margin
        texture = torch.rand(size, full, full, generator=generator) * 0.5 + 0.4
        slip = torch.randn(size, 3, generator=generator)
        x = torch.arange(full, dtype=torch.float32) - (full - 1) / 2
        pupil = (
            torch.hypot(x - 4 * slip[:, :1, None], (x - 4 * slip[:, 1:2]).unsqueeze(-1))
            < 8
        ).float()
        light = texture * (1 - 0.9 * pupil)
        radiance = torch.stack([torch.zeros_like(light), light], 1)
        coverage = torch.stack([torch.zeros_like(light), torch.ones_like(light)], 1)
        depth = (
            (20_000 + 2000 * slip[:, 2])
            .clamp(14_500, 29_000)[:, None, None, None]
            .expand_as(radiance)
        )
        inside = slice(self.margin, -self.margin)
        return FrameBatch(
            Frames(radiance, coverage, depth.contiguous()),
            pupil[:, inside, inside],
            slip,
        )


def _trainer(config=None, *, optics=OPTICS, architecture=None):
    config = config or InnerConfig(steps=6, batch=2, subnets=0)
    made = training.make_model(optics, pitch_um=10.0, seed=config.seed)
    return Trainer(config, optics, SENSOR, Discs(), made, architecture=architecture)


def _weights(trainer):
    state = trainer.model
    return [
        *state.net.state_dict().values(),
        state.coefficients_rad.detach(),
        state.log_pitch.detach(),
    ]


def _equal(a, b):
    return all(torch.equal(x, y) for x, y in zip(_weights(a), _weights(b), strict=True))


MOVING = InnerConfig(
    steps=6,
    batch=2,
    subnets=1,
    optics=LearningRateSchedule(0.02, 0.0, 0.7),
    pitch=LearningRateSchedule(0.02, 0.0, 0.7),
    budget_mmacs=1.3,
)


@pytest.fixture(scope="module")
def whole():
    """A run that nobody stopped, and what it said."""
    trainer = _trainer(MOVING)
    return trainer, list(trainer.run())


def test_two_runs_from_one_seed_are_bit_identical(whole):
    one, lines = whole
    two = _trainer(MOVING)
    assert list(two.run()) == lines
    assert _equal(one, two)


def test_optics_and_pitch_move_only_inside_their_schedules():
    trainer = _trainer(MOVING)
    # it begins at its coarsest
    trainer.model.log_pitch.register_hook(lambda slope: slope.abs() + 0.1)
    list(trainer.run(until=5))
    lens = trainer.model.coefficients_rad.detach().clone()
    pitch = float(trainer.model.log_pitch.detach())
    assert float(lens.abs().max()) > 0
    assert pitch != math.log(10.0)
    list(trainer.run())
    torch.testing.assert_close(
        trainer.model.coefficients_rad.detach(), lens, rtol=0, atol=0
    )
    assert float(trainer.model.log_pitch.detach()) == pitch


def test_a_budget_drives_the_pitch_up():
    # which leaves room for pixels up to 16 um
    space = SearchSpace(resolution=(0.6, 1.0))
    member = replace(smallest_architecture(space), resolution=1.0)
    # 40 and 41 pixels differ in cost: between others the count is flat
    start_um = SIZE * OPTICS.sample_um / 40.5
    pitch_um = []
    for weight in (0.0, 100.0):
        made = training.make_model(OPTICS, pitch_um=start_um, seed=2, space=space)
        config = replace(MOVING, budget_mmacs=0.7, budget_weight=weight)
        trainer = Trainer(config, OPTICS, SENSOR, Discs(), made, architecture=member)
        assert (
            min(record.mmacs for record in trainer.run()) > 1.05 * config.budget_mmacs
        )  # or nothing would drive
        pitch_um.append(float(trainer.model.pitch_um.detach()))
    # Adam's steps have the size of the rate: 0.03 in all
    assert pitch_um[1] > 1.01 * start_um
    assert pitch_um[1] > 1.005 * pitch_um[0]


def test_the_pitch_stays_between_the_samples_of_the_image_and_sixteen_pixels():
    """Driven hard to either side: a budget far below every network, and a slope that
    asks for ever finer pixels.
    """
    fast = replace(
        MOVING,
        steps=40,
        pitch=LearningRateSchedule(0.5),
        optics=LearningRateSchedule(0.0),
        budget_mmacs=1e-3,
    )
    space = SearchSpace(resolution=(0.6, 1.0))
    for budget, limit in (
        (1e-3, SIZE * OPTICS.sample_um * 0.6 / 16),
        (0.0, OPTICS.sample_um),
    ):
        made = training.make_model(OPTICS, pitch_um=10.0, seed=2, space=space)
        if not budget:
            made.log_pitch.register_hook(lambda slope: torch.ones_like(slope))
        config = replace(fast, budget_mmacs=budget)
        member = replace(smallest_architecture(space), resolution=1.0)
        trainer = Trainer(config, OPTICS, SENSOR, Discs(), made, architecture=member)
        records = list(trainer.run(until=20))
        assert records[-1].pitch_um == pytest.approx(limit, rel=1e-9)


def test_budgets_of_a_run_are_trained_in_turn():
    made = training.make_model(OPTICS, pitch_um=9.0, seed=0)
    still = replace(
        MOVING, budget_mmacs=0.0, pitch=LearningRateSchedule(0.0), subnets=0
    )
    trainer = Trainer(still, OPTICS, SENSOR, Discs(), made, budgets_mmacs=(3.0, 1.4))
    spent = [record.mmacs for record in trainer.run()]
    assert all(a > 1.2 * b for a, b in zip(spent[::2], spent[1::2], strict=True))
    assert max(spent[1::2]) <= 1.4


def test_a_bad_gradient_is_skipped_and_counted():
    trainer = _trainer(architecture=smallest_architecture(SearchSpace()))
    before = [w.clone() for w in _weights(trainer)]
    hook = trainer.model.net.stem.weight.register_hook(lambda g: g * float("nan"))
    record = next(trainer.run())
    assert record.skipped == 1
    assert all(
        torch.equal(a, b) for a, b in zip(before, _weights(trainer), strict=True)
    )
    hook.remove()
    assert list(trainer.run())[-1].skipped == 1


def test_only_bad_gradients_end_the_run_with_the_cause():
    trainer = _trainer(
        InnerConfig(steps=6, batch=2, patience=3),
        architecture=smallest_architecture(SearchSpace()),
    )
    trainer.model.net.stem.weight.register_hook(lambda g: g * float("inf"))
    with pytest.raises(
        TrainingError,
        match=r"no finite gradient in 3 steps up to step 2; not finite: weights",
    ):
        list(trainer.run())


def test_the_optics_loss_falls_along_its_own_gradient():
    from codesign.optics import stack as lens
    from codesign.train import separability

    coefficients = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    start = separability.texture_depth_loss(
        lens.lens_psf_stack(OPTICS, coefficients), OPTICS, energy=0.4
    )
    (slope,) = torch.autograd.grad(start, coefficients)
    assert float(slope.norm()) > 0
    step = (0.05 / float(slope.norm())) * slope
    after = separability.texture_depth_loss(
        lens.lens_psf_stack(OPTICS, (coefficients - step).detach()), OPTICS, energy=0.4
    )
    assert float(after) < float(start.detach())


def test_impossible_schedules_are_refused():
    with pytest.raises(ConfigError, match="0 <= start < end"):
        LearningRateSchedule(0.1, 0.8, 0.2)
    with pytest.raises(ConfigError, match="need 1 or more"):
        InnerConfig(steps=0)
    with pytest.raises(ConfigError, match="slip_scale_mm"):
        InnerConfig(slip_scale_mm=(1.4, 0.0, 2.3))


class Hard(Discs):
    """Frames whose pupil is hidden by a blink, or cut by the border of the frame."""

    def __init__(self, kind):
        self.kind = kind

    def batch(self, step, size):
        plain = super().batch(step, size)
        mask = torch.zeros_like(plain.mask)
        if self.kind == "border":
            mask[:, :3, :2] = 1.0
        return replace(plain, mask=mask)


@pytest.mark.parametrize("kind", ["blink", "border"])
def test_batches_of_blinks_and_pupils_at_the_border_train_on(kind):
    config = InnerConfig(
        steps=2,
        batch=2,
        subnets=0,
        optics=LearningRateSchedule(0.02, 0.0, 1.0),
        patience=1,
    )
    made = training.make_model(OPTICS, pitch_um=9.0, seed=0)
    records = list(
        Trainer(
            config,
            OPTICS,
            SENSOR,
            Hard(kind),
            made,
            architecture=smallest_architecture(SearchSpace()),
        ).run()
    )
    assert records[-1].skipped == 0
    assert all(math.isfinite(r.loss) for r in records)
    assert float(made.coefficients_rad.detach().abs().max()) > 0


def test_a_spike_of_the_loss_moves_nothing_farther_than_its_clip():
    """Labels a million times too large for one batch. A first large gradient moves Adam
    by 0.37 / sqrt(0.33), 0.64 of
    the rate, an element; in turned axes, whose sums of squares are the same, that holds
    of the root mean square."""
    trainer = _trainer(
        InnerConfig(steps=6, batch=2), architecture=smallest_architecture(SearchSpace())
    )
    list(trainer.run(until=2))
    before = [p.detach().clone() for p in trainer.model.net.parameters()]
    plain = trainer.scenes.batch
    trainer.scenes.batch = lambda step, size: replace(
        plain(step, size), slip_mm=1e6 * plain(step, size).slip_mm
    )
    record = next(trainer.run())
    assert record.loss > 1e4
    pairs = zip(before, trainer.model.net.parameters(), strict=True)
    longest = max(float((a - b.detach()).square().mean().sqrt()) for a, b in pairs)
    # with what is left of the momentum before
    assert 0 < longest < trainer.inner.weights.rate


def test_only_the_weights_of_the_network_decay():
    """Optics and pixel pitch have units: drawn to 0, a pitch without a gradient would
    shrink.
    """
    decay = {
        name: made.param_groups[0]["weight_decay"]
        for name, made in _trainer().optimisers.items()
    }
    assert decay == {"weights": 0.01, "reading": 0.01, "optics": 0.0, "pitch": 0.0}
