"""Which tests run which lines of the library, as seen while they run: a mutant is asked
of those tests alone.
"""

import ast
import functools
import hashlib
import json
import re
import sys
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import pytest

PACKAGES = ("metalens", "layout", "characterize", "codesign")
CALLS = 40  # of one function within one test that are followed line by line
MODULE = ""  # the name of what stands outside every function
_LOOPS = re.compile(
    r"(^|[_.])n?jit\b|^(inside|compiled|overload)\b|vectorize"
)  # decorators that compile
Line = tuple[str, int]
Seen = dict[str, tuple[float, list[Line]]]  # test -> its seconds, the lines that it ran


class Watch:
    """A pytest plugin: the lines of ``root``'s packages that each test runs, those of
    its fixtures included.
    """

    def __init__(self, root: Path) -> None:
        self.root = f"{root}/"
        self.tests: dict[str, float] = {}  # those that passed, with their seconds
        self.lines: dict[str, set[Line]] = {}
        self._fixtures: defaultdict[str, set[Line]] = defaultdict(set)
        self._into: set[Line] = set()
        self._calls: Counter[CodeType] = Counter()
        self._paths: dict[CodeType, str | None] = {}

    def _followed(self, frame: FrameType, event: str, _: Any) -> Any:
        code = frame.f_code
        if code not in self._paths:
            name = code.co_filename.removeprefix(self.root)
            self._paths[code] = name if name.partition("/")[0] in PACKAGES else None
        path = self._paths[code]
        if path is None or self._calls[code] >= CALLS:
            return None
        self._calls[code] += 1

        def line(inner: FrameType, event: str, _: Any) -> Any:
            if event == "line":
                self._into.add((path, inner.f_lineno))
            return line

        return line

    def _begin(self, into: set[Line]) -> None:
        self._into = into
        self._calls.clear()
        threading.settrace(self._followed)
        sys.settrace(self._followed)

    @pytest.hookimpl(hookwrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any, request: Any) -> Iterator[None]:
        if fixturedef.scope == "function":
            yield
            return
        outer = self._into
        self._begin(self._fixtures[fixturedef.argname])
        yield
        self._begin(outer)

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_protocol(self, item: Any, nextitem: Any) -> Iterator[None]:
        start = time.perf_counter()
        self.lines[item.nodeid] = set()
        self._begin(self.lines[item.nodeid])
        yield
        sys.settrace(None)
        self.tests[item.nodeid] = time.perf_counter() - start
        for name in getattr(item, "fixturenames", ()):
            self.lines[item.nodeid] |= self._fixtures[name]

    def written(self, file: Path, failed: set[str]) -> None:
        """What was seen of the tests that passed, for the process that asked."""
        kept = self.tests.keys() - failed
        seen = {
            test: [round(self.tests[test], 3), sorted(self.lines[test])]
            for test in kept
        }
        file.write_text(json.dumps(seen), encoding="utf-8")


@dataclass
class Reach:
    """Tests by function and line of it: a change elsewhere in a module leaves both as
    they are.

    files: digest of every measured test file. seconds: of every test that passed. hits:
    path -> function -> line of
    that function -> tests.
    """

    files: dict[str, str] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    hits: dict[str, dict[str, dict[str, list[str]]]] = field(default_factory=dict)

    def add(self, root: Path, file: str, seen: Seen) -> None:
        """What the tests of one file ran, in place of what was known of that file."""
        for lines in (
            lines for functions in self.hits.values() for lines in functions.values()
        ):
            for at in lines:
                lines[at] = [
                    test for test in lines[at] if test.partition("::")[0] != file
                ]
        self.seconds = {
            t: s for t, s in self.seconds.items() if t.partition("::")[0] != file
        }
        self.files[file] = digest(root / file)
        for test, (spent, ran) in seen.items():
            self.seconds[test] = spent
            for path, number in ran:
                name, first = home(root / path, number)
                if name == MODULE:
                    continue
                lines = self.hits.setdefault(path, {}).setdefault(name, {})
                lines.setdefault(str(number - first), []).append(test)

    def tests(self, root: Path, path: str, number: int, budget_s: float) -> list[str]:
        """Tests that run line ``number`` of ``path``: of the test file named so first,
        then the quickest, then others
        of the same files (what one test keeps, the next may judge); as many as the
        budget holds, one at least."""
        stem = Path(path).stem

        def order(test: str) -> tuple[bool, float]:
            return re.search(
                rf"(^|_){stem}(_|$)", Path(test.partition("::")[0]).stem
            ) is None, self.seconds[test]

        direct = {
            test for test in self._direct(root, path, number) if test in self.seconds
        }
        files = {test.partition("::")[0] for test in direct}
        others = {
            test for test in self.seconds if test.partition("::")[0] in files
        } - direct
        chosen: list[str] = []
        spent = 0.0
        for test in (*sorted(direct, key=order), *sorted(others, key=order)):
            if not chosen or spent + self.seconds[test] <= budget_s:
                chosen.append(test)
                spent += self.seconds[test]
        return chosen

    def by_file(self) -> dict[str, float]:
        """Seconds of every test file."""
        total: defaultdict[str, float] = defaultdict(float)
        for test, spent in self.seconds.items():
            total[test.partition("::")[0]] += spent
        return dict(total)

    def _direct(self, root: Path, path: str, number: int) -> set[str]:
        name, first = home(root / path, number)
        functions = self.hits.get(path, {})
        if name == MODULE:
            return _all(functions.values())
        if name in compiled(root / path):
            return _all(self._lines_of(callers(root, name)))
        lines = functions.get(name, {})
        return set(lines.get(str(number - first), [])) or _all([lines])

    def _lines_of(
        self, where: Iterable[tuple[str, str]]
    ) -> Iterator[dict[str, list[str]]]:
        for path, name in where:
            yield self.hits.get(path, {}).get(name, {})


def _all(parts: Iterable[dict[str, list[str]]]) -> set[str]:
    return {test for lines in parts for tests in lines.values() for test in tests}


def digest(file: Path) -> str:
    """Of a file's bytes."""
    return hashlib.sha256(file.read_bytes()).hexdigest()[:16]


def home(path: Path, number: int) -> tuple[str, int]:
    """(name, first line) of the innermost function around a line; ("", 0) outside of
    all.
    """
    around = [f for f in _functions(path) if f[1] <= number <= f[2]]
    return max(around, key=lambda f: f[1])[:2] if around else (MODULE, 0)


def compiled(path: Path) -> set[str]:
    """Functions that numba compiles: no tracer sees their lines."""
    return {name for name, _, _, loops in _functions(path) if loops}


@functools.cache
def at_import(path: Path) -> set[str]:
    """Functions that run while their module is read, called by its own lines: a change
    in memory comes too late.
    """
    tree = ast.parse(path.read_text(encoding="utf-8"))
    bodies = {
        node.name: node for node in tree.body if isinstance(node, ast.FunctionDef)
    }
    open_ = [node for node in tree.body if not isinstance(node, ast.FunctionDef)]
    found: set[str] = set()
    while open_:
        names = {
            node.func.id
            for node in _called(open_.pop())
            if isinstance(node.func, ast.Name)
        }
        open_ += [bodies[name] for name in names & bodies.keys() - found]
        found |= names & bodies.keys()
    return found


def _called(top: ast.AST) -> Iterator[ast.Call]:
    """Calls in a statement or a function, without those in functions inside it."""
    for node in ast.iter_child_nodes(top):
        if not isinstance(node, (ast.FunctionDef, ast.Lambda)):
            yield from (node,) if isinstance(node, ast.Call) else ()
            yield from _called(node)


@functools.cache
def callers(root: Path, name: str) -> set[tuple[str, str]]:
    """(path, function) of the interpreted functions that lead to a compiled one, by
    their words.
    """
    names, found = {name}, set()
    texts = [
        (
            path,
            f[0],
            f[3],
            "\n".join(path.read_text(encoding="utf-8").splitlines()[f[1] - 1 : f[2]]),
        )
        for package in PACKAGES
        for path in sorted((root / package).rglob("*.py"))
        for f in _functions(path)
    ]
    before = 0
    while len(names) > before:
        before = len(names)
        pattern = re.compile(
            rf"\b({'|'.join(sorted(n.rpartition('.')[2] for n in names))})\b"
        )
        for path, function, loops, text in texts:
            if pattern.search(text):
                names |= {function} if loops else set()
                found |= (
                    set() if loops else {(path.relative_to(root).as_posix(), function)}
                )
    return found


@functools.cache
def _functions(path: Path) -> list[tuple[str, int, int, bool]]:
    """(name, first line, last line, compiled) of every function of a module; an
    overload has its function's name.
    """
    found = []

    def walk(node: ast.AST, prefix: str) -> None:
        for child in ast.iter_child_nodes(node):
            inside = prefix
            if isinstance(child, (ast.FunctionDef, ast.ClassDef)):
                inside = f"{prefix}{child.name}."
            if isinstance(child, ast.FunctionDef):
                words = " ".join(ast.unparse(d) for d in child.decorator_list)
                loops, other = (
                    _LOOPS.search(words) is not None,
                    re.match(r"overload\((\w+)", words),
                )
                found.append(
                    (
                        other[1] if other else inside[:-1],
                        child.lineno,
                        child.end_lineno or 0,
                        loops,
                    )
                )
                if loops:  # what stands in it is compiled with it
                    continue
            walk(child, inside)

    walk(ast.parse(path.read_text(encoding="utf-8")), "")
    return found
