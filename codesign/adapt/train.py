"""The network trained on for the lens that was made: the inner loop on its PSFs, with
the optics fixed.

Training draws a lens from the posterior of the fit at every step, so the network trusts
no parameter more than the
captures do. What retraining bought is measured against three others: the nominal lens,
the made lens before, and, on
a virtual bench, a network that was trained with the truth known.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from characterize.bench import Truth
from characterize.inference import AsBuilt
from codesign.adapt import reading
from codesign.adapt.reading import Accuracy
from codesign.adapt.settings import RetrainConfig
from codesign.adapt.source import (
    Source,
    architecture_of,
    check_lens,
    lens_file,
    load,
    rows_of,
)
from codesign.batches import TEST
from codesign.network import recalibrate
from codesign.optics import MadeLens, Stack, built
from codesign.train import (
    Batch,
    InnerConfig,
    Record,
    Scenes,
    Schedule,
    Seen,
    Trainer,
    assess,
    checkpoint,
    model,
    place,
)

APART = 7919  # between the seeds of retrainings: no step of one is a step of another
JOBS = (
    "nominal",
    "retrained",
    "known",
)  # networks that are trained on: for the design, the fit, and the truth


@dataclass(frozen=True, eq=False, slots=True)
class Lenses:
    """PSFs of the lens in question.

    nominal: as designed. best: of the fitted values. drawn: from the posterior, for
    training. judges: those that
    judge: the truth where it is known, else further draws. known: whether it is.
    """

    nominal: Stack
    best: Stack
    drawn: tuple[Stack, ...]
    judges: tuple[Stack, ...]
    known: bool


def gap_sigma_mm(worse: Accuracy, better: Accuracy) -> float:
    """Standard error of the difference of two mean slippage errors over the frames,
    which both cases share.
    """
    apart = (worse.error_mm - better.error_mm).mean(1)
    return float(apart.std()) / math.sqrt(len(apart))


@dataclass(frozen=True, eq=False, slots=True)
class Outcome:
    """Accuracy in the order of the story.

    designed: the run's network on the nominal lens, as it was. nominal: trained on for
    the nominal lens just as long,
    so that the others are not credited with more training. before: that network on the
    made lens. after: retrained on
    the fit. known: trained on with the truth known; None on a real bench.
    """

    designed: Accuracy
    nominal: Accuracy
    before: Accuracy
    after: Accuracy
    known: Accuracy | None

    @property
    def gap_mm(self) -> float:
        """What the made lens costs an unwarned network."""
        return self.before.slip_mm - self.nominal.slip_mm

    @property
    def gap_sigma_mm(self) -> float:
        """Standard error of the gap."""
        return gap_sigma_mm(self.before, self.nominal)

    @property
    def recovered(self) -> float | None:
        """Share of the gap that retraining wins back; None where the gap is within two
        of its standard errors.
        """
        if self.gap_mm <= 2 * self.gap_sigma_mm:
            return None
        return (self.before.slip_mm - self.after.slip_mm) / self.gap_mm

    @property
    def above(self) -> str:
        """Why the error of some case's images is above what the run asks for, of the
        made lens first; empty where none
        is."""
        return self.after.above or self.designed.above

    def rows(self) -> dict[str, dict[str, float]]:
        """Numbers by name of the case."""
        cases = {
            n: getattr(self, n)
            for n in ("designed", "nominal", "before", "after", "known")
        }
        return {name: case.values() for name, case in cases.items() if case is not None}


def lenses(
    made: MadeLens, result: AsBuilt, config: RetrainConfig, truth: Truth | None = None
) -> Lenses:
    """PSFs of the nominal, fitted, drawn and (where known) true lens."""
    rows = list(built.posterior(result, config.draws + config.judge, seed=config.seed))
    drawn = tuple(made.stack(x) for x in rows[: config.draws])
    judging = rows[config.draws :] if truth is None else [truth.vector()]
    best = made.stack(result.parameters())
    return Lenses(
        made.stack(),
        best,
        drawn,
        tuple(made.stack(x) for x in judging),
        truth is not None,
    )


def trainer(source: Source, config: RetrainConfig, stacks: Sequence[Stack]) -> Trainer:
    """The inner loop of the run, from its trained weights and where it is placed, on
    given PSFs; only weights move.
    """
    settings, origin = source.settings, source.run.trainer
    fresh = model(
        settings.optics, pitch_um=settings.run.pitch_um, seed=settings.inner.seed, space=settings.space,
    )  # fmt: skip
    fresh.net.load_state_dict(origin.model.net.state_dict())
    with torch.no_grad():
        fresh.coefficients_rad.copy_(origin.model.coefficients_rad)
        fresh.log_pitch.copy_(origin.model.log_pitch)
    made = Trainer(
        fine_tuning(settings.inner, config), settings.optics, origin.sensor, origin.scenes, fresh,
        architecture=source.architecture, stacks=stacks,
    )  # fmt: skip
    place(made, origin.light.device)
    return made


def fine_tuning(inner: InnerConfig, config: RetrainConfig) -> InnerConfig:
    """The inner loop's settings for training on."""
    still = Schedule(0.0)
    return replace(
        inner, steps=config.steps, seed=inner.seed + APART * (config.seed + 1),
        weights=replace(inner.weights, rate=config.rate, start=0.0, end=1.0), optics=still, pitch=still,
    )  # fmt: skip


def job(source: Source, config: RetrainConfig, found: Lenses, name: str) -> Trainer:
    """The training of one of :data:`JOBS`."""
    return trainer(
        source,
        config,
        {"nominal": (found.nominal,), "retrained": found.drawn, "known": found.judges}[
            name
        ],
    )


def jobs(found: Lenses) -> tuple[str, ...]:
    """Networks that can be trained: with the truth only where it is known."""
    return JOBS if found.known else JOBS[:2]


def train(
    going: Trainer, path: Path, settings: object, *, every: int = 50
) -> Iterator[Record]:
    """Run one job to its end, from where it stands, with checkpoints in ``path``; a
    record a step.
    """
    for record in going.run():
        yield record
        if record.step % every == 0 or record.step == going.inner.steps:
            checkpoint.save(path, {"trainer": going.state()}, settings=settings)


def settle(going: Trainer, source: Source, *, batches: int = 8) -> None:
    """Measure the batch statistics on training frames through the lenses that the
    network was trained for.

    Never on frames that judge: a network that nobody warned of the made lens knows none
    of its images.
    """
    frames = []
    for number in range(batches):
        made = going.light.stacks[number % len(going.light.stacks)]
        step = _Step(going.scenes, number)
        frames.append(assess.frames(going, step, 1, stack=made).frames)
    recalibrate(going.model.net, source.architecture, frames)


@dataclass(frozen=True, slots=True)
class _Step:
    """One batch of scenes."""

    scenes: Scenes
    number: int

    @property
    def margin(self) -> int:
        """Samples around the frames."""
        return self.scenes.margin

    def batch(self, step: int, size: int) -> Batch:
        """The batch, whatever ``step``."""
        return self.scenes.batch(self.number, size)


@dataclass(frozen=True, eq=False, slots=True)
class Held:
    """Frames that judge, rendered once for every case."""

    batches: tuple[Batch, ...]
    margin: int
    stream: int

    def batch(self, step: int, size: int) -> Batch:
        """Batch number ``step``, of the size that it was rendered in."""
        return self.batches[step]


def held(source: Source, config: RetrainConfig) -> Held:
    """The test frames of a run, that no training sees."""
    scenes = source.run.scenes(TEST)
    size = source.settings.inner.batch
    return Held(
        tuple(scenes.batch(n, size) for n in range(config.test_batches)),
        scenes.margin,
        scenes.stream,
    )


def judge(
    going: Trainer,
    source: Source,
    config: RetrainConfig,
    stacks: Sequence[Stack],
    *,
    frames: Held | None = None,
    finer: bool = True,
) -> Accuracy:
    """Errors on test frames, each the mean over these lenses: the frames are what all
    cases share.

    Args:
        frames: of :func:`held`, where several cases are judged.
        finer: judge on images formed at a quarter of the tolerance too.
    """
    settle(going, source)
    frames = frames or held(source, config)
    own, fine = [], []
    for made in stacks[: config.judge]:
        seen = assess.frames(going, frames, config.test_batches, stack=made)
        own.append(_read(going, source, seen))
        more = (going, frames, config.test_batches) if finer else None
        exact = more and assess.finer_frames(*more, stack=made)
        if exact is not None:
            fine.append(_read(going, source, exact))
    whole = _mean(own)
    return replace(whole, finer=_mean(fine)) if len(fine) == len(own) else whole


def _read(going: Trainer, source: Source, seen: Seen) -> Accuracy:
    answers = assess.predict(going.model.net, source.architecture, seen, going.inner)
    return reading.accuracy(answers, seen)


def _mean(parts: Sequence[Accuracy]) -> Accuracy:
    """Errors frame by frame, each the mean over lenses."""
    error, iou = (
        torch.stack([getattr(p, name) for p in parts]).mean(0)
        for name in ("error_mm", "iou")
    )
    return Accuracy(error, iou, next((p.above for p in parts if p.above), ""))


def outcome(
    source: Source, config: RetrainConfig, found: Lenses, trained: dict[str, Trainer]
) -> Outcome:
    """Accuracy of all cases, on the same test frames."""
    nominal, frames = (found.nominal,), held(source, config)
    untouched = trainer(source, config, nominal)

    def of(going: Trainer, stacks: Sequence[Stack]) -> Accuracy:
        return judge(going, source, config, stacks, frames=frames)

    return Outcome(
        designed=of(untouched, nominal),
        nominal=of(trained["nominal"], nominal),
        before=of(trained["nominal"], found.judges),
        after=of(trained["retrained"], found.judges),
        known=of(trained["known"], found.judges) if found.known else None,
    )


def retrain(
    folder: Path,
    result: AsBuilt,
    *,
    config: RetrainConfig | None = None,
    truth: Truth | None = None,
) -> Outcome:
    """A finished run's network trained on for the lens that was made, in one call;
    ``metalens retrain`` keeps files.

    Args:
        folder: of ``metalens codesign``. result: of ``metalens fit`` for that run's
            lens.h5.
        truth: of the virtual bench, where there is one.

    Raises:
        TrainingError: the run is missing, half written or of another version.
        FitError: the record is of another lens, or its fit was refused.
    """
    from metalens import lens as lens_files

    config = config or RetrainConfig()
    source = load(folder, budget_mmacs=config.budget_mmacs)
    design = lens_files.load(
        lens_file(folder, source.settings, source.row["budget_mmacs"])
    )
    check_lens(design, result)
    found = lenses(
        MadeLens(design, source.settings.optics, response=result.response),
        result,
        config,
        truth,
    )
    trained = {name: job(source, config, found, name) for name in jobs(found)}
    for going in trained.values():
        for _ in going.run():
            pass
    return outcome(source, config, found, trained)


__all__ = [
    "Accuracy", "Held", "Lenses", "Outcome", "RetrainConfig", "Source", "architecture_of", "check_lens",
    "fine_tuning", "held", "job", "jobs", "judge", "lenses", "load", "outcome", "retrain", "rows_of",
    "train", "trainer",
]  # fmt: skip
