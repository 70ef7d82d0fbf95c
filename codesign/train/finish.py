"""What a run reached: the network of every budget on test frames, on frames where only
blur tells depth, and why.
"""

import copy
import json
import math
from dataclasses import dataclass, replace
from typing import Any

from torch import Tensor

from codesign.batches import TEST, VALIDATION
from codesign.network import Architecture, Baseline, blur, recalibrate, smallest
from codesign.train import ambiguity, assess, evolution
from codesign.train.assess import Answers, Seen
from codesign.train.depth_test import depth_response
from codesign.train.evolution import Candidate, Search
from codesign.train.inner import Model, Schedule, Trainer
from codesign.train.run import Run
from metalens.ground.errors import TrainingError


def finish(run: Run) -> list[dict[str, Any]]:
    """The best of every budget on the test frames: one row a budget; one row for a
    baseline network.

    Raises:
        TrainingError: a search has not ended.
    """
    return [end.row for end in finished(run)]


@dataclass(frozen=True, eq=False, slots=True)
class End:
    """What a budget ended in.

    row: of the result. model: that reached it, fine-tuned where that is asked for.
    seen, answers: test frames, and
    what the model said of them. interval_mm: (n,) half width of its 90 % intervals of
    the axial slippage; None of a
    network that gives none.
    """

    row: dict[str, Any]
    model: Model
    seen: Seen
    answers: Answers
    interval_mm: Tensor | None


def finished(run: Run) -> list[End]:
    """The ends of :func:`finish`, a budget each.

    ``mmacs``: that run for a frame. A search holds its budget to the smooth count,
    beside which it may lie where the
    pitch does not divide the image, or a network's resolution the pixels.
    ``effective_pitch_um``: distance of the cells that the network sees: of pixels
    binned to its resolution.
    ``axial_coverage_90``: share of test frames within the network's calibrated 90 %
    interval, whose mean half width is
    ``axial_interval_mm``. ``window_depth_mm``: mean error of the depth of the windows.
    Batch statistics are measured on training frames through the final lens, never on
    those that are judged.
    """
    settings = run.settings
    chosen = _chosen(run)
    tests = {"": assess.frames(run.trainer, run.scenes(TEST), settings.test_batches)}
    pairs = None
    if settings.ambiguity_pairs:
        pairs = ambiguity.ambiguous(
            run.scenes(TEST), settings.ambiguity_pairs, settings.inner.seed
        )
        tests["ambiguous_"] = assess.frames(
            run.trainer, pairs, max(1, len(pairs) // settings.inner.batch)
        )
    measured = assess.frames(
        run.trainer, run.trainer.scenes, min(8, settings.test_batches)
    )
    apart = assess.frames(
        run.trainer, run.scenes(VALIDATION), settings.validation_batches
    )
    out = []
    for i, (budget, best) in enumerate(chosen):
        trainer = _tuned(run, best.architecture, i)
        net, architecture = trainer.model.net, best.architecture
        recalibrate(net, architecture, assess.parts(measured))
        row: dict[str, Any] = {
            "budget_mmacs": budget,
            "mmacs": run.macs(architecture) / 1e6,
        }
        row["effective_pitch_um"] = (
            float(run.trainer.model.pitch_um.detach()) / architecture.resolution
        )
        reach = widths(assess.predict(net, architecture, apart, settings.inner), apart)
        plain = assess.predict(net, architecture, tests[""], settings.inner)
        for name, seen in tests.items():
            answers = (
                assess.predict(net, architecture, seen, settings.inner)
                if name
                else plain
            )
            row |= _errors(name, answers, seen) | told(name, answers, seen, reach)
        response = depth_response(
            trainer,
            pairs or run.scenes(TEST),
            net,
            architecture,
            batches=max(1, settings.test_batches // 4),
        )
        row["depth_response_mm_per_mm"] = response.mean
        row["depth_response_error"] = response.standard_error
        row["architecture"] = (
            json.loads(evolution.dumps(Search((best,))))["history"][0]
            if budget
            else None
        )
        out.append(End(row, trainer.model, tests[""], plain, _wide(plain, reach)))
    return out


def _chosen(run: Run) -> list[tuple[float | None, Candidate]]:
    settings, net = run.settings, run.trainer.model.net
    if isinstance(net, Baseline):
        only = smallest(net.space)
        return [(None, Candidate(only, 0.0, run.macs(only)))]
    if len(run.searches) < len(settings.run.budgets_mmacs):
        raise TrainingError(
            f"{len(run.searches)} of {len(settings.run.budgets_mmacs)} searches are done; resume the run"
        )
    return [
        (b, evolution.best(s.history))
        for b, s in zip(settings.run.budgets_mmacs, run.searches, strict=True)
    ]


def _errors(name: str, answers: Answers, seen: Seen) -> dict[str, float | None]:
    error = (answers.slip_mm - seen.slip_mm).abs().mean(0)
    shared = float(answers.iou.mean())
    return {
        f"{name}axial_slip_mm": float(error[2]),
        f"{name}lateral_slip_mm": float(error[:2].mean()),
        f"{name}iou": shared
        if shared == shared
        else None,  # a network without a mask has none
    }


def widths(answers: Answers, seen: Seen, *, share: float = 0.9) -> float | None:
    """Half width, in its own standard deviations, of the interval that holds this share
    of the axial slippages.

    From frames that neither training nor test sees: with them the network's uncertainty
    is calibrated.
    """
    if answers.slip_sd_mm is None:
        return None
    ratio = (answers.slip_mm - seen.slip_mm)[:, 2].abs() / answers.slip_sd_mm[:, 2]
    rank = min(
        math.ceil(share * (len(ratio) + 1)), len(ratio)
    )  # conformal: holds whatever the distribution
    return float(ratio.sort().values[rank - 1])


def _wide(answers: Answers, reach: float | None) -> Tensor | None:
    """(n,) half width of the 90 % intervals of the axial slippage."""
    return (
        None
        if answers.slip_sd_mm is None or reach is None
        else reach * answers.slip_sd_mm[:, 2]
    )


def told(
    name: str, answers: Answers, seen: Seen, reach: float | None
) -> dict[str, float]:
    """What the network tells beside the slippage: coverage of its 90 % intervals, their
    width, depth of windows.
    """
    row: dict[str, float] = {}
    if (wide := _wide(answers, reach)) is not None:
        row[f"{name}axial_coverage_90"] = float(
            ((answers.slip_mm - seen.slip_mm)[:, 2].abs() <= wide).float().mean()
        )
        row[f"{name}axial_interval_mm"] = float(wide.mean())
    if answers.depth is not None and seen.vergence is not None:
        miss = blur.depth_mm(answers.depth[:, 0]) - blur.depth_mm(seen.vergence)
        row[f"{name}window_depth_mm"] = float(miss.abs().mean())
    return row


def _tuned(run: Run, architecture: Architecture, number: int) -> Trainer:
    """A copy of the trainer whose weights were trained on for one architecture, lens
    and pitch as they are.
    """
    steps = run.settings.run.finetune_steps
    source = run.trainer
    made = copy.deepcopy(source.model)
    rate = source.inner.weights.rate / 4
    inner = replace(
        source.inner,
        steps=max(steps, 1),
        seed=source.inner.seed + 1000 * (number + 1),
        weights=replace(source.inner.weights, rate=rate),
        optics=Schedule(0.0),
        pitch=Schedule(0.0),
    )
    going = Trainer(
        inner,
        source.optics,
        source.sensor,
        source.scenes,
        made,
        architecture=architecture,
        stacks=source.light.stacks,
    )
    going.light.device = source.light.device  # where the copied network lies already
    for _ in going.run() if steps else ():
        pass
    return going
