"""The network trained on for the lens that was made: the inner loop on its PSFs, with
the optics fixed.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from characterize.bench import HiddenLens
from characterize.inference import AsBuilt
from codesign.adapt.source import FinishedRun, check_lens, lens_file, load_finished_run
from codesign.batches import TEST, FrameBatch
from codesign.optics import MadeLens, PixelPsfStack, built
from codesign.settings import RetrainConfig
from codesign.train import (
    InnerConfig,
    LearningRateSchedule,
    LogRecord,
    SensorFrames,
    Trainer,
    assess,
    checkpoint,
    make_model,
    place_on_device,
)
from metalens import lens as lenses

APART = 7919  # between the seeds of retrainings: no step of one is a step of another
JOBS = (
    "nominal",
    "retrained",
    "known",
)  # networks that are trained on: for the design, the fit, and the truth


@dataclass(frozen=True, eq=False, slots=True)
class NetworkAccuracy:
    """Errors of one network on one lens: (n,) absolute errors of the slippage, mean
    over axes and along each, in mm.

    The error that the studies speak of is ``slip_mm``, the mean over the three axes.

    above: why the error of the images that were read is above what their run asks for;
    empty where it is not.
    finer: the same on images formed at a quarter of the tolerance; None where they are
    not known.
    """

    error_mm: Tensor
    iou: Tensor
    above: str = ""
    finer: "NetworkAccuracy | None" = None

    @property
    def slip_mm(self) -> float:
        """Mean over frames and axes."""
        return float(self.error_mm.mean())

    @property
    def axial_mm(self) -> float:
        """Mean error of the distance."""
        return float(self.error_mm[:, 2].mean())

    @property
    def lateral_mm(self) -> float:
        """Mean error across."""
        return float(self.error_mm[:, :2].mean())

    def interval_mm(self, *, draws: int = 1000, seed: int = 0) -> tuple[float, float]:
        """95 % interval of ``slip_mm`` by a bootstrap over frames.

        Args:
            draws: resamples of the bootstrap. seed: of the random generator.
        """
        low, high = assess.bootstrap_interval(
            self.error_mm.mean(1).double().numpy(), draws=draws, seed=seed
        )
        return low, high

    def _beside(self, fine: "NetworkAccuracy") -> dict[str, float]:
        return {
            "finer_slip_mm": fine.slip_mm,
            "finer_axial_mm": fine.axial_mm,
            "finer_ratio": fine.slip_mm / self.slip_mm,
        }

    def values(self) -> dict[str, float]:
        """The numbers by name, for tables and JSON."""
        low, high = self.interval_mm()
        fine = {} if self.finer is None else self._beside(self.finer)
        return fine | {
            "slip_mm": self.slip_mm,
            "slip_low_mm": low,
            "slip_high_mm": high,
            "axial_mm": self.axial_mm,
            "lateral_mm": self.lateral_mm,
            "iou": float(self.iou.mean()),
        }


@dataclass(frozen=True, eq=False, slots=True)
class LensPsfs:
    """PSFs of the lens in question.

    nominal: as designed. best: of the fitted values. drawn: from the posterior, for
    training. judges: those that
    judge: the truth where it is known, else further draws. known: whether it is.
    """

    nominal: PixelPsfStack
    best: PixelPsfStack
    drawn: tuple[PixelPsfStack, ...]
    judges: tuple[PixelPsfStack, ...]
    known: bool


def gap_sigma_mm(worse: NetworkAccuracy, better: NetworkAccuracy) -> float:
    """Standard error of the difference of two mean slippage errors over the frames,
    which both cases share.

    Args:
        worse: case with the larger error. better: case with the smaller error.
    """
    apart = (worse.error_mm - better.error_mm).mean(1)
    return float(apart.std()) / math.sqrt(len(apart))


@dataclass(frozen=True, eq=False, slots=True)
class RetrainingOutcome:
    """Accuracy in the order of the story.

    designed: the run's network on the nominal lens, as it was. nominal: trained on for
    the nominal lens just as long,
    so that the others are not credited with more training. before: that network on the
    made lens. after: retrained on
    the fit. known: trained on with the truth known; None on a real bench.
    """

    designed: NetworkAccuracy
    nominal: NetworkAccuracy
    before: NetworkAccuracy
    after: NetworkAccuracy
    known: NetworkAccuracy | None

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


def lens_psfs(
    made: MadeLens,
    result: AsBuilt,
    config: RetrainConfig,
    truth: HiddenLens | None = None,
) -> LensPsfs:
    """PSFs of the nominal, fitted, drawn and (where known) true lens.

    Args:
        made: lens ready for perturbations. result: of the fit.
        config: of the retraining. truth: lens of a virtual bench; None of a real one.
    """
    rows = list(
        built.posterior_parameters(
            result, config.draws + config.judge, seed=config.seed
        )
    )
    drawn = tuple(made.stack(x) for x in rows[: config.draws])
    judging = rows[config.draws :] if truth is None else [truth.vector()]
    best = made.stack(result.parameters())
    return LensPsfs(
        made.stack(),
        best,
        drawn,
        tuple(made.stack(x) for x in judging),
        truth is not None,
    )


def make_trainer(
    source: FinishedRun, config: RetrainConfig, stacks: Sequence[PixelPsfStack]
) -> Trainer:
    """The inner loop of the run, from its trained weights and where it is placed, on
    given PSFs; only weights move.

    Args:
        source: finished run: its network, lens and sensor. config: of the retraining.
        stacks: PSFs of made lenses.
    """
    settings, origin = source.settings, source.run.trainer
    fresh = make_model(
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
    place_on_device(made, origin.light.device)
    return made


def fine_tuning(inner: InnerConfig, config: RetrainConfig) -> InnerConfig:
    """The inner loop's settings for training on.

    Args:
        config: of the retraining.
    """
    still = LearningRateSchedule(0.0)
    return replace(
        inner, steps=config.steps, seed=inner.seed + APART * (config.seed + 1),
        weights=replace(inner.weights, rate=config.rate, start=0.0, end=1.0), optics=still, pitch=still,
    )  # fmt: skip


def make_job(
    source: FinishedRun, config: RetrainConfig, found: LensPsfs, name: str
) -> Trainer:
    """The training of one of :data:`JOBS`.

    Args:
        source: finished run: its network, lens and sensor. config: of the retraining.
        found: PSFs of the lenses in question. name: of the job.
    """
    return make_trainer(
        source,
        config,
        {"nominal": (found.nominal,), "retrained": found.drawn, "known": found.judges}[
            name
        ],
    )


def available_jobs(found: LensPsfs) -> tuple[str, ...]:
    """Networks that can be trained: with the truth only where it is known.

    Args:
        found: PSFs of the lenses in question.
    """
    return JOBS if found.known else JOBS[:2]


def run_job(
    going: Trainer, path: Path, settings: object, *, every: int = 50
) -> Iterator[LogRecord]:
    """Run one job to its end, from where it stands, with checkpoints in ``path``; a
    record a step.

    Args:
        going: training with its network. settings: record that a resume compares.
        every: steps from checkpoint to checkpoint.
    """
    for record in going.run():
        yield record
        if record.step % every == 0 or record.step == going.inner.steps:
            checkpoint.save(path, {"trainer": going.state()}, settings=settings)


@dataclass(frozen=True, eq=False, slots=True)
class TestFrames:
    """Frames that judge, rendered once for every case."""

    batches: tuple[FrameBatch, ...]
    margin: int
    stream: int

    def batch(self, step: int, size: int) -> FrameBatch:
        """Batch number ``step``, of the size that it was rendered in."""
        return self.batches[step]


def render_test_frames(source: FinishedRun, config: RetrainConfig) -> TestFrames:
    """The test frames of a run, that no training sees.

    Args:
        source: finished run: its network, lens and sensor. config: of the retraining.
    """
    scenes = source.run.scenes(TEST)
    size = source.settings.inner.batch
    return TestFrames(
        tuple(scenes.batch(n, size) for n in range(config.test_batches)),
        scenes.margin,
        scenes.stream,
    )


def judge_network(
    going: Trainer,
    source: FinishedRun,
    config: RetrainConfig,
    stacks: Sequence[PixelPsfStack],
    *,
    frames: TestFrames | None = None,
    finer: bool = True,
) -> NetworkAccuracy:
    """Errors on test frames, each the mean over these lenses: the frames are what all
    cases share.

    Args:
        frames: of :func:`render_test_frames`, where several cases are judged.
        finer: judge on images formed at a quarter of the tolerance too.
        going: training with its network.
        source: finished run: its network, lens and sensor. config: of the retraining.
        stacks: PSFs of made lenses.
    """
    assess.recalibrate_network(going, source.architecture)
    frames = frames or render_test_frames(source, config)
    own, fine = [], []
    for made in stacks[: config.judge]:
        seen = assess.sensor_frames(going, frames, config.test_batches, stack=made)
        own.append(_read(going, source, seen))
        more = (going, frames, config.test_batches) if finer else None
        exact = more and assess.finer_frames(*more, stack=made)
        if exact is not None:
            fine.append(_read(going, source, exact))
    whole = _mean(own)
    return replace(whole, finer=_mean(fine)) if len(fine) == len(own) else whole


def _read(going: Trainer, source: FinishedRun, seen: SensorFrames) -> NetworkAccuracy:
    answers = assess.predict_frames(
        going.model.net, source.architecture, seen, going.inner
    )
    error = (answers.slip_mm - seen.slip_mm).abs()
    return NetworkAccuracy(error, answers.iou, seen.above)


def _mean(parts: Sequence[NetworkAccuracy]) -> NetworkAccuracy:
    """Errors frame by frame, each the mean over lenses."""
    error, iou = (
        torch.stack([getattr(p, name) for p in parts]).mean(0)
        for name in ("error_mm", "iou")
    )
    return NetworkAccuracy(error, iou, next((p.above for p in parts if p.above), ""))


def retraining_outcome(
    source: FinishedRun,
    config: RetrainConfig,
    found: LensPsfs,
    trained: dict[str, Trainer],
) -> RetrainingOutcome:
    """Accuracy of all cases, on the same test frames.

    Args:
        source: finished run: its network, lens and sensor. config: of the retraining.
        found: PSFs of the lenses in question. trained: trainings by name of the job.
    """
    nominal = (found.nominal,)
    frames = render_test_frames(source, config)
    untouched = make_trainer(source, config, nominal)

    def of(going: Trainer, stacks: Sequence[PixelPsfStack]) -> NetworkAccuracy:
        return judge_network(going, source, config, stacks, frames=frames)

    return RetrainingOutcome(
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
    truth: HiddenLens | None = None,
) -> RetrainingOutcome:
    """A finished run's network trained on for the lens that was made, in one call;
    ``metalens retrain`` keeps files.

    Args:
        folder: of ``metalens codesign``. result: of ``metalens fit`` for that run's
            lens.h5.
        truth: of the virtual bench, where there is one.
        config: of the retraining; its defaults without it.

    Raises:
        TrainingError: the run is missing, half written or of another version.
        FitError: the record is of another lens, or its fit was refused.
    """
    config = config or RetrainConfig()
    source = load_finished_run(folder, budget_mmacs=config.budget_mmacs)
    design = lenses.load(lens_file(folder, source.settings, source.row["budget_mmacs"]))
    check_lens(design, result)
    found = lens_psfs(
        MadeLens(design, source.settings.optics, response=result.response),
        result,
        config,
        truth,
    )
    trained = {
        name: make_job(source, config, found, name) for name in available_jobs(found)
    }
    for going in trained.values():
        for _ in going.run():
            pass
    return retraining_outcome(source, config, found, trained)
