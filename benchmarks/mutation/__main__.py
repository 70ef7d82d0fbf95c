"""``python -m benchmarks.mutation [--count N] [--seed S]``: draw mutants, run their tests, keep the table."""

import argparse
import ast
import contextlib
import json
import multiprocessing
import os
import random
import sys
from collections import defaultdict
from dataclasses import asdict
from pathlib import Path

from benchmarks.mutation import rules, table
from benchmarks.mutation.graph import PACKAGES, Graph
from benchmarks.mutation.runner import Bench, copy_of, load_libraries

ROOT = Path(__file__).parents[2]
RESULT = ROOT / "benchmarks" / "results" / "mutants.json"
REASONS = ROOT / "benchmarks" / "mutation" / "equivalent.json"  # {"path: was -> became": why no test can tell}
SECONDS = ROOT / "build" / "mutants" / "seconds.json"  # of each test file, as measured before the first mutant


def drawn(count: int, seed: int, only: str, bars: float) -> list[rules.Mutant]:
    """``count`` mutants, the share ``bars`` of them from lines that make error bars; modules and rules in turn."""
    generator, pools = random.Random(seed), {}
    for package in PACKAGES[:-1]:
        for path in sorted((ROOT / package).rglob("*.py")):
            if rules.numeric(path.relative_to(ROOT)) and path.relative_to(ROOT).as_posix().startswith(only):
                pools[path] = rules.mutants(ROOT, path)
    chosen: list[rules.Mutant] = []
    for bar, share in ((True, round(bars * count)), (False, count - round(bars * count))):
        by_rule = {path: _shuffled([m for m in pool if m.bar is bar], generator) for path, pool in pools.items()}
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
    graph: Graph
    seconds: dict[str, float]

    @classmethod
    def begin(cls, trees: list[str], seconds: dict[str, float]) -> None:
        at = multiprocessing.current_process()._identity[0] - 1
        cls.bench, cls.graph, cls.seconds = Bench(Path(trees[at % len(trees)])), Graph(ROOT), seconds

    @classmethod
    def measure(cls, test: str) -> tuple[str, str, float]:
        """(test file, outcome, seconds) as the tree stands; compiled loops are made on the way."""
        outcome, spent = cls.bench.run([test], 200.0, fresh=False)
        return test, outcome, spent

    @classmethod
    def judge(cls, task: tuple[rules.Mutant, float]) -> dict[str, object]:
        """What became of one mutant, with the tests that ran."""
        mutant, budget_s = task
        path = ROOT / mutant.path
        module = mutant.path.removesuffix(".py").replace("/", ".")
        tests = cls.graph.related(module, cls.seconds, budget_s)
        if not tests:
            return _row(mutant) | {"outcome": "no test", "seconds": 0.0, "tests": []}
        usual = sum(cls.seconds.get(t, 10.0) for t in tests)
        source = mutant.applied(path.read_text(encoding="utf-8"))
        compiled = module in cls.graph.compiled
        outcome, spent = cls.bench.outcome(mutant.path, source, tests, usual, fresh=compiled)
        outcome = {"passed": "survived", "failed": "killed", "time": "killed by time"}[outcome]
        return _row(mutant) | {"outcome": outcome, "seconds": round(spent, 1), "tests": tests}


def _row(mutant: rules.Mutant) -> dict[str, object]:
    line = (ROOT / mutant.path).read_text(encoding="utf-8").splitlines()[mutant.line - 1].strip()
    return {k: v for k, v in asdict(mutant).items() if k not in ("start", "end")} | {"text": line}


def main(words: list[str]) -> int:
    """Draw, judge, print as it goes, keep; 1 where a mutant survives without a reason."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.mutation", description=__doc__)
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="modules whose path starts so")
    parser.add_argument("--bars", type=float, default=1 / 3, help="share drawn from lines that make error bars")
    parser.add_argument("--jobs", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--budget", type=float, default=60.0, help="seconds of related tests for one mutant")
    parser.add_argument("--trust", action="store_true", help="do not run the tests without a mutant first")
    parser.add_argument("--again", action="store_true", help="judge the survivors of the kept result once more")
    asked = parser.parse_args(words)
    chosen = _survivors() if asked.again else drawn(asked.count, asked.seed, asked.only, asked.bars)
    load_libraries()
    with contextlib.ExitStack() as stack:
        trees = [str(stack.enter_context(copy_of(ROOT))) for _ in range(asked.jobs)]
        seconds = {} if asked.trust else _measured(chosen, trees, asked.budget)
        rows = []
        with multiprocessing.get_context("fork").Pool(asked.jobs, Worker.begin, (trees, seconds)) as pool:
            for row in pool.imap_unordered(Worker.judge, [(m, asked.budget) for m in chosen]):
                rows.append(row)
                _say(len(rows), len(chosen), row)
    rows.sort(key=lambda row: (row["path"], row["line"], row["became"]))
    return _keep(rows, asked, " ".join(words))


def _survivors() -> list[rules.Mutant]:
    """Those of the kept result that have no reason, found again in the source as it is now."""
    kept = json.loads(RESULT.read_text(encoding="utf-8"))["mutants"]
    reasons = json.loads(REASONS.read_text(encoding="utf-8"))
    open_ = (r for r in kept if r["outcome"] == "survived" and _reasoned(r) not in reasons)
    left = {(row["path"], row["text"], row["was"], row["became"]) for row in open_}
    found = []
    for path in sorted({row[0] for row in left}):
        for mutant in rules.mutants(ROOT, ROOT / path):
            if (path, _row(mutant)["text"], mutant.was, mutant.became) in left:
                found.append(mutant)
    return found


def _measured(chosen: list[rules.Mutant], trees: list[str], budget_s: float) -> dict[str, float]:
    """Seconds of every test file that may be asked; one that is red without a mutant is left out."""
    known: dict[str, float] = json.loads(SECONDS.read_text(encoding="utf-8")) if SECONDS.exists() else {}
    graph = Graph(ROOT)
    modules = {m.path.removesuffix(".py").replace("/", ".") for m in chosen}
    needed = {t for m in modules for t in graph.related(m, known, budget_s)} - known.keys()
    with multiprocessing.get_context("fork").Pool(len(trees), Worker.begin, (trees, known)) as pool:
        for test, outcome, spent in pool.imap_unordered(Worker.measure, sorted(needed)):
            known[test] = spent if outcome == "passed" else float("inf")
            print(f"{spent:6.1f} s  {outcome}  {test}", flush=True)
    SECONDS.parent.mkdir(parents=True, exist_ok=True)
    SECONDS.write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")
    return known


def _say(done: int, total: int, row: dict[str, object]) -> None:
    print(
        f"{done}/{total} {row['outcome']:14} {row['seconds']:6} s  {row['path']}:{row['line']} [{row['rule']}]",
        flush=True,
    )
    if row["outcome"] in ("survived", "no test"):
        print(f"      {row['text']}\n      {row['was']}  ->  {row['became']}", flush=True)


def _keep(rows: list[dict[str, object]], asked: argparse.Namespace, words: str) -> int:
    """The result as JSON and as a table; with --again the judged ones replace their old lines."""
    reasons = json.loads(REASONS.read_text(encoding="utf-8"))
    if asked.again:
        kept = json.loads(RESULT.read_text(encoding="utf-8"))
        judged = {_identity(row): row for row in rows}
        rows, words = [judged.get(_identity(row), row) for row in kept["mutants"]], kept["command"]
    else:
        words = f"python -m benchmarks.mutation {words}".strip()
    for row in rows:
        row.pop("reason", None)
        reason = reasons.get(_reasoned(row))
        if reason and row["outcome"] != "killed":
            row["reason"] = reason
    RESULT.write_text(json.dumps({"command": words, "mutants": rows}, indent=1) + "\n", encoding="utf-8")
    RESULT.with_suffix(".md").write_text(table.markdown(rows, words), encoding="utf-8")
    print(table.summary(rows))
    return int(any(row["outcome"] in ("survived", "no test") and "reason" not in row for row in rows))


def _reasoned(row: dict[str, object]) -> str:
    """What a mutant is called in the file of reasons."""
    return f"{row['path']}: {row['was']} -> {row['became']}"


def _identity(row: dict[str, object]) -> tuple[object, ...]:
    return row["path"], row["text"], row["was"], row["became"]


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
