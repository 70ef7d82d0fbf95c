"""``python -m benchmarks.mutation [--count N] [--seed S]``: draw mutants, run their
tests, keep the table.
"""

import argparse
import ast
import contextlib
import functools
import json
import multiprocessing
import os
import random
import subprocess
import sys
from collections import defaultdict
from dataclasses import asdict
from pathlib import Path

from benchmarks.mutation import rules, table
from benchmarks.mutation.graph import Graph
from benchmarks.mutation.reach import (
    PACKAGES,
    Reach,
    Seen,
    at_import,
    compiled,
    digest,
    home,
)
from benchmarks.mutation.runner import SLACK_S, Bench, copy_of, load_libraries
from benchmarks.mutation.server import Server

ROOT = Path(__file__).parents[2]
RESULT = ROOT / "benchmarks" / "results" / "mutants.json"
REASONS = (
    ROOT / "benchmarks" / "mutation" / "equivalent.json"
)  # path -> line's words -> change -> why none can tell
PROMISED = "tests/test_defaults.py"  # reads defaults off the source
LONGEST_S = 120.0  # of processor time, of test files whose usual time is not known
SEEN = (
    ROOT / "build" / "mutants" / "reach.json"
)  # which tests run which lines, as seen before the first mutant


def drawn(count: int, seed: int, only: str, bars: float) -> list[rules.Mutant]:
    """``count`` mutants, the share ``bars`` of them from lines that make error bars;
    modules and rules in turn.
    """
    generator, pools = random.Random(seed), {}
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            if rules.numeric(path.relative_to(ROOT)) and path.relative_to(
                ROOT
            ).as_posix().startswith(only):
                pools[path] = rules.mutants(ROOT, path)
    chosen: list[rules.Mutant] = []
    for bar, share in (
        (True, round(bars * count)),
        (False, count - round(bars * count)),
    ):
        by_rule = {
            path: _shuffled([m for m in pool if m.bar is bar], generator)
            for path, pool in pools.items()
        }
        order = [path for path, pool in by_rule.items() if pool]
        generator.shuffle(order)
        part: list[rules.Mutant] = []
        while order and len(part) < share:
            order = [path for path in order if by_rule[path]]
            popped = [by_rule[path].pop() for path in order[: share - len(part)]]
            part += [mutant for mutant in popped if _compiles(mutant)]
        chosen += part
    return chosen


def _compiles(mutant: rules.Mutant) -> bool:
    try:
        ast.parse(mutant.applied((ROOT / mutant.path).read_text(encoding="utf-8")))
    except SyntaxError:
        return False
    return True


def _shuffled(pool: list[rules.Mutant], generator: random.Random) -> list[rules.Mutant]:
    """The mutants so that the last ones are of different rules and lines."""
    kinds = defaultdict(list)
    for mutant in pool:
        kinds[mutant.rule].append(mutant)
    for group in kinds.values():
        generator.shuffle(group)
    out: list[rules.Mutant] = []
    while kinds:
        names = sorted(kinds)
        generator.shuffle(names)
        for name in names:
            out.append(kinds[name].pop())
            if not kinds[name]:
                del kinds[name]
    return out[::-1]


class Worker:
    """One copy of the tree in one process of the pool."""

    bench: Bench
    server: Server
    graph: Graph
    reach: Reach
    near: tuple[int, ...]
    longest_s: float

    @classmethod
    def begin(
        cls,
        trees: list[str],
        reach: Reach,
        tests: str,
        near: tuple[int, ...] = (),
        files: tuple[str, ...] = (),
        longest_s: float = LONGEST_S,
    ) -> None:
        at = multiprocessing.current_process()._identity[0] - 1
        tree = Path(trees[at % len(trees)])
        cls.bench, cls.server = Bench(tree), Server(tree, files or (tests,))
        cls.graph, cls.reach, cls.near, cls.longest_s = (
            Graph(ROOT, tests),
            reach,
            near,
            longest_s,
        )

    @classmethod
    def measure(cls, test: str) -> tuple[str, Seen]:
        """(test file, what its tests ran) as the tree stands; compiled loops are made
        on the way.
        """
        return test, cls.server.seen(test)

    @classmethod
    def judge(cls, task: tuple[rules.Mutant, float]) -> dict[str, object]:
        """What became of one mutant, with the tests that ran: in memory where that can
        be, else from the file.
        """
        mutant, budget_s = task
        module = mutant.path.removesuffix(".py").replace("/", ".")
        source = mutant.applied((ROOT / mutant.path).read_text(encoding="utf-8"))
        path = ROOT / mutant.path
        loops = home(path, mutant.line)[0] in compiled(path) | at_import(path)
        if cls.near:
            return cls._judged_near(mutant, module, source, loops)
        tests = cls.reach.tests(ROOT, mutant.path, mutant.line, budget_s)
        usual = sum(cls.reach.seconds[test] for test in tests)
        answer = None
        if tests and not loops:
            answer = cls.server.outcome(mutant.path, source, tests, 3 * usual + 10)
        if not tests:  # read when a module is loaded, or run by children alone
            tests, usual = (
                cls.graph.related(module, cls.reach.by_file(), budget_s),
                budget_s,
            )
        if not tests:
            return _row(mutant) | {"outcome": "no test", "seconds": 0.0, "tests": []}
        fresh = module in cls.graph.compiled
        outcome, spent = answer or cls.bench.outcome(
            mutant.path, source, tests, usual, fresh=fresh
        )
        outcome = {"passed": "survived", "failed": "killed", "time": "killed by time"}[
            outcome
        ]
        files = list(dict.fromkeys(test.partition("::")[0] for test in tests))
        return _row(mutant) | {
            "outcome": outcome,
            "seconds": round(spent, 1),
            "tests": files,
        }

    @classmethod
    def _judged_near(
        cls, mutant: rules.Mutant, module: str, source: str, loops: bool
    ) -> dict[str, object]:
        """As ``judge``, by the nearest test files; where it survives them, by the next
        ones, that are farther off.
        """
        said, spent, asked, seen = "survived", 0.0, list[str](), 0
        for reach in cls.near:
            tests, seen = _near(cls.graph, module, reach)[seen:], reach
            if said != "survived" or not tests:
                break
            outcome, seconds, tests = cls._asked(
                mutant, module, source, tests, loops, promised=not asked
            )
            spent, asked = spent + seconds, asked + tests
            said = (
                outcome
                if outcome == "survived" or reach == cls.near[0]
                else table.FARTHER
            )
        return _row(mutant) | {
            "outcome": said,
            "seconds": round(spent, 1),
            "tests": asked,
        }

    @classmethod
    def _asked(
        cls,
        mutant: rules.Mutant,
        module: str,
        source: str,
        tests: list[str],
        loops: bool,
        *,
        promised: bool,
    ) -> tuple[str, float, list[str]]:
        """(outcome, seconds, test files) by files in full; what they do not answer in
        time has survived them, unless
        they answer the plain source in that time.

        promised: where no function in memory changes it may be a default, of which the
            list of these is asked first.
        """
        answer = (
            None
            if loops
            else cls.server.outcome(mutant.path, source, tests, cls.longest_s)
        )
        if promised and answer is None and not loops:
            tests = [PROMISED, *tests]
        fresh = module in cls.graph.compiled
        outcome, spent = answer or cls.bench.outcome(
            mutant.path, source, tests, cls.longest_s / 3, fresh=fresh
        )
        said = "killed" if outcome == "failed" else "survived"
        if (
            outcome == "time"
            and cls.bench.run(tests, max(cls.longest_s - SLACK_S, 0) / 3, fresh=False)[
                0
            ]
            == "passed"
        ):
            said = "killed by time"
        return said, spent, tests


def _near(graph: Graph, module: str, count: int) -> list[str]:
    """So many test files nearest to a module: where no time is known, the graph counts
    10 s for each.
    """
    return graph.related(module, {}, 10.0 * count)


def _row(mutant: rules.Mutant) -> dict[str, object]:
    line = (
        (ROOT / mutant.path)
        .read_text(encoding="utf-8")
        .splitlines()[mutant.line - 1]
        .strip()
    )
    return {k: v for k, v in asdict(mutant).items() if k not in ("start", "end")} | {
        "text": line
    }


def main(words: list[str]) -> int:
    """Draw, judge, print as it goes, keep; 1 where a mutant survives without a reason."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.mutation", description=__doc__
    )
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="modules whose path starts so")
    parser.add_argument(
        "--bars",
        type=float,
        default=1 / 3,
        help="share drawn from lines that make error bars",
    )
    parser.add_argument("--jobs", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument(
        "--budget", type=float, default=60.0, help="seconds of tests for one mutant"
    )
    parser.add_argument(
        "--near",
        type=int,
        default=0,
        help="ask so many nearest test files, measure nothing first",
    )
    parser.add_argument(
        "--far",
        type=int,
        default=0,
        help="with --near: ask survivors of so many files in all",
    )
    parser.add_argument(
        "--longest",
        type=float,
        default=LONGEST_S,
        help="processor seconds of these files, with --near",
    )
    parser.add_argument(
        "--trust",
        action="store_true",
        help="take what tests ran at the last measurement",
    )
    parser.add_argument(
        "--tests", default="tests", help="ask the tests of this folder alone"
    )
    parser.add_argument(
        "--result", type=Path, default=RESULT, help="file that keeps the table"
    )
    parser.add_argument(
        "--again",
        action="store_true",
        help="judge the survivors of the kept result once more",
    )
    asked = parser.parse_args(words)
    if asked.far and not 0 < asked.near < asked.far:
        parser.error("--far: need --near, and more files than that")
    chosen = (
        _survivors(asked.result)
        if asked.again
        else drawn(asked.count, asked.seed, asked.only, asked.bars)
    )
    load_libraries()
    with contextlib.ExitStack() as stack:
        trees = [str(stack.enter_context(copy_of(ROOT))) for _ in range(asked.jobs)]
        reach = Reach()
        if asked.trust:
            reach = Reach(**json.loads(SEEN.read_text(encoding="utf-8")))
        elif not asked.near:
            reach = _measured(trees, asked.tests)
        near = tuple(count for count in (asked.near, asked.far) if count)
        files = _files(chosen, asked.tests, max(near)) if near else ()
        begun = trees, reach, asked.tests, near, files, asked.longest
        rows = []
        with multiprocessing.get_context("fork").Pool(
            asked.jobs, Worker.begin, begun
        ) as pool:
            for row in pool.imap_unordered(
                Worker.judge, [(m, asked.budget) for m in chosen]
            ):
                rows.append(row)
                _say(len(rows), len(chosen), row)
    rows.sort(key=lambda row: (row["path"], row["line"], row["became"]))
    return _keep(rows, asked, " ".join(words))


def _files(chosen: list[rules.Mutant], tests: str, near: int) -> tuple[str, ...]:
    """All test files that will be asked."""
    graph = Graph(ROOT, tests)
    modules = {mutant.path.removesuffix(".py").replace("/", ".") for mutant in chosen}
    return tuple(
        sorted({test for module in modules for test in _near(graph, module, near)})
    )


def _survivors(result: Path) -> list[rules.Mutant]:
    """Those of the kept result that have no reason, found again in the source as it is
    now.
    """
    kept = json.loads(result.read_text(encoding="utf-8"))["mutants"]
    open_ = (r for r in kept if r["outcome"] == "survived" and not _reason(r))
    left = {(row["path"], row["text"], row["was"], row["became"]) for row in open_}
    found = []
    for path in sorted({row[0] for row in left}):
        for mutant in rules.mutants(ROOT, ROOT / path):
            if (path, _row(mutant)["text"], mutant.was, mutant.became) in left:
                found.append(mutant)
    return found


def _measured(trees: list[str], tests: str) -> Reach:
    """What every test of a folder runs; files that are as they were at the last
    measurement are not asked again.
    """
    known = (
        Reach(**json.loads(SEEN.read_text(encoding="utf-8")))
        if SEEN.exists()
        else Reach()
    )
    files = {
        path.relative_to(ROOT).as_posix(): path
        for path in (ROOT / tests).rglob("test_*.py")
    }
    needed = sorted(
        name for name, path in files.items() if known.files.get(name) != digest(path)
    )
    with multiprocessing.get_context("fork").Pool(
        len(trees), Worker.begin, (trees, known, tests)
    ) as pool:
        for done, (test, seen) in enumerate(
            pool.imap_unordered(Worker.measure, needed), 1
        ):
            known.add(ROOT, test, seen)
            print(
                f"{done}/{len(needed)} {sum(s for s, _ in seen.values()):6.1f} s  {len(seen)} pass  {test}",
                flush=True,
            )
            _kept(known, done % 10 == 0 or done == len(needed))
    return known


def _kept(known: Reach, now: bool) -> None:
    if now:
        SEEN.parent.mkdir(parents=True, exist_ok=True)
        SEEN.write_text(json.dumps(asdict(known)) + "\n", encoding="utf-8")


def _say(done: int, total: int, row: dict[str, object]) -> None:
    print(
        f"{done}/{total} {row['outcome']:14} {row['seconds']:6} s  {row['path']}:{row['line']} [{row['rule']}]",
        flush=True,
    )
    if row["outcome"] in ("survived", "no test"):
        print(
            f"      {row['text']}\n      {row['was']}  ->  {row['became']}", flush=True
        )


def _keep(rows: list[dict[str, object]], asked: argparse.Namespace, words: str) -> int:
    """The result as JSON and as a table; with --again the judged ones replace their old
    lines, open ones of source
    that is no longer there go, and what was said of the draw stays."""
    drawn, commit = "", _commit()
    if asked.again:
        kept = json.loads(asked.result.read_text(encoding="utf-8"))
        judged = {_identity(row): row for row in rows}
        stay = [
            r
            for r in kept["mutants"]
            if _identity(r) in judged or r["outcome"] != "survived" or _reason(r)
        ]
        rows, words = [judged.get(_identity(row), row) for row in stay], kept["command"]
        drawn, commit = (
            kept.get("drawn") or table.summary(kept["mutants"]),
            kept.get("commit", ""),
        )
    else:
        words = f"python -m benchmarks.mutation {words}".strip()
    for row in rows:
        row.pop("reason", None)
        reason = _reason(row)
        if reason and row["outcome"] != "killed":
            row["reason"] = reason
    about = {"command": words, "commit": commit} | ({"drawn": drawn} if drawn else {})
    asked.result.write_text(
        json.dumps(about | {"mutants": rows}, indent=1) + "\n", encoding="utf-8"
    )
    asked.result.with_suffix(".md").write_text(
        table.markdown(rows, words, drawn, commit), encoding="utf-8"
    )
    print(table.summary(rows))
    return int(
        any(
            row["outcome"] in ("survived", "no test") and "reason" not in row
            for row in rows
        )
    )


def _commit() -> str:
    """Of the source as it stands; "" where there is no repository."""
    asked = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    return asked.stdout.strip()


def _reason(row: dict[str, object]) -> str:
    """Why no test can tell a mutant, by its file, the words of its line and the change;
    "" where nobody said.
    """
    reason: str = (
        _reasons()
        .get(row["path"], {})
        .get(row["text"], {})
        .get(f"{row['was']} -> {row['became']}", "")
    )
    return reason


@functools.cache
def _reasons() -> dict[object, dict[object, dict[str, str]]]:
    reasons: dict[object, dict[object, dict[str, str]]] = json.loads(
        REASONS.read_text(encoding="utf-8")
    )
    return reasons


def _identity(row: dict[str, object]) -> tuple[object, ...]:
    return row["path"], row["text"], row["was"], row["became"]


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
