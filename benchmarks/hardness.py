"""What bad luck and bad input do to the commands: kills, two writers, full disks,
damaged files, values out of range.

    python -m benchmarks hardness                                       # small: some minutes on two quiet cores
    python -m benchmarks.hardness --kills 40 --writers 10 --disks 20    # so many more of each: runs add up
    python -m benchmarks.hardness --kills 40 --verbs design scene       # of some commands alone
    python -m benchmarks.hardness --mutations 100000 --kinds tiff png   # more damaged files, of some kinds alone
    python -m benchmarks.hardness --points 2 --verbs psf layout         # every file operation of so many runs each
    python -m benchmarks.hardness --values --threads --seeds

The error of a row is the number of failures: mixed results, files lost, scratch left,
untyped ends, crashes; each is
printed with what it needs to be had again. Trials of commands are numbered; those that
failed are tried again first.
"""

import argparse
import dataclasses
import itertools
import json
import math
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from benchmarks import (
    Row,
    _hardness_commands,
    _hardness_files,
    _hardness_points,
    _hardness_runs,
    _hardness_samples,
    _hardness_seeds,
    _hardness_threads,
    _hardness_values,
)
from benchmarks.__main__ import table
from metalens.ground import lock, store

KILLS, WRITERS, DISKS, MUTATIONS = 18, 18, 18, 9000
# damaged files after which all is noted: a run that is ended keeps what it did
PORTION = 20_000
QUICK = (
    "design",
    "psf",
    "export",
    "layout",
    "library",
    "capture",
    "measure",
    "check",
    "view",
    "field",
)
OFTEN = 4  # turns of a quick command for one of the others
WORDS = {"kills": "kills", "writers": "pairs of writers", "disks": "full disks"}
AGAINST = {
    "kills": "mixed, lost, or scratch left",
    "writers": "mixed, or none succeeded",
    "disks": "crash, part of a result, or scratch left",
}
Tried = dict[
    str, dict[str, dict[str, Any]]
]  # kind; verb, or kind of file: trials done, the words of those that failed
RESULT = Path(__file__).parent / "results" / "hardness.json"
TRIALS = RESULT.with_name("hardness_trials.json")


def rows() -> list[Row]:
    """All parts at their small size."""
    asked = {"kills": KILLS, "writers": WRITERS, "disks": DISKS}
    verbs = tuple(_hardness_commands.VERBS)
    return [
        *runs(asked, verbs),
        mutations(MUTATIONS),
        bad_values(),
        threads(),
        seeds(verbs),
    ]


def runs(
    asked: dict[str, int], verbs: tuple[str, ...], seconds: float = math.inf
) -> list[Row]:
    """Commands that are killed, run twice at once, or out of room: so many more trials
    of each kind, within a time.
    """
    tried = _tried()
    with _hardness_runs.bench(verbs) as bench:
        if not bench.fills:
            print(
                "no small file system can be made here: full disks are limits on the size of files alone"
            )
        bench.prepare()
        end = time.perf_counter() + seconds
        for kind, verb, number in _trials(tried, asked, verbs):
            found = bench.trial(kind, verb, number)
            entry = _tried().get(kind, {}).get(verb, {"done": 0, "failed": {}})
            entry["done"] = max(entry["done"], number + 1)
            entry["failed"].pop(str(number), None)
            if found:
                entry["failed"][str(number)] = found
                print("\n".join(found), flush=True)
            tried = _note(kind, verb, entry)
            if time.perf_counter() > end:
                break
    return [
        _of_trials(kind, tried[kind], tried.get("points", {}))
        for kind in AGAINST
        if kind in tried
    ]


def points(sweeps: int, verbs: tuple[str, ...], seconds: float = math.inf) -> list[Row]:
    """Kills, refused writes, full disks and second writers at every file operation of
    so many runs of every verb.
    """
    end = time.perf_counter() + seconds
    with _hardness_runs.bench(()) as bench:
        if not bench.fills:
            print(
                "no mounts of one's own can be made here: file operations are not tried one by one"
            )
            return []
        for verb, number in _sweeps(verbs, sweeps):
            bench.verbs = (verb,)
            bench.prepare()
            entry = _tried().get("points", {}).get(verb, {"done": 0, "failed": {}})
            sweep = _hardness_points.Sweep(bench, verb, number, fresh=number % 2 == 1)
            sweep.run()
            if number == entry["done"]:
                for kind, count in sweep.counts.items():
                    entry[kind] = entry.get(kind, 0) + count
                entry["done"] += 1
            kept = {
                words: found
                for words, found in entry["failed"].items()
                if _number(words) != number
            }
            entry["failed"] = kept | {
                f"{number}: {how}": found for how, found in sweep.found.items()
            }
            _note("points", verb, entry)
            print(f"{verb}: {sweep.counts}, {len(sweep.found)} failed", flush=True)
            if time.perf_counter() > end:
                break
    tried = _tried()
    return [_of_trials(kind, tried.get(kind, {}), tried["points"]) for kind in AGAINST]


def _sweeps(verbs: tuple[str, ...], more: int) -> Iterator[tuple[str, int]]:
    """(verb, number) of sweeps in which something failed before, then of so many new
    ones.
    """
    tried = _tried().get("points", {})
    for verb in verbs:
        entry = tried.get(verb, {"done": 0, "failed": {}})
        again = sorted({_number(words) for words in entry["failed"]})
        yield from (
            (verb, number)
            for number in (*again, *range(entry["done"], entry["done"] + more))
        )


def _number(words: str) -> int:
    """Of the sweep that a failure belongs to."""
    return int(words.partition(":")[0])


def _trials(
    tried: Tried, asked: dict[str, int], verbs: tuple[str, ...]
) -> Iterator[tuple[str, str, int]]:
    """(kind, verb, number) of trials that failed before, then of new ones; quick verbs
    come round more often.
    """
    for kind in asked:
        by_verb = tried.get(kind, {})
        yield from [
            (kind, verb, int(n))
            for verb in verbs
            for n in by_verb.get(verb, {}).get("failed", {})
        ]
    done = {
        (kind, verb): tried.get(kind, {}).get(verb, {"done": 0})["done"]
        for kind in asked
        for verb in verbs
    }
    turns = {
        kind: itertools.cycle(
            [v for i in range(OFTEN) for v in verbs if v in QUICK or i == 0]
        )
        for kind in asked
    }
    for turn in range(max(asked.values(), default=0)):
        for kind, count in asked.items():
            if turn < count:
                verb = next(turns[kind])
                yield kind, verb, done[kind, verb]
                done[kind, verb] += 1


def _of_trials(
    kind: str, by_verb: dict[str, Any], at_operations: dict[str, Any]
) -> Row:
    """The row of all trials of a kind so far: at moments drawn by chance, and at file
    operations.
    """
    drawn = sum(entry["done"] for entry in by_verb.values())
    systematic = sum(entry.get(kind, 0) for entry in at_operations.values())
    failed = sum(len(entry["failed"]) for entry in by_verb.values())
    failed += sum(
        found[0] == kind
        for entry in at_operations.values()
        for found in entry["failed"].values()
    )
    verbs = sorted(
        {*by_verb, *(verb for verb, entry in at_operations.items() if entry.get(kind))}
    )
    case = f"{drawn + systematic} {WORDS[kind]}, {systematic} of them each at a file operation"
    return _row(case, f"over {', '.join(verbs)}", math.nan, failed, AGAINST[kind])


def mutations(copies: int, kinds: Sequence[str] = ()) -> Row:
    """So many more damaged copies of every kind of file, or of those that are named;
    noted portion by portion.
    """
    begun, start = _tried().get("mutations", {}), time.perf_counter()
    for first in range(0, copies, PORTION):
        with tempfile.TemporaryDirectory() as name:
            for found in _hardness_files.counted(
                Path(name), min(PORTION, copies - first), kinds, begun
            ):
                entry = begun.get(found.kind, {"done": 0, "refused": 0, "failed": {}})
                entry["refused"] += found.refused
                entry["done"] = max(entry["done"], found.last + 1)
                entry["failed"] = {
                    str(number): words for number, words in found.failures.items()
                }
                begun = _note("mutations", found.kind, entry)["mutations"]
    seconds = time.perf_counter() - start
    done, refused = (
        sum(entry[name] for entry in begun.values()) for name in ("done", "refused")
    )
    failures = sum(len(entry["failed"]) for entry in begun.values())
    case = f"{done} damaged files of {len(begun)} kinds"
    print(f"{copies} copies in {seconds:.0f} s")
    return _row(
        case,
        f"{refused} refused",
        math.nan,
        failures,
        "untyped, crash, over 1 GB or 5 s",
    )


def bad_values() -> Row:
    """The matrix of bad values: failures are untyped ends and refusals that name
    neither file nor key.
    """
    start = time.perf_counter()
    found = list(_hardness_values.trials())
    failures = [t for t in found if not t.typed or (t.said and not t.names_it)]
    print(
        "\n".join(
            f"{t.settings} {t.key} = {t.value}: {t.said[:200]}" for t in failures[:20]
        )
    )
    refused = sum(bool(t.said) for t in found)
    case, seconds = f"{len(found)} bad values of every key", time.perf_counter() - start
    return _row(
        case, f"{refused} refused", seconds, len(failures), "untyped, or key not named"
    )


def threads() -> Row:
    """Commands whose results differ with the number of threads."""
    with tempfile.TemporaryDirectory() as name:
        found = dict(_hardness_threads.differing(Path(name)))
    print(
        "\n".join(
            f"{verb}: other bytes in {', '.join(names)}"
            for verb, names in found.items()
            if names
        )
    )
    case = (
        f"{', '.join(found)} on {', '.join(map(str, _hardness_threads.COUNTS))} threads"
    )
    failures = sum(map(bool, found.values()))
    return _row(case, "bytes of all files", math.nan, failures, "other bytes, not said")


def seeds(verbs: tuple[str, ...]) -> Row:
    """Commands whose results differ with the interpreter that runs them."""
    with tempfile.TemporaryDirectory() as name:
        found = dict(_hardness_seeds.differing(Path(name), verbs))
    print(
        "\n".join(
            f"{verb}: other bytes in {', '.join(names)}"
            for verb, names in found.items()
            if names
        )
    )
    case = f"{', '.join(found)} in two interpreters"
    method = "bytes of all files; other hash seeds, loops compiled and cached, clocks that agree"
    return _row(case, method, math.nan, sum(map(bool, found.values())), "other bytes")


def _row(case: str, method: str, seconds: float, failures: int, against: str) -> Row:
    return Row(
        case,
        method,
        seconds,
        float(failures),
        against,
        goal=f"0: {'met' if failures == 0 else 'missed'}",
    )


def _tried() -> Tried:
    """What was tried so far."""
    found: Tried = json.loads(TRIALS.read_text("utf-8")) if TRIALS.is_file() else {}
    return found


def _note(kind: str, name: str, entry: dict[str, Any]) -> Tried:
    """Put an entry into what was tried so far; all of that. Runs of other verbs or
    kinds may do so at the same time.
    """
    with lock.folder(TRIALS.parent):
        tried = _tried()
        tried.setdefault(kind, {})[name] = entry
        store.write_text(TRIALS, json.dumps(tried, indent=1) + "\n")
    return tried


def keep(found: list[Row]) -> None:
    """Put rows into the result, in place of those of the same parts."""
    held = json.loads(RESULT.read_text("utf-8"))["rows"] if RESULT.is_file() else []
    new = [dataclasses.asdict(row) for row in found]
    parts = {row["against"] for row in new}
    kept = [row for row in held if row["against"] not in parts]
    store.write_text(RESULT, json.dumps({"rows": kept + new}, indent=1) + "\n")


def main() -> None:
    """The parts that are asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name in (*AGAINST, "mutations", "points"):
        parser.add_argument(f"--{name}", type=int, default=0)
    for name in ("values", "threads", "seeds"):
        parser.add_argument(f"--{name}", action="store_true")
    parser.add_argument(
        "--seconds",
        type=float,
        default=math.inf,
        help="no new trial of a command after so long",
    )
    parser.add_argument(
        "--verbs", nargs="*", choices=list(_hardness_commands.VERBS), default=()
    )
    parser.add_argument(
        "--kinds", nargs="*", choices=sorted(_hardness_samples.READERS), default=()
    )
    asked = parser.parse_args()
    found, trials = [], {kind: getattr(asked, kind) for kind in AGAINST}
    if any(trials.values()):
        found += runs(
            trials, tuple(asked.verbs) or tuple(_hardness_commands.VERBS), asked.seconds
        )
    found += (
        points(
            asked.points,
            tuple(asked.verbs) or tuple(_hardness_commands.VERBS),
            asked.seconds,
        )
        if asked.points
        else []
    )
    found += [mutations(asked.mutations, asked.kinds)] if asked.mutations else []
    found += [bad_values()] if asked.values else []
    found += [threads()] if asked.threads else []
    found += (
        [seeds(tuple(asked.verbs) or tuple(_hardness_commands.VERBS))]
        if asked.seeds
        else []
    )
    print(table(found))
    keep(found)


if __name__ == "__main__":
    main()
