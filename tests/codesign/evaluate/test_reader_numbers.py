"""What the reference reader tells, on answers typed in: intervals by rank and
bootstrap, depths of windows.
"""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from codesign.evaluate import reader
from codesign.evaluate.reader import LensFrames, ReaderConfig, ReaderResult
from codesign.network import blur
from metalens import design
from metalens.cell import Film, Index
from metalens.core.errors import ConfigError
from metalens.design import Focus
from metalens.lens import Layers
from tests.codesign import made_lens as m


def frames(count, seed):
    """Frames with truth, and what a stand-in for the network answers: slippage in its
    own units and log spreads.
    """
    rng = np.random.default_rng(seed)
    vergence = torch.from_numpy(rng.uniform(-1, 1, (count, 7, 7)))
    slip = torch.from_numpy(rng.normal(0, 1, (count, 3)))
    answer = torch.from_numpy(
        np.concatenate(
            [rng.normal(0, 1, (count, 3)), rng.uniform(-5, 3, (count, 3))], 1
        )
    )
    told = vergence + torch.from_numpy(rng.normal(0, 0.3, (count, 7, 7)))
    told = torch.stack([told, torch.from_numpy(rng.uniform(-2, 1, (count, 7, 7)))], 1)
    pixels = torch.arange(count, dtype=torch.float64)[:, None, None, None] + 1000 * seed
    return LensFrames(pixels, vergence, slip), answer, told


class Stand:
    """A reader whose answers are looked up by the frame's number, in the order that it
    is asked.
    """

    def __init__(self, *known):
        self.answers = {
            float(f.pixels[k]): (a[k], t[k]) for f, a, t in known for k in range(len(a))
        }

    def branch(self, pixels):
        found = [self.answers[float(p)] for p in pixels]
        return torch.stack([t for _, t in found]), torch.stack([a for a, _ in found])

    def slip(self, features):
        return features


@pytest.mark.parametrize("count", [40, 300])
def test_intervals_are_calibrated_by_rank_and_judged_on_others(count):
    """The 0.9 (n + 1)-th smallest error over spread of the frames to spare, times the
    spread of those judged.
    """
    spare, judged = frames(count, 1), frames(263, 2)  # more than are told at once
    got = reader._judge(Stand(spare, judged), spare[0], judged[0], 0.043)
    scale = np.array([1.4, 1.2, 2.3])

    def axial(of):
        made, answer, _ = of
        off = np.abs(answer[:, :3].numpy() * scale - made.slip_mm.numpy())
        return off, 2.3 * np.exp(np.clip(answer[:, 5].numpy(), -4, 2))

    off, spread = axial(spare)
    rank = math.ceil(0.9 * (count + 1))  # of 40: 37, of 300: 271
    reach = np.sort(off[:, 2] / spread)[rank - 1]
    off, spread = axial(judged)
    near = 1e-6  # float32 scales
    assert got.axial_mm.numpy() == pytest.approx(off[:, 2], rel=near, abs=near)
    assert got.lateral_mm.numpy() == pytest.approx(
        off[:, :2].mean(1), rel=near, abs=near
    )
    assert got.interval_mm == pytest.approx((reach * spread).mean(), rel=1e-5)
    assert got.covered == pytest.approx((off[:, 2] <= reach * spread).mean(), abs=1e-6)
    assert got.image_error == 0.043
    made, _, told = judged
    depth = 1e3 / (45 + 8 * made.vergence.numpy())
    read = 1e3 / np.clip(45 + 8 * told[:, 0].numpy(), 1, 200)
    assert got.window_mm.numpy() == pytest.approx(
        np.abs(read - depth).mean((1, 2)), rel=1e-9
    )
    unsure = (read**2 * np.exp(told[:, 1].numpy())).ravel()  # |dz| = z² |d(1/z)|
    surest = np.abs(read - depth).ravel()[np.argsort(unsure)[: unsure.size // 2]]
    assert got.trusted_mm == pytest.approx(surest.mean(), rel=1e-6)
    middle = np.sort(depth.ravel())[(depth.size - 1) // 2]  # torch: the lower of two
    assert got.guess_mm == pytest.approx(np.abs(depth - middle).mean(), rel=1e-9)


def test_few_frames_to_spare_take_their_largest_ratio():
    spare, judged = frames(7, 3), frames(5, 4)  # ceil(0.9 x 8) = 8 of 7
    got = reader._judge(Stand(spare, judged), spare[0], judged[0], math.nan)
    scale = torch.tensor([1.4, 1.2, 2.3])
    off = (spare[1][:, :3] * scale - spare[0].slip_mm).abs()[:, 2]
    reach = float((off / (2.3 * spare[1][:, 5].clamp(-4, 2).exp())).max())
    wide = 2.3 * judged[1][:, 5].clamp(-4, 2).exp()
    assert got.interval_mm == pytest.approx(float(reach * wide.mean()), rel=1e-5)


def test_the_interval_of_the_mean_is_a_bootstrap_over_frames():
    """Of 400 errors: ± 1.96 sigma / √400 about the mean, to the 5 % of 1000 draws."""
    error = torch.from_numpy(np.random.default_rng(6).gamma(3.0, 0.2, 400))
    values = ReaderResult(
        error, 2 * error, 3 * error, 2.5, 0.9, 1.1, 0.01, 0.7
    ).values()
    mean, half = float(error.mean()), 1.96 * float(error.std()) / 20
    assert values["axial_mm"] == pytest.approx(mean)
    assert values["axial_low_mm"] == pytest.approx(mean - half, abs=0.15 * half)
    assert values["axial_high_mm"] == pytest.approx(mean + half, abs=0.15 * half)
    assert (values["lateral_mm"], values["window_mm"]) == pytest.approx(
        (2 * mean, 3 * mean)
    )
    assert values["trusted_mm"] == 0.7


def test_batches_are_of_their_own_rows_and_the_rate_rises_and_falls():
    """One weight pulled by 1 a step: AdamW moves by the rate and decays; OneCycle
    starts at a 25th of it.
    """
    part = torch.nn.Linear(1, 1, bias=False)
    rows, moved = [], []
    torch.manual_seed(3)
    for some in reader._steps(part, 11, 3, 4, rate=1e-2, decay=0.0):
        assert part.training
        rows.append(some.tolist())
        before = float(part.weight.detach())
        part.weight.sum().backward()
        moved.append(before)
    assert not part.training
    assert [len(r) for r in rows] == [
        4
    ] * 6  # two whole batches of 11 rows, three times
    for k in (0, 2, 4):
        assert len(set(rows[k]) | set(rows[k + 1])) == 8
    steps = -np.diff([*moved, float(part.weight.detach())])
    other = torch.optim.AdamW([torch.zeros(1)], lr=1e-2)
    schedule = torch.optim.lr_scheduler.OneCycleLR(other, 1e-2, total_steps=6)
    mean, want = 0.0, []
    for k in range(
        6
    ):  # of a constant slope of 1: its mean about the momentum of the turn, over what is missing of it
        momentum = other.param_groups[0]["betas"][0]
        mean = momentum * mean + (1 - momentum)
        want.append(schedule.get_last_lr()[0] * mean / (1 - momentum ** (k + 1)))
        other.step()
        schedule.step() if k < 5 else None
    assert want[0] == pytest.approx(1e-2 / 25)
    assert steps == pytest.approx(want, rel=1e-3, abs=1e-7)  # float32 weights


def test_the_loss_of_a_slippage_is_huber_s_and_a_tenth_of_the_likelihood(monkeypatch):
    """By finite differences of the formula at two frames; the miss of the likelihood
    pulls the spread alone.
    """
    out = torch.tensor(
        [[0.1, -0.8, 0.3, 0.2, -5.0, 0.4], [1.2, 0.0, -0.4, 3.0, 0.1, -0.6]],
        dtype=torch.float64,
    )
    truth = torch.tensor([[0.2, 0.5, 0.9], [1.0, -0.3, -0.5]], dtype=torch.float64)
    leaf = out.clone().requires_grad_()
    made = SimpleNamespace(slip=lambda features: leaf[features[:, 0].long()])
    seen = SimpleNamespace(
        slip_mm=truth * torch.tensor([1.4, 1.2, 2.3], dtype=torch.float64)
    )
    monkeypatch.setattr(reader, "_features", lambda *_: torch.tensor([[0.0], [1.0]]))
    asked = []

    def steps(part, count, passes, batch, *, rate, decay):
        asked.append((count, passes, batch, rate, decay))
        yield torch.tensor([1, 0])

    monkeypatch.setattr(reader, "_steps", steps)
    reader._learn_slip(made, seen)
    assert asked == [(2, 12, 128, 2e-3, 0.03)]

    def loss(v, held):
        miss = np.abs(v[:, :3] - truth.numpy())
        huber = np.where(miss < 0.3, miss**2 / 0.6, miss - 0.15).mean()
        spread = np.clip(v[:, 3:], -4, 2)
        return huber + 0.1 * (held**2 / 2 * np.exp(-2 * spread) + spread).mean()

    held = out.numpy()[:, :3] - truth.numpy()
    for k in np.ndindex(2, 6):
        step = np.zeros((2, 6))
        step[k] = 1e-6
        want = (loss(out.numpy() + step, held) - loss(out.numpy() - step, held)) / 2e-6
        assert float(leaf.grad[k]) == pytest.approx(
            want, abs=1e-6
        )  # float32 scales of the slippage


def test_depths_are_learned_on_their_windows(monkeypatch):
    asked = []

    def steps(part, count, passes, batch, *, rate, decay):
        asked.append((count, passes, batch, rate, decay))
        yield torch.tensor([1])

    told = torch.zeros(1, 2, 7, 7, requires_grad=True)
    compared = []

    def loss(answer, truth):
        compared.append(truth)
        return answer.sum()

    monkeypatch.setattr(reader, "_steps", steps)
    monkeypatch.setattr(reader.losses, "depth_loss", loss)
    learn = SimpleNamespace(pixels=torch.zeros(2, 1, 9, 9), vergence=torch.arange(2.0))
    reader._learn_depth(SimpleNamespace(branch=lambda _: (told, None)), learn)
    assert asked == [(2, 4, 64, 3e-3, 0.01)]
    assert compared[0].tolist() == [1.0]
    assert float(told.grad.sum()) == 2 * 49


def test_what_the_reader_s_sensor_is():
    config = ReaderConfig(pixels=48, pitch_um=13.0, electrons=1500.0)
    sensor = config.sensor
    assert config.margin == 12  # 144 um of 13: 11.08
    assert (sensor.pitch_um, sensor.base_pitch_um, sensor.exposure_e) == (
        13.0,
        9.0,
        1500.0,
    )
    assert (sensor.ambient_e, sensor.full_well_e, sensor.read_noise_e, sensor.bits) == (
        0.0,
        3000.0,
        5.0,
        10,
    )
    assert blur.FEATURES == 9 * 16 + 1 + 3 * 14


def test_lenses_are_read_through_their_true_images_over_the_depths_in_micrometres(
    monkeypatch,
):
    """The reader itself left out: what it is given to look through is the image of a
    lens file.
    """
    made = []
    monkeypatch.setattr(
        reader,
        "render_scenes",
        lambda config, *, sensor_distance_um: sensor_distance_um,
    )
    monkeypatch.setattr(
        reader, "train_reader", lambda optics, seen, config: made.append((optics, seen))
    )
    config = ReaderConfig(pixels=32, pitch_um=9.0, depths_mm=(2.1, 3.4), tolerance=0.4)
    glass, focus = Layers(behind=(Film(Index(1.5), 60.0),)), Focus(0.85, 300.0, 3000.0)
    wanted = design.phase_of(None, focus, radius_um=18.0)
    bare = design.make(wanted, focus, aperture_um=36.0, cell=m.CELL, proxy=m.PROXY)[0]
    behind = replace(bare, layers=glass)
    assert [name for name, _ in reader.judge_lenses({"glass": behind}, config)] == [
        "glass"
    ]
    ((optics, seen),) = made
    assert seen == pytest.approx(240.0 + 60.0 / 1.5)
    grid = optics.grid
    assert (grid.samples, grid.step_um, grid.depths_um) == (
        (32, 32),
        9.0,
        (2.1e3, 3.4e3),
    )
    assert (grid.margin, grid.window) == (16, 33)  # 144 um
    with pytest.raises(
        ConfigError, match="different sensor distances"
    ):  # 300 and 280 um
        list(reader.judge_lenses({"glass": behind, "air": bare}, config))
