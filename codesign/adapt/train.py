"""The network retrained for the fabricated lens: the inner loop with fixed optics."""

import copy
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from characterize.bench import HiddenLens
from characterize.inference import AsBuilt
from codesign.adapt.source import FinishedRun, fabricated_lens, load_finished_run
from codesign.batches import TEST, FrameBatch
from codesign.optics import MadeLens, PixelPsfStack, psf_error
from codesign.settings import RetrainConfig
from codesign.train import (
    InnerConfig,
    LogRecord,
    SensorFrames,
    Trainer,
    assess,
    checkpoint,
)
from metalens.core.arrays import Array


@dataclass(frozen=True, eq=False, slots=True)
class NetworkAccuracy:
    """Errors of one network on one lens over n test frames.

    error_mm: (n, 3) absolute errors of the slippage along each axis. iou: (n,) of the
    pupil's mask. The error that the studies report is ``slip_mm``, the mean over axes.
    above: why the error of the images is above what their run requires; empty where it
    is not.
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

    def values(self) -> dict[str, float]:
        """The numbers by name, for tables and JSON: ``slip_mm`` with its 95 % interval
        by a bootstrap over frames, and errors on the finer images with their ratio.
        """
        low, high = assess.bootstrap_interval(self.error_mm.mean(1).double().numpy())
        values = {
            "slip_mm": self.slip_mm,
            "slip_low_mm": low,
            "slip_high_mm": high,
            "axial_mm": float(self.error_mm[:, 2].mean()),
            "lateral_mm": float(self.error_mm[:, :2].mean()),
            "iou": float(self.iou.mean()),
        }
        if self.finer is not None:
            values["finer_slip_mm"] = self.finer.slip_mm
            values["finer_ratio"] = self.finer.slip_mm / self.slip_mm
        return values


@dataclass(frozen=True, eq=False, slots=True)
class LensPsfs:
    """PSFs of the lens in question.

    nominal: as designed. best: of the fitted values. drawn: from the posterior, for
    training. judges: for testing: the truth where it is known, else further draws.
    known: whether it is. judge_parameters: all parameters of the first judge.
    """

    nominal: PixelPsfStack
    best: PixelPsfStack
    drawn: tuple[PixelPsfStack, ...]
    judges: tuple[PixelPsfStack, ...]
    known: bool
    judge_parameters: Array

    @property
    def errors(self) -> dict[str, float]:
        """Relative L2 error of the PSFs of the fitted and of the first judging lens
        against the nominal ones.
        """
        lenses = {"fitted": self.best, "judge": self.judges[0]}
        return {name: psf_error(one, self.nominal) for name, one in lenses.items()}


@dataclass(frozen=True, eq=False, slots=True)
class RetrainingOutcome:
    """Accuracy of every case of a retraining.

    designed: the run's network on the nominal lens, unchanged. nominal: trained further
    on the nominal lens for the same number of steps as the others. before: that network
    on the made lens. after: retrained on the fit. known: retrained on the true lens;
    None on a real bench.
    """

    designed: NetworkAccuracy
    nominal: NetworkAccuracy
    before: NetworkAccuracy
    after: NetworkAccuracy
    known: NetworkAccuracy | None

    @property
    def gap_mm(self) -> float:
        """Additional error of the nominal network on the made lens, mm."""
        return self.before.slip_mm - self.nominal.slip_mm

    @property
    def gap_sigma_mm(self) -> float:
        """Standard error of the gap, over the frames that both cases share."""
        difference = (self.before.error_mm - self.nominal.error_mm).mean(1)
        return float(difference.std()) / math.sqrt(len(difference))

    @property
    def recovered(self) -> float | None:
        """Fraction of the gap that retraining removes.

        None where the gap is within two of its standard errors.
        """
        if self.gap_mm <= 2 * self.gap_sigma_mm:
            return None
        return (self.before.slip_mm - self.after.slip_mm) / self.gap_mm

    @property
    def above(self) -> str:
        """Why the error of the images of some case is too large, the made lens first;
        else empty.
        """
        return self.after.above or self.designed.above

    def rows(self) -> dict[str, dict[str, float]]:
        """Numbers by name of the case."""
        cases = {name: getattr(self, name) for name in RetrainingOutcome.__slots__}
        return {name: case.values() for name, case in cases.items() if case is not None}


def lens_psfs(
    lens_model: MadeLens,
    result: AsBuilt,
    config: RetrainConfig,
    truth: HiddenLens | None = None,
) -> LensPsfs:
    """PSFs of the nominal, fitted, drawn and (where known) true lens.

    Args:
        lens_model: lens ready for perturbations. result: of the fit.
        config: of the retraining; numbers of posterior draws.
        truth: lens of a virtual bench; None of a real one.
    """
    samples = result.lens_samples(config.draws + config.judge, seed=config.seed)
    rows = [result.parameters(sample) for sample in samples]
    judge_rows = [truth.vector()] if truth else rows[config.draws :]
    return LensPsfs(
        lens_model.stack(),
        lens_model.stack(result.parameters()),
        tuple(lens_model.stack(row) for row in rows[: config.draws]),
        tuple(lens_model.stack(row) for row in judge_rows),
        truth is not None,
        judge_rows[0],
    )


def make_trainer(
    source: FinishedRun, config: RetrainConfig, stacks: Sequence[PixelPsfStack]
) -> Trainer:
    """Trainer with copies of a run's weights, lens and pitch, on PSFs of made lenses.

    On the run's device; only the weights are trained.

    Args:
        source: finished run: its network, lens and sensor. config: of the retraining.
        stacks: PSFs of made lenses.
    """
    origin = source.run.trainer
    trainer = replace(
        origin,
        inner=fine_tuning(source.settings.inner, config),
        model=copy.deepcopy(origin.model),
        architecture=source.architecture,
        stacks=stacks,
        budgets_mmacs=(),
    )
    trainer.light.device = origin.light.device
    return trainer


def fine_tuning(inner: InnerConfig, config: RetrainConfig) -> InnerConfig:
    """The inner loop's settings for retraining: weights alone, over the whole run.

    Args:
        inner: of the run. config: of the retraining.
    """
    # a prime between them, so that steps of different retrainings differ
    seed = inner.seed + 7919 * (config.seed + 1)
    return inner.fine_tuning(config.steps, seed, weights=config.rate)


def training_stacks(psfs: LensPsfs) -> dict[str, tuple[PixelPsfStack, ...]]:
    """{job: PSFs that it trains on}: for the design, for the fit, and for the truth
    where it is known.

    Args:
        psfs: of the lenses in question.
    """
    stacks = {"nominal": (psfs.nominal,), "retrained": psfs.drawn}
    return stacks | ({"known": psfs.judges} if psfs.known else {})


def run_job(
    trainer: Trainer, path: Path, settings: object, *, every: int = 50
) -> Iterator[LogRecord]:
    """Train one job from its present step to its end, yielding a record a step.

    A checkpoint is written to ``path`` after every ``every`` steps and at the end.

    Args:
        trainer: training with its network. path: of the checkpoint.
        settings: record that a resume compares. every: steps between checkpoints.
    """
    for record in trainer.run():
        yield record
        if record.step % every == 0 or record.step == trainer.inner.steps:
            checkpoint.save_checkpoint(
                path, {"trainer": trainer.state()}, settings=settings
            )


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
    trainer: Trainer,
    source: FinishedRun,
    config: RetrainConfig,
    stacks: Sequence[PixelPsfStack],
    *,
    frames: TestFrames,
    finer: bool = True,
) -> NetworkAccuracy:
    """Errors of a network on test frames, frame by frame the mean over lenses.

    Its batch statistics are measured first. All cases share the frames.

    Args:
        trainer: training with its network.
        source: finished run: its network, lens and sensor. config: of the retraining.
        stacks: PSFs of made lenses; at most ``config.judge`` are used.
        frames: of :func:`render_test_frames`.
        finer: judge on images formed at a quarter of the tolerance too.
    """
    assess.recalibrate_network(trainer, source.architecture)
    own, fine = [], []
    for stack in stacks[: config.judge]:
        given = trainer, frames, config.test_batches
        own.append(
            _accuracy(source, trainer, assess.sensor_frames(*given, stack=stack))
        )
        exact = assess.finer_frames(*given, stack=stack) if finer else None
        if exact is not None:
            fine.append(_accuracy(source, trainer, exact))
    accuracy = _mean(own)
    return accuracy if len(fine) < len(own) else replace(accuracy, finer=_mean(fine))


def _accuracy(
    source: FinishedRun, trainer: Trainer, frames: SensorFrames
) -> NetworkAccuracy:
    """Errors of a trainer's network on each of the sensor frames."""
    predictions = assess.predict_frames(
        trainer.model.net, source.architecture, frames, trainer.inner
    )
    error = (predictions.slip_mm - frames.slip_mm).abs()
    return NetworkAccuracy(error, predictions.iou, frames.above)


def _mean(parts: Sequence[NetworkAccuracy]) -> NetworkAccuracy:
    """Errors frame by frame, each the mean over lenses."""
    error = torch.stack([part.error_mm for part in parts]).mean(0)
    iou = torch.stack([part.iou for part in parts]).mean(0)
    return NetworkAccuracy(error, iou, next((p.above for p in parts if p.above), ""))


def retraining_outcome(
    source: FinishedRun,
    config: RetrainConfig,
    training_psfs: LensPsfs,
    trained: dict[str, Trainer],
) -> RetrainingOutcome:
    """Accuracy of all cases, on the same test frames.

    Args:
        source: finished run: its network, lens and sensor. config: of the retraining.
        training_psfs: PSFs of the lenses in question.
        trained: trainers by name of the job.
    """
    nominal = (training_psfs.nominal,)
    frames = render_test_frames(source, config)
    untouched = make_trainer(source, config, nominal)

    def judge(
        trainer: Trainer, stacks: Sequence[PixelPsfStack], *, finer: bool = True
    ) -> NetworkAccuracy:
        return judge_network(
            trainer, source, config, stacks, frames=frames, finer=finer
        )

    # how finer images change errors behind the nominal lens stands in the run's result
    return RetrainingOutcome(
        designed=judge(untouched, nominal, finer=False),
        nominal=judge(trained["nominal"], nominal, finer=False),
        before=judge(trained["nominal"], training_psfs.judges),
        after=judge(trained["retrained"], training_psfs.judges),
        known=judge(trained["known"], training_psfs.judges)
        if training_psfs.known
        else None,
    )


def retrain_network(
    folder: Path,
    result: AsBuilt,
    *,
    config: RetrainConfig | None = None,
    truth: HiddenLens | None = None,
) -> RetrainingOutcome:
    """Retrain a finished run's network for the lens that was made; accuracy of all
    cases.

    In one call and without files; ``metalens retrain`` writes them.

    Args:
        folder: of ``metalens codesign``.
        result: of ``metalens fit`` for that run's lens.h5.
        config: of the retraining; its defaults without it.
        truth: of the virtual bench, where there is one.

    Raises:
        TrainingError: the run is missing, half written or of another version.
        FitError: the record is of another lens, or its fit was refused.
    """
    config = config or RetrainConfig()
    source = load_finished_run(folder, budget_mmacs=config.budget_mmacs)
    psfs = lens_psfs(fabricated_lens(source, result), result, config, truth)
    trained = {
        name: make_trainer(source, config, stacks)
        for name, stacks in training_stacks(psfs).items()
    }
    for trainer in trained.values():
        for _ in trainer.run():
            pass
    return retraining_outcome(source, config, psfs, trained)
