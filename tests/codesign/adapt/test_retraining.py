"""Training on for the lens as built: what is refused and why, resume bit for bit, who
is judged on what.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

import codesign
from characterize.bench.bench import HiddenLens
from characterize.model.parameters import KnownValue
from codesign.adapt import source as finished
from codesign.adapt import train as retraining
from codesign.adapt.train import NetworkAccuracy, RetrainingOutcome
from codesign.optics import image_formation
from codesign.optics.as_built_lens import MadeLens
from codesign.optics.stack import PixelPsfStack
from codesign.settings import RetrainConfig
from codesign.train import assess
from metalens.core.errors import ConfigError, FitError, TrainingError
from metalens.lens.record import DiameterMap
from tests.codesign import made_lens as m

SHORT = RetrainConfig(steps=2, draws=2, judge=1, test_batches=1)
TRUTH = HiddenLens(
    (3000.0,), parameter=tuple(KnownValue(n, v) for n, v in m.TRUE.items())
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("retraining") / "run"
    m.finished_run(path)
    return path


@pytest.fixture(scope="module")
def found():
    return retraining.lens_psfs(MadeLens(m.small(), m.SEEN), m.asbuilt(), SHORT, TRUTH)


def _accuracy(error, n=50):
    return NetworkAccuracy(torch.full((n, 3), error), torch.ones(n))


def test_bars_of_a_gap_and_of_an_accuracy():
    """Frames that both cases share: their common scatter takes no part in the bar of
    the gap.
    """
    generator = torch.Generator().manual_seed(5)
    shared = torch.rand(4000, 1, generator=generator) * 3
    own = torch.randn(4000, 3, generator=generator) * torch.tensor([0.3, 0.6, 0.9])
    better = NetworkAccuracy(
        (shared + torch.tensor([1.0, 2.0, 6.0])).expand(4000, 3),
        torch.full((4000,), 0.75),
    )
    worse = NetworkAccuracy(better.error_mm + 0.21 + own, better.iou)
    told = RetrainingOutcome(better, better, worse, better, None)
    assert told.gap_mm == pytest.approx(0.21, abs=4 * 0.374 / math.sqrt(4000))
    # the mean of three axes scatters by sqrt(0.09 + 0.36 + 0.81) / 3 = 0.374
    assert told.gap_sigma_mm == pytest.approx(0.374 / math.sqrt(4000), rel=0.05)
    told_better = better.values()
    depth = told_better["axial_mm"] - told_better["lateral_mm"]
    assert depth == pytest.approx(4.5, rel=1e-5)
    assert better.slip_mm == pytest.approx(4.5, abs=0.05)
    low, high = (better.values()[f"slip_{end}_mm"] for end in ("low", "high"))
    assert high - low == pytest.approx(
        2 * 1.96 * 3 / math.sqrt(12) / math.sqrt(4000), rel=0.1
    )  # 1000 draws: 3 %
    assert set(told.rows()) == {"designed", "nominal", "before", "after"}
    assert told.rows()["after"]["iou"] == 0.75


def test_share_won_back_is_that_of_the_gap():
    cases = [_accuracy(e) for e in (0.5, 0.4, 0.9, 0.45, 0.44)]
    told = RetrainingOutcome(*cases)
    assert told.gap_mm == pytest.approx(0.5)
    assert told.recovered == pytest.approx(0.9)
    assert replace(told, before=_accuracy(0.4)).recovered is None
    scattered = NetworkAccuracy(
        0.4 + 0.1 * (torch.arange(150.0).reshape(50, 3) % 2 - 0.48), torch.ones(50)
    )
    assert replace(told, before=scattered).gap_mm > 0
    # a gap of 2.0 um, with a standard error of 2.4 um
    assert replace(told, before=scattered).recovered is None
    assert list(told.rows()) == ["designed", "nominal", "before", "after", "known"]
    assert list(replace(told, known=None).rows()) == [
        "designed",
        "nominal",
        "before",
        "after",
    ]


def test_interval_of_the_error_covers_the_mean_as_often_as_it_says():
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(200):
        low, high = assess.bootstrap_interval(rng.exponential(1.0, 200))
        hits += low <= 1.0 <= high
    # 95 %, with the spread of 200 trials and the bootstrap's own bias
    assert 0.88 <= hits / 200 <= 0.99


def test_a_single_subject_has_its_own_value_for_an_interval():
    one, other = np.array([3.0]), np.array([1.5])
    assert assess.bootstrap_interval(one) == (3.0, 3.0)
    assert assess.bootstrap_ratio(one, other) == (2.0, 2.0, 2.0)


def test_the_judge_is_the_truth_where_it_is_known_and_never_a_draw_of_training(found):
    assert found.known
    assert len(found.drawn) == 2
    true = MadeLens(m.small(), m.SEEN).stack(TRUTH.vector())
    assert torch.equal(found.judges[0].intensity, true.intensity)
    blind = retraining.lens_psfs(MadeLens(m.small(), m.SEEN), m.asbuilt(), SHORT)
    assert not blind.known
    assert not any(
        torch.equal(blind.judges[0].intensity, d.intensity) for d in blind.drawn
    )


def test_draws_judge_where_the_truth_is_not_known_and_every_frame_counts_once(folder):
    """As on a real bench: the error of a frame is its mean over the lenses, so one lens
    and three compare.
    """
    config = replace(SHORT, judge=3)
    source = finished.load_finished_run(folder)
    blind = retraining.lens_psfs(MadeLens(m.small(), m.SEEN), m.asbuilt(), config)
    going = retraining.make_trainer(source, config, (blind.nominal,))
    told = retraining.retraining_outcome(
        source, config, blind, {"nominal": going, "retrained": going}
    )
    assert told.known is None
    assert told.gap_sigma_mm > 0
    frames = retraining.render_test_frames(source, config)
    apart = [
        retraining.judge_network(going, source, config, (one,), frames=frames)
        for one in blind.judges
    ]
    assert len(apart) == 3
    assert (
        told.before.error_mm.shape
        == apart[0].error_mm.shape
        == (source.settings.inner.batch, 3)
    )
    mean = sum(one.error_mm for one in apart) / 3
    assert torch.allclose(told.before.error_mm, mean, rtol=1e-6, atol=0)
    assert told.before.slip_mm == pytest.approx(
        sum(one.slip_mm for one in apart) / 3, rel=1e-6
    )


def test_a_job_stopped_and_resumed_ends_bit_for_bit_the_same(folder, found, tmp_path):
    source = finished.load_finished_run(folder)
    whole = retraining.make_trainer(
        source, SHORT, retraining.training_stacks(found)["retrained"]
    )
    list(retraining.run_job(whole, tmp_path / "whole", SHORT))
    first = retraining.run_job(
        retraining.make_trainer(
            source, SHORT, retraining.training_stacks(found)["retrained"]
        ),
        tmp_path / "part",
        SHORT,
        every=1,
    )
    next(first), next(first)  # the checkpoint of step 1 is written
    second = retraining.make_trainer(
        source, SHORT, retraining.training_stacks(found)["retrained"]
    )
    list(retraining.run_job(second, tmp_path / "part", SHORT))
    for a, b in zip(
        whole.model.net.state_dict().values(),
        second.model.net.state_dict().values(),
        strict=True,
    ):
        assert torch.equal(a, b)
    before = source.run.trainer.model.net.state_dict()
    assert any(
        not torch.equal(before[n], v) for n, v in whole.model.net.state_dict().items()
    )


def test_only_weights_move(folder, found):
    source = finished.load_finished_run(folder)
    going = retraining.make_trainer(
        source, SHORT, retraining.training_stacks(found)["known"]
    )
    list(going.run())
    assert torch.equal(
        going.model.coefficients_rad, source.run.trainer.model.coefficients_rad
    )
    assert torch.equal(going.model.log_pitch, source.run.trainer.model.log_pitch)


def test_the_whole_story_in_one_call(folder):
    told = codesign.retrain_network(folder, m.asbuilt(), config=SHORT, truth=TRUTH)
    assert all(
        np.isfinite(v).all() for row in told.rows().values() for v in row.values()
    )
    assert told.known is not None


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("result.json", "half-written run: result.json missing; finish it with"),
        ("checkpoint.safetensors", "half-written run: checkpoint"),
        ("lens.h5", "half-written run: lens.h5 missing"),
    ],
)
def test_half_written_runs_are_named(folder, tmp_path, name, message):
    for path in folder.iterdir():
        if path.name != name:
            (tmp_path / path.name).write_bytes(path.read_bytes())
    with pytest.raises(TrainingError, match=message):
        finished.load_finished_run(tmp_path)


def test_no_run_and_a_result_that_is_cut_or_of_another_version_are_named(
    folder, tmp_path
):
    with pytest.raises(
        TrainingError,
        match=r"is no run folder: .* give the folder that `metalens codesign",
    ):
        finished.load_finished_run(tmp_path)
    for path in folder.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / "result.json").write_text((folder / "result.json").read_text()[:-9])
    with pytest.raises(TrainingError, match="cut short or of another version"):
        finished.load_finished_run(tmp_path)
    with pytest.raises(TrainingError, match="no network of 7 MMACs; its budgets are 2"):
        finished.load_finished_run(folder, budget_mmacs=7.0)


@pytest.mark.parametrize("take_up", [finished.load_finished_run, finished.rows_of])
def test_a_retraining_is_no_run_and_said_to_be_none(folder, tmp_path, take_up):
    for name in ("retrain.toml", "result.json"):
        (tmp_path / name).write_text("{}")
    with pytest.raises(
        TrainingError,
        match=r"holds a retraining, no run: .* give the folder that `metalens codesign",
    ):
        take_up(tmp_path)


def test_a_fit_of_another_lens_or_a_refused_one_is_refused():
    d = m.small().diameters
    other = np.where(d.diameter_um > 0, np.clip(d.diameter_um + 0.003, 0, 0.33), 0)
    foreign = replace(m.small(), diameters=DiameterMap(other, d.pitch_um))
    with pytest.raises(
        FitError, match=r"another lens: designed diameters differ by up to 3\.0 nm"
    ):
        finished.check_lens(m.small(), m.asbuilt(made=foreign))
    wider = replace(m.small(), diameters=DiameterMap(d.diameter_um[1:], d.pitch_um))
    with pytest.raises(FitError, match="another lens"):
        finished.check_lens(m.small(), m.asbuilt(made=wider))
    refused = m.asbuilt(problems=("chi2 is 3",))
    with pytest.raises(FitError, match="refused by its own checks: chi2 is 3"):
        finished.check_lens(m.small(), refused)
    finished.check_lens(m.small(), refused, insist=True)


def test_a_made_lens_images_truly_as_its_pillars_do(found):
    """The image through the lens plane on axis has the PSFs of the made lens: an engine
    of its own gave those.

    Budget: 3 % of the image's tolerance, and the squares of a sample that its PSFs are
    averaged over, 5 %.
    """
    settings = replace(m.SEEN, image="true", image_tolerance=0.1)
    made = image_formation.make_imager(
        settings, torch.zeros(0), 43, margin=4, made=found.judges[0]
    )
    other = image_formation.make_imager(
        settings, torch.zeros(0), 43, margin=4, made=found.nominal
    )
    assert made is image_formation.make_imager(
        settings, torch.zeros(0), 43, margin=4, made=found.judges[0]
    )
    centres = [
        image.stack[tuple(n // 2 for n in image.stack.shape[:2])]
        for image in (made, other)
    ]
    moved, told = (
        float((a - b).norm() / b.norm())
        for a, b in (centres, _units(found.judges[0], found.nominal))
    )
    # depths differ: the image places its own nodes
    assert moved == pytest.approx(told, rel=0.35)
    bare = PixelPsfStack(found.nominal.intensity, found.nominal.depths_um)
    with pytest.raises(TrainingError, match="PSFs on axis alone"):
        image_formation.make_imager(settings, torch.zeros(0), 43, margin=4, made=bare)


def _units(*stacks):
    return [s.intensity / s.intensity.sum((-2, -1), keepdim=True) for s in stacks]


def test_impossible_settings_are_refused():
    with pytest.raises(ConfigError, match="draws"):
        RetrainConfig(draws=0)
