"""The whole chain on a real lens: every stage is run as its command, and one report
shows it all.
"""

import contextlib
import io
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from metalens.cli import main as run_verb
from metalens.commands import chain
from metalens.commands.chain import ChainFiles, ChainStage
from metalens.commands.common import CommonOptions
from metalens.core import report, store, transaction
from metalens.core.errors import ConfigError, MetalensError

OUTCOMES = "outcomes.jsonl"


@dataclass(frozen=True, slots=True)
class StageOutcome:
    """What a verb did: its exit status, its --json result, and its wall time."""

    stage: ChainStage
    status: int
    values: dict[str, Any]
    seconds: float


@dataclass(frozen=True)
class Options(CommonOptions):
    """Options of ``metalens demo``.

    Attributes:
        output: folder of all results; report.html is the page to open.
        config: CHAIN.toml of your own (cell, design, process; psf, bench_design,
            bench_truth, bench_metrology, run):
            the same chain unattended, at any size.
        resume: go on after the last stage that was finished.
        aperture_mm: diameter of the lens, in place of the one in the design.
    """

    output: tyro.conf.Positional[Path]
    config: Path | None = None
    aperture_mm: float | None = None
    resume: bool = False


def run(options: Options) -> int:
    """Run the chain of commands and write its report.

    Exit status 0 when every stage passed its own check, else that of the first that did
    not.

    Args:
        options: of the command line.

    Raises:
        ConfigError: an aperture out of range, or a folder of other settings.
    """
    if options.aperture_mm is not None and not 0.02 <= options.aperture_mm <= 10:
        raise ConfigError(f"aperture_mm = {options.aperture_mm}: need 0.02 to 10")
    files = (
        chain.shipped_settings()
        if options.config is None
        else chain.load_chain(options.config)
    )
    source = None if options.config is None else options.config.parent
    inputs = chain.lay_out_inputs(files, source, aperture_mm=options.aperture_mm)
    target = options.output.absolute()  # stages run in another folder
    with options.claim_work(target, keep=(OUTCOMES,), resume=options.resume) as draft:
        folder = draft.path
        if not inputs.stands_in(folder):  # results of other settings are not mixed in
            if (folder / OUTCOMES).is_file():
                raise ConfigError(
                    f"{options.output} was begun with other settings; start over with --force"
                )
            transaction.empty_folder(folder)
            inputs.write(folder)
        outcomes: list[StageOutcome] = []
        for outcome in _run_stages(folder, inputs.files):
            outcomes.append(outcome)
            words = " ".join(outcome.stage.words)
            verdict = "ok" if outcome.status == 0 else "FAILED"
            options.console.say(
                f"{outcome.seconds:6.1f} s  metalens {words}  {verdict}"
            )
        _write(folder, outcomes)
    page = options.output / "report.html"
    values = {
        _name(o.stage): {"status": o.status, "seconds": o.seconds, **o.values}
        for o in outcomes
    }
    options.console.result({"report": str(page), **values}, f"open {page}")
    return next((o.status for o in outcomes if o.status), 0)


def _name(stage: ChainStage) -> str:
    """The verb of a stage; ``bench_design`` for the second design of the chain."""
    verb = stage.words[0]
    of_bench = verb == "design" and "bench_design.toml" in stage.words
    return "bench_design" if of_bench else verb


def _run_stages(folder: Path, files: ChainFiles) -> Iterator[StageOutcome]:
    """Outcome of every stage in order; stages of an earlier run are not repeated.

    Args:
        folder: of the chain, which becomes the current folder.
        files: settings files of the stages.

    Raises:
        MetalensError: a stage that refused its input.
    """
    done = dict(_done(folder / OUTCOMES))
    with contextlib.chdir(folder):
        for stage in chain.chain_stages(files):
            if stage.words in done:
                yield StageOutcome(stage, *done[stage.words])
                continue
            start = time.perf_counter()
            printed = io.StringIO()
            with contextlib.redirect_stdout(printed):
                status = run_verb([*stage.words, "--json", "--force"])
            values = (
                json.loads(printed.getvalue()) if printed.getvalue().strip() else {}
            )
            seconds = time.perf_counter() - start
            if status in (0, 1):
                store.append_line(
                    Path(OUTCOMES), json.dumps([stage.words, status, values, seconds])
                )
            yield StageOutcome(stage, status, values, seconds)
            if status == 130:
                raise KeyboardInterrupt
            if status not in (0, 1):
                raise MetalensError(
                    f"the chain stopped: `metalens {' '.join(stage.words)}` refused its input"
                )


def _done(
    path: Path,
) -> Iterator[tuple[tuple[str, ...], tuple[int, dict[str, Any], float]]]:
    """Words and (status, result, seconds) of the stages that an earlier run finished.

    Damaged lines are left out, so that their stages run again.
    """
    for line in store.whole_lines(path):
        with contextlib.suppress(ValueError, TypeError, RecursionError):
            words, status, values, seconds = json.loads(line)
            yield tuple(words), (int(status), dict(values), float(seconds))


def _write(folder: Path, outcomes: list[StageOutcome]) -> None:
    """Write report.html: key figures, a table of the stages, and a section for each.

    Args:
        folder: of the chain.
        outcomes: of the stages that ran.
    """
    total = sum(o.seconds for o in outcomes)
    design = next(o.values for o in outcomes if o.stage.words[0] == "design")
    passed = not any(o.status for o in outcomes)
    keys = [
        report.KeyFigure("pillars", f"{design.get('pillars', 0):,}"),
        report.KeyFigure(
            "focusing efficiency", report.in_figures(design.get("efficiency"), 3)
        ),
        report.KeyFigure(
            "every stage passed its check", report.in_figures(passed), good=passed
        ),
        report.KeyFigure("from first solve to this page", f"{total:.0f} s"),
    ]
    head = ("stage", "seconds", "how wrong it may be", "passed its check", "command")
    rows = [
        (
            o.stage.title,
            f"{o.seconds:.1f}",
            _error(o),
            o.status == 0,
            f"metalens {' '.join(o.stage.words)}",
        )
        for o in outcomes
    ]
    timing = report.Table(
        head, rows, "Time and error. Run any of these yourself in this folder."
    )
    sections = [
        report.Section(
            "The chain",
            "Every stage is a command; every artefact is a file.",
            (timing,),
        ),
        *(_section(folder, outcome) for outcome in outcomes),
    ]
    report.write_report(
        folder / "report.html",
        "From pillar cell to the lens as built",
        sections,
        lead="A metalens for an eye tracker: the physics of one silicon pillar, the mask, and the lens that was made.",
        key_figures=keys,
    )


def _section(folder: Path, outcome: StageOutcome) -> report.Section:
    stage = outcome.stage
    pictures = [
        report.Figure((folder / name).read_bytes(), caption, wide=True)
        for name, caption in stage.pictures
        if (folder / name).is_file()
    ]
    words = f"metalens {' '.join(stage.words)}: {outcome.seconds:.1f} s"
    table = report.summary_table(outcome.values, words)
    return report.Section(stage.title, stage.text, (*pictures, table))


def _error(outcome: StageOutcome) -> str:
    """Error of a stage in figures with its meaning; the meaning alone if unknown."""
    key, meaning = outcome.stage.error
    value = outcome.values.get(key)
    if isinstance(value, dict):
        value = sum(len(differences) for differences in value.values())
    if not isinstance(value, int | float):
        return meaning
    return f"{report.in_figures(float(value), 2)} {meaning}"
