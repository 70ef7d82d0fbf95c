"""RUN.toml to RUN_DIR: lens, pixel pitch and network trained together, then searched
under compute budgets.
"""

import io
import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from matplotlib import image as plt_image

from codesign.adapt import lens_file, weights_file
from codesign.batches import parallel
from codesign.commands import onnx_file
from codesign.commands.options.codesign import Options
from codesign.network import Subnet
from codesign.optics import formed
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
    """Train, search, finish; exit 1 where the error of the true image is above what the
    run asks for.

    Args:
        options: of the command line.
    """
    settings = _frozen(runs.load_run_settings(options.config), options.freeze)
    device = device_of(options.device)
    parallel.join_processes(device)
    if parallel.process_rank():
        return _assist(transaction.unfinished_path(options.output), settings, device)
    with options.claim_work(
        options.output, keep=(CHECKPOINT,), resume=options.resume
    ) as draft:
        rows, said = _work(options, settings, device, draft.path)
    count = torch.get_num_threads()
    values = {
        "rows": rows,
        "folder": str(options.output),
        "image": said,
        "threads": count,
    }
    words = f"trained on {count} thread{'s' * (count > 1)}; another number changes the last digits, and with them the run"
    return options.console.judged(
        values,
        f"{_table(rows)}\n{formed.describe_image_text(said)}\n{words}",
        [said["above"]],
    )


def _work(
    options: Options, settings: RunConfig, device: torch.device, folder: Path
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Train, search and write into the folder; a row a network, and what images they
    were trained on.
    """
    console = options.console
    going = _resume(folder, settings) if options.resume else _start(folder, settings)
    if settings.run.pitch_um < settings.optics.sample_um:
        console.say(_of_samples(settings))
    place_on_device(going.trainer, device)
    parallel.wait_for_all()
    writer = _writer(folder, going.trainer.step) if options.events else None
    held = False
    records = runs.train_run(going, folder / CHECKPOINT)
    left = settings.inner.steps - going.trainer.step
    for record in console.track(records, total=left, label="training"):
        checkpoint.append_entry(folder / LOG, {"kind": "step", **asdict(record)})
        if writer:
            _events(writer, going, record)
        if (limit := going.trainer.pitch_held_um) is not None and not held:
            held = True
            console.say(f"step {record.step}: {_of_pitch(going, limit)}")
        if record.step % settings.checkpoint_every == 0:
            console.say(
                f"step {record.step}/{settings.inner.steps}: loss {record.loss:.4f}, task {record.task:.4f}, "
                f"pitch {record.pitch_um:.2f} um, {record.mmacs:.1f} MMACs, {record.skipped} skipped"
            )
    for budget, born in search.search_architectures(going, folder / CHECKPOINT):
        one = {"budget_mmacs": budget, "error": born.error, "mmacs": born.macs / 1e6}
        entry = {"kind": "birth", **one, "architecture": asdict(born.architecture)}
        checkpoint.append_entry(folder / LOG, entry)
        console.say(
            f"budget {budget:g} MMACs: gaze error {born.error:.2f} deg at {born.macs / 1e6:.2f} MMACs"
        )
    parallel.leave_processes()
    ends = finished_budgets(going)
    said = _image(going)
    _keep(folder, going, ends, said)
    if options.export:
        _export(folder, going, ends)
    return [end.row for end in ends], said


def _of_samples(settings: RunConfig) -> str:
    return (
        f"run.pitch_um = {settings.run.pitch_um:g} is finer than the samples of the image, optics.sample_um = "
        f"{settings.optics.sample_um:g}: such pixels cost more and show nothing new"
    )


def _of_pitch(going: CodesignRun, limit_um: float) -> str:
    settings = going.settings
    if limit_um <= going.trainer.model.finest_um:
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


def _image(going: CodesignRun) -> dict[str, Any]:
    settings = going.settings
    side = settings.scenes.pixels + 2 * settings.scenes.margin
    coefficients = going.trainer.model.coefficients_rad.detach()
    return formed.describe_image(
        settings.optics, coefficients, side, margin=settings.scenes.margin
    )


def _export(folder: Path, going: CodesignRun, ends: list[BudgetResult]) -> None:
    """Every budget's network as ONNX."""
    for end, state in zip(ends, going.searches, strict=True):
        path = folder / f"subnet_{end.row['budget_mmacs']:g}.onnx"
        own = replace(going, trainer=end.trainer)
        net = end.trainer.model.net
        onnx_file.write_network_file(
            path, own, net, best_candidate(state.history).architecture
        )


def _assist(folder: Path, settings: RunConfig, device: torch.device) -> int:
    """Another process of ``torchrun``: trains and searches along from the same
    checkpoint, writes nothing.
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


def _frozen(settings: RunConfig, parts: tuple[Part, ...]) -> RunConfig:
    both = tuple(sorted({*settings.run.frozen, *parts}))
    return replace(settings, run=replace(settings.run, frozen=both))


def _writer(folder: Path, step: int) -> Any:
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


def _events(writer: Any, going: CodesignRun, record: LogRecord) -> None:
    for name, value in asdict(record).items():
        if name != "step":
            writer.add_scalar(name, float(value), record.step)
    if record.step % going.settings.checkpoint_every == 0:
        for name, picture in results.run_pictures(going).items():
            image = plt_image.imread(io.BytesIO(picture))
            writer.add_image(name, image, record.step, dataformats="HWC")
    writer.flush()


def _start(folder: Path, settings: RunConfig) -> CodesignRun:
    store.write_text(folder / SETTINGS, config.dumps(settings))
    made = runs.start_run(settings)
    runs.save_run(folder / CHECKPOINT, made)
    return made


def _resume(folder: Path, settings: RunConfig) -> CodesignRun:
    """The run of the folder's checkpoint; log lines beyond it are dropped."""
    made = runs.resume_run(folder / CHECKPOINT, settings)
    births = sum(len(s.history) for s in made.searches)
    entries = checkpoint.read_entries(folder / LOG)
    steps = [
        e for e in entries if e["kind"] == "step" and e["step"] <= made.trainer.step
    ]
    born = [e for e in entries if e["kind"] == "birth"]
    checkpoint.write_entries(folder / LOG, steps + born[:births])
    return made


def _keep(
    folder: Path, going: CodesignRun, ends: list[BudgetResult], said: dict[str, Any]
) -> None:
    """lens.h5, the networks, result.json, answers.h5 and the plot of the Pareto set."""
    settings = going.settings
    about = store.Provenance(config=config.dumps(settings), seed=settings.inner.seed)
    phase = going.trainer.model.coefficients_rad.detach()
    lens.save(folder / "lens.h5", trained.trained_lens(settings.optics, phase, about))
    _weights(folder, going, ends, about)
    pitch = float(going.trainer.model.pitch_um.detach())
    rows = [end.row for end in ends]
    found = {
        "pitch_um": pitch,
        "seed": settings.inner.seed,
        "steps": settings.inner.steps,
        "rows": rows,
    }
    found |= {"bound": results.window_depth_bound(going)}
    found |= {"frozen": list(settings.run.frozen), "image": said}
    found |= {"pitch_held_um": going.trainer.pitch_held_um}
    found |= {"threads": torch.get_num_threads(), "bytes_depend_on_threads": True}
    store.write_text(folder / RESULT, json.dumps(found, indent=1) + "\n")
    said_by = {
        f"network_{i}": f"budget {row['budget_mmacs']:g} million MACs"
        for i, row in enumerate(rows)
    }
    store.save(
        folder / ANSWERS,
        "answers",
        results.predictions_of_frames(ends, SHOWN),
        attributes=said_by,
    )
    if going.searches:
        store.write_bytes(folder / "pareto.png", _plot(going))


def _weights(
    folder: Path, going: CodesignRun, ends: list[BudgetResult], about: store.Provenance
) -> None:
    """Every network, cut to its own architecture, with the lens of its own."""
    for end, state in zip(ends, going.searches, strict=True):
        model, budget = end.trainer.model, end.row["budget_mmacs"]
        kept = Subnet(model.net, best_candidate(state.history).architecture)
        optics = {
            "optics.coefficients_rad": model.coefficients_rad,
            "optics.log_pitch": model.log_pitch,
        }
        checkpoint.save_network(weights_file(folder, budget), kept, beside=optics)
        if going.settings.search.inner_steps:
            own = trained.trained_lens(
                going.settings.optics, model.coefficients_rad.detach(), about
            )
            lens.save(lens_file(folder, going.settings, budget), own)


def _plot(going: CodesignRun) -> bytes:
    figure, axes = report.make_figure(size=(6.0, 4.0))
    for budget, state in zip(
        going.settings.run.budgets_mmacs, going.searches, strict=True
    ):
        macs = [c.macs / 1e6 for c in state.history]
        axes.plot(
            macs,
            [c.error for c in state.history],
            "o",
            label=f"budget {budget:g} MMACs",
        )
    front = pareto_front([c for s in going.searches for c in s.history])
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
    cells = [[row.get(name) for name in COLUMNS] for row in rows]
    text = report.Table(list(COLUMNS.values()), cells, digits=3).text
    worst = max((r.get("finer_ratio", 1.0) for r in rows), default=1.0)
    if worst <= assess.SAME:
        return text
    return (
        f"{text}\nresults depend on the image: on one formed at a quarter of "
        f"optics.image_tolerance errors are {worst:.2f} times as large; lower it"
    )
