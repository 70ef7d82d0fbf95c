"""The error budget of the demo's reader against what the virtual experiment measures on its frames, link by link."""

import math
import tempfile
import time
from importlib import resources
from pathlib import Path

from benchmarks import Row
from codesign.adapt import train as retraining
from codesign.budget import MEASURED, TOTAL, Entry, Given, bench, links
from metalens import cli, lens
from metalens.ground.errors import TrainingError


def rows() -> list[Row]:
    """Train the demo's run (two minutes on two cores), then its budget: a row a link, the sum with its ratio."""
    with tempfile.TemporaryDirectory() as work:
        recipe, folder = Path(work) / "run.toml", Path(work) / "run"
        shipped = resources.files("metalens").joinpath("data", "demo", "run.toml")
        recipe.write_text(shipped.read_text(encoding="utf-8"), encoding="utf-8")
        if cli.main(["codesign", str(recipe), "-o", str(folder)]):
            raise TrainingError("the demo's run did not finish")
        start = time.perf_counter()
        given = Given(run=retraining.load(folder))
        found = list(links.entries(bench(lens.load(folder / "lens.h5"), given)))
        spent = time.perf_counter() - start
    measured = next(e.gaze_rad for e in found if e.link == MEASURED)
    return [_row(entry, spent if entry.link == TOTAL else math.nan, measured) for entry in found]


def _row(entry: Entry, seconds: float, measured_rad: float) -> Row:
    degrees = math.degrees(entry.gaze_rad)
    goal = f"within 1.5x of measured: {entry.gaze_rad / measured_rad:.2f}x" if entry.link == TOTAL else ""
    said = entry.method if entry.counted else f"{entry.method} (not in the sum)"
    return Row(entry.link, "metalens budget --run", seconds, degrees, f"deg of gaze; {said}", goal=goal)
