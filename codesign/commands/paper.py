"""RUN_DIR... to one page: every table and figure of the paper with our measurement: paper, ours,
ratio, conditions.
"""

import json
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
from codesign.train import run as codesign_run
from metalens.core import report, store
from metalens.core.errors import ConfigError

JSON, PAGE = "paper.json", "report.html"


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
            f"{folder / JSON} exists; give --force to write it again from the measurements in the folder"
        )
    for path in options.runs:
        finished.rows_of(path)  # refused now, not after an hour of measuring
    with options.claim_work(folder, keep=("[!m]*",), grow=True) as draft:
        if options.runs and options.measure:
            _run_measurements(options, draft.path)
        measured = collect_measurements(draft.path, runs)
        claims = paper.claim_lines(measured, draft.path)
        _write_page(draft.path, claims)
        values = [asdict(line) for line in claims]
        values = [line.pop("claim") | line for line in values]
        store.write_text(
            draft.path / JSON, json.dumps(values, indent=1, default=float) + "\n"
        )
    head = ("place", "what", "paper", "ours", "ratio", "conditions")
    table = report.Table(head, [line.words() for line in claims]).text
    return options.console.judged(
        {"lines": values, "folder": str(folder)},
        f"{table}\nopen {folder / PAGE}",
        [
            f"{name}: {words}"
            for name, path in measurement_files(folder).items()
            for words in json.loads(path.read_text("utf-8")).get("failures", [])
        ],
    )


def measurement_files(folder: Path) -> dict[str, Path]:
    """Files of the measurements that a ``folder`` holds, by name."""
    names = {"experiment": "experiment", "dim": "experiment", "optics": "optics"}
    files = {name: folder / name / f"{file}.json" for name, file in names.items()}
    return {name: path for name, path in files.items() if path.is_file()}


def collect_measurements(
    folder: Path, runs: dict[str, Path]
) -> dict[str, MeasuredNumber]:
    """Numbers measured into ``folder``, and those of the runs.

    Args:
        folder: of the measurements. runs: folder by role.

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
    return measured | paper.of_runs(rows) | paper.of_gaze(rows.get("proposed", []))


def _run_measurements(options: Options, folder: Path) -> None:
    """Run the experiments and the optics evaluation that are missing in the folder."""
    names = ROLES[: len(options.runs)]
    config = ExperimentConfig(subjects=options.subjects)
    for name, settings in (
        ("experiment", config),
        ("dim", replace(config, snr_db=15.0)),
    ):
        if not (folder / name / "experiment.json").is_file():
            options.console.say(f"measuring: {name}")
            experiment = experiment_options.Options(
                options.runs,
                folder / name,
                names,
                settings=settings,
                quiet=True,
                force=True,
            )
            command_experiment.run(experiment)
    if not (folder / "optics" / "optics.json").is_file():
        options.console.say("measuring: optics")
        # the tables name lenses by their files, and compare them with the first
        (folder / "lenses").mkdir(exist_ok=True)
        paths = {name: folder / "lenses" / f"{name}.h5" for name in names}
        for path, run_dir in zip(paths.values(), options.runs, strict=True):
            store.write_bytes(path, (run_dir / "lens.h5").read_bytes())
        first = paths.pop("hyperbolic", None)
        tolerance = max(
            codesign_run.load_run_settings(run_dir / "run.toml").optics.image_tolerance
            for run_dir in options.runs
        )
        settings_file = folder / "optics.toml"
        store.write_text(settings_file, f"[scenes]\nimage_tolerance = {tolerance}\n")
        optics = optics_options.Options(
            lenses=(*([first] if first else []), *paths.values()),
            output=folder / "optics",
            config=settings_file,
            scenes=options.scenes,
            quiet=True,
            force=True,
        )
        command_evaluate_optics.run(optics)


def _write_page(folder: Path, claims: list[ClaimLine]) -> None:
    """Write the page: for every table and figure of the paper, its claims and ours."""
    head = ("what", "paper", "ours", "ratio", "conditions")
    sections = []
    for place in dict.fromkeys(line.claim.place for line in claims):
        lines = [line for line in claims if line.claim.place == place]
        items: list[report.Figure | report.Table] = [
            report.Figure(
                (folder / line.picture).read_bytes(), line.claim.what, wide=True
            )
            for line in lines
            if line.picture
        ]
        rows = [line.words()[1:] for line in lines if not line.picture]
        if rows:
            items.insert(0, report.Table(head, rows))
        sections.append(report.Section(place, items=items))
    lead = "Every table and figure of the paper with our measurement. What was not measured says which command would."
    report.write_report(folder / PAGE, "The paper, and ours", sections, lead=lead)
