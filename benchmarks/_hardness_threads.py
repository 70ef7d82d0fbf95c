"""Bytes of the results of psf, design, fit and codesign on 1, 2 and 8 threads, and
whether a result says it depends.
"""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from benchmarks import _hardness_commands as commands
from metalens.ground import store

VERBS = ("psf", "design", "fit", "codesign")
COUNTS = (1, 2, 8)
TIMED = ("manifest.json", "report.html", "log.jsonl", "result.json")  # hold times
_VARIABLES = (
    "OMP_NUM_THREADS",
    "NUMBA_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
)


def differing(folder: Path) -> Iterator[tuple[str, list[str]]]:
    """(verb, files of its result that depend on the number of threads without its
    saying so).
    """
    commands.settings(folder)
    for words in commands.inputs(VERBS):
        _run(folder, words, 2)
    for verb in VERBS:
        words, output = commands.VERBS[verb]
        states = []
        for count in COUNTS:
            _run(folder, words.format(0), count)
            said = _says_so(folder / output)
            states.append(_state(folder, Path(output).stem))
            for path in folder.glob(Path(output).stem + "*"):
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        names = set().union(*states)
        yield (
            verb,
            sorted(
                name
                for name in names
                if not said and len({state.get(name) for state in states}) > 1
            ),
        )


def _says_so(output: Path) -> bool:
    """Whether a result says that its bytes depend on the number of threads."""
    result = output / "result.json"
    return (
        result.is_file()
        and json.loads(result.read_text("utf-8")).get("bytes_depend_on_threads", False)
        is True
    )


def _run(folder: Path, words: str, threads: int) -> None:
    told = os.environ | dict.fromkeys(_VARIABLES, str(threads))
    command = [sys.executable, "-m", "metalens", *words.split(), "--quiet"]
    done = subprocess.run(
        command, cwd=folder, env=told, capture_output=True, text=True, check=False
    )
    if done.returncode not in (0, 1):
        raise RuntimeError(f"{words}: {done.stderr}")


def _state(folder: Path, stem: str) -> dict[str, str]:
    paths = [
        path
        for top in folder.glob(stem + "*")
        for path in (top, *top.rglob("*"))
        if path.is_file()
    ]
    return {
        p.relative_to(folder).as_posix(): store.sha256(p)
        for p in paths
        if p.name not in TIMED
    }
