"""Bytes of the results of every command in two interpreters with other seeds of
hashing, before clocks that agree.

Trials of other parts run in forks of one interpreter, where sets have one order, and
leave out of their comparison what
two runs of it make differently, which are times. Here nothing is left out. The first
interpreter compiles the loops,
the second takes them from the cache, which is empty at the beginning.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from benchmarks import _hardness_commands as commands
from benchmarks._hardness_commands import VERBS
from metalens.ground import store

SEEDS = ("1", "4294967295")
# seconds pass by the call, so that no rate is infinite; not for threads beside, which
# come when they come, nor for
# libraries, whose compiler looks at the clock where it compiles
_STILL = """
import sys, threading, time
ours, passed = ("metalens", "layout", "characterize", "codesign"), [0.0]
def seconds():
    asks = sys._getframe(1).f_globals.get("__name__", "").split(".")[0]
    passed[0] += (asks in ours and threading.current_thread() is threading.main_thread()) / 1024
    return passed[0]
time.perf_counter, time.time = seconds, lambda: 1.7e9
from metalens.cli import main
sys.exit(main(sys.argv[1:]))
"""


def differing(
    folder: Path, verbs: tuple[str, ...] = tuple(VERBS)
) -> Iterator[tuple[str, list[str]]]:
    """(verb, files of its result that another interpreter makes otherwise, or not at
    all).
    """
    commands.settings(folder)
    for words in commands.inputs(verbs):
        _run(folder, words, SEEDS[0])
    commands.found(folder, verbs)
    for verb in verbs:
        words, output = VERBS[verb]
        states = []
        for seed in SEEDS:
            _run(folder, words.format(0), seed)
            states.append(
                {
                    p.relative_to(folder).as_posix(): store.sha256(p)
                    for p in _files(folder, output)
                }
            )
            for path in folder.glob(Path(output).stem + "*"):
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        names = set().union(*states)
        yield (
            verb,
            sorted(
                name for name in names if len({state.get(name) for state in states}) > 1
            ),
        )


def _files(folder: Path, output: str) -> list[Path]:
    """All files of an output and of what lies beside it under its name."""
    tops = folder.glob(Path(output).stem + "*")
    return [path for top in tops for path in (top, *top.rglob("*")) if path.is_file()]


def _run(folder: Path, words: str, seed: str) -> None:
    told = os.environ | {
        "PYTHONHASHSEED": seed,
        "PYTHONPATH": str(Path(__file__).parents[1]),
    }
    told["NUMBA_CACHE_DIR"] = str(folder / "numba")
    command = [sys.executable, "-c", _STILL, *words.split(), "--quiet"]
    done = subprocess.run(
        command, cwd=folder, env=told, capture_output=True, text=True, check=False
    )
    if done.returncode not in (0, 1):
        raise RuntimeError(f"{words}: {done.stderr}")
