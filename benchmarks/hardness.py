"""What bad luck and bad input do to the commands: kills, two writers, full disks, damaged files, values out of range.

    python -m benchmarks hardness                                        # small: some minutes on two quiet cores
    python -m benchmarks.hardness --kills 2000 --writers 200 --disks 200 --mutations 1000000

The error of a row is the number of failures: mixed results, files lost, scratch left, untyped ends, crashes. Two sets
of different size take turns, so that a result made of both would show.
"""

import argparse
import dataclasses
import hashlib
import io
import json
import math
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from benchmarks import Row
from benchmarks.__main__ import table
from characterize.bench import Truth
from characterize.captures import capture as captures
from characterize.commands.fit import Metrology
from characterize.pupil import PupilSpec
from codesign.budget import PlanConfig
from codesign.commands.scene import Scene
from metalens import lens, library, psf
from metalens.commands.design import Design
from metalens.commands.library import CellFile
from metalens.commands.psf import Settings
from metalens.ground import config, executor
from metalens.ground.errors import MetalensError, WorkerError

SEED = 5
TOLD = ("manifest.json", "layout.json", "report.html")  # hold times and commands: no part of what is compared
KILLS, WRITERS, DISKS, MUTATIONS = 12, 4, 6, 4000
RECORDS = (Design, CellFile, Settings, Truth, Metrology, PupilSpec, PlanConfig, Scene)
BAD = (-1, -1.5, 0, 10**30, 1e20, math.inf, -math.inf, math.nan, "", "\0", True, [], [[]], {}, {"a": {}}, "x" * 9999)
MOST_MEMORY = 1 << 30
DESIGNS = ("aperture_mm = 0.02\nlibrary = 'library.h5'\n", "aperture_mm = 0.03\nlibrary = 'library.h5'\n")
CELL = "[cell]\npitch_um = 0.3\npillar = {n = 3.6}\n[sweep]\nwavelengths_um = [0.85]\nsamples = 40\ntolerance = 0.05\n"
FRAME = "frames = 1\npixels = {}\npitch_um = 60.0\n"
# verb: words for each of two settings, and the output
VERBS = {
    "design": ("design design{}.toml -o out.h5 --skip-focus-check", "out.h5"),
    "psf": ("psf lens{}.h5 --config psf.toml -o out.h5", "out.h5"),
    "layout": ("layout lens{}.h5 -o out", "out"),
    "scene": ("scene scene{}.toml -o out", "out"),
}


def rows() -> list[Row]:
    """All parts at their small size."""
    return measured(KILLS, WRITERS, DISKS, MUTATIONS)


def measured(kills: int, writers: int, disks: int, mutations: int) -> list[Row]:
    """A row a part."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _prepare(folder)
        known = {verb: _known(folder, verb) for verb in VERBS}
        return [
            _timed(f"{kills} kills", lambda: _kills(folder, known, kills), "mixed, lost, or scratch left"),
            _timed(f"{writers} pairs of writers", lambda: _pairs(folder, known, writers), "mixed, or none succeeded"),
            _timed(f"{disks} full disks", lambda: _disks(folder, known, disks), "crash, loss, or scratch left"),
            _timed(f"{mutations} damaged files", lambda: _mutations(folder, mutations), "untyped ends and crashes"),
            _timed("bad values of every key", _bad_values, "untyped ends"),
            _timed("psf on 1, 2, 8 threads", lambda: _threads(folder), "results that differ"),
        ]


def _timed(case: str, part: Callable[[], int], against: str) -> Row:
    start = time.perf_counter()
    failures = part()
    goal = f"0: {'met' if failures == 0 else 'missed'}"
    return Row(case, "as it comes", time.perf_counter() - start, float(failures), against, goal=goal)


def _start(folder: Path, words: str, **more: Any) -> "subprocess.Popen[bytes]":
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    return subprocess.Popen([sys.executable, "-m", "metalens", *words.split()], cwd=folder, **(quiet | more))


def _run(folder: Path, words: str, **more: Any) -> tuple[int, str]:
    child = _start(folder, words, **more)
    told = child.communicate()[1].decode("utf-8", "replace")
    return child.returncode, told


def _prepare(folder: Path) -> None:
    texts = {"cell.toml": CELL, "psf.toml": "depths_mm = [16.0, 18.0, 1.0]\nangles_deg = [0.0]\nsamples = 32\n"}
    texts |= {f"design{i}.toml": text for i, text in enumerate(DESIGNS)}
    texts |= {f"scene{i}.toml": FRAME.format(n) for i, n in enumerate((24, 32))}
    for name, text in texts.items():
        (folder / name).write_text(text)
    for words in ("library cell.toml -o library.h5", *(f"design design{i}.toml -o lens{i}.h5" for i in (0, 1))):
        status, told = _run(folder, words)
        if status not in (0, 1):
            raise RuntimeError(f"{words}: {told}")


def _state(folder: Path, output: str) -> dict[str, str]:
    """{name: SHA-256} of an output and what lies beside it; times and commands are no part of it."""
    stem = Path(output).stem
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if (
            path.is_file()
            and name.startswith(stem)
            and path.name not in ("manifest.json", "layout.json", "report.html")
        ):
            found[name] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def _clear(folder: Path, output: str) -> None:
    for name in _state(folder, output):
        (folder / name).unlink()
    for path in sorted(folder.glob("out*"), reverse=True):
        subprocess.run(["rm", "-rf", str(path)], check=True)


def _known(folder: Path, verb: str) -> list[dict[str, str]]:
    """The two whole results of a verb; the second is left standing."""
    words, output = VERBS[verb]
    states = []
    for i in (0, 1):
        _clear(folder, output)
        status, told = _run(folder, words.format(i))
        if status not in (0, 1):
            raise RuntimeError(f"{verb}: {told}")
        states.append(_state(folder, output))
    return states


def _whole(state: dict[str, str], known: list[dict[str, str]], output: str) -> bool:
    """Whether a state is one result: all of it, or a file whose pictures are not there yet."""
    named = any(name == output or name.startswith(output + "/") for name in state)
    return named and any(
        state.items() <= one.items() and (Path(output).suffix != "" or state.keys() == one.keys()) for one in known
    )


def _scratch(folder: Path) -> int:
    return sum(1 for p in folder.iterdir() if p.name.startswith(".") or p.name.endswith(".unfinished"))


def _kills(folder: Path, known: dict[str, list[dict[str, str]]], count: int) -> int:
    chance, failures = random.Random(SEED), 0
    for turn in range(count):
        verb = sorted(VERBS)[turn % len(VERBS)]
        words, output = VERBS[verb]
        if turn < len(VERBS) or not _whole(_state(folder, output), known[verb], output):
            _clear(folder, output)
        start = time.perf_counter()
        _run(folder, words.format(0) + " --force")
        lasts = time.perf_counter() - start
        child = _start(folder, words.format(1) + " --force")
        time.sleep(lasts * chance.uniform(0.3, 1.0))
        child.send_signal(chance.choice([signal.SIGKILL, signal.SIGINT, signal.SIGTERM, signal.SIGHUP]))
        child.communicate()
        failures += not _whole(_state(folder, output), known[verb], output)
        status, _ = _run(folder, words.format(1) + " --force")
        failures += status not in (0, 1) or _state(folder, output) != known[verb][1] or _scratch(folder) > 0
        _clear(folder, output)
    return failures


def _pairs(folder: Path, known: dict[str, list[dict[str, str]]], count: int) -> int:
    failures = 0
    for turn in range(count):
        verb = sorted(VERBS)[turn % len(VERBS)]
        words, output = VERBS[verb]
        _clear(folder, output)
        pair = [_start(folder, words.format(i)) for i in (0, 1)]
        ends = sorted((child.communicate(), child.returncode)[1] for child in pair)
        failures += ends[0] > 1 or ends[1] > 2 or _state(folder, output) not in known[verb] or _scratch(folder) > 0
        _clear(folder, output)
    return failures


def _disks(folder: Path, known: dict[str, list[dict[str, str]]], count: int) -> int:
    """A limit on the size of a file stands for a full disk: no right to mount one is needed."""
    chance, failures = random.Random(SEED), 0
    for turn in range(count):
        verb = sorted(VERBS)[turn % len(VERBS)]
        words, output = VERBS[verb]
        _clear(folder, output)
        most = int(10 ** chance.uniform(2, 5))
        limit = lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))  # noqa: B023, E731
        status, told = _run(folder, words.format(0), preexec_fn=limit)
        state = _state(folder, output)
        failures += status not in (0, 1, 2) or "Traceback" in told or _scratch(folder) > 0
        failures += bool(state) and state != known[verb][0]
        _clear(folder, output)
    return failures


def _mutations(folder: Path, count: int) -> int:
    """In workers that may die: every death, untyped error and read of more than a gigabyte or 5 s counts."""
    files = [str(folder / name) for name in ("library.h5", "lens0.h5", "cell.toml", "design0.toml", "psf.toml")]
    (folder / "page.tif").write_bytes(_tiff())
    files.append(str(folder / "page.tif"))
    each = 50
    tasks = [(files[k % len(files)], SEED + k, each) for k in range(max(1, count // each))]
    try:
        return sum(failures for _, failures in executor.run(mutate, tasks))
    except WorkerError:
        return len(tasks)


def _tiff() -> bytes:
    import tifffile

    out = io.BytesIO()
    tifffile.imwrite(out, np.arange(3 * 12 * 16, dtype=np.uint16).reshape(3, 12, 16), photometric="minisblack")
    return out.getvalue()


def mutate(task: tuple[str, int, int]) -> int:
    """Failures of a reader on so many damaged copies of a file."""
    name, seed, count = task
    chance, whole, failures = random.Random(seed), Path(name).read_bytes(), 0
    resource.setrlimit(resource.RLIMIT_AS, (8 * MOST_MEMORY, resource.RLIM_INFINITY))
    readers = {".toml": _read_toml, ".tif": captures.load, ".h5": lens.load if "lens" in name else library.load}
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / Path(name).name
        for _ in range(count):
            path.write_bytes(_damaged(whole, chance))
            if path.suffix == ".h5" and chance.random() < 0.7:
                path.write_bytes(whole)
                _edit(path, chance)
            before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
            start = time.perf_counter()
            try:
                readers[path.suffix](path)
            except MetalensError:
                pass
            except Exception as error:  # noqa: BLE001 (what is counted)
                sys.stderr.write(f"{path.name} {type(error).__name__}: {error}\n")
                failures += 1
            grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - before
            failures += time.perf_counter() - start > 5 or grown > MOST_MEMORY
    return failures


def _read_toml(path: Path) -> object:
    kinds = {"cell": CellFile, "psf": Settings}
    return config.load(path, kinds.get(path.stem, Design))


def _damaged(whole: bytes, chance: random.Random) -> bytes:
    data = bytearray(whole)
    for _ in range(chance.randint(1, 4)):
        at = chance.randrange(max(1, len(data)))
        how = chance.randrange(4)
        if how == 0:
            data = data[:at]
        elif how == 1:
            data[at : at + 1] = bytes([chance.randrange(256)])
        elif how == 2:
            data[at:at] = data[at : at + chance.randint(1, 64)] * chance.randint(1, 4)
        else:
            data[at : at + 4] = chance.choice([b"\xff" * 4, b"\0" * 4, b"\x7f\xff\xff\xff", b"1e99"])
    return bytes(data)


def _edit(path: Path, chance: random.Random) -> None:
    """Put something of the wrong kind into an HDF5 file, with good checksums."""
    values: tuple[Any, ...] = (
        -1,
        math.nan,
        "x",
        b"\xff",
        [1.0, 2.0],
        np.zeros((2, 2)),
        10**18,
        np.array(["a"], "S1"),
        1j,
    )
    with h5py.File(path, "r+") as file:
        names: list[str] = []
        file.visit(names.append)
        if chance.random() < 0.5:
            file.attrs[chance.choice(sorted(file.attrs))] = chance.choice(values)
            return
        name = chance.choice(names)
        del file[name]
        if chance.random() < 0.8:
            file[name] = chance.choice(values)


def _bad_values() -> int:
    """Every key of every record with every bad value: refused by type, or fit for that key."""
    failures = 0
    for record in RECORDS:
        for keys in _keys(record):
            for value in BAD:
                entry: Any = value
                for key in reversed(keys):
                    entry = {key: entry}
                try:
                    config.from_table(entry, record)
                except MetalensError:
                    continue
                except Exception as error:  # noqa: BLE001 (what is counted)
                    sys.stderr.write(f"{record.__name__} {'.'.join(keys)} = {value!r:.40}: {error!r}\n")
                    failures += 1
    return failures


def _keys(record: Any, depth: int = 0) -> Iterator[tuple[str, ...]]:
    for entry in dataclasses.fields(record):
        yield (entry.name,)
        nested = entry.default if dataclasses.is_dataclass(entry.default) else None
        if entry.default_factory is not dataclasses.MISSING and dataclasses.is_dataclass(entry.default_factory):
            nested = entry.default_factory
        if nested is not None and depth < 3:
            kind = nested if isinstance(nested, type) else type(nested)
            yield from ((entry.name, *keys) for keys in _keys(kind, depth + 1))


def _threads(folder: Path) -> int:
    found = set()
    for count in (1, 2, 8):
        told = {name: str(count) for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS")}
        _clear(folder, "out.h5")
        status, words = _run(folder, "psf lens0.h5 --config psf.toml -o out.h5", env=os.environ | told)
        if status not in (0, 1):
            raise RuntimeError(words)
        found.add(np.asarray(psf.load(folder / "out.h5").intensity).tobytes())
    return len(found) - 1


def main() -> None:
    """Parts at other sizes."""
    parser = argparse.ArgumentParser(description=__doc__)
    for name, value in (("kills", KILLS), ("writers", WRITERS), ("disks", DISKS), ("mutations", MUTATIONS)):
        parser.add_argument(f"--{name}", type=int, default=value)
    found = measured(**vars(parser.parse_args()))
    print(table(found))
    target = Path(__file__).parent / "results" / "hardness.json"
    target.write_text(json.dumps({"rows": [dataclasses.asdict(row) for row in found]}, indent=1) + "\n")


if __name__ == "__main__":
    main()
