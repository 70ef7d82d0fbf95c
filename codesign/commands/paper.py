"""RUN_DIR... to one page: every table and figure of the paper beside ours: paper, ours,
ratio, conditions.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

from codesign.adapt import source as finished
from codesign.commands import evaluate_optics as command_evaluate_optics
from codesign.commands import experiment as command_experiment
from codesign.commands.options import experiment as experiment_options
from codesign.commands.options import optics as optics_options
from codesign.commands.options.paper import Options
from codesign.evaluate import ROLES, ClaimLine, MeasuredNumber, paper
from codesign.settings import ExperimentConfig
from metalens.core import report, store
from metalens.core.errors import ConfigError

JSON, PAGE = "paper.json", "report.html"
DIM_DB = 15.0


def run(options: Options) -> int:
    """Measure what is missing, compare, write; exit 1 where a measurement's own check
    failed.

    Args:
        options: of the command line.
    """
    if len(options.runs) > len(ROLES):
        raise ConfigError(
            f"{len(options.runs)} runs; give at most {len(ROLES)}: {', '.join(ROLES)}"
        )
    folder = options.output
    runs = dict(zip(ROLES, options.runs, strict=False))
    if (folder / JSON).is_file() and not options.force:
        raise ConfigError(
            f"{folder / JSON} exists; give --force to write it again from the measurements beside it"
        )
    for path in options.runs:
        finished.rows_of(path)  # refused now, not after an hour of measuring
    with options.claim_work(folder, keep=("[!m]*",), grow=True) as draft:
        if options.runs and options.measure:
            _run_measurements(options, draft.path)
        claims = paper.claim_lines(
            collect_measurements(draft.path, runs, options.others), draft.path
        )
        _write_page(draft.path, claims)
        values = [
            {
                **asdict(t.claim),
                "ours": asdict(t.ours) if t.ours else None,
                "picture": t.picture,
            }
            for t in claims
        ]
        store.write_text(
            draft.path / JSON, json.dumps(values, indent=1, default=float) + "\n"
        )
    text = f"{claims_table(claims)}\nopen {folder / PAGE}"
    return options.console.judged(
        {"lines": values, "folder": str(folder)}, text, measurement_failures(folder)
    )


def measurement_files(folder: Path) -> dict[str, Path]:
    """Files of the measurements that a ``folder`` holds, by name."""
    names = {"experiment": "experiment", "dim": "experiment", "optics": "optics"}
    files = {name: folder / name / f"{file}.json" for name, file in names.items()}
    return {name: path for name, path in files.items() if path.is_file()}


def measurement_failures(folder: Path) -> list[str]:
    """Checks that the measurements in ``folder`` failed, each with its measurement."""
    return [
        f"{name}: {words}"
        for name, path in measurement_files(folder).items()
        for words in json.loads(path.read_text("utf-8")).get("failures", [])
    ]


def collect_measurements(
    folder: Path, runs: dict[str, Path], others: Sequence[Path] = ()
) -> dict[str, MeasuredNumber]:
    """Numbers measured into ``folder``, and those of the runs and ablations.

    Args:
        folder: of the measurements. runs: folder by role. others: runs with a part
            frozen.

    Raises:
        StoreError, TrainingError: a measurement or a run is damaged or of another
            version.
    """
    measured: dict[str, MeasuredNumber] = {}
    files = measurement_files(folder)
    if "experiment" in files:
        measured |= paper.of_experiment(files["experiment"])
    if {"experiment", "dim"} <= files.keys():
        measured |= paper.of_dim(files["experiment"], files["dim"])
    if "optics" in files:
        measured |= paper.of_optics(files["optics"])
    rows = {role: finished.rows_of(path) for role, path in runs.items()}
    ours = rows.get("proposed", [])
    measured |= paper.of_runs(rows) | paper.of_gaze(ours)
    return measured | paper.of_ablations(ours, dict(paper.frozen_rows(others)))


def _run_measurements(options: Options, folder: Path) -> None:
    """Run the experiments and the optics evaluation that are missing in the folder."""
    names = ROLES[: len(options.runs)]
    config = ExperimentConfig(subjects=options.subjects)
    for name, settings in (
        ("experiment", config),
        ("dim", replace(config, snr_db=DIM_DB)),
    ):
        if not (folder / name / "experiment.json").is_file():
            options.console.say(f"measuring: {name}")
            experiment = experiment_options.Options(
                options.runs, folder / name, names, settings, quiet=True, force=True
            )
            command_experiment.run(experiment)
    if not (folder / "optics" / "optics.json").is_file():
        options.console.say("measuring: optics")
        order = sorted(
            zip(names, options.runs, strict=True),
            key=lambda pair: pair[0] != "hyperbolic",
        )
        lenses = tuple(_copy_lens(folder, name, path) for name, path in order)
        settings_file = folder / "optics.toml"
        store.write_text(
            settings_file,
            f"[scenes]\nimage_tolerance = {paper.image_tolerance(options.runs)}\n",
        )
        optics = optics_options.Options(
            lenses=lenses,
            output=folder / "optics",
            config=settings_file,
            scenes=options.scenes,
            quiet=True,
            force=True,
        )
        command_evaluate_optics.run(optics)


def _copy_lens(folder: Path, name: str, run_dir: Path) -> Path:
    """Copy of a run's lens under the name of its role, which the tables use."""
    lens_folder = folder / "lenses"
    lens_folder.mkdir(exist_ok=True)
    store.write_bytes(lens_folder / f"{name}.h5", (run_dir / "lens.h5").read_bytes())
    return lens_folder / f"{name}.h5"


def claims_table(claims: list[ClaimLine]) -> str:
    """The lines as text.

    Args:
        claims: with their measurements.
    """
    head = ("place", "what", "paper", "ours", "ratio", "conditions")
    return report.Table(head, [line.words() for line in claims]).text


def _write_page(folder: Path, claims: list[ClaimLine]) -> None:
    """Write the page: for every table and figure of the paper, its claims and ours."""
    places = list(dict.fromkeys(t.claim.place for t in claims))
    head = ("what", "paper", "ours", "ratio", "conditions")
    sections = []
    for place in places:
        lines = [t for t in claims if t.claim.place == place]
        items: list[report.Figure | report.Table] = (
            [report.Table(head, [t.words()[1:] for t in lines if not t.picture])]
            if any(not t.picture for t in lines)
            else []
        )
        items += [
            report.Figure((folder / t.picture).read_bytes(), t.claim.what, wide=True)
            for t in lines
            if t.picture
        ]
        sections.append(report.Section(place, items=items))
    measured = sum(t.ours is not None or bool(t.picture) for t in claims)
    keys = [
        report.KeyFigure("claims of the paper", str(len(claims))),
        report.KeyFigure("measured here", str(measured)),
    ]
    lead = "Every table and figure of the paper beside ours. What was not measured says which command would."
    report.write_report(
        folder / PAGE, "The paper, and ours", sections, lead=lead, key_figures=keys
    )
