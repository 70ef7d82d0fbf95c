"""What finished runs say to Table 2 and Fig. 8b of the paper: gaze, cost of what is
frozen.
"""

import functools
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from codesign.adapt import restore_weights
from codesign.adapt import train as retraining
from codesign.batches import CALIBRATION, TEST
from codesign.evaluate.paper import MeasuredNumber
from codesign.gaze import NetworkReadings
from codesign.gaze import bench as gaze_test
from codesign.network import Architecture, recalibrate_batch_norm
from codesign.train import CodesignRun, SensorFrames, assess
from codesign.train import run as runs
from metalens.core.errors import TrainingError

PEOPLE, EACH = 16, 40  # frames of a person; a fifth of them calibrates
# other people of as many frames, whose gaze tells what an axis that is read means
BEFORE = 32
WORDS = "visual axis after a personal calibration on a fifth of the frames"


@dataclass(frozen=True, slots=True)
class RunKind:
    """What a finished run was: which parts did not move."""

    frozen: tuple[str, ...]


def kind_of(folder: Path) -> RunKind:
    """Read from result.json.

    Args:
        folder: of the files.

    Raises:
        TrainingError: no finished run, or of another version.
    """
    retraining.rows_of(folder)  # refuses what is missing, cut short or empty
    told = json.loads((folder / "result.json").read_text("utf-8"))
    return RunKind(tuple(told.get("frozen", ())))


def image_tolerance(folders: Sequence[Path]) -> float:
    """Of the true image that lenses of these runs are compared by: the largest that one
    of them is imaged at.

    Args:
        folders: of finished runs.
    """
    return max(
        runs.load_run_settings(folder / "run.toml").optics.image_tolerance
        for folder in folders
    )


@torch.no_grad()
def gaze_errors(
    folder: Path, *, people: int = PEOPLE, each: int = EACH, seed: int = 5
) -> list[dict[str, Any]]:
    """Gaze errors of every network of a finished run on people whom training never saw;
    least compute first.

    Args:
        folder: of the files. each: frames a person. seed: of the random generator.

    Raises:
        TrainingError: no finished run, half written, or of another version.
    """
    settings = runs.load_run_settings(folder / "run.toml")
    going = runs.resume_run(folder / "checkpoint.safetensors", settings)
    shown = _shown(going, TEST, people, each, seed)
    before = functools.cache(lambda: _shown(going, CALIBRATION, BEFORE, each, seed + 1))
    known = assess.training_frames(going.trainer)
    out = []
    for row in sorted(retraining.rows_of(folder), key=lambda r: float(r["mmacs"])):
        architecture = retraining.architecture_of(row["architecture"], going, folder)
        restore_weights(going, row, folder)
        recalibrate_batch_norm(going.trainer.model.net, architecture, known)
        read, how = _read(going, architecture, shown), None
        if read.axis_deg is not None:
            how = gaze_test.learn_from_people(
                before()[0], _read(going, architecture, before())
            )
        found = gaze_test.gaze_errors(shown[0], read, how=how)
        out.append(
            {
                "mmacs": row["mmacs"],
                "people": people,
                "frames_each": each,
                "seed": seed,
                **asdict(found),
            }
        )
    return out


def _shown(
    going: CodesignRun, stream: int, people: int, each: int, seed: int
) -> tuple[gaze_test.PeopleFrames, SensorFrames]:
    """People and their frames through a run's lens."""
    test = gaze_test.simulate_people(going.scenes(stream), people, each, seed=seed)
    return test, assess.sensor_frames(
        going.trainer, test, math.ceil(people * each / going.settings.inner.batch)
    )


def _read(
    going: CodesignRun,
    architecture: Architecture,
    shown: tuple[gaze_test.PeopleFrames, SensorFrames],
) -> NetworkReadings:
    """What a network of a run reads of their frames."""
    test, seen = shown
    answers = assess.predict_frames(
        going.trainer.model.net, architecture, seen, going.settings.inner
    )
    return gaze_test.read_of(test, answers.centre, answers.slip_mm, answers.axis)


def of_gaze(told: Mapping[str, Mapping[str, Any]]) -> dict[str, MeasuredNumber]:
    """Table 2 from gaze.json, {folder: {rows of :func:`gaze_errors`}}: the first run is
    the
    proposed one. Networks of others are not rebuilt here.

    Args:
        told: content of gaze.json.
    """
    for entry in told.values():
        rows = entry["rows"]
        accurate = min(rows, key=lambda r: float(r["personal_deg"]))
        return {
            "table2/proposed_efficient": _measured(rows[0]),
            "table2/proposed_accurate": _measured(accurate),
        }
    return {}


def _measured(row: Mapping[str, Any]) -> MeasuredNumber:
    words = f"{row['mmacs']:.1f} MMACs, {row['people']} synthetic people, seed {row['seed']}, {WORDS}"
    return MeasuredNumber(float(row["personal_deg"]), conditions=words)


def of_ablations(
    ours: Sequence[Mapping[str, Any]], others: Mapping[str, Sequence[Mapping[str, Any]]]
) -> dict[str, MeasuredNumber]:
    """Fig. 8b: compute of a run with one part frozen over ours, at the best axial
    slippage that the frozen one reaches.

    ours: rows of the joint run. others: {frozen part: rows}. A part whose best error
    ours never reaches is left out.
    """
    found = {}
    for part, rows in others.items():
        best = min(rows, key=lambda r: float(r["axial_slip_mm"]))
        enough = [
            float(r["mmacs"])
            for r in ours
            if r["axial_slip_mm"] <= best["axial_slip_mm"]
        ]
        if enough:
            words = f"axial slippage of {best['axial_slip_mm']:.2f} mm or less, at {min(enough):.1f} MMACs"
            found[f"fig8b/{part}"] = MeasuredNumber(
                float(best["mmacs"]) / min(enough), conditions=words
            )
    return found


def frozen_rows(folders: Sequence[Path]) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """(part, rows) of every run in which exactly one part was frozen.

    Args:
        folders: of finished runs.

    Raises:
        TrainingError: two runs with the same part frozen.
    """
    seen: dict[str, Path] = {}
    for folder in folders:
        kind = kind_of(folder)
        if len(kind.frozen) != 1:
            continue
        part = kind.frozen[0]
        if part in seen:
            raise TrainingError(
                f"{seen[part]} and {folder} both have {part} frozen; give one of them"
            )
        seen[part] = folder
        yield part, retraining.rows_of(folder)
