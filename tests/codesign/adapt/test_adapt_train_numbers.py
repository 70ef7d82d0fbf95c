"""Training on part by part, by lenses and frames that are names: which lens trains,
which judges, what is kept when.
"""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from codesign.adapt import train as retraining
from codesign.adapt.reading import Accuracy
from codesign.adapt.settings import RetrainConfig
from codesign.adapt.train import Lenses, Outcome
from codesign.train import InnerConfig
from codesign.train.moving import Schedule

CONFIG = RetrainConfig(draws=3, judge=2, seed=6, test_batches=4)


@pytest.mark.parametrize("truth", [None, SimpleNamespace(vector=lambda: "truth")])
def test_lenses_that_judge_are_none_that_train(monkeypatch, truth):
    asked = []
    monkeypatch.setattr(
        retraining.built,
        "posterior",
        lambda result, count, *, seed: asked.append((count, seed)) or iter("abcde"),
    )
    made = SimpleNamespace(stack=lambda x=None: f"lens {x}")
    found = retraining.lenses(
        made, SimpleNamespace(parameters=lambda: "fit"), CONFIG, truth
    )
    assert asked == [(5, 6)]
    assert (found.nominal, found.best) == ("lens None", "lens fit")
    assert found.drawn == ("lens a", "lens b", "lens c")
    assert found.judges == (("lens truth",) if truth else ("lens d", "lens e"))
    assert found.known is (truth is not None)
    assert retraining.jobs(found) == (
        ("nominal", "retrained", "known") if truth else ("nominal", "retrained")
    )


def test_a_job_trains_on_its_own_lenses(monkeypatch):
    monkeypatch.setattr(retraining, "trainer", lambda source, config, stacks: stacks)
    found = Lenses("design", "fit", ("a", "b"), ("c",), True)
    told = {name: retraining.job(None, CONFIG, found, name) for name in retraining.JOBS}
    assert told == {"nominal": ("design",), "retrained": ("a", "b"), "known": ("c",)}


def test_a_job_is_kept_at_every_so_many_steps_and_at_its_end(monkeypatch):
    kept = []
    monkeypatch.setattr(
        retraining.checkpoint,
        "save",
        lambda path, state, *, settings: kept.append((state["trainer"], settings)),
    )
    at = SimpleNamespace(inner=SimpleNamespace(steps=107))

    def run():
        for step in range(1, 108):
            at.state = lambda step=step: step
            yield SimpleNamespace(step=step)

    at.run = run
    assert len(list(retraining.train(at, "path", "settings"))) == 107
    assert kept == [(50, "settings"), (100, "settings"), (107, "settings")]
    kept.clear()
    assert len(list(retraining.train(at, "path", "settings", every=40))) == 107
    assert [step for step, _ in kept] == [40, 80, 107]


def test_statistics_are_measured_on_training_frames_through_the_lenses_in_turn(
    monkeypatch,
):
    asked = []

    def frames(going, scenes, count, *, stack):
        asked.append((scenes.batch(99, 12), scenes.margin, count, stack))
        return SimpleNamespace(frames=f"frames {len(asked)}")

    scenes = SimpleNamespace(margin=5, batch=lambda number, size: (number, size))
    going = SimpleNamespace(
        scenes=scenes, light=SimpleNamespace(stacks=("a", "b", "c"))
    )
    monkeypatch.setattr(retraining.assess, "frames", frames)
    monkeypatch.setattr(retraining, "network", lambda going: "net")
    told = []
    monkeypatch.setattr(retraining, "recalibrate", lambda *about: told.append(about))
    retraining.settle(going, SimpleNamespace(architecture="member"), batches=5)
    assert asked == [((k, 12), 5, 1, "abcab"[k]) for k in range(5)]
    assert told == [("net", "member", [f"frames {k}" for k in range(1, 6)])]
    asked.clear()
    retraining.settle(going, SimpleNamespace(architecture="member"))
    assert len(asked) == 8


def test_test_frames_are_rendered_once_in_batches_of_the_run():
    streams = []
    scenes = SimpleNamespace(
        margin=5, stream=2, batch=lambda number, size: (number, size)
    )
    run = SimpleNamespace(scenes=lambda stream: streams.append(stream) or scenes)
    source = SimpleNamespace(
        run=run, settings=SimpleNamespace(inner=SimpleNamespace(batch=12))
    )
    held = retraining.held(source, CONFIG)
    assert streams == [2]  # those of the test, which no training sees
    assert held.batches == ((0, 12), (1, 12), (2, 12), (3, 12))
    assert (held.margin, held.stream, held.batch(3, 7)) == (5, 2, (3, 12))


def test_an_error_is_the_mean_over_as_many_lenses_as_judge(monkeypatch):
    """Two of three: 1 and 4 mm, 0.5 and 0.9 of overlap; the first reason that there is."""
    by_lens = {
        "a": (1.0, 0.5, ""),
        "b": (4.0, 0.9, "too coarse"),
        "c": (70.0, 0.0, "never seen"),
    }
    asked = []

    def frames(going, scenes, count, *, stack):
        asked.append((scenes, count))
        return stack

    def accuracy(answers, seen):
        error, iou, above = by_lens[seen]
        return Accuracy(torch.full((3, 3), error), torch.full((3,), iou), above)

    monkeypatch.setattr(
        retraining, "settle", lambda going, source: asked.append("settled")
    )
    monkeypatch.setattr(retraining.assess, "frames", frames)
    monkeypatch.setattr(
        retraining.assess, "predict", lambda net, member, seen, inner: None
    )
    monkeypatch.setattr(retraining.reading, "accuracy", accuracy)
    going = SimpleNamespace(model=SimpleNamespace(net="net"), inner="inner")
    found = retraining.judge(
        going,
        SimpleNamespace(architecture="member"),
        CONFIG,
        ("a", "b", "c"),
        frames="frames",
    )
    assert asked == ["settled", ("frames", 4), ("frames", 4)]
    assert found.error_mm.tolist() == [[2.5] * 3] * 3
    assert found.iou.tolist() == pytest.approx([0.7] * 3)
    assert found.above == "too coarse"


def errors(*frames):
    """Frames of one error along all axes."""
    return Accuracy(
        torch.tensor(frames)[:, None].expand(len(frames), 3), torch.ones(len(frames))
    )


def test_the_bar_of_a_gap_is_of_differences_frame_by_frame():
    """Differences 0.2, 0.6, 1.0, 1.4 over 0.8: squares 0.36, 0.04, 0.04, 0.36 over 3,
    of the mean of four. A gap of
    twice its bar is none; of what is above that 0.5 of 0.8 is won back."""
    nominal, before = errors(1.0, 2.0, 0.5, 4.0), errors(1.2, 2.6, 1.5, 5.4)
    told = Outcome(
        errors(9.0),
        nominal,
        before,
        replace(before, error_mm=before.error_mm - 0.5),
        None,
    )
    sigma = (0.8 / 3 / 4) ** 0.5
    assert told.gap_mm == pytest.approx(0.8, rel=1e-6)
    assert told.gap_sigma_mm == pytest.approx(sigma, rel=1e-6)
    assert retraining.gap_sigma_mm(nominal, before) == pytest.approx(sigma, rel=1e-6)
    assert told.recovered == pytest.approx(0.625, rel=1e-5)
    alike = errors(1.0, 1.0)
    assert (
        Outcome(alike, alike, alike, alike, None).recovered is None
    )  # no gap and no bar


@pytest.mark.parametrize(
    ("share", "counted"), [(1.2, False), (1.98, False), (2.02, True)]
)
def test_a_gap_counts_from_two_of_its_bars_on(share, counted):
    """Differences of a gap -+ 0.3 over 10 frames: a bar of 0.3 sqrt(10 / 9) / sqrt(10)
    = 0.1.
    """
    nominal = errors(*[1.0] * 10)
    before = errors(*(1.0 + 0.1 * share + 0.3 * (-1) ** k for k in range(10)))
    told = Outcome(nominal, nominal, before, nominal, None)
    assert told.gap_sigma_mm == pytest.approx(0.1, rel=1e-5)
    assert (told.recovered is not None) == counted


def test_what_is_wrong_with_images_is_told_of_the_made_lens_first():
    plain, bad, worse = (
        errors(1.0),
        replace(errors(1.0), above="made"),
        replace(errors(1.0), above="designed"),
    )
    assert Outcome(worse, plain, plain, bad, None).above == "made"
    assert Outcome(worse, plain, plain, plain, None).above == "designed"
    assert Outcome(plain, plain, plain, plain, None).above == ""


def test_seeds_lie_apart_by_a_prime_and_weights_move_to_the_end():
    """7919 a retraining, the first one included; the batch is the run's."""
    run = InnerConfig(seed=5, batch=12, weights=Schedule(3e-3, 0.25, 0.75, clip=0.4))
    for seed, want in ((0, 7_924), (1, 15_843), (6, 55_438)):
        made = retraining.fine_tuning(
            run, RetrainConfig(seed=seed, steps=33, rate=7e-4)
        )
        assert (made.seed, made.steps, made.batch) == (want, 33, 12)
        assert made.weights == Schedule(7e-4, 0.0, 1.0, clip=0.4)
        assert made.optics == made.pitch == Schedule(0.0)


def test_without_frames_the_run_s_own_test_frames_judge(monkeypatch):
    seen = []
    monkeypatch.setattr(retraining, "settle", lambda going, source: None)
    monkeypatch.setattr(retraining, "held", lambda source, config: "held")
    monkeypatch.setattr(
        retraining.assess,
        "frames",
        lambda going, scenes, count, *, stack: seen.append(scenes),
    )
    monkeypatch.setattr(retraining.assess, "predict", lambda *about: None)
    monkeypatch.setattr(
        retraining.reading, "accuracy", lambda answers, shown: errors(1.0, 2.0)
    )
    going = SimpleNamespace(model=SimpleNamespace(net="net"), inner="inner")
    retraining.judge(going, SimpleNamespace(architecture="member"), CONFIG, ("a",))
    assert seen == ["held"]
