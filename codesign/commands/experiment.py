"""RUN_DIR... to Figs. 10 and 11: gaze and slippage of synthetic subjects, or in own
frames, before each run's lens and network (Sec. 5).
"""

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from codesign.adapt import FinishedRun, retrained_network
from codesign.commands.evaluate import distinct_names
from codesign.commands.options.experiment import Options
from codesign.evaluate import RunResult, gaze_experiment, own_frames, run_experiment
from codesign.gaze import PopulationPrior, shared
from codesign.optics import image_formation
from codesign.settings import ExperimentConfig
from codesign.train import bootstrap_interval, bootstrap_ratio
from metalens.core import config as settings
from metalens.core import report, store
from metalens.core.errors import ConfigError

JSON, PAGE = "experiment.json", "report.html"


def run(options: Options) -> int:
    """Simulate subjects or read own frames, predict, calibrate, and write tables and
    plots.

    Exit 1 where the error of a run's images is above what the run requires.

    Args:
        options: of the command line.
    """
    if not options.runs:
        raise ConfigError("no run to evaluate; give one run folder or more")
    stems = [
        p.name if p.suffix != ".safetensors" else f"{p.parent.name} {p.stem}"
        for p in (path.resolve() for path in options.runs)
    ]
    names = options.names or distinct_names(stems)
    if len(names) != len(options.runs):
        raise ConfigError(
            f"{len(names)} names for {len(options.runs)} runs; give one a run"
        )
    if len(set(names)) < len(names):
        raise ConfigError(
            f"names {', '.join(names)}: two are alike; give every run one of its own"
        )
    sources = {
        name: retrained_network.load_retrained(path)
        for name, path in zip(names, options.runs, strict=True)
    }
    with options.claim_folder(options.output) as draft:
        if options.frames:
            values, text = _read_own_frames(
                options.frames, options.settings, sources, draft.path
            )
        else:
            values, text = _simulate(options, sources, draft.path)
        store.write_text(draft.path / JSON, json.dumps(values, indent=1) + "\n")
    return options.console.judged(
        values, f"{text}\nopen {options.output / PAGE}", values["failures"]
    )


def _read_own_frames(
    frames: Path,
    config: ExperimentConfig,
    sources: dict[str, FinishedRun],
    folder: Path,
) -> tuple[dict[str, Any], str]:
    """Predictions of every run for own frames, a table a run, and a page of their
    errors; the numbers, and the table as text.
    """
    rows = []
    for name, source in sources.items():
        table = own_frames.predict_own_frames(source, frames, config)
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerows([table, *zip(*table.values(), strict=True)])
        store.write_text(folder / f"{name}.csv", text.getvalue())
        errors = {k: v for k, v in table.items() if "error" in k or k == "iou"}
        rows.append(
            {"name": name, "frames": len(table["file"])}
            | {k: float(np.nanmean(v)) for k, v in errors.items()}
        )
    head = [report.in_words(name) for name in rows[0]]
    shown = report.Table(head, [list(row.values()) for row in rows], digits=3)
    words = (
        "Mean absolute errors over the frames whose targets are given. Gaze is calibrated on "
        f"{config.share:.0%} of each subject's stimuli and judged on the others; the prior of its map comes "
        f"from {config.people} simulated people. Predictions of every frame: a table a run."
    )
    section = report.Section("Errors", words, [shown])
    report.write_report(folder / PAGE, "Own frames", [section])
    return {"frames": str(frames), "runs": rows, "failures": []}, shown.text


def _simulate(
    options: Options, sources: dict[str, FinishedRun], folder: Path
) -> tuple[dict[str, Any], str]:
    """The virtual experiment of all runs, with files, plots and page in the folder; the
    numbers, and their tables as text.
    """
    config, names = options.settings, list(sources)
    results: list[RunResult] = []
    steps = run_experiment(list(sources.values()), config, names=names)
    for _, latest in options.console.track(
        steps, total=config.subjects, label="subjects"
    ):
        results = latest
    values = experiment_summary(results, config) | {
        "images": {
            name: json.loads((source.folder / "result.json").read_text("utf-8")).get(
                "image"
            )
            for name, source in sources.items()
        },
        "lenses": {name: source.lens for name, source in sources.items()},
        "beyond_training_mm": {
            name: sorted(
                slip
                for slip in config.slips_mm.tolist()
                if np.any(np.abs(slip) > source.settings.scenes.slip_mm)
            )
            for name, source in sources.items()
        },
        "failures": [
            f"{result.name}: {result.above}" for result in results if result.above
        ],
    }
    figures = []
    for name, picture in (
        ("errors.png", gaze_experiment.plot_gaze_errors(results)),
        ("ambiguity.png", gaze_experiment.plot_ambiguity(results[0])),
    ):
        store.write_bytes(folder / name, picture)
        figures.append(report.Figure(picture, CAPTIONS[name], wide=True))
    for number, result in enumerate(results, 1):
        if isinstance(result.how, PopulationPrior):
            run_settings = sources[result.name].settings
            origin = store.Provenance(
                config=f"{settings.dumps(run_settings)}\n{settings.dumps(config)}",
                seed=run_settings.inner.seed,
            )
            shared.save_people(
                folder / f"people_{number}.h5", result.how, provenance=origin
            )
    tables, remarks = experiment_tables(values), _remarks(values)
    sections = [
        report.Section("Numbers", ". ".join([_method_text(config), *remarks]), tables),
        report.Section("Figures", "", figures),
    ]
    report.write_report(folder / PAGE, "Virtual experiment", sections)
    images = [
        f"{name}: {image_formation.describe_image_text(image)}"
        for name, image in values["images"].items()
        if image
    ]
    return values, "\n".join([*(table.text for table in tables), *remarks, *images])


FINER = ("gaze_axial_deg", "gaze_lateral_deg", "slip_mm", "slip_axial_mm", "iou")


def experiment_summary(
    results: Sequence[RunResult], config: ExperimentConfig
) -> dict[str, Any]:
    """Mean errors of every run with bootstrap intervals over subjects, and ratios.

    Ratios are of the first run to each of the others.

    Args:
        results: one a run. config: subjects, stimuli, slippage and calibration.
    """
    rows = []
    ratios = []
    first = results[0].subject_errors
    for result in results:
        errors = result.subject_errors
        row: dict[str, Any] = {"name": result.name, "mmacs": result.mmacs}
        for name, values in errors.items():
            row[name] = float(values.mean())
            if len(values) > 1:
                row[f"{name}_interval"] = list(bootstrap_interval(values))
        finer = result.finer.subject_errors if result.finer else {}
        for name in FINER:
            row[f"finer_{name}"] = float(finer[name].mean()) if finer else None
        row["finer_ratio"] = (
            row["finer_gaze_axial_deg"] / row["gaze_axial_deg"] if finer else None
        )
        rows.append(row)
        if result is results[0]:
            continue
        for name in FINER[:4]:
            ratio, *interval = bootstrap_ratio(first[name], errors[name])
            ratios.append({
                "quantity": name, "against": result.name, "ratio": ratio, "interval": interval,
            })  # fmt: skip
    about = {**asdict(config), "frames": config.frames}
    return {"first": results[0].name, "settings": about, "runs": rows, "ratios": ratios}


def experiment_tables(values: dict[str, Any]) -> list[report.Table]:
    """Numbers of every run, and ratios of the first to the others.

    Args:
        values: content of experiment.json.
    """
    rows = [[run[name] for name in COLUMNS] for run in values["runs"]]
    tables = [report.Table(list(COLUMNS.values()), rows, digits=3)]
    ratios = [
        (
            COLUMNS[r["quantity"]].split(" / ")[0],
            r["against"],
            r["ratio"],
            "{:.2f} to {:.2f}".format(*r["interval"]),
        )
        for r in values["ratios"]
    ]
    if ratios:
        head = ("error", "against", f"ratio of {values['first']}", "95 % interval")
        tables.append(report.Table(head, ratios, digits=3))
    return tables


def _remarks(values: dict[str, Any]) -> list[str]:
    """Sentences on made lenses, and on slippage outside the range of training."""
    made = [
        f"{name}: through the lens {lens}"
        for name, lens in values["lenses"].items()
        if lens != "as designed"
    ]
    for name, slips in values["beyond_training_mm"].items():
        places = ", ".join("({:g}, {:g}, {:g})".format(*slip) for slip in slips)
        if slips:
            made.append(f"{name}: slippages {places} mm lie outside its training")
    return made


# what the numbers are called in the result, and in tables
COLUMNS = {
    "name": "run",
    "mmacs": "MMACs",
    "gaze_axial_deg": "gaze, axial slip / deg",
    "finer_gaze_axial_deg": "finer image / deg",
    "finer_ratio": "ratio",
    "gaze_lateral_deg": "gaze, lateral slip / deg",
    "sphere_gaze_axial_deg": "by sphere, axial / deg",
    "sphere_gaze_lateral_deg": "by sphere, lateral / deg",
    "slip_mm": "slip / mm",
    "finer_slip_mm": "finer image / mm",
    "slip_axial_mm": "axial slip / mm",
    "slip_lateral_mm": "lateral slip / mm",
    "iou": "IoU",
}
CAPTIONS = {
    "errors.png": "Mean gaze error at every stimulus: area of the markers (paper Fig. 11).",
    "ambiguity.png": "Pupil centres under slippage (paper Fig. 10): one place, many gazes.",
}


def _method_text(config: ExperimentConfig) -> str:
    """Sentences on subjects, calibration, intervals, light and image model."""
    light = (
        "in good light"
        if config.snr_db is None
        else f"in dim light under a bright background, {config.snr_db:g} dB in a "
        "pixel of the first run behind a lens that images all light; exposure and "
        "background are the same for every run"
    )
    how = (
        "Pupil and slippage become gaze by the spherical-eye solver."
        if config.calibrator == "sphere"
        else "Axis, pupil and slippage become gaze by a linear mixed model learned from "
        f"{config.people} other people (of a network that predicts no axis, by sphere)."
    )
    return (
        f"{config.subjects} subjects whom training never saw, {config.frames} frames. Each is calibrated on "
        f"{config.share:.0%} of the stimuli, drawn at random, and judged on the rest. {how} The columns by sphere "
        "have the spherical-eye solver with a regressor of one hidden layer. Subjects "
        f"fixate with {config.fixation_deg} degrees of scatter, which counts as error. Intervals are over subjects. "
        f"Frames are the {config.image} image {light}. The finer image is formed at a "
        "quarter of the run's tolerance; a ratio near 1 says that results do not "
        "depend on it"
    )
