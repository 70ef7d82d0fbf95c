"""RUN_DIR... to Figs. 10 and 11: gaze and slippage of synthetic subjects before each
run's lens and network (Sec. 5).
"""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from codesign.adapt import FinishedRun, retrained_network
from codesign.commands.options.experiment import Options
from codesign.evaluate import AXIAL, LATERAL, RunResult, plots, run_experiment
from codesign.gaze import PopulationPrior, people_file
from codesign.optics import image_formation
from codesign.settings import ExperimentConfig
from codesign.train import bootstrap_interval, bootstrap_ratio
from metalens.core import config as settings
from metalens.core import reading, report, store
from metalens.core.errors import ConfigError

JSON, PAGE = "experiment.json", "report.html"
GOALS = {"gaze_axial_deg": "<= 0.58 of mid-range", "slip_mm": "<= 0.55 of mid-range"}


def run(options: Options) -> int:
    """Run the virtual experiment: simulate, predict, calibrate, and write tables and
    plots.

    Exit 1 where the error of a run's images is above what the run requires.

    Args:
        options: of the command line.
    """
    if not options.runs:
        raise ConfigError("no run to evaluate; give one run folder or more")
    names = options.names or distinct_run_names(options.runs)
    if len(names) != len(options.runs):
        raise ConfigError(
            f"{len(names)} names for {len(options.runs)} runs; give one a run"
        )
    if len(set(names)) < len(names):
        raise ConfigError(
            f"names {', '.join(names)}: two are alike; give every run one of its own"
        )
    folder = options.output
    config = options.settings
    sources = [retrained_network.load_retrained(path) for path in options.runs]
    with options.claim_folder(folder) as draft:
        results: list[RunResult] = []
        steps = run_experiment(sources, config, names=names)
        for _, latest in options.console.track(
            steps, total=config.subjects, label="subjects"
        ):
            results = latest
        lenses = {
            name: retrained_network.lens_of(path)
            for name, path in zip(names, options.runs, strict=True)
        }
        values = experiment_summary(results, config) | {
            "images": image_summary(options.runs, names),
            "lenses": lenses,
            "beyond_training_mm": {
                name: _beyond_training(source, config)
                for name, source in zip(names, sources, strict=True)
            },
        }
        values["failures"] = [
            f"{result.name}: {result.above}" for result in results if result.above
        ]
        pictures = {
            "ambiguity.png": plots.plot_ambiguity(results[0]),
            "errors.png": plots.plot_gaze_errors(results),
        }
        _write_files(draft.path, values, pictures)
        for number, (result, source) in enumerate(
            zip(results, sources, strict=True), 1
        ):
            if isinstance(result.how, PopulationPrior):
                people_file.save_people(
                    draft.path / f"people_{number}.h5",
                    result.how,
                    provenance=_provenance(source, config),
                )
    return options.console.judged(
        values, f"{experiment_text(values)}\nopen {folder / PAGE}", values["failures"]
    )


def _provenance(source: FinishedRun, config: ExperimentConfig) -> store.Provenance:
    """Settings of run and experiment, and the seed."""
    seed = source.settings.inner.seed
    return store.Provenance(
        config=f"{settings.dumps(source.settings)}\n{settings.dumps(config)}", seed=seed
    )


def image_summary(folders: Sequence[Path], names: Sequence[str]) -> dict[str, Any]:
    """Image model and error of every run, from its result.json; None where it has none.

    Of a retraining, those of its run.

    Args:
        folders: of finished runs. names: of the runs.
    """
    return {
        name: json.loads(
            (retrained_network.run_of(folder) / "result.json").read_text("utf-8")
        ).get("image")
        for name, folder in zip(names, folders, strict=True)
    }


def distinct_run_names(paths: Sequence[Path]) -> tuple[str, ...]:
    """Folder names of runs, with that of a network file, numbered where they repeat.

    Args:
        paths: of runs or retrainings.
    """
    resolved = (path.resolve() for path in paths)
    stems = [
        reading.to_valid_utf8(
            p.name if p.suffix != ".safetensors" else f"{p.parent.name} {p.stem}"
        )
        for p in resolved
    ]
    return tuple(
        s if stems.count(s) == 1 else f"{s} {i + 1}" for i, s in enumerate(stems)
    )


def experiment_summary(
    results: Sequence[RunResult], config: ExperimentConfig
) -> dict[str, Any]:
    """Mean errors of every run with bootstrap intervals over subjects, and ratios.

    Ratios are of the first run to each of the others.

    Args:
        results: one a run. config: subjects, stimuli, slippage and calibration.
    """
    subject_means = [_subject_means(r) for r in results]
    rows = []
    for result, means in zip(results, subject_means, strict=True):
        row: dict[str, Any] = {"name": result.name, "mmacs": result.mmacs}
        for quantity, values in means.items():
            row[quantity] = float(values.mean())
            if len(values) > 1:
                row[f"{quantity}_interval"] = list(bootstrap_interval(values))
        rows.append(row | _finer_image_errors(result, row))
    ratios = []
    for other, means in zip(results[1:], subject_means[1:], strict=True):
        for quantity in (
            "gaze_axial_deg",
            "gaze_lateral_deg",
            "slip_mm",
            "slip_axial_mm",
        ):
            value, low, high = bootstrap_ratio(
                subject_means[0][quantity], means[quantity]
            )
            ratios.append({
                "quantity": quantity, "against": other.name, "ratio": value, "interval": [low, high],
                "goal": GOALS.get(quantity, ""),
            })  # fmt: skip
    about = {**asdict(config), "frames": config.frames}
    return {"first": results[0].name, "settings": about, "runs": rows, "ratios": ratios}


FINER = ("gaze_axial_deg", "gaze_lateral_deg", "slip_mm", "slip_axial_mm", "iou")


def _finer_image_errors(result: RunResult, row: dict[str, Any]) -> dict[str, Any]:
    """Mean errors on the finer image, and the ratio of its gaze error; None without
    one.
    """
    if result.finer is None:
        return {f"finer_{name}": None for name in (*FINER, "ratio")}
    means = _subject_means(result.finer)
    errors = {f"finer_{name}": float(means[name].mean()) for name in FINER}
    ratio = errors["finer_gaze_axial_deg"] / row["gaze_axial_deg"]
    return errors | {"finer_ratio": ratio}


def _beyond_training(
    source: FinishedRun, config: ExperimentConfig
) -> list[list[float]]:
    """Slippages (x, y, z) of the experiment in mm outside the range of a run's
    training.
    """
    slips = config.slips_mm
    outside = (np.abs(slips) > source.settings.scenes.slip_mm).any(1)
    beyond: list[list[float]] = np.unique(slips[outside], axis=0).tolist()
    return beyond


def _subject_means(result: RunResult) -> dict[str, Any]:
    """(subjects,) mean of every error by name, gaze in deg and slippage in mm."""
    error, axial = result.slip_error_mm, result.trial.group(AXIAL)
    return {
        "gaze_axial_deg": result.per_subject(result.gaze_deg, axial),
        "gaze_lateral_deg": result.per_subject(
            result.gaze_deg, result.trial.group(LATERAL)
        ),
        "slip_mm": result.per_subject(error.mean(1)),
        "slip_axial_mm": result.per_subject(error[:, 2]),
        "slip_lateral_mm": result.per_subject(error[:, :2].mean(1)),
        "iou": result.per_subject(result.iou),
    }


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


def experiment_text(values: dict[str, Any]) -> str:
    """The tables and remarks as text.

    Args:
        values: content of experiment.json.
    """
    images = [
        f"{name}: {image_formation.describe_image_text(image)}"
        for name, image in values["images"].items()
        if image
    ]
    tables = [table.text for table in experiment_tables(values)]
    return "\n".join([*tables, *_remarks(values), *images])


def _write_files(
    folder: Path, values: dict[str, Any], pictures: dict[str, bytes]
) -> None:
    """Write pictures, page and experiment.json."""
    for name, picture in pictures.items():
        store.write_bytes(folder / name, picture)
    _page(folder / PAGE, values, pictures)
    store.write_text(folder / JSON, json.dumps(values, indent=1) + "\n")


# what the numbers are called in the result, and in tables
COLUMNS = {
    "name": "run",
    "mmacs": "MMACs",
    "gaze_axial_deg": "gaze, axial slip / deg",
    "finer_gaze_axial_deg": "finer image / deg",
    "finer_ratio": "ratio",
    "gaze_lateral_deg": "gaze, lateral slip / deg",
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


def _page(path: Path, values: dict[str, Any], pictures: dict[str, bytes]) -> None:
    """Write report.html."""
    figures = [
        report.Figure(pictures[name], caption, wide=True)
        for name, caption in CAPTIONS.items()
    ]
    keys = [
        report.KeyFigure(
            f"{r['name']}: gaze error under axial slip", f"{r['gaze_axial_deg']:.2f}°"
        )
        for r in values["runs"]
    ]
    words = [
        _method_text(values["settings"]),
        *(f"{line}." for line in _remarks(values)),
    ]
    sections = [
        report.Section("Numbers", " ".join(words), experiment_tables(values)),
        report.Section("Figures", "", figures),
    ]
    report.write_report(path, "Virtual experiment", sections, key_figures=keys)


def _method_text(about: dict[str, Any]) -> str:
    """Paragraph on subjects, calibration and intervals."""
    return (
        f"{about['subjects']} subjects whom training never saw, {about['frames']} frames. Each is calibrated on "
        f"{about['share']:.0%} of the stimuli, drawn at random, and judged on the rest: what is read (axis, "
        f"pupil, slippage) becomes gaze by a linear mixed model learned from {about['people']} other people, or, of a "
        "network that tells no axis, by a sphere and a regressor of one hidden layer. Subjects "
        f"fixate with {about['fixation_deg']} degrees of scatter, which counts as error. Intervals are over subjects. "
        f"{_light_text(about)}"
    )


def _light_text(about: dict[str, Any]) -> str:
    """Sentences on light level and image model of the frames."""
    image = {"true": "the true image", "trained": "the image of training"}
    light = (
        "in good light"
        if about["snr_db"] is None
        else f"in dim light under a bright background, {about['snr_db']:g} dB in a "
        "pixel of the first run behind a lens that images all light; exposure and "
        "background are the same for every run"
    )
    return (
        f"Frames are {image[about['image']]} {light}. The finer image is formed at a "
        "quarter of the run's tolerance; a ratio near 1 says that results do not "
        "depend on it."
    )
