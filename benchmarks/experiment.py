"""The virtual experiment of the paper's Sec. 5 on three lenses of one network: jointly trained, mid-range, best focus.

    python -m benchmarks.experiment train NAME --work DIR      # NAME: codesigned, midrange or bestfocus; resumes
    python -m benchmarks.experiment run --work DIR             # of the lenses there are, kept in benchmarks/results

Gaze is calibrated twice: on stimuli drawn at random, and on as many spread over the field.

``python -m benchmarks experiment`` shows what was kept, and times the experiment itself on small untrained networks.
"""

import argparse
import json
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import get_args

import torch

from benchmarks import Row
from benchmarks.loop_runs import Recipe, finished
from codesign.adapt import train as retraining
from codesign.evaluate.gaze_experiment import experiment
from codesign.evaluate.shown import ExperimentConfig, Points
from metalens.ground import store

RESULT = Path(__file__).parent / "results" / "experiment_study.json"
WIDE = {
    "pitch_um": 12.0,
    "edge_um": 1872.0,  # 20 mm at the eye: the pupil stays in the image at every stimulus and slippage
    "steps": 5000,
    "pool": 12288,
    "rate": 0.05,
    "optics_weight": 0.0,
    "slip_mm": (5.0, 1.0, 5.5),
    "gaze_deg": (24.0, 16.0),
}  # the reach of the experiment itself
LENSES = {
    "codesigned": Recipe(33.0, moves=True, **WIDE),  # type: ignore[arg-type]
    "midrange": Recipe(20.0, **WIDE),  # type: ignore[arg-type]
    "bestfocus": Recipe(33.0, **WIDE),  # type: ignore[arg-type]
}


def rows() -> list[Row]:
    """Time of the experiment on untrained networks, and the kept result of trained ones."""
    with tempfile.TemporaryDirectory() as folder:
        finished(Path(folder) / "run", replace(LENSES["midrange"], steps=1, pool=64))
        source = retraining.load(Path(folder) / "run")
        config, edge = ExperimentConfig(), source.settings.scenes.pixels
        start = time.perf_counter()
        for _ in experiment([source], config):
            pass
        seconds = time.perf_counter() - start
    case = f"{config.frames} frames: render, image, read, calibrate"
    out = [
        Row(
            case,
            f"{source.row['mmacs']:.1f} MMACs, {edge} x {edge} pixels",
            seconds,
            float("nan"),
            "untrained",
            goal="1-2 min",
        )
    ]
    if RESULT.is_file():
        kept = json.loads(RESULT.read_text("utf-8"))
        for points, found in kept.items():
            for entry in found["ratios"]:
                case = f"{entry['quantity']}, {entry['against']}, {points} points"
                what = "ratio of the errors"
                out.append(Row(case, found["first"], float("nan"), entry["ratio"], what, goal=entry["goal"]))
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("train", "run"))
    parser.add_argument("name", nargs="?", choices=tuple(LENSES))
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=WIDE["steps"])
    given = parser.parse_args()
    torch.set_num_threads(1)
    if given.what == "train":
        finished(given.work / given.name, replace(LENSES[given.name], steps=given.steps))
        return
    from codesign.commands import experiment as command_experiment

    names = tuple(name for name in LENSES if (given.work / name / "result.json").is_file())
    folders = tuple(given.work / name for name in names)
    kept = {}
    for points in get_args(Points):
        out, settings = given.work / f"experiment_{points}", ExperimentConfig(points=points)
        command_experiment.run(command_experiment.Options(folders, out, names=names, settings=settings, force=True))
        kept[points] = json.loads((out / command_experiment.JSON).read_text("utf-8"))
    store.write_text(RESULT, json.dumps(kept, indent=1) + "\n")


if __name__ == "__main__":
    main()
