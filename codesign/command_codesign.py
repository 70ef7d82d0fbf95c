"""RUN.toml to RUN_DIR: lens, pixel pitch and network trained together, then searched under compute budgets."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import tyro
from safetensors.torch import save_file

from codesign import optics as trained
from codesign import run as runs
from codesign.evolution import best, pareto
from codesign.inner import Record
from codesign.run import Run, RunConfig
from codesign.subnet import Subnet
from metalens import config, design, lens, library, report, store
from metalens.commands import Common, Output
from metalens.console import Console
from metalens.errors import ConfigError

CHECKPOINT, LOG, SETTINGS, RESULT = "checkpoint.safetensors", "log.jsonl", "run.toml", "result.json"


@dataclass(frozen=True)
class Options(Common):
    """Options of ``metalens codesign``.

    Attributes:
        config: RUN.toml.
        output: folder of the run.
        resume: go on from the folder's checkpoint, bit for bit.
    """

    config: tyro.conf.Positional[Path]
    output: Output = Path("run")
    resume: bool = False


def run(options: Options) -> int:
    """Train, search, finish; exit 0."""
    settings = runs.load(options.config)
    folder, console = options.output, options.console
    going = _resume(folder, settings) if options.resume else _start(folder, settings, force=options.force)
    for record in _progress(console, runs.train(going, folder / CHECKPOINT), going):
        _log(folder, {"kind": "step", **asdict(record)})
        if record.step % settings.checkpoint_every == 0:
            console.say(
                f"step {record.step}/{settings.inner.steps}: loss {record.loss:.4f}, task {record.task:.4f}, "
                f"pitch {record.pitch_um:.2f} um, {record.mmacs:.1f} MMACs, {record.skipped} skipped"
            )
    for budget, born in runs.search(going, folder / CHECKPOINT):
        _log(folder, {"kind": "birth", "budget_mmacs": budget, "error": born.error, "mmacs": born.macs / 1e6})
        console.say(f"budget {budget:g} MMACs: slip error {born.error:.3f} mm at {born.macs / 1e6:.2f} MMACs")
    rows = runs.finish(going)
    _keep(folder, going, rows)
    console.result({"rows": rows, "folder": str(folder)}, _table(rows))
    return 0


def _start(folder: Path, settings: RunConfig, *, force: bool) -> Run:
    if folder.exists() and any(folder.iterdir()):
        if not force:
            raise ConfigError(f"{folder} is not empty; give --resume to go on, or --force to start over")
        shutil.rmtree(folder)
    folder.mkdir(parents=True, exist_ok=True)
    store.write_text(folder / SETTINGS, config.dumps(settings))
    made = runs.start(settings)
    runs.save(folder / CHECKPOINT, made)
    return made


def _resume(folder: Path, settings: RunConfig) -> Run:
    """The run of the folder's checkpoint; log lines beyond it are dropped."""
    made = runs.resume(folder / CHECKPOINT, settings)
    births = sum(len(s.history) for s in made.searches)
    kept: list[str] = []
    for line in (folder / LOG).read_text(encoding="utf-8").splitlines() if (folder / LOG).is_file() else []:
        entry = _entry(line)
        if entry.get("kind") == "step" and entry["step"] <= made.trainer.step:
            kept.append(line)
        elif entry.get("kind") == "birth" and births > 0:
            kept.append(line)
            births -= 1
    store.write_text(folder / LOG, "".join(line + "\n" for line in kept))
    return made


def _entry(line: str) -> dict[str, Any]:
    try:
        entry: dict[str, Any] = json.loads(line)
    except json.JSONDecodeError:  # the line that was being written when the run was killed
        return {}
    return entry


def _progress(console: Console, records: Iterator[Record], going: Run) -> Iterator[Record]:
    left = going.settings.inner.steps - going.trainer.step
    return console.track(records, total=left, label="training")


def _log(folder: Path, entry: dict[str, Any]) -> None:
    with open(folder / LOG, "a", encoding="utf-8") as file:
        file.write(json.dumps(entry) + "\n")


def _keep(folder: Path, going: Run, rows: list[dict[str, Any]]) -> None:
    """lens.h5, the networks, result.json and the plot of the Pareto set."""
    settings = going.settings
    _lens(folder / "lens.h5", going)
    for budget, state in zip(settings.run.budgets_mmacs, going.searches, strict=True):
        cut = Subnet(going.trainer.model.net, best(state.history).architecture)
        with store.replacing(folder / f"subnet_{budget:g}.safetensors") as part:
            save_file(cut.state_dict(), str(part), metadata={"kind": "subnet", "version": "1"})
    pitch = float(going.trainer.model.pitch_um.detach())
    found = {"pitch_um": pitch, "seed": settings.inner.seed, "steps": settings.inner.steps, "rows": rows}
    store.write_text(folder / RESULT, json.dumps(found, indent=1) + "\n")
    store.write_bytes(folder / "pareto.png", _plot(going))


def _lens(path: Path, going: Run) -> None:
    settings = going.settings.optics
    made = library.sweep(library.DEFAULT_CELL, wavelengths_um=(settings.focus.wavelength_um,))
    phase = trained.phase_of(settings, runs.coefficients(going).numpy())
    result, _ = design.make(
        phase,
        settings.focus,
        aperture_um=settings.aperture_mm * 1e3,
        cell=made.cell,
        proxy=library.proxy_of(made),
        profile="codesign",
        provenance=store.Provenance(config=config.dumps(going.settings), seed=going.settings.inner.seed),
    )
    lens.save(path, result)


def _plot(going: Run) -> bytes:
    figure, axes = report.canvas(size=(6.0, 4.0))
    for budget, state in zip(going.settings.run.budgets_mmacs, going.searches, strict=True):
        macs = [c.macs / 1e6 for c in state.history]
        axes.plot(macs, [c.error for c in state.history], "o", label=f"budget {budget:g} MMACs")
    front = pareto([c for s in going.searches for c in s.history])
    axes.step([c.macs / 1e6 for c in front], [c.error for c in front], where="post", color="k", label="Pareto set")
    axes.set(xlabel="MMACs", ylabel="slippage error on validation / mm", title="Accuracy against compute")
    axes.legend()
    return report.png(figure)


def _table(rows: list[dict[str, Any]]) -> str:
    head = "budget  MMACs  axial / mm  lateral / mm   IoU"
    names = ("budget_mmacs", "mmacs", "axial_slip_mm", "lateral_slip_mm", "iou")
    lines = ["{:6g}  {:5.2f}  {:10.3f}  {:12.3f}  {:.3f}".format(*(r[name] for name in names)) for r in rows]
    return "\n".join([head, *lines])
