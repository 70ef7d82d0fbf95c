"""Damaged copies of every kind of file that a command reads, each read in a forked
process that may die.

    python -m benchmarks._hardness_files COPIES [KIND ...]      # prints failures by kind

A failure is an untyped error, a death, more than a gigabyte above what the reader's
libraries take, or more than 5 s.
The damage of copy number n of a kind is drawn from a generator seeded with both, so any
failure can be had again.
"""

import collections
import json
import os
import random
import resource
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks import _hardness_bytes as damage
from benchmarks import _hardness_samples as samples
from metalens.ground.errors import MetalensError

SEED = 5
MOST_BYTES, MOST_SECONDS, PATIENCE = 1 << 30, 5.0, 60
Mutator = Callable[[bytes, random.Random], bytes]
MUTATORS: dict[str, Mutator] = {
    ".png": damage.png, ".oas": damage.oasis, ".safetensors": damage.safetensors, ".h5": damage.hdf5,
    ".tif": damage.head, ".npy": damage.head, ".mat": damage.head, ".gds": damage.plain,
}  # fmt: skip
# kinds whose reader has a process of its own: one copy for so many of the others
_OF_HDF5 = {
    kind: 20 for kind, (name, _) in samples.READERS.items() if name.endswith(".h5")
}
SLOW = {"mat5": 200, "mat73": 20, "gdsii": 4} | _OF_HDF5
Begun = Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True, slots=True)
class Count:
    """What came of so many copies of a kind: refused, and failures in words by the
    number of the copy.

    last: number of the last one.
    """

    kind: str
    copies: int
    refused: int
    failures: dict[int, str]
    last: int


def counted(
    folder: Path, copies: int, kinds: Sequence[str] = (), begun: Begun | None = None
) -> Iterator[Count]:
    """Share ``copies`` among the kinds (all of them, if none is named); a count a kind.

    begun: {kind: {"done": copies before, "failed": {number: words}}}: those that failed
    come again, then the next.
    """
    samples.write(folder)
    kinds = sorted(kinds or samples.READERS)
    weight = {kind: 1 / SLOW.get(kind, 1) for kind in kinds}
    total = sum(weight.values())
    for kind in kinds:
        name, read = samples.READERS[kind]
        read(folder / kind / name)  # what it imports is inherited by all children
    for kind in kinds:
        before = (begun or {}).get(kind, {"done": 0, "failed": {}})
        fresh = range(
            before["done"],
            before["done"] + max(1, round(copies * weight[kind] / total)),
        )
        found = _kind(folder, kind, [*map(int, before["failed"]), *fresh])
        for number, failure in found.failures.items():
            print(f"{kind}: copy {number}: {failure}", flush=True)
        yield found


def _kind(folder: Path, kind: str, numbers: Sequence[int]) -> Count:
    """All copies of a kind; a child that dies is a failure, and the next goes on after
    the copy that killed it.
    """
    journal = folder / f"{kind}.jsonl"
    journal.unlink(missing_ok=True)
    done = refused = 0
    failures: dict[int, str] = {}
    whole = (folder / kind / samples.READERS[kind][0]).read_bytes()
    while done < len(numbers):
        child = os.fork()
        if child == 0:
            try:
                _child(folder, kind, whole, numbers[done:])
            finally:
                traceback.print_exc()
                os._exit(1)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        told = [json.loads(line) for line in journal.read_text().splitlines()]
        journal.unlink()
        done += sum(not entry["ended"] for entry in told)
        refused += told[-1]["refused"]
        failures |= {entry["copy"]: entry["error"] for entry in told if entry["error"]}
        if status:
            failures[told[-1]["copy"]] = f"its reader ended with {status}"
    return Count(kind, len(numbers), refused, failures, max(numbers))


def _child(folder: Path, kind: str, whole: bytes, numbers: Sequence[int]) -> None:
    """Read damaged copies until the last or until one of them ends this process; never
    returns.
    """
    name, read = samples.READERS[kind]
    here, refused, base = folder / kind / name, 0, _peak()
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(
        resource.RLIMIT_AS, (_address_space() + 6 * MOST_BYTES, resource.RLIM_INFINITY)
    )
    with open(folder / f"{kind}.jsonl", "a", buffering=1) as journal:
        for number in numbers:
            entry = {"copy": number, "refused": refused, "error": "", "ended": False}
            journal.write(json.dumps(entry) + "\n")
            damaged(here, whole, random.Random(f"{SEED} {kind} {number}"))
            signal.alarm(PATIENCE)
            typed, error = _outcome(read, here, base)
            refused += typed
            if error or number == numbers[-1]:
                journal.write(
                    json.dumps(
                        entry
                        | {"refused": refused, "error": error[:300], "ended": True}
                    )
                    + "\n"
                )
    here.write_bytes(whole)
    os._exit(0)


def _outcome(read: Callable[[Path], object], path: Path, base: int) -> tuple[bool, str]:
    """Whether a reader refused a file, and what was wrong about the way it did."""
    start, refused, error = time.process_time(), False, ""
    try:
        read(path)
    except (MetalensError, OSError):
        refused = True
    except Exception as untyped:  # noqa: BLE001 (what is counted)
        error = f"{type(untyped).__name__}: {untyped}"
    lasted = (
        time.process_time() - start
    )  # of this process alone: the machine may be shared
    if lasted > MOST_SECONDS:
        error += f" took {lasted:.1f} s"
    if _peak() - base > MOST_BYTES:
        error += f" took {(_peak() - base) / 1e9:.2g} GB"
        Path("/proc/self/clear_refs").write_text("5")
    return refused, error


def _address_space() -> int:
    return int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf(
        "SC_PAGE_SIZE"
    )


def _peak() -> int:
    """Bytes of the largest resident set since it was last cleared."""
    told = Path("/proc/self/status").read_text()
    return 1024 * int(told.partition("VmHWM:")[2].split()[0])


def damaged(path: Path, whole: bytes, chance: random.Random) -> None:
    """Write one damaged copy."""
    if path.suffix == ".h5" and chance.random() < 0.5:
        damage.edited(path, whole, chance)
        return
    mutator = MUTATORS.get(path.suffix, damage.text)
    path.write_bytes(
        (damage.plain if chance.random() < 0.1 else mutator)(whole, chance)
    )


def summary(counts: list[Count]) -> str:
    """Failures by kind, each with its first example."""
    by = collections.Counter({c.kind: len(c.failures) for c in counts if c.failures})
    first = {c.kind: next(iter(c.failures.values())) for c in counts if c.failures}
    return "\n".join(
        f"{kind}: {n}, first: {first[kind]}" for kind, n in by.most_common()
    )


def main() -> None:
    """So many copies of the kinds that are named, or of all."""
    with tempfile.TemporaryDirectory() as place:
        counts = list(counted(Path(place), int(sys.argv[1]), sys.argv[2:]))
    print(
        f"{sum(c.copies for c in counts)} copies, {sum(c.refused for c in counts)} refused\n{summary(counts)}"
    )


if __name__ == "__main__":
    main()
