"""Time and memory of every command, each a process of its own: a lens of 1 mm and nine
million pillars, a bench, a run.

    python -m benchmarks limits                              # all of them, some fifteen minutes on two quiet cores
    python -m benchmarks.speed.limits library info --work DIR      # these alone, on what DIR already holds

Library, design, PSF, mask, budget, plan and scene are at full size; bench and networks
are those of the demo.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks import Row
from benchmarks.__main__ import table
from metalens.commands import chain
from metalens.commands.chain import ChainStage

NAN = float("nan")
BUDGET = (
    "budget",
    "lens.h5",
    "--library",
    "library.h5",
    "--process",
    "process.toml",
    "-o",
    "budget.h5",
)
EVALUATE = ("evaluate", "experiment", "run", "-o", "experiment")
OTHERS = (
    ChainStage("", "", BUDGET, ("gaze_error_deg", "deg of gaze from all links")),
    ChainStage(
        "",
        "",
        ("plan", "--gaze-error", "2deg", "-o", "plan"),
        ("predicted_deg", "deg of gaze, predicted"),
    ),
    ChainStage("", "", ("scene", "-o", "scene"), ("", "no error")),
    ChainStage(
        "", "", ("evaluate", "optics", "lens.h5", "-o", "optics"), ("", "no error")
    ),
    ChainStage("", "", EVALUATE, ("", "no error")),
    ChainStage("", "", ("info", "lens.h5"), ("", "no error")),
)
SIZES = {"library": "one cell, one wavelength", "design": "1 mm", "psf": "1 mm, 21 depths, 3 angles", "layout": "1 mm",
         "budget": "1 mm", "plan": "1 mm", "evaluate": "1 mm", "info": "1 mm", "scene": "as shipped"}  # fmt: skip


def rows() -> list[Row]:
    """Every command, in an empty folder."""
    with tempfile.TemporaryDirectory() as name:
        return measured(Path(name), ())


def measured(folder: Path, verbs: tuple[str, ...]) -> list[Row]:
    """A row a command; only these verbs where some are named."""
    files = chain.shipped_settings()
    chain.lay_out_inputs(files, None, aperture_mm=None).write(folder)
    every = [*chain.chain_stages(files), *OTHERS]
    return [
        _row(folder, stage) for stage in every if not verbs or stage.words[0] in verbs
    ]


def _row(folder: Path, stage: ChainStage) -> Row:
    force = () if stage.words[0] == "info" else ("--force",)
    values, seconds, peak = _run(folder, [*stage.words, "--json", *force])
    key, meaning = stage.error
    error = values.get(key)
    number = float(error) if isinstance(error, int | float) else NAN
    size = SIZES.get(stage.words[0], "of the demo")
    words = " ".join(w for w in stage.words[:2] if not w.startswith("-"))
    return Row(
        words,
        size,
        seconds,
        number,
        meaning,
        threads=len(os.sched_getaffinity(0)),
        peak_mb=peak,
    )


def _run(folder: Path, words: list[str]) -> tuple[dict[str, object], float, float]:
    """(--json result, wall seconds, largest resident memory in MB) of one command, by
    itself.
    """
    start, verb = time.perf_counter(), " ".join(words)
    process = subprocess.Popen(
        [sys.executable, "-m", "metalens", *words],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )
    shown = process.stdout.read() if process.stdout else b""
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode not in (0, 1) or not shown:
        raise RuntimeError(
            f"metalens {verb} ended with {process.returncode}, {len(shown)} bytes of result"
        )
    print(
        f"{time.perf_counter() - start:8.1f} s  metalens {verb}",
        file=sys.stderr,
        flush=True,
    )
    return json.loads(shown), time.perf_counter() - start, usage.ru_maxrss / 1024


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("verbs", nargs="*")
    parser.add_argument("--work", type=Path, required=True)
    given = parser.parse_args()
    given.work.mkdir(parents=True, exist_ok=True)
    sys.stdout.write(table(measured(given.work, tuple(given.verbs))) + "\n")


if __name__ == "__main__":
    main()
