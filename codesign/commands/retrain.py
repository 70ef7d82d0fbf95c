"""RUN_DIR and asbuilt.h5 to DIR: the network trained on for the lens that was made, and
the next mask's correction.
"""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from characterize import next_mask
from characterize.bench import HiddenLens
from characterize.inference import AsBuilt
from codesign.adapt import FinishedRun, LensPsfs
from codesign.adapt import report as retrain_report
from codesign.adapt import train as retraining
from codesign.adapt.retrained_network import (
    RECIPE,
    RESULT,
    RetrainingRecipe,
    relative_inputs,
)
from codesign.adapt.source import fabricated_lens, load_finished_run
from codesign.commands.options.retrain import Options
from codesign.optics import MadeLens
from codesign.train import (
    Trainer,
    assess,
    checkpoint,
    device_of,
    place_on_device,
    results,
)
from metalens.core import config, store
from metalens.core.errors import TrainingError
from metalens.core.transaction import OutputDraft
from metalens.fabrication import Bias

LOG = "log.jsonl"
UNKNOWN = "the truth is not known: lenses drawn from the posterior judge, as good as the fit's covariance"


Given = tuple[FinishedRun, AsBuilt, MadeLens, HiddenLens | None, Bias]


def run(options: Options) -> int:
    """Train on, judge, correct, report; exit 1 where the error of the images that judge
    is above what the run asks
    for.

    Args:
        options: of the command line.
    """
    source = load_finished_run(
        options.run_dir, budget_mmacs=options.settings.budget_mmacs
    )
    place_on_device(source.run.trainer, device_of(options.device))
    result = AsBuilt.load(options.asbuilt)
    lens_model = fabricated_lens(source, result, insist=options.insist)
    truth = config.load(options.truth, HiddenLens) if options.truth else None
    old = next_mask.present_bias(options.process)
    recipe = RetrainingRecipe(
        options.settings,
        store.sha256(options.asbuilt),
        store.sha256(options.run_dir / "checkpoint.safetensors"),
        source.settings,
        store.sha256(options.truth) if options.truth else "",
    )
    with options.claim_work(
        options.output, keep=("*.safetensors",), resume=options.resume
    ) as draft:
        _check_recipe(draft, recipe, resume=options.resume)
        story = _retrain_and_correct(
            options, draft.path, recipe, (source, result, lens_model, truth, old)
        )
    return options.console.judged(
        _values(story, options), _text(story, options.output), [story.outcome.above]
    )


def _retrain_and_correct(
    options: Options, folder: Path, recipe: RetrainingRecipe, inputs: Given
) -> retrain_report.RetrainingResults:
    """Retrain, evaluate and correct; write the correction and networks into the
    folder.
    """
    source, result, lens_model, truth, old = inputs
    console = options.console
    console.say(
        f"lenses: the design, the fit and {options.settings.draws} draws of its posterior"
    )
    psfs = retraining.lens_psfs(lens_model, result, options.settings, truth)
    trained = {
        name: _train(options, folder, (recipe, source, psfs), name)
        for name in retraining.training_stacks(psfs)
    }
    console.say(f"judging: {len(trained) + 2} cases on the same frames")
    outcome = retraining.retraining_outcome(source, options.settings, psfs, trained)
    mask = next_mask.plan_next_mask(result, old=old, truths=[psfs.judge_parameters])
    story = retrain_report.RetrainingResults(
        outcome,
        psfs,
        mask,
        (*result.problems, *result.degeneracies, *([] if psfs.known else [UNKNOWN])),
    )
    if not mask.refused:
        next_mask.write_correction(folder, mask.plan, evened=not mask.uneven)
    _write_results(folder, options, (source, trained["retrained"]), story)
    if options.export:
        net = trained["retrained"].model.net
        results.write_network_file(
            folder / "subnet_retrained.onnx", source.run, net, source.architecture
        )
    return story


def _check_recipe(
    draft: OutputDraft, recipe: RetrainingRecipe, *, resume: bool
) -> None:
    """Note the recipe, or refuse to resume another."""
    folder = draft.path
    if resume:
        if not (folder / RECIPE).is_file():
            raise TrainingError(
                f"{draft.target}: no retraining to resume ({RECIPE} missing); start without --resume"
            )
        changed = checkpoint.settings_difference(
            (folder / RECIPE).read_text("utf-8"), recipe
        )
        if changed:
            raise TrainingError(
                f"{folder} belongs to other settings; start anew or undo the change:\n{changed}"
            )
        return
    store.write_text(folder / RECIPE, config.dumps(recipe))


def _train(
    options: Options,
    folder: Path,
    inputs: tuple[RetrainingRecipe, FinishedRun, LensPsfs],
    name: str,
) -> Trainer:
    """Train one job to its end with log and checkpoints.

    A resume drops the log lines after its checkpoint.
    """
    recipe, source, psfs = inputs
    stacks = retraining.training_stacks(psfs)[name]
    trainer = retraining.make_trainer(source, options.settings, stacks)
    path = folder / f"{name}.safetensors"
    if path.is_file():
        trainer.restore(checkpoint.load_checkpoint(path, settings=recipe)["trainer"])
    entries = checkpoint.read_entries(folder / LOG)
    checkpoint.write_entries(
        folder / LOG,
        [e for e in entries if e["job"] != name or e["step"] <= trainer.step],
    )
    records = retraining.run_job(trainer, path, recipe)
    for record in options.console.track(
        records, total=trainer.inner.steps - trainer.step, label=f"training: {name}"
    ):
        checkpoint.append_entry(folder / LOG, {"job": name, **asdict(record)})
    return trainer


def _write_results(
    folder: Path,
    options: Options,
    trained: tuple[FinishedRun, Trainer],
    story: retrain_report.RetrainingResults,
) -> None:
    """Write the retrained network, the page, the picture of cases and result.json."""
    source, trainer = trained
    assess.recalibrate_network(trainer, source.architecture)
    file = folder / "subnet_retrained.safetensors"
    checkpoint.save_checkpoint(file, trainer.model.state(), settings=source.settings)
    retrain_report.write_retraining_page(folder / "report.html", story)
    store.write_bytes(
        folder / "cases.png", retrain_report.plot_error_bars(story.outcome)
    )
    store.write_text(
        folder / RESULT, json.dumps(_values(story, options), indent=1) + "\n"
    )


def _values(
    story: retrain_report.RetrainingResults, options: Options
) -> dict[str, Any]:
    """Content of result.json."""
    outcome, folder = story.outcome, options.output
    cases = outcome.rows()
    return {
        "folder": str(folder),
        "given": relative_inputs(
            folder, options.run_dir, options.asbuilt, options.truth
        ),
        "rows": [
            {"case": retrain_report.CASES[name], **row} for name, row in cases.items()
        ],
        "slip_mm": cases["after"]["slip_mm"],
        "cases": cases,
        "gap_mm": outcome.gap_mm,
        "gap_sigma_mm": outcome.gap_sigma_mm,
        "recovered": outcome.recovered,
        "psf_error": story.psfs.errors,
        "truth_known": story.psfs.known,
        "next_lens": [
            {"name": step.name, "strehl": step.strehl, "light": step.light}
            for step in story.mask.steps
        ],
        "correction_refused": story.mask.refused,
        "map_refused": story.mask.uneven,
    }


def _text(story: retrain_report.RetrainingResults, folder: Path) -> str:
    """Summary of a retraining for the terminal."""
    lines = [
        retrain_report.accuracy_table(story.outcome).text,
        retrain_report.gap_text(story.outcome),
    ]
    for step in story.mask.steps:
        lines.append(f"next lens, {step.name:<26} Strehl {step.strehl:.3f}")
    lines.append(f"next mask: {story.mask.summary}")
    return "\n".join([*lines, f"open {folder / 'report.html'}"])
