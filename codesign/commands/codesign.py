"""RUN.toml to RUN_DIR: lens, pixel pitch and network trained together, then searched
under compute budgets.
"""

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch

from codesign.adapt import lens_file, weights_file
from codesign.batches import parallel
from codesign.commands.options.codesign import Options
from codesign.optics import image_formation
from codesign.optics import stack as trained
from codesign.train import (
    BudgetResult,
    CodesignRun,
    RunConfig,
    TrainedModel,
    assess,
    best_candidate,
    checkpoint,
    device_of,
    finished_budgets,
    place_on_device,
    results,
    search,
)
from codesign.train import run as runs
from metalens import lens
from metalens.core import config, report, store, transaction
from metalens.core.errors import ConfigError

CHECKPOINT = "checkpoint.safetensors"
LOG = "log.jsonl"
SETTINGS = "run.toml"
RESULT, ANSWERS = "result.json", "answers.h5"


def run(options: Options) -> int:
    """Train, search and write a run.

    Exit 1 where the error of the true image is above what the run requires.

    Args:
        options: of the command line.
    """
    settings = runs.load_run_settings(options.config)
    frozen = tuple(sorted({*settings.run.frozen, *options.freeze}))
    settings = replace(settings, run=replace(settings.run, frozen=frozen))
    device = device_of(options.device)
    parallel.join_processes(device)
    if parallel.process_rank():
        return _train_along(
            transaction.unfinished_path(options.output), settings, device
        )
    with options.claim_work(
        options.output, keep=(CHECKPOINT,), resume=options.resume
    ) as draft:
        rows, image = _train_and_search(options, settings, device, draft.path)
    count = torch.get_num_threads()
    values = {
        "rows": rows,
        "folder": str(options.output),
        "image": image,
        "threads": count,
    }
    note = f"trained on {count} thread{'s' * (count > 1)}; another number changes the last digits, and with them the run"
    return options.console.judged(
        values,
        f"{_table(rows)}\n{image_formation.describe_image_text(image)}\n{note}",
        [image["above"]],
    )


def _train_and_search(
    options: Options, settings: RunConfig, device: torch.device, folder: Path
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Train, search and write into the folder; rows of result.json, and the image
    record.
    """
    console = options.console
    training_run = (
        _resume(folder, settings) if options.resume else _start(folder, settings)
    )
    if settings.run.pitch_um < settings.optics.sample_um:
        console.say(
            f"run.pitch_um = {settings.run.pitch_um:g} is finer than the samples of the image, optics.sample_um = "
            f"{settings.optics.sample_um:g}: such pixels cost more and show nothing new"
        )
    place_on_device(training_run.trainer, device)
    parallel.wait_for_all()
    event_writer = (
        _event_writer(folder, training_run.trainer.step) if options.events else None
    )
    records = runs.train_run(training_run, folder / CHECKPOINT)
    steps_left = settings.inner.steps - training_run.trainer.step
    for record in console.track(records, total=steps_left, label="training"):
        checkpoint.append_entry(folder / LOG, {"kind": "step", **asdict(record)})
        if event_writer:
            for name, value in asdict(record).items():
                event_writer.add_scalar(name, float(value), record.step)
            event_writer.flush()
        if record.step % settings.checkpoint_every == 0:
            console.say(
                f"step {record.step}/{settings.inner.steps}: loss {record.loss:.4f}, task {record.task:.4f}, "
                f"pitch {record.pitch_um:.2f} um, {record.mmacs:.1f} MMACs, {record.skipped} skipped"
            )
    for budget, candidate in search.search_architectures(
        training_run, folder / CHECKPOINT
    ):
        mmacs = candidate.macs / 1e6
        entry = {
            "kind": "birth", "budget_mmacs": budget, "error": candidate.error, "mmacs": mmacs,
            "architecture": asdict(candidate.architecture),
        }  # fmt: skip
        checkpoint.append_entry(folder / LOG, entry)
        console.say(
            f"budget {budget:g} MMACs: gaze error {candidate.error:.2f} deg at {mmacs:.2f} MMACs"
        )
    parallel.leave_processes()
    ends = finished_budgets(training_run)
    margin = settings.scenes.margin
    image = image_formation.describe_image(
        settings.optics, training_run.trainer.model.coefficients_rad.detach(),
        settings.scenes.pixels + 2 * margin, margin=margin,
    )  # fmt: skip
    _write_results(folder, training_run, ends, image, export=options.export)
    return [end.row for end in ends], image


def _train_along(folder: Path, settings: RunConfig, device: torch.device) -> int:
    """Training and search of the other processes of ``torchrun``, which write nothing.

    From the checkpoint that process 0 wrote.
    """
    parallel.wait_for_all()
    training_run = runs.resume_run(folder / CHECKPOINT, settings)
    place_on_device(training_run.trainer, device)
    for _ in runs.train_run(training_run, folder / CHECKPOINT):
        pass
    for _ in search.search_architectures(training_run, folder / CHECKPOINT):
        pass
    parallel.leave_processes()
    return 0


def _event_writer(folder: Path, step: int) -> Any:
    """TensorBoard events of the run's folder; those beyond a resumed step are dropped.

    Raises:
        ConfigError: tensorboard is not installed.
    """
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        raise ConfigError(
            "--events needs tensorboard: pip install 'metalens-toolchain[events]'"
        ) from None
    make: Any = SummaryWriter
    return make(str(folder), purge_step=step + 1 if step else None)


def _start(folder: Path, settings: RunConfig) -> CodesignRun:
    """A new run, with its settings and first checkpoint in the folder."""
    store.write_text(folder / SETTINGS, config.dumps(settings))
    new = runs.start_run(settings)
    runs.save_run(folder / CHECKPOINT, new)
    return new


def _resume(folder: Path, settings: RunConfig) -> CodesignRun:
    """The run of the folder's checkpoint; log lines beyond it are dropped."""
    resumed = runs.resume_run(folder / CHECKPOINT, settings)
    births = sum(len(s.history) for s in resumed.searches)
    entries = checkpoint.read_entries(folder / LOG)
    steps = [
        e for e in entries if e["kind"] == "step" and e["step"] <= resumed.trainer.step
    ]
    births_logged = [e for e in entries if e["kind"] == "birth"]
    checkpoint.write_entries(folder / LOG, steps + births_logged[:births])
    return resumed


def _write_results(
    folder: Path,
    codesign_run: CodesignRun,
    ends: list[BudgetResult],
    image: dict[str, Any],
    *,
    export: bool,
) -> None:
    """Write the lenses, networks, candidates' errors over cost, result.json and
    answers.h5.
    """
    settings, trainer = codesign_run.settings, codesign_run.trainer
    provenance = store.Provenance(
        config=config.dumps(settings), seed=settings.inner.seed
    )

    def save_lens(path: Path, model: TrainedModel) -> None:
        phase = model.coefficients_rad.detach()
        lens.save(path, trained.trained_lens(settings.optics, phase, provenance))

    save_lens(folder / "lens.h5", trainer.model)
    figure, axes = report.make_figure(size=(6.0, 4.0))
    for end, state in zip(ends, codesign_run.searches, strict=True):
        model, budget = end.trainer.model, end.row["budget_mmacs"]
        architecture = best_candidate(state.history).architecture
        costs = [candidate.macs / 1e6 for candidate in state.history]
        errors = [candidate.error for candidate in state.history]
        axes.plot(costs, errors, "o", label=f"budget {budget:g} MMACs")
        file = weights_file(folder, budget)
        checkpoint.save_checkpoint(file, model.state(), settings=settings)
        if settings.search.inner_steps:
            save_lens(lens_file(folder, settings, budget), model)
        if export:
            own = replace(codesign_run, trainer=end.trainer)
            path = folder / f"subnet_{budget:g}.onnx"
            results.write_network_file(path, own, model.net, architecture)
    axes.set(xlabel="MMACs", ylabel="gaze error on validation / deg")
    axes.legend()
    store.write_bytes(folder / "pareto.png", report.figure_png(figure))
    rows = [end.row for end in ends]
    record = {
        "pitch_um": float(trainer.model.pitch_um.detach()),
        "seed": settings.inner.seed,
        "steps": settings.inner.steps,
        "rows": rows,
        "frozen": list(settings.run.frozen),
        "image": image,
        "threads": torch.get_num_threads(),
    }
    store.write_text(folder / RESULT, json.dumps(record, indent=1) + "\n")
    labels = {
        f"network_{i}": f"budget {row['budget_mmacs']:g} million MACs"
        for i, row in enumerate(rows)
    }
    answers = results.predictions_of_frames(ends, count=8)
    store.save(folder / ANSWERS, "answers", answers, attributes=labels)


COLUMNS = {  # of the table, by name in result.json
    "budget_mmacs": "budget",
    "mmacs": "MMACs",
    "effective_pitch_um": "pixels read / um",
    "gaze_deg": "gaze / deg",
    "axial_slip_mm": "axial / mm",
    "finer_axial_slip_mm": "finer image / mm",
    "finer_ratio": "ratio",
    "axial_interval_mm": "90 % interval / mm",
    "axial_coverage_90": "covers",
    "lateral_slip_mm": "lateral / mm",
    "iou": "IoU",
    "depth_response_mm_per_mm": "mm per mm of depth",
}


def _table(rows: list[dict[str, Any]]) -> str:
    """Text table of the rows of result.json, with a warning where the image matters."""
    cells = [[row.get(name) for name in COLUMNS] for row in rows]
    text = report.Table(list(COLUMNS.values()), cells, digits=3).text
    worst = max((r.get("finer_ratio", 1.0) for r in rows), default=1.0)
    if worst <= assess.SAME:
        return text
    return (
        f"{text}\nresults depend on the image: on one formed at a quarter of "
        f"optics.image_tolerance errors are {worst:.2f} times as large; lower it"
    )
