"""What bad luck and bad input do to the commands: kills, two writers, full disks, damaged files, values out of range.

    python -m benchmarks hardness                                        # small: some minutes on two quiet cores
    python -m benchmarks.hardness --kills 2000 --writers 200 --disks 200 --mutations 1000000
    python -m benchmarks.hardness --kills 40 --verbs design scene        # one part alone; the others keep their rows

The error of a row is the number of failures: mixed results, files lost, scratch left, untyped ends, crashes; each is
printed with what it needs to be had again.
"""

import argparse
import dataclasses
import json
import os
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from benchmarks import Row, _hardness_files, _hardness_runs, _hardness_values
from benchmarks.__main__ import table
from metalens import psf

KILLS, WRITERS, DISKS, MUTATIONS = 18, 9, 9, 9000
RESULT = Path(__file__).parent / "results" / "hardness.json"


def rows() -> list[Row]:
    """All parts at their small size."""
    return [*runs(KILLS, WRITERS, DISKS), mutations(MUTATIONS), bad_values(), threads()]


def runs(kills: int, writers: int, disks: int, verbs: Sequence[str] = ()) -> list[Row]:
    """Commands that are killed, run twice at once, or out of room."""
    with tempfile.TemporaryDirectory() as name:
        bench = _hardness_runs.Bench(Path(name), tuple(verbs) or tuple(sorted(_hardness_runs.VERBS)))
        bench.prepare()
        over = f"over {', '.join(bench.verbs)}"
        parts = [
            (f"{kills} kills", kills, bench.kill, "mixed, lost, or scratch left"),
            (f"{writers} pairs of writers", writers, bench.pair, "mixed, or none succeeded"),
            (f"{disks} full disks", disks, bench.fill, "crash, part of a result, or scratch left"),
        ]
        found = [
            _timed(case, over, lambda work=work, count=count: work(count), against)
            for case, count, work, against in parts
            if count
        ]
    print("\n".join(bench.failures))
    return found


def mutations(copies: int) -> Row:
    """Damaged copies of every kind of file."""
    with tempfile.TemporaryDirectory() as name:
        start = time.perf_counter()
        counts = list(_hardness_files.counted(Path(name), copies))
        seconds = time.perf_counter() - start
    print(_hardness_files.summary(counts))
    refused, done = sum(c.refused for c in counts), sum(c.copies for c in counts)
    case = f"{done} damaged files of {len(counts)} kinds"
    failures = sum(len(c.failures) for c in counts)
    return _row(case, f"{refused} refused", seconds, failures, "untyped, crash, over 1 GB or 5 s")


def bad_values() -> Row:
    """The matrix of bad values: failures are untyped ends and refusals that name neither file nor key."""
    start = time.perf_counter()
    found = list(_hardness_values.trials())
    failures = [t for t in found if not t.typed or (t.said and not t.names_it)]
    print("\n".join(f"{t.settings} {t.key} = {t.value}: {t.said[:200]}" for t in failures[:20]))
    refused = sum(bool(t.said) for t in found)
    case, seconds = f"{len(found)} bad values of every key", time.perf_counter() - start
    return _row(case, f"{refused} refused", seconds, len(failures), "untyped, or key not named")


def threads() -> Row:
    """Results of one command that differ with the number of threads."""
    found, start = set(), time.perf_counter()
    with tempfile.TemporaryDirectory() as name:
        bench = _hardness_runs.Bench(Path(name), ())
        bench.prepare()
        for count in (1, 2, 8):
            told = dict.fromkeys(("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS"), str(count))
            status, words = bench.run("psf lens0.h5 --config psf.toml -o out.h5", env=os.environ | told)
            if status not in (0, 1):
                raise RuntimeError(words)
            found.add(np.asarray(psf.load(bench.folder / "out.h5").intensity).tobytes())
            bench.clear("out.h5")
    return _row("psf on 1, 2, 8 threads", "as it comes", time.perf_counter() - start, len(found) - 1, "other bytes")


def _timed(case: str, method: str, part: Callable[[], int], against: str) -> Row:
    start = time.perf_counter()
    failures = part()
    return _row(case, method, time.perf_counter() - start, failures, against)


def _row(case: str, method: str, seconds: float, failures: int, against: str) -> Row:
    return Row(case, method, seconds, float(failures), against, goal=f"0: {'met' if failures == 0 else 'missed'}")


def keep(found: list[Row]) -> None:
    """Put rows into the result, in place of those of the same parts."""
    held = json.loads(RESULT.read_text("utf-8"))["rows"] if RESULT.is_file() else []
    new = [dataclasses.asdict(row) for row in found]
    parts = {row["against"] for row in new}
    kept = [row for row in held if row["against"] not in parts]
    RESULT.write_text(json.dumps({"rows": kept + new}, indent=1) + "\n", encoding="utf-8")


def main() -> None:
    """The parts that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    for name in ("kills", "writers", "disks", "mutations"):
        parser.add_argument(f"--{name}", type=int, default=0)
    for name in ("values", "threads"):
        parser.add_argument(f"--{name}", action="store_true")
    parser.add_argument("--verbs", nargs="*", choices=sorted(_hardness_runs.VERBS), default=())
    asked = parser.parse_args()
    found = []
    if asked.kills or asked.writers or asked.disks:
        found += runs(asked.kills, asked.writers, asked.disks, asked.verbs)
    found += [mutations(asked.mutations)] if asked.mutations else []
    found += [bad_values()] if asked.values else []
    found += [threads()] if asked.threads else []
    print(table(found))
    keep(found)


if __name__ == "__main__":
    main()
