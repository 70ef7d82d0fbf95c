"""The example notebooks, read and not run: what they import is there, and every call of
ours names known arguments.

`make notebooks` runs them, which takes minutes.
"""

import ast
import importlib
import inspect
from pathlib import Path

import pytest

EXAMPLES = sorted(
    p
    for p in (Path(__file__).parents[1] / "examples").glob("*.py")
    if p.stem not in ("run", "__init__")
)
OURS = ("metalens", "layout", "characterize", "codesign", "benchmarks")


def _imported(tree):
    """{name in the script: what it is} of the imports of our packages."""
    found = {}
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.ImportFrom)
            and (node.module or "").split(".")[0] in OURS
        ):
            module = importlib.import_module(node.module)
            for name in node.names:
                try:
                    found[name.asname or name.name] = getattr(module, name.name)
                except AttributeError:
                    found[name.asname or name.name] = importlib.import_module(
                        f"{node.module}.{name.name}"
                    )
    return found


def _meant(node, names):
    """What a dotted name stands for; None where it is no import of ours."""
    if isinstance(node, ast.Name):
        return names.get(node.id)
    if isinstance(node, ast.Attribute):
        owner = _meant(node.value, names)
        return getattr(owner, node.attr) if inspect.ismodule(owner) else None
    return None


def _wrong_calls(text):
    tree = ast.parse(text)
    names, wrong, seen = _imported(tree), [], 0
    for node in ast.walk(tree):
        called = _meant(node.func, names) if isinstance(node, ast.Call) else None
        if called is None:
            continue
        known = inspect.signature(called).parameters
        seen += 1
        given = {k.arg for k in node.keywords if k.arg}
        if not any(p.kind is p.VAR_KEYWORD for p in known.values()) and given - set(
            known
        ):
            wrong.append(
                (node.lineno, ast.unparse(node.func), sorted(given - set(known)))
            )
    return seen, wrong


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda p: p.stem)
def test_calls_name_arguments_that_exist(path):
    seen, wrong = _wrong_calls(path.read_text(encoding="utf-8"))
    assert seen >= 2
    assert not wrong


def test_a_call_with_an_unknown_argument_is_seen():
    text = "from layout.mask import build\nmade = build.draw_mask(lens, rules, dosed=False)\n"
    assert _wrong_calls(text) == (1, [(2, "build.draw_mask", ["dosed"])])
