"""The runner of mutants on a module of its own: what changes, what runs a line, what
takes its place in memory.
"""

import argparse
import importlib.util
import json
import multiprocessing

import pytest

from benchmarks.mutation import __main__ as main
from benchmarks.mutation import reach, rules, runner, server
from benchmarks.mutation.graph import Graph
from benchmarks.mutation.reach import Reach

MODULE = '''"""Numbers."""
import math

SCALE = 2.0


def sigma_of(values, axis=0):
    """Spread."""
    if axis > 3:
        raise ValueError("no")
    total = sum(v * v for v in values)
    return math.sqrt(total / len(values)) - SCALE


class Box:
    def width(self, x):
        return abs(x) + 1e-300

    def mtf(self, image):
        return image.mtf(axis="y").sum(axis=-1)
'''


@pytest.fixture
def tree(tmp_path):
    (tmp_path / "metalens").mkdir()
    (tmp_path / "metalens" / "numbers_of.py").write_text(MODULE)
    return tmp_path


def test_mutants_are_of_what_is_computed_and_of_nothing_else(tree):
    path = tree / "metalens" / "numbers_of.py"
    made = rules.mutants(tree, path)
    changed = {(m.was, m.became, m.rule) for m in made}
    assert ("v * v", "((v) / (v))", "factor") in changed
    assert (
        "math.sqrt(total / len(values)) - SCALE",
        "((math.sqrt(total / len(values))) + (SCALE))",
        "sign",
    ) in changed
    assert (
        "math.sqrt(total / len(values))",
        "(total / len(values))",
        "dropped term",
    ) in changed
    assert ("2.0", "(4.0)", "constant") in changed
    assert not any(m.was == "3" or "axis >" in m.was for m in made)  # a refusal
    assert not any(m.was == "1e-300" for m in made)  # a guard
    assert {m.line for m in made if m.bar} == {7, 11, 12}  # of a function named so
    assert (
        'image.mtf(axis="y").sum(axis=-1)',
        "(image.mtf(axis='y').sum(axis=-2))",
        "axis",
    ) in changed
    assert ('image.mtf(axis="y")', "(image.mtf(axis='x'))", "axis") in changed
    one = next(m for m in made if m.was == "v * v" and m.became == "((v) / (v))")
    assert one.applied(MODULE) == MODULE.replace("v * v", "((v) / (v))")


def test_lines_are_known_by_their_function(tree):
    path = tree / "metalens" / "numbers_of.py"
    assert reach.home(path, 12) == ("sigma_of", 7)
    assert reach.home(path, 17) == ("Box.width", 16)
    assert reach.home(path, 4) == ("", 0)
    seen = Reach()
    test = tree / "test_x.py"
    test.write_text("")
    seen.add(
        tree,
        "test_x.py",
        {
            "test_x.py::a": (0.5, [("metalens/numbers_of.py", 12)]),
            "test_x.py::b": (0.1, []),
        },
    )
    where = "metalens/numbers_of.py"
    assert seen.tests(tree, where, 12, 9.0) == [
        "test_x.py::a",
        "test_x.py::b",
    ]  # and what else its file holds
    assert seen.tests(tree, where, 12, 0.2) == ["test_x.py::a"]
    assert seen.tests(tree, where, 11, 0.2) == [
        "test_x.py::a"
    ]  # no line of its own: its function's
    assert seen.tests(tree, where, 17, 9.0) == []
    path.write_text(
        MODULE.replace("SCALE = 2.0\n", "SCALE = 2.0\n\n\n")
    )  # all lines move
    reach._functions.cache_clear()
    assert seen.tests(tree, where, 14, 0.2) == ["test_x.py::a"]
    seen.add(tree, "test_x.py", {})
    assert seen.tests(tree, where, 14, 9.0) == []


def test_compiled_loops_are_not_changed_in_memory(tree):
    """By numba's decorator, the layout's own or as an overload, which answers to the
    name of its function.
    """
    path = tree / "metalens" / "loops.py"
    path.write_text(
        "@numba.njit(cache=True)\ndef one(x):\n    return two(x)\n\n\n"
        "@compiled\ndef two(x):\n    return x\n\n\n"
        "@overload(three, inline='always')\ndef _three(x):\n    def short(x):\n        return x\n    return short\n\n\n"
        "def plain(x):\n    return one(x)\n"
    )
    assert reach.compiled(path) == {"one", "two", "three"}
    assert [reach.home(path, line)[0] for line in (3, 8, 14, 19)] == [
        "one",
        "two",
        "three",
        "plain",
    ]
    assert reach.callers(tree, "two") == {
        ("metalens/loops.py", "plain")
    }  # through the other
    assert "metalens.loops" in Graph(tree).compiled


def test_what_runs_while_a_module_is_read_is_not_changed_in_memory(tree):
    """Called by the module's own lines, or by what these call; not by what only stands
    in a function or a lambda.
    """
    path = tree / "metalens" / "rows.py"
    path.write_text(
        "def row(x):\n    return inner(x)\n\n\ndef inner(x):\n    return x + 1\n\n\n"
        "def later(x):\n    return other(x)\n\n\ndef other(x):\n    return x\n\n\n"
        "class Box:\n    width = own(3)\n\n    def height(self):\n        return other(2)\n\n\n"
        "def own(x):\n    return x\n\n\nROWS = (row(2), *(row(i) for i in range(2)))\nLATER = lambda: later(1)\n"
    )
    assert reach.at_import(path) == {"row", "inner", "own"}


def test_changed_functions_run_their_new_code_in_memory(tree):
    path = str(tree / "metalens" / "numbers_of.py")
    spec = importlib.util.spec_from_file_location("numbers_of", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    held, box = module.sigma_of, module.Box()
    functions = server._functions({})[path]
    assert held([3.0, 5.0]) == pytest.approx(17**0.5 - 2)
    assert (
        server.patched(
            functions,
            path,
            MODULE.replace("len(values)) - SCALE", "len(values)) + SCALE"),
        )
        == 1
    )
    assert held([3.0, 5.0]) == pytest.approx(17**0.5 + 2)
    assert box.width(-2) == 2
    assert (
        server.patched(functions, path, MODULE.replace("SCALE = 2.0", "SCALE = 4.0"))
        == 1
    )  # back to what was
    assert (
        server.patched(functions, path, MODULE.replace("SCALE = 2.0", "SCALE = 4.0"))
        == 0
    )  # no function holds it


def test_a_watched_test_tells_its_lines(tree):
    (tree / "test_it.py").write_text(
        "import sys\nsys.path.insert(0, 'metalens')\n"
        "import numbers_of\ndef test_a():\n    numbers_of.Box().width(3)\n"
        "def test_b():\n    assert numbers_of.sigma_of([1.0]) > 0\n"
        "def test_c():\n    assert numbers_of.Box().width(3) > 99\n"
    )
    answer = server.Server(tree, ["test_it.py"])
    seen = answer.seen("test_it.py")
    assert list(seen) == ["test_it.py::test_a"]  # the other fails
    assert seen["test_it.py::test_a"][1] == [["metalens/numbers_of.py", 17]]
    path = "metalens/numbers_of.py"
    assert answer.outcome(path, MODULE, ["test_it.py::test_a"], 60.0) is None
    wrong = MODULE.replace("abs(x) + 1e-300", "[][x]")
    assert answer.outcome(path, wrong, ["test_it.py::test_a"], 60.0)[0] == "failed"
    assert (
        answer.outcome(path, wrong, ["test_it.py::test_c"], 60.0)[0] == "passed"
    )  # it fails anyway
    other = MODULE.replace("abs(x)", "(x)")
    assert answer.outcome(path, other, ["test_it.py::test_a"], 60.0)[0] == "passed"
    answer.close()


def _asked(tree):
    """In a worker of a pool, which may have no children of its own."""
    answer = server.Server(tree, ["test_it.py"])
    other = MODULE.replace("abs(x)", "(x)")
    told = answer.outcome("metalens/numbers_of.py", other, ["test_it.py"], 60.0)[0]
    answer.close()
    return told, runner.Bench(tree).outcome(
        "metalens/numbers_of.py", other, ["test_it.py"], 20.0, fresh=False
    )[0]


def test_tests_that_start_processes_pass_in_workers_too(tree):
    (tree / "test_it.py").write_text(
        "import multiprocessing, sys\nsys.path.insert(0, 'metalens')\nimport numbers_of\n"
        "def test_a():\n    numbers_of.Box().width(3)\n"
        "    child = multiprocessing.get_context('spawn').Process(target=print)\n    child.start()\n    child.join()\n"
        "    assert child.exitcode == 0\n"
    )
    with multiprocessing.get_context("fork").Pool(1) as pool:
        assert pool.apply(_asked, (tree,)) == ("passed", "passed")


def test_a_reason_is_for_one_line(tmp_path, monkeypatch):
    """The same change of another line of the file has no reason; lines that move keep
    theirs.
    """
    file = tmp_path / "reasons.json"
    file.write_text('{"a.py": {"x = 2.0": {"2.0 -> (4.0)": "a scale"}}}')
    monkeypatch.setattr(main, "REASONS", file)
    main._reasons.cache_clear()
    row = {
        "path": "a.py",
        "line": 3,
        "text": "x = 2.0",
        "was": "2.0",
        "became": "(4.0)",
    }
    assert main._reason(row) == main._reason(row | {"line": 9}) == "a scale"
    assert not any(
        main._reason(row | other)
        for other in ({"text": "y = 2.0"}, {"became": "(1.0)"}, {"path": "b.py"})
    )
    main._reasons.cache_clear()


def test_what_was_drawn_is_told_beside_what_was_judged_once_more(tmp_path):
    """Of three one is killed; then a second one, and the source of the third is gone.
    Once more: the draw stays.
    """
    rows = [
        {
            "path": "layout/a.py",
            "text": f"x = {k}",
            "was": "1",
            "became": "(2)",
            "rule": "constant",
            "bar": k > 0,
        }
        | {"outcome": "killed" if k == 0 else "survived"}
        for k in range(3)
    ]
    result = tmp_path / "mutants.json"
    asked = argparse.Namespace(again=False, result=result)
    assert main._keep(rows, asked, "--count 3") == 1
    assert "As drawn" not in result.with_suffix(".md").read_text()
    asked.again = True
    for again in ([rows[1] | {"outcome": "killed"}], []):
        assert main._keep(again, asked, "--again") == 0
        page = result.with_suffix(".md").read_text()
        assert (
            "Made by `python -m benchmarks.mutation --count 3`" in page
        )  # and of which source
        assert json.loads(result.read_text())["commit"] == main._commit()
        first, then = (
            line for line in page.splitlines() if "of" in line and "killed (" in line
        )
        assert first.startswith(
            "As drawn: all: 1 of 3 killed (33.3%), 0 more are equivalent; on lines that make an"
        )
        assert first.endswith("0 of 2 killed (0.0%), 0 more are equivalent.")
        assert then.startswith("all: 2 of 2 killed")


def test_test_files_of_closed_forms_are_asked_first(tree):
    """Of the module's own name; after those come its other one, such files that import
    it, and the rest by words.
    """
    folder = tree / "tests" / "metalens"
    folder.mkdir(parents=True)
    said = "from metalens import numbers_of\n"
    files = {
        "numbers_of": said * 9,
        "numbers_of_truths": said,
        "sums_parts": said,
        "other": said * 20,
    }
    for name, words in files.items():
        (folder / f"test_{name}.py").write_text(words)
    asked = Graph(tree).related("metalens.numbers_of", {}, 40.0)
    assert [name.split("test_")[1] for name in asked] == [
        "numbers_of_truths.py",
        "numbers_of.py",
        "sums_parts.py",
        "other.py",
    ]


def _told_by(tree, near):
    """What test files, so many of the nearest and then of all, say of a sum that became
    a difference.
    """
    worker = main.Worker
    worker.graph, worker.near, worker.longest_s = Graph(tree), near, 20.0
    worker.bench, worker.server = runner.Bench(tree), server.Server(tree)
    made = rules.mutants(tree, tree / "metalens" / "numbers_of.py")
    mutant = next(m for m in made if m.was.endswith(" - SCALE") and m.rule == "sign")
    row = worker.judge((mutant, 20.0))
    worker.server.close()
    return row["outcome"], [name.split("test_")[1] for name in row["tests"]]


def test_survivors_are_asked_of_test_files_farther_off(tree, monkeypatch):
    """The nearest file holds a width alone; the spread of 3 and 4 less 2, √12.5 - 2, is
    known to the next one.
    """
    monkeypatch.setattr(main, "ROOT", tree)
    folder = tree / "tests" / "metalens"
    folder.mkdir(parents=True)
    said = f"import sys\nsys.path.insert(0, {str(tree / 'metalens')!r})\nimport numbers_of\n\n"
    said += "def for_the_graph():\n    from metalens import numbers_of\n\ndef test_one():\n    assert numbers_of."
    (folder / "test_numbers_of.py").write_text(f"{said}Box().width(-3.5) == 3.5\n")
    (folder / "test_other.py").write_text(f"{said}sigma_of([3.0, 4.0]) < 1.54\n")
    assert _told_by(tree, (1,)) == ("survived", ["numbers_of.py"])
    assert _told_by(tree, (1, 2)) == (
        "killed farther off",
        ["numbers_of.py", "other.py"],
    )
    assert _told_by(tree, (2,)) == ("killed", ["numbers_of.py", "other.py"])
    assert (
        "1 of 1 killed (100.0%) (of them 1 by test files farther off"
        in main.table.summary([{"outcome": "killed farther off", "bar": False}])
    )
