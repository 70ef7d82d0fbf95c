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
from codesign.commands import onnx_file
from codesign.commands.options.codesign import Options
from codesign.network import Subnet
from codesign.optics import image_formation
from codesign.optics import stack as trained
from codesign.settings import Part
from codesign.train import (
    BudgetResult,
    CodesignRun,
    LogRecord,
    RunConfig,
    assess,
    best_candidate,
    checkpoint,
    device_of,
    finished_budgets,
    pareto_front,
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
SHOWN = 8  # test frames that are kept with the answers


def run(options: Options) -> int:
    """Train, search and write a run.

    Exit 1 where the error of the true image is above what the run requires.

    Args:
        options: of the command line.
    """
    settings = _with_frozen_parts(
        runs.load_run_settings(options.config), options.freeze
    )
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
    going = _resume(folder, settings) if options.resume else _start(folder, settings)
    if settings.run.pitch_um < settings.optics.sample_um:
        console.say(_fine_pitch_warning(settings))
    place_on_device(going.trainer, device)
    parallel.wait_for_all()
    event_writer = _event_writer(folder, going.trainer.step) if options.events else None
    pitch_reported = False
    records = runs.train_run(going, folder / CHECKPOINT)
    steps_left = settings.inner.steps - going.trainer.step
    for record in console.track(records, total=steps_left, label="training"):
        checkpoint.append_entry(folder / LOG, {"kind": "step", **asdict(record)})
        if event_writer:
            _write_events(event_writer, record)
        if (limit := going.trainer.pitch_held_um) is not None and not pitch_reported:
            pitch_reported = True
            console.say(f"step {record.step}: {_of_pitch(going, limit)}")
        if record.step % settings.checkpoint_every == 0:
            console.say(
                f"step {record.step}/{settings.inner.steps}: loss {record.loss:.4f}, task {record.task:.4f}, "
                f"pitch {record.pitch_um:.2f} um, {record.mmacs:.1f} MMACs, {record.skipped} skipped"
            )
    for budget, candidate in search.search_architectures(going, folder / CHECKPOINT):
        score = {
            "budget_mmacs": budget,
            "error": candidate.error,
            "mmacs": candidate.macs / 1e6,
        }
        entry = {
            "kind": "birth",
            **score,
            "architecture": asdict(candidate.architecture),
        }
        checkpoint.append_entry(folder / LOG, entry)
        console.say(
            f"budget {budget:g} MMACs: gaze error {candidate.error:.2f} deg at {candidate.macs / 1e6:.2f} MMACs"
        )
    parallel.leave_processes()
    ends = finished_budgets(going)
    image = _image_record(going)
    _write_results(folder, going, ends, image)
    if options.export:
        _export(folder, going, ends)
    return [end.row for end in ends], image


def _fine_pitch_warning(settings: RunConfig) -> str:
    """Warning that the pitch is finer than the samples of the image."""
    return (
        f"run.pitch_um = {settings.run.pitch_um:g} is finer than the samples of the image, optics.sample_um = "
        f"{settings.optics.sample_um:g}: such pixels cost more and show nothing new"
    )


def _of_pitch(codesign_run: CodesignRun, limit_um: float) -> str:
    """Why the pitch was clamped at a limit, and what to change."""
    settings = codesign_run.settings
    if limit_um <= codesign_run.trainer.model.finest_um:
        return (
            f"the pitch is held at {limit_um:.3f} um and asks for less, where the smallest network would be beyond "
            f"the budget of {min(settings.run.budgets_mmacs):g} MMACs"
        )
    if limit_um <= settings.optics.sample_um:
        more = settings.optics.sample_um / 2
        return (
            f"the pitch is held at {limit_um:.3f} um, the samples of the image, and asks for less; to let it go on, "
            f"set optics.sample_um = {more:g} with optics.window_samples, scenes.pixels and scenes.margin twice as many"
        )
    return f"the pitch is held at {limit_um:.3f} um: coarser pixels would leave a network less than it can take"


def _image_record(codesign_run: CodesignRun) -> dict[str, Any]:
    """Image model of a run and its error:
    :func:`codesign.optics.image_formation.describe_image`.
    """
    settings = codesign_run.settings
    side = settings.scenes.pixels + 2 * settings.scenes.margin
    coefficients = codesign_run.trainer.model.coefficients_rad.detach()
    return image_formation.describe_image(
        settings.optics, coefficients, side, margin=settings.scenes.margin
    )


def _export(folder: Path, codesign_run: CodesignRun, ends: list[BudgetResult]) -> None:
    """Write the network of every budget as ONNX."""
    for end, state in zip(ends, codesign_run.searches, strict=True):
        path = folder / f"subnet_{end.row['budget_mmacs']:g}.onnx"
        own = replace(codesign_run, trainer=end.trainer)
        net = end.trainer.model.net
        onnx_file.write_network_file(
            path, own, net, best_candidate(state.history).architecture
        )


def _train_along(folder: Path, settings: RunConfig, device: torch.device) -> int:
    """Training and search of the other processes of ``torchrun``, which write nothing.

    From the checkpoint that process 0 wrote.
    """
    parallel.wait_for_all()
    going = runs.resume_run(folder / CHECKPOINT, settings)
    place_on_device(going.trainer, device)
    for _ in runs.train_run(going, folder / CHECKPOINT):
        pass
    for _ in search.search_architectures(going, folder / CHECKPOINT):
        pass
    parallel.leave_processes()
    return 0


def _with_frozen_parts(settings: RunConfig, parts: tuple[Part, ...]) -> RunConfig:
    """The settings with further parts frozen."""
    frozen = tuple(sorted({*settings.run.frozen, *parts}))
    return replace(settings, run=replace(settings.run, frozen=frozen))


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


def _write_events(writer: Any, record: LogRecord) -> None:
    """Write a step's scalars to TensorBoard."""
    for name, value in asdict(record).items():
        if name != "step":
            writer.add_scalar(name, float(value), record.step)
    writer.flush()


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
    said: dict[str, Any],
) -> None:
    """Write lens.h5, networks, result.json, answers.h5 and the plot of the Pareto
    set.
    """
    settings = codesign_run.settings
    provenance = store.Provenance(
        config=config.dumps(settings), seed=settings.inner.seed
    )
    phase = codesign_run.trainer.model.coefficients_rad.detach()
    lens.save(
        folder / "lens.h5", trained.trained_lens(settings.optics, phase, provenance)
    )
    _write_networks(folder, codesign_run, ends, provenance)
    pitch_um = float(codesign_run.trainer.model.pitch_um.detach())
    rows = [end.row for end in ends]
    record = {
        "pitch_um": pitch_um,
        "seed": settings.inner.seed,
        "steps": settings.inner.steps,
        "rows": rows,
        "frozen": list(settings.run.frozen),
        "image": said,
        "pitch_held_um": codesign_run.trainer.pitch_held_um,
        "threads": torch.get_num_threads(),
        "bytes_depend_on_threads": True,
    }
    store.write_text(folder / RESULT, json.dumps(record, indent=1) + "\n")
    labels = {
        f"network_{i}": f"budget {row['budget_mmacs']:g} million MACs"
        for i, row in enumerate(rows)
    }
    store.save(
        folder / ANSWERS,
        "answers",
        results.predictions_of_frames(ends, SHOWN),
        attributes=labels,
    )
    if codesign_run.searches:
        store.write_bytes(folder / "pareto.png", _pareto_picture(codesign_run))


def _write_networks(
    folder: Path,
    codesign_run: CodesignRun,
    ends: list[BudgetResult],
    about: store.Provenance,
) -> None:
    """Write every budget's network, cut to its architecture, with lens and pitch.

    And its own lens file, where the search optimised lenses.
    """
    for end, state in zip(ends, codesign_run.searches, strict=True):
        model = end.trainer.model
        budget = end.row["budget_mmacs"]
        network = Subnet(model.net, best_candidate(state.history).architecture)
        optics = {
            "optics.coefficients_rad": model.coefficients_rad,
            "optics.log_pitch": model.log_pitch,
        }
        checkpoint.save_network(weights_file(folder, budget), network, beside=optics)
        if codesign_run.settings.search.inner_steps:
            own_lens = trained.trained_lens(
                codesign_run.settings.optics, model.coefficients_rad.detach(), about
            )
            lens.save(lens_file(folder, codesign_run.settings, budget), own_lens)


def _pareto_picture(codesign_run: CodesignRun) -> bytes:
    """PNG of gaze error over cost of all candidates, with their Pareto set."""
    figure, axes = report.make_figure(size=(6.0, 4.0))
    for budget, state in zip(
        codesign_run.settings.run.budgets_mmacs, codesign_run.searches, strict=True
    ):
        macs = [c.macs / 1e6 for c in state.history]
        axes.plot(
            macs,
            [c.error for c in state.history],
            "o",
            label=f"budget {budget:g} MMACs",
        )
    front = pareto_front([c for s in codesign_run.searches for c in s.history])
    axes.step(
        [c.macs / 1e6 for c in front],
        [c.error for c in front],
        where="post",
        color="k",
        label="Pareto set",
    )
    axes.set(
        xlabel="MMACs",
        ylabel="gaze error on validation / deg",
        title="Accuracy against compute",
    )
    axes.legend()
    return report.figure_png(figure)


COLUMNS = {  # of the table, by name in result.json
    "budget_mmacs": "budget",
    "mmacs": "MMACs",
    "effective_pitch_um": "pixels seen / um",
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
