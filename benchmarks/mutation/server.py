"""A process that has collected the suite once: each question is answered by a fork of
it, so nothing is read again.
"""

import contextlib
import gc
import importlib
import json
import multiprocessing
import os
import resource
import signal
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

import pytest

from benchmarks.mutation.reach import Seen, Watch

QUIET = (
    "-q",
    "-m",
    "not slow and not peers",
    "-p",
    "no:cacheprovider",
    "-p",
    "no:xdist",
    "--tb=no",
)
UNPATCHED = 71  # exit status: no function in memory holds what was changed


class Server:
    """The suite of ``tree``, or some of it, collected in a child process that waits for
    questions.
    """

    def __init__(self, tree: Path, tests: Sequence[str] = ("tests",)) -> None:
        self.tree = tree
        self._pipe, theirs = multiprocessing.Pipe()
        self._child = os.fork()
        if self._child == 0:
            self._pipe.close()
            os.setpgid(0, 0)
            with contextlib.suppress(BaseException):
                _serve(tree, theirs, tests)
            os._exit(0)
        theirs.close()

    def seen(self, file: str) -> Seen:
        """Of the tests of one file that pass: their seconds, and the lines that they
        run.
        """
        self._pipe.send((None, [file], 600.0))
        found: Seen = self._pipe.recv()
        return found

    def outcome(
        self, path: str, source: str, tests: list[str], limit_s: float
    ) -> tuple[str, float] | None:
        """What tests say of ``source`` in ``path``: passed, failed, time; None where no
        function in memory changes.
        """
        self._pipe.send(((str(self.tree / path), source), tests, limit_s))
        answer: tuple[str, float] | None = self._pipe.recv()
        return answer

    def close(self) -> None:
        """Let the child go."""
        self._pipe.close()
        os.waitpid(self._child, 0)


def may_have_children() -> None:
    """Of a fork of a pool's worker: tests that start processes of their own fail where
    they are not allowed to.
    """
    multiprocessing.current_process().daemon = False


def _serve(tree: Path, pipe: Connection, tests: Sequence[str]) -> None:
    may_have_children()
    os.chdir(tree)
    null = os.open(
        os.environ.get("MUTANT_LOG", os.devnull), os.O_WRONLY | os.O_CREAT | os.O_APPEND
    )
    os.dup2(null, 1)
    os.dup2(null, 2)
    sys.path[:] = [str(tree), *(p for p in sys.path if p and Path(p).resolve() != tree)]
    for name in [n for n in sys.modules if n.split(".")[0] == "benchmarks"]:
        del sys.modules[name]
    os.environ.update(PYTHONPATH=str(tree), CI="1")
    pytest.main([*QUIET, *tests], [_Loop(pipe)])


class _Loop:
    """A pytest plugin whose loop over the tests is a loop over questions."""

    def __init__(self, pipe: Connection) -> None:
        self.pipe = pipe
        self.failed: set[str] = set()
        self.first = False  # stop at the first failure

    def pytest_runtest_logreport(self, report: Any) -> None:
        if not report.passed and not report.skipped:
            self.failed.add(report.nodeid)

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        functions = _functions({})
        gc.freeze()
        while True:
            try:
                change, names, limit_s = self.pipe.recv()
            except EOFError:
                return True
            wanted = dict.fromkeys(names)
            by_name = {item.nodeid: item for item in session.items}
            items = [by_name[n] for n in wanted if n in by_name]
            files = list(wanted)
            whole = [
                item
                for item in session.items
                if item.nodeid.partition("::")[0] in wanted
            ]
            items += sorted(
                whole, key=lambda item: files.index(item.nodeid.partition("::")[0])
            )
            if change is None:
                self.pipe.send(self._seen(items, limit_s))
                continue
            if change[0] not in functions:  # a module that is loaded when first used
                parts = Path(change[0]).relative_to(Path.cwd()).with_suffix("").parts
                importlib.import_module(".".join(parts))
                functions = _functions(functions)
            self.pipe.send(
                self._outcome(items, functions.get(change[0], []), change, limit_s)
            )

    def _seen(self, items: list[pytest.Item], limit_s: float) -> Seen:
        with tempfile.TemporaryDirectory(prefix="seen-") as folder:
            file = Path(folder) / "seen.json"

            def watched() -> int:
                watch = Watch(Path.cwd())
                items[0].config.pluginmanager.register(watch)
                self._run(items)
                watch.written(file, self.failed)
                return 0

            if items:
                _forked(watched, limit_s)
            return (
                dict(json.loads(file.read_text(encoding="utf-8")))
                if file.exists()
                else {}
            )

    def _outcome(
        self,
        items: list[pytest.Item],
        functions: list[FunctionType],
        change: tuple[str, str],
        limit_s: float,
    ) -> tuple[str, float] | None:
        """A test that the plain source fails as well has told nothing: what it would
        have stopped has survived.
        """
        with tempfile.TemporaryDirectory(prefix="failed-") as folder:
            told = Path(folder) / "test"

            def mutated() -> int:
                self.first = True
                if not patched(functions, *change):
                    return UNPATCHED
                self._run(items)
                told.write_text("".join(self.failed), encoding="utf-8")
                return int(bool(self.failed))

            status, spent = _forked(mutated, limit_s)
            if os.WIFSIGNALED(status):
                slow = os.WTERMSIG(status) in (
                    signal.SIGXCPU,
                    signal.SIGALRM,
                    signal.SIGKILL,
                )
                return "time" if slow else "failed", spent
            code = os.WEXITSTATUS(status)
            if code == UNPATCHED:
                return None
            name = told.read_text(encoding="utf-8") if told.exists() else ""
        telling = [item for item in items if item.nodeid == name]
        return "failed" if code and telling and self._passes(
            telling, limit_s
        ) else "passed", spent

    def _passes(self, items: list[pytest.Item], limit_s: float) -> bool:
        """Whether the source as it is passes tests."""

        def plain() -> int:
            self._run(items)
            return int(bool(self.failed))

        return _forked(plain, limit_s)[0] == 0

    def _run(self, items: list[pytest.Item]) -> None:
        for item, following in zip(items, [*items[1:], None], strict=True):
            item.ihook.pytest_runtest_protocol(item=item, nextitem=following)
            if self.first and self.failed:
                return


def _functions(known: dict[str, list[FunctionType]]) -> dict[str, list[FunctionType]]:
    """Those in memory by the file of their code, of files that are not known."""
    found: defaultdict[str, list[FunctionType]] = defaultdict(list)
    for function in gc.get_objects():
        if (
            type(function) is FunctionType
            and function.__code__.co_filename not in known
        ):
            found[function.__code__.co_filename].append(function)
    return known | dict(found)


def _forked(work: Any, limit_s: float) -> tuple[int, float]:
    """(exit status, seconds) of ``work`` in a fork with its own folder for temporary
    files.
    """
    start = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="mutant-") as folder:
        child = os.fork()
        if child == 0:
            code = 1
            with contextlib.suppress(BaseException):
                os.environ["PYTEST_DEBUG_TEMPROOT"] = folder
                resource.setrlimit(
                    resource.RLIMIT_CPU, (int(limit_s) + 1, int(limit_s) + 6)
                )
                signal.alarm(int(8 * limit_s) + 8)
                code = work()
            os._exit(code)
        status = os.waitpid(child, 0)[1]
    return status, time.monotonic() - start


def patched(functions: list[FunctionType], path: str, source: str) -> int:
    """How many functions in memory, of module ``path``, ``source`` changes; they run
    the new code from now on.

    What is evaluated once while a module is read (constants, defaults, decorators,
    compiled loops) is not among them.
    """
    new = dict(_outermost(compile(source, path, "exec")))
    changed = [
        f for f in functions if new.get(_key(f.__code__), f.__code__) != f.__code__
    ]
    for function in changed:
        function.__code__ = new[_key(function.__code__)]
    return len(changed)


def _key(code: CodeType) -> tuple[str, int]:
    return code.co_qualname, code.co_firstlineno


def _outermost(code: CodeType) -> Iterator[tuple[tuple[str, int], CodeType]]:
    """Functions of a module and methods of its classes, and those inside them."""
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield _key(constant), constant
            yield from _outermost(constant)
