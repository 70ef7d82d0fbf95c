"""Runs the tests of one mutant in a process forked from one that has numpy, torch and
numba loaded already.
"""

import importlib
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from benchmarks.mutation.server import QUIET, may_have_children

LIBRARIES = (
    "numpy",
    "scipy.linalg",
    "scipy.optimize",
    "scipy.special",
    "scipy.interpolate",
    "scipy.ndimage",
    "torch",
    "numba",
)
LIBRARIES += ("h5py", "hypothesis", "hypothesis.extra.numpy", "pytest", "tifffile")
LEFT_OUT = shutil.ignore_patterns(
    ".git",
    ".venv*",
    "build",
    "*.egg-info",
    ".hypothesis",
    ".mypy_cache",
    ".ruff_cache",
    ".ci",
)
NOT_FOUND = 4  # of pytest: a test that was asked by name is not there
# on top of three times the usual: imports, and loops that a mutant makes longer without
# end
SLACK_S = 30


def load_libraries() -> None:
    """Once, before the first fork."""
    for name in LIBRARIES:
        importlib.import_module(name)


@contextmanager
def copy_of(root: Path) -> Iterator[Path]:
    """A copy of the tree to mutate; byte code and compiled loops are kept with the
    times of their sources.
    """
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        yield Path(
            shutil.copytree(root, Path(folder) / "tree", ignore=LEFT_OUT, symlinks=True)
        )


class Bench:
    """A copied tree in which one module at a time is replaced and tests are run."""

    def __init__(self, tree: Path) -> None:
        self.tree = tree
        self._edits = 0

    def outcome(
        self, path: str, source: str, tests: list[str], usual_s: float, *, fresh: bool
    ) -> tuple[str, float]:
        """What tests say of ``source`` in ``path``, passed, failed or time (far beyond
        the usual), and the seconds.
        """
        file = self.tree / path
        before, stat = file.read_text(encoding="utf-8"), file.stat()
        self._edits += 1
        file.write_text(source, encoding="utf-8")
        os.utime(file, (stat.st_atime, stat.st_mtime + self._edits))  # no old byte code
        try:
            return self.run(tests, usual_s, fresh=fresh)
        finally:
            file.write_text(before, encoding="utf-8")
            os.utime(file, (stat.st_atime, stat.st_mtime))

    def run(
        self, tests: list[str], usual_s: float, *, fresh: bool
    ) -> tuple[str, float]:
        """The tests as the tree stands; ``fresh``: with compiled loops of their own."""
        start = time.monotonic()
        child = os.fork()
        if child == 0:
            self._child(
                tests, int(3 * usual_s + SLACK_S + (120 if fresh else 0)), fresh
            )
        _, status = os.waitpid(child, 0)
        spent = time.monotonic() - start
        if os.WIFSIGNALED(status):
            return "time" if os.WTERMSIG(status) in (
                signal.SIGXCPU,
                signal.SIGALRM,
                signal.SIGKILL,
            ) else "failed", spent
        if os.WEXITSTATUS(status) == NOT_FOUND and any("::" in test for test in tests):
            files = list(
                dict.fromkeys(test.partition("::")[0] for test in tests)
            )  # tests named after what changed
            return self.run(files, usual_s, fresh=fresh)
        return "passed" if os.WEXITSTATUS(status) == 0 else "failed", spent

    def _child(self, tests: list[str], limit_s: int, fresh: bool) -> None:
        os.setpgid(0, 0)
        may_have_children()
        resource.setrlimit(resource.RLIMIT_CPU, (limit_s, limit_s + 5))
        signal.alarm(8 * limit_s)
        null = os.open(
            os.environ.get("MUTANT_LOG", os.devnull),
            os.O_WRONLY | os.O_CREAT | os.O_APPEND,
        )
        os.dup2(null, 1)
        os.dup2(null, 2)
        os.chdir(self.tree)
        import numba
        import pytest

        with tempfile.TemporaryDirectory(prefix="loops-") as cache:
            if fresh:
                os.environ["NUMBA_CACHE_DIR"] = numba.config.CACHE_DIR = cache
            sys.path[:] = [
                str(self.tree),
                *(p for p in sys.path if p and Path(p).resolve() != Path.cwd()),
            ]
            for name in [n for n in sys.modules if n.split(".")[0] == "benchmarks"]:
                del sys.modules[name]
            os.environ.update(PYTHONPATH=str(self.tree), CI="1")
            code = pytest.main([*QUIET, "-x", *tests])
        os._exit(int(code) if code != 5 else 0)
