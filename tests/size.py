"""Size and plainness of the code: ``python tests/size.py [--lower]``.

``--lower`` writes the present figures to ``size_limits.json`` where they are below
the limits that stand there; a limit never rises.
"""

import ast
import collections
import functools
import io
import json
import re
import sys
import tokenize
from pathlib import Path

ROOT = Path(__file__).parents[1]
LIBRARY = ("metalens", "layout", "characterize", "codesign")
LIMITS = Path(__file__).with_name("size_limits.json")
COLUMNS = 88
NOT_CODE = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}
REPEATABLE = {"load", "save", "read", "write", "run", "main"}  # function names
FUNCTION = (ast.FunctionDef, ast.AsyncFunctionDef)


def docstring_lines(tree: ast.Module) -> set[int]:
    """Line numbers of the docstrings of a module, its classes and functions."""
    lines: set[int] = set()
    for node in ast.walk(tree):
        documented = isinstance(node, (*FUNCTION, ast.ClassDef, ast.Module))
        if documented and ast.get_docstring(node, clean=False) is not None:
            first = node.body[0]
            lines.update(range(first.lineno, first.end_lineno + 1))
    return lines


def count_tokens(text: str, tree: ast.Module) -> int:
    """Tokens of code: without comments, docstrings and line ends."""
    skipped = docstring_lines(tree)
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return sum(t.type not in NOT_CODE and t.start[0] not in skipped for t in tokens)


@functools.cache
def parse_module(path: Path) -> tuple[str, ast.Module, int]:
    """(text, syntax tree, number of tokens) of a file."""
    text = path.read_text(encoding="utf-8")
    tree = ast.parse(text)
    return text, tree, count_tokens(text, tree)


def holds_number(node: ast.stmt) -> bool:
    """Whether a statement assigns a value that contains a number."""
    if not isinstance(node, (ast.Assign, ast.AnnAssign)) or node.value is None:
        return False
    numbers = (n.value for n in ast.walk(node.value) if isinstance(n, ast.Constant))
    return any(type(value) in (int, float) for value in numbers)


def is_one_word(name: str) -> bool:
    return "_" not in name and not re.search("[a-z][A-Z]", name)


def undocumented_parameters(node: ast.AST) -> tuple[int, int]:
    """(parameters that the docstring of a function does not name, all of them)."""
    args = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
    names = [a.arg for a in args if a.arg not in ("self", "cls")]
    text = ast.get_docstring(node) or ""
    missing = [n for n in names if not re.search(rf"\b{n}\b", text)]
    return len(missing), len(names)


def measure(folders: tuple[str, ...]) -> dict[str, float]:
    """Figures of all modules in some top-level folders."""
    classes: collections.Counter[str] = collections.Counter()
    functions: collections.Counter[str] = collections.Counter()
    figures: collections.Counter[str] = collections.Counter()
    words, public, parameters, missing = 0, 0, 0, 0
    paths = [path for folder in folders for path in (ROOT / folder).rglob("*.py")]
    for path in paths:
        text, tree, tokens = parse_module(path)
        words += len((ast.get_docstring(tree) or "").split())
        figures["tokens"] += tokens
        figures["lines"] += text.count("\n")
        figures["long_lines"] += sum(len(ln) > COLUMNS for ln in text.splitlines())
        figures["numbers"] += sum(holds_number(node) for node in tree.body)
        for node in tree.body:
            if not isinstance(node, (*FUNCTION, ast.ClassDef)):
                continue
            if node.name.startswith("_"):
                continue
            public += 1
            figures["one_word"] += is_one_word(node.name)
            if isinstance(node, ast.ClassDef):
                classes[node.name] += 1
            else:
                functions[node.name] += 1
                absent, every = undocumented_parameters(node)
                missing = missing + absent
                parameters = parameters + every
    twice = [n for n, count in classes.items() if count > 1 and n != "Options"]
    figures["classes_twice"] = len(twice)
    twice = [n for n, c in functions.items() if c > 1 and n not in REPEATABLE]
    figures["functions_twice"] = len(twice)
    return dict(figures) | {
        "one_word": round(100 * figures["one_word"] / max(1, public), 1),
        "undocumented_percent": round(100 * missing / max(1, parameters), 1),
        "module_docstring_words": round(words / max(1, len(paths)), 1),
    }


def measured() -> dict[str, dict[str, float]]:
    """{folder: figures}, with the four packages together as ``library``."""
    sizes = ("tokens", "lines", "long_lines")
    found = {name: measure((name,)) for name in LIBRARY} | {"library": measure(LIBRARY)}
    for name in ("tests", "benchmarks"):
        figures = measure((name,))
        found[name] = {key: figures[key] for key in sizes}
    return found


def main() -> None:
    found = measured()
    limits = json.loads(LIMITS.read_text()) if LIMITS.exists() else {}
    for name, figures in found.items():
        row = ", ".join(f"{key} {value:g}" for key, value in figures.items())
        print(f"{name}: {row}")
        for key, value in figures.items():
            if key != "lines" or name == "tests":
                old = limits.setdefault(name, {}).get(key, value)
                limits[name][key] = min(old, value)
    if "--lower" in sys.argv:
        LIMITS.write_text(json.dumps(limits, indent=1) + "\n")


if __name__ == "__main__":
    main()
