"""The chain as far as it stands, on a real lens: every stage is run as its command, and one report shows it all."""

import contextlib
import io
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import tyro

from metalens import report, store
from metalens.cli import main as run_verb
from metalens.commands import Common
from metalens.errors import ConfigError, MetalensError


@dataclass(frozen=True, slots=True)
class Stage:
    """One verb of the chain.

    words: of the command line, relative to the demo's folder. error: entry of the result that says how wrong it may
    be, and what it means. pictures: files that the verb leaves, with captions.
    """

    title: str
    text: str
    words: tuple[str, ...]
    error: tuple[str, str]
    pictures: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a verb did: its exit status, its --json result, and its wall time."""

    stage: Stage
    status: int
    values: dict[str, Any]
    seconds: float


@dataclass(frozen=True)
class Options(Common):
    """Options of ``metalens demo``.

    Attributes:
        output: folder for everything that is made; report.html is the page to open.
        aperture_mm: diameter of the lens.
    """

    output: tyro.conf.Positional[Path]
    aperture_mm: float = 1.0


def stages() -> tuple[Stage, ...]:
    """The chain, in order."""
    return (
        Stage(
            "Pillar library",
            "Rigorous solves of one pillar cell over the diameter, joined by a rational function, with an error bar on "
            "every entry, and the polynomial proxy (paper Eq. 2) that every later stage uses.",
            ("library", "cell.toml", "-o", "library.h5"),
            ("max_error", "largest error bar of |t|"),
            (
                (
                    "library.png",
                    "Phase and transmission of the pillars with their error bars, and the proxy's residual.",
                ),
            ),
        ),
        Stage(
            "Lens",
            "Every site takes the printable diameter whose phase is the wanted one. A direct Rayleigh-Sommerfeld sum "
            "over all pillars then shows where the light really meets.",
            ("design", "design.toml", "-o", "lens.h5"),
            ("max_phase_error_rad", "rad between wanted and made phase"),
            (("lens.png", "Phase and diameter of the pillars across the lens, and a zoom to single pillars."),),
        ),
        Stage(
            "Point spread functions",
            "Images of point sources from 16 to 26 mm, computed on the sensor window only, to a stated error.",
            ("psf", "lens.h5", "-o", "psf.h5"),
            ("error", "relative error of the PSFs"),
            (
                ("psf_xz.png", "Slice through the PSF along depth."),
                ("psf_montage.png", "PSFs over depth and field angle."),
                ("psf_information.png", "Axial information of Eq. 11; the normalisation decides the ranking."),
                ("psf_mtf.png", "Modulation transfer, and energy inside a circle."),
            ),
        ),
        Stage(
            "Mask",
            "One cell per diameter, polygons of equal area on the mask grid, aperture, marks, label, dose test and "
            "witness cells; checked against the design rules, written, read back and compared.",
            ("layout", "lens.h5", "--process", "process.toml", "-o", "mask", "--oasis", "--gds"),
            ("differences", "differences between plan and written files"),
            (
                ("mask/die.png", "The whole die."),
                ("mask/pillars.png", "Single pillars as polygons of the mask."),
                ("mask/diameters.png", "How many pillars of each diameter."),
                ("mask/margins.png", "Distance to the design rules."),
            ),
        ),
    )


def run(options: Options) -> int:
    """Run the chain; exit 0 when every stage passed its own check, else the status of the first that did not."""
    folder = options.output
    if folder.exists() and any(folder.iterdir()) and not options.force:
        raise ConfigError(f"{folder} is not empty; give --force to write into it")
    if not 0.02 <= options.aperture_mm <= 10:
        raise ConfigError(f"aperture_mm = {options.aperture_mm}: need 0.02 to 10")
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("cell.toml", "design.toml", "process.toml"):
        text = resources.files("metalens").joinpath("data", "demo", name).read_text(encoding="utf-8")
        store.write_text(folder / name, text.replace("aperture_mm = 1.0", f"aperture_mm = {options.aperture_mm}"))
    outcomes: list[Outcome] = []
    for outcome in _chain(folder):
        outcomes.append(outcome)
        words = " ".join(outcome.stage.words)
        options.console.say(f"{outcome.seconds:6.1f} s  metalens {words}  {'ok' if outcome.status == 0 else 'FAILED'}")
    _write(folder, outcomes)
    page = folder / "report.html"
    values = {o.stage.words[0]: {"status": o.status, "seconds": o.seconds, **o.values} for o in outcomes}
    options.console.result({"report": str(page), **values}, f"open {page}")
    return next((o.status for o in outcomes if o.status), 0)


def _chain(folder: Path) -> Iterator[Outcome]:
    """Run the verbs in the demo's folder until one refuses its input."""
    with contextlib.chdir(folder):
        for stage in stages():
            start, shown = time.perf_counter(), io.StringIO()
            with contextlib.redirect_stdout(shown):
                status = run_verb([*stage.words, "--json", "--force"])
            values = json.loads(shown.getvalue()) if shown.getvalue().strip() else {}
            yield Outcome(stage, status, values, time.perf_counter() - start)
            if status == 2:
                raise MetalensError(f"the demo stopped: `metalens {' '.join(stage.words)}` refused its input")


def _write(folder: Path, outcomes: list[Outcome]) -> None:
    total = sum(o.seconds for o in outcomes)
    made = {o.stage.words[0]: o.values for o in outcomes}
    keys = [
        report.KeyFigure("pillars", f"{made['design'].get('pillars', 0):,}"),
        report.KeyFigure("numerical aperture", f"{made['design'].get('numerical_aperture', 0):.3f}"),
        report.KeyFigure("focusing efficiency", f"{made['design'].get('efficiency', 0):.1%}"),
        report.KeyFigure("every stage passed its check", _verdict(outcomes), good=not any(o.status for o in outcomes)),
        report.KeyFigure("from cell to checked mask", f"{total:.0f} s"),
    ]
    rows = [
        (o.stage.title, "metalens " + " ".join(o.stage.words), f"{o.seconds:.1f}", _error(o), _verdict([o]))
        for o in outcomes
    ]
    head = ("stage", "command", "seconds", "how wrong it may be", "passed its check")
    timing = report.Table(head, rows, "Run any of these yourself in this folder.")
    sections = [_section(folder, outcome) for outcome in outcomes]
    report.write(
        folder / "report.html",
        "From pillar cell to verified mask",
        [report.Section("The chain", "Every stage is a command; every artefact is a file.", (timing,)), *sections],
        lead="A metalens for an eye tracker, from the physics of one silicon pillar to the file that is written.",
        key_figures=keys,
    )


def _section(folder: Path, outcome: Outcome) -> report.Section:
    stage = outcome.stage
    pictures = [
        report.Figure((folder / name).read_bytes(), caption, wide=True)
        for name, caption in stage.pictures
        if (folder / name).is_file()
    ]
    rows = [
        (name.replace("_", " "), f"{value:.5g}" if isinstance(value, float) else value)
        for name, value in outcome.values.items()
        if isinstance(value, bool | int | float | str)
    ]
    table = report.Table(("result", "value"), rows, f"metalens {' '.join(stage.words)}: {outcome.seconds:.1f} s")
    return report.Section(stage.title, stage.text, (*pictures, table))


def _error(outcome: Outcome) -> str:
    key, meaning = outcome.stage.error
    found = outcome.values.get(key)
    if isinstance(found, dict):
        found = sum(len(differences) for differences in found.values())
    return f"{found:.2g} {meaning}" if isinstance(found, int | float) else meaning


def _verdict(outcomes: list[Outcome]) -> str:
    return "yes" if not any(o.status for o in outcomes) else "no"
