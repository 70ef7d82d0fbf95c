"""The virtual experiment of the paper's Sec. 5 on three lenses of one network: jointly trained, mid-range, best focus.

    python -m benchmarks.experiment train NAME --work DIR      # NAME: codesigned, midrange or bestfocus; resumes
    python -m benchmarks.experiment run --work DIR             # the experiment, kept in benchmarks/results

``python -m benchmarks experiment`` shows what was kept, and times the experiment itself on small untrained networks.
"""

import argparse
import json
import tempfile
import time
from pathlib import Path

import torch

from benchmarks import Row
from benchmarks.retrain_study import base
from codesign import retraining
from codesign.experiment import ExperimentConfig, experiment
from metalens import store

RESULT = Path(__file__).parent / "results" / "experiment.json"
COMMON = """
preset = "smoke"
checkpoint_every = 100
[scenes]
pixels = 64
margin = 8
pool = 4096
slip_mm = [5.0, 1.0, 5.5]
gaze_deg = [24.0, 16.0]
[space]
widths = [0.35]
depths = [2]
expansions = [3]
kernels = [5]
resolution = [1.0, 1.0]
[run]
pitch_um = 18.0
budgets_mmacs = [8.0]
[inner]
steps = {steps}
batch = 32
slip_scale_mm = [2.9, 0.6, 3.2]
[inner.optics]
rate = {rate}
start = 0.12
end = 0.8
[optics]
depth_count = 16
focus_mm = {focus}
polynomials = {polynomials}
"""
LENSES = {"codesigned": (33.0, 35, 0.02), "midrange": (20.0, 0, 0.0), "bestfocus": (33.0, 0, 0.0)}


def settings_of(name: str, steps: int = 1500) -> str:
    """RUN.toml of a lens."""
    focus, polynomials, rate = LENSES[name]
    return COMMON.format(focus=focus, polynomials=polynomials, rate=rate, steps=steps)


def rows() -> list[Row]:
    """Time of the experiment on untrained networks, and the kept result of trained ones."""
    with tempfile.TemporaryDirectory() as folder:
        base(Path(folder) / "run", settings_of("midrange", 1).replace("pool = 4096", "pool = 64"))
        source = retraining.load(Path(folder) / "run")
        config = ExperimentConfig()
        start = time.perf_counter()
        for _ in experiment([source], config):
            pass
        seconds = time.perf_counter() - start
    case = f"{config.frames} frames: render, image, read, calibrate"
    out = [
        Row(
            case, f"{source.row['mmacs']:.1f} MMACs, 64 x 64 pixels", seconds, float("nan"), "untrained", goal="1-2 min"
        )
    ]
    if RESULT.is_file():
        kept = json.loads(RESULT.read_text("utf-8"))
        for entry in kept["ratios"]:
            case = f"{entry['quantity']}, {entry['against']}"
            out.append(
                Row(case, kept["first"], float("nan"), entry["ratio"], "ratio of the errors", goal=entry["goal"])
            )
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("train", "run"))
    parser.add_argument("name", nargs="?", choices=tuple(LENSES))
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=1500)
    given = parser.parse_args()
    torch.set_num_threads(1)
    if given.what == "train":
        base(given.work / given.name, settings_of(given.name, given.steps))
        return
    from codesign import command_experiment

    folders = tuple(given.work / name for name in LENSES)
    options = command_experiment.Options(folders, given.work / "experiment", names=tuple(LENSES), force=True)
    command_experiment.run(options)
    store.write_text(RESULT, (given.work / "experiment" / "experiment.json").read_text("utf-8"))


if __name__ == "__main__":
    main()
