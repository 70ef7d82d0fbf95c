"""Gaze of the runs of the co-design study: population eye, own eye, personal
calibration on 20 % of the points.

python -m benchmarks.codesign_gaze --work DIR [--case p9]      # writes benchmarks/results/codesign_gaze.json
"""

import argparse
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from benchmarks import kept_lines
from benchmarks.codesign_study import (
    CASES,
    SCENES,
    architecture_of,
    restored,
    scenes_of,
    stem,
)
from codesign.batches.batch import Batch
from codesign.batches.flat import flattened
from codesign.batches.scenes import TEST
from codesign.gaze import bench as gaze_test
from codesign.gaze.bench import People
from codesign.train import assess

ROOT = Path(__file__).parents[1]
PEOPLE, EACH, BATCH = 16, 40, 32


@dataclass(frozen=True, eq=False, slots=True)
class Rendered:
    """The frames of the people as one surface each, rendered once."""

    batches: list[Batch]
    margin: int = SCENES.margin
    stream: int = 7

    def batch(self, step: int, size: int) -> Batch:
        """Frames of a step."""
        return self.batches[step]


def rendered(test: People) -> Rendered:
    """All frames of the people."""
    out = []
    for step in range(len(test.states) // BATCH):
        batch = test.batch(step, BATCH)
        one = flattened(batch.frames, torch.ones(BATCH))  # type: ignore[arg-type]
        out.append(Batch(one, batch.mask, batch.slip_mm))
    return Rendered(out)


def gaze_of(
    work: Path, line: dict[str, Any], test: People, frames: Rendered
) -> dict[str, Any]:
    """Gaze errors of one run of the study."""
    trainer = restored(work, line, frames)
    seen = assess.frames(trainer, frames, len(frames.batches))
    architecture = architecture_of(CASES[line["run"].split("/")[0]])
    answers = assess.predict(trainer.model.net, architecture, seen, trainer.inner)
    return {
        "run": line["run"],
        **asdict(
            gaze_test.gaze_errors(
                test, gaze_test.read_of(test, answers.centre, answers.slip_mm)
            )
        ),
    }


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--case", default="p9")
    options = parser.parse_args()
    torch.set_num_threads(1)
    test = gaze_test.people(scenes_of(TEST), PEOPLE, EACH, seed=5)
    frames = rendered(test)
    rows = []
    for line in kept_lines(options.work / "runs.jsonl"):
        weights = stem(options.work, line["run"]).with_suffix(".safetensors")
        if line["run"].startswith(options.case + "/") and weights.is_file():
            rows.append(gaze_of(options.work, line, test, frames))
            print(json.dumps(rows[-1]), flush=True)
    target = ROOT / "benchmarks" / "results" / "codesign_gaze.json"
    target.write_text(
        json.dumps({"people": PEOPLE, "frames_each": EACH, "rows": rows}, indent=1)
        + "\n",
        encoding="utf-8",
    )


if __name__ == "__main__":
    main()
