"""The error budget of a reader against what the virtual experiment measures on its
frames, link by link.

``python -m benchmarks closure`` takes a lens of 0.4 mm and a reader of 240 steps:
minutes, the whole budget to its end.
``python -m benchmarks.closure demo`` takes the demo's run and its five subjects.
"""

import json
import math
import sys
import tempfile
import time
from dataclasses import asdict
from importlib import resources
from pathlib import Path

from benchmarks import Row
from codesign.adapt import train as retraining
from codesign.budget import MEASURED, TOTAL, Entry, Given, bench, links
from codesign.evaluate import ExperimentConfig
from metalens import cli, lens
from metalens.ground.errors import TrainingError

SMALL = """preset = "smoke"
checkpoint_every = 120
test_batches = 8
[scenes]
pool = 512
[optics]
aperture_mm = 0.4
sensor_distance_mm = 1.0
sample_um = 9.0
focus_mm = 33.0
polynomials = 0
[space]
widths = [0.25]
expansions = [3]
kernels = [3]
resolution = [1.0, 1.0]
[inner]
steps = 240
batch = 16
[inner.pitch]
rate = 0.0
[search]
population = 1
tournament = 1
rounds = 1
[run]
pitch_um = 9.0
budgets_mmacs = [4.0]
"""
FRAMES = ExperimentConfig(
    subjects=4, grid=(5, 4), share=0.3, axial_mm=(-2.5, 2.5), lateral_mm=(-1.5,)
)


def rows() -> list[Row]:
    """Train a small reader, then its budget: a row a link, the sum with its ratio."""
    return closed(SMALL, FRAMES)


def closed(recipe: str, frames: ExperimentConfig) -> list[Row]:
    """The budget of a run on these frames, as rows."""
    with tempfile.TemporaryDirectory() as work:
        settings, folder = Path(work) / "run.toml", Path(work) / "run"
        settings.write_text(recipe, encoding="utf-8")
        if cli.main(["codesign", str(settings), "-o", str(folder), "--quiet"]):
            raise TrainingError("the run did not finish")
        start = time.perf_counter()
        given = Given(run=retraining.load(folder), frames=frames)
        found = []
        for entry in links.entries(bench(lens.load(folder / "lens.h5"), given)):
            print(
                f"{time.perf_counter() - start:7.1f} s  {entry.link}",
                file=sys.stderr,
                flush=True,
            )
            found.append(entry)
        spent = time.perf_counter() - start
    measured = next(e.gaze_rad for e in found if e.link == MEASURED)
    return [
        _row(entry, spent if entry.link == TOTAL else math.nan, measured)
        for entry in found
    ]


def _row(entry: Entry, seconds: float, measured_rad: float) -> Row:
    degrees = math.degrees(entry.gaze_rad)
    goal = (
        f"within 1.5x of measured: {entry.gaze_rad / measured_rad:.2f}x"
        if entry.link == TOTAL
        else ""
    )
    said = entry.method if entry.counted else f"{entry.method} (not in the sum)"
    return Row(
        entry.link,
        "metalens budget --run",
        seconds,
        degrees,
        f"deg of gaze; {said}",
        goal=goal,
    )


if __name__ == "__main__":
    if sys.argv[1:] not in ([], ["demo"]):
        raise SystemExit(f"{sys.argv[1:]}: need nothing, or demo")
    if sys.argv[1:]:
        shipped = (
            resources.files("metalens")
            .joinpath("data", "demo", "run.toml")
            .read_text(encoding="utf-8")
        )
        made = closed(shipped, ExperimentConfig(subjects=5))
    else:
        made = rows()
    print(json.dumps([asdict(row) for row in made], indent=1))
