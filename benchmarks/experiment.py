"""The virtual experiment of the paper's Sec. 5: best focus, mid-range, asphere, jointly
trained lens of one network.

    python -m benchmarks.experiment train NAME --seed 0 --work DIR  # NAME: of LENSES;
    resumes
    python -m benchmarks.experiment run --work DIR                  # of the runs there, beside the kept ones of others

Trained and judged on the true image: a field of ±25 degrees in light of 30 nm. Gaze is
calibrated on stimuli drawn at
random, or with ``--points spread`` on as many spread over the field. Networks of
another seed have other weights,
frames and noise; the subjects are the same.

``python -m benchmarks experiment`` shows what was kept, and times the experiment itself
on small untrained networks.
"""

import argparse
import json
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import torch

from benchmarks import Row, experiment_asphere
from benchmarks.design_guide_report import Interval, interval, ratio
from benchmarks.loop_runs import Recipe, finished
from codesign.adapt import train as retraining
from codesign.evaluate.gaze_experiment import experiment
from codesign.evaluate.shown import ExperimentConfig, Points
from metalens.ground import store

RESULT = Path(__file__).parent / "results" / "experiment_study.json"
WIDE = Recipe(
    focus_mm=33.0,
    pitch_um=12.0,
    # 20 mm at the eye: the pupil stays in the image at every stimulus and slippage
    edge_um=1872.0,
    steps=4000,
    batch=8,
    pool=12288,
    rate=0.05,
    optics_weight=0.0,
    slip_mm=(5.0, 1.0, 5.5),  # the reach of the experiment itself
    gaze_deg=(24.0, 16.0),
    image="true",
    fwhm_nm=30.0,
)
ASPHERE = experiment_asphere.kept()
STANDING = replace(
    WIDE, focus_mm=ASPHERE["focus_mm"], asphere_rad=tuple(ASPHERE["coefficients_rad"])
)
LENSES = {
    "bestfocus": WIDE,
    "midrange": replace(WIDE, focus_mm=20.0),
    "asphere": STANDING,
    "codesigned": replace(
        STANDING, moves=True
    ),  # from the designer's lens: the best start there is
}
QUANTITIES = (
    "gaze_axial_deg",
    "gaze_lateral_deg",
    "gaze_told_slip_deg",
    "slip_mm",
    "slip_axial_mm",
    "slip_lateral_mm",
    "slip_visible_mm",
    "slip_rest_mm",
    "iou",
)


def rows() -> list[Row]:
    """Time of the experiment on untrained networks, and the kept result of trained
    ones.
    """
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
        for points, found in json.loads(RESULT.read_text("utf-8")).items():
            out += [
                row
                for name, seeds in found.items()
                for row in _kept(name, points, seeds, found)
            ]
    return out


def _kept(
    name: str, points: str, seeds: dict[str, Any], all_lenses: dict[str, Any]
) -> list[Row]:
    """Means over the seeds of one lens, and its ratio to the mid-range lens of the same
    seeds.
    """
    out = []
    for quantity in (q for q in QUANTITIES if all(q in of for of in seeds.values())):
        case = f"{quantity}, {name}, {points} points"
        found = over_seeds(seeds, quantity)
        out.append(
            Row(
                case,
                f"{found.seeds} seeds",
                float("nan"),
                found.mean,
                f"truth: {found}",
            )
        )
        if name != "midrange" and set(seeds) & set(all_lenses.get("midrange", {})):
            to = ratio(
                *(
                    {int(s): of[quantity] for s, of in lens.items()}
                    for lens in (seeds, all_lenses["midrange"])
                )
            )
            out.append(
                Row(case, "to mid-range", float("nan"), to.mean, f"paired seeds: {to}")
            )
    return out


def over_seeds(seeds: dict[str, Any], quantity: str) -> Interval:
    """Mean of a quantity over {seed: results} with Student's interval."""
    return interval([of[quantity] for of in seeds.values()])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("train", "run"))
    parser.add_argument("name", nargs="?", choices=tuple(LENSES))
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=WIDE.steps)
    parser.add_argument("--points", choices=get_args(Points), default="random")
    given = parser.parse_args()
    torch.set_num_threads(1)
    if given.what == "train":
        recipe = replace(LENSES[given.name], steps=given.steps, seed=given.seed)
        finished(given.work / f"{given.name}-{given.seed}", recipe)
        return
    folders = sorted(f.parent for f in given.work.glob("*-*/result.json"))
    kept = json.loads(RESULT.read_text("utf-8")) if RESULT.is_file() else {}
    kept[given.points] = kept.get(given.points, {}) | _shown(
        given.work, given.points, folders
    )
    store.write_text(RESULT, json.dumps(kept, indent=1) + "\n")


def _shown(
    work: Path, points: Points, folders: list[Path]
) -> dict[str, dict[str, Any]]:
    """{lens: {seed: numbers of its run}} of one way to calibrate; every run sees the
    same frames.
    """
    from codesign.commands import experiment as command_experiment

    out, settings = work / f"experiment_{points}", ExperimentConfig(points=points)
    names = tuple(folder.name for folder in folders)
    command_experiment.run(
        command_experiment.Options(
            tuple(folders), out, names=names, settings=settings, force=True
        )
    )
    found: dict[str, dict[str, Any]] = {}
    for row in json.loads((out / command_experiment.JSON).read_text("utf-8"))["runs"]:
        name, seed = row.pop("name").rsplit("-", 1)
        found.setdefault(name, {})[seed] = row
    return found


if __name__ == "__main__":
    main()
