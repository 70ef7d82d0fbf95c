"""Mutants of a module: expressions of numeric meaning, each replaced by another that
still runs.
"""

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

BARS = re.compile(
    r"error|sigma|varian|weight|covar|noise|spread|tolerance|uncertain|(^|_)(std|bar|bars|cov)(_|$)",
    re.I,
)
NOT_NUMERIC = re.compile(
    r"(^|_)(plots?|(?<!tiff_)pages?|report|picture|console|commands?|journal|cli|lazy)(_|$)|^errors$"
)
OPERATORS = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/"}
INVERSE = {ast.Add: "-", ast.Sub: "+", ast.Mult: "/", ast.Div: "*"}
COMPARISONS = {
    ast.Lt: (">", "<="),
    ast.Gt: ("<", ">="),
    ast.LtE: (">", "<"),
    ast.GtE: ("<", ">"),
    ast.Eq: ("!=",),
}
SIGNS = {ast.Lt: "<", ast.Gt: ">", ast.LtE: "<=", ast.GtE: ">=", ast.Eq: "=="}
TWINS = {
    "sin": "cos",
    "cos": "sin",
    "min": "max",
    "max": "min",
    "floor": "ceil",
    "ceil": "floor",
}
TWINS |= {
    "maximum": "minimum",
    "minimum": "maximum",
    "argmin": "argmax",
    "argmax": "argmin",
}
TWINS |= {
    "real": "imag",
    "imag": "real",
    "median": "max",
    "cumsum": "sort",
    "mean": "sum",
    "std": "var",
    "var": "std",
}
TWINS |= {"nm": "um", "um": "nm", "mm": "um"}
DROPPED = {
    "sqrt",
    "conj",
    "conjugate",
    "abs",
    "square",
    "radians",
    "deg2rad",
    "flip",
    "hypot",
    "transpose",
    "exp",
    "diff",
}
AXES = {"axis", "dim", "axes"}
LEFT_OUT = (ast.Raise, ast.JoinedStr, ast.Import, ast.ImportFrom)


@dataclass(frozen=True, slots=True)
class Mutant:
    """One replacement by ``rule``; ``bar`` where the line makes an error, a sigma, a
    variance or a weight.
    """

    path: str
    line: int
    start: int
    end: int
    was: str
    became: str
    rule: str
    bar: bool

    def applied(self, text: str) -> str:
        """The module's source with the one change (offsets are in bytes)."""
        data = text.encode()
        return (data[: self.start] + self.became.encode() + data[self.end :]).decode()


def numeric(path: Path) -> bool:
    """Whether a module computes: pages, plots, consoles and commands do not."""
    return (
        not any(NOT_NUMERIC.search(part) for part in (*path.parts[:-1], path.stem))
        and path.stem[0] != "_"
    )


def mutants(root: Path, path: Path) -> list[Mutant]:
    """All mutants of one module, in the order of its lines."""
    text = path.read_text(encoding="utf-8")
    starts = [0]
    for line in text.encode().splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    data, lines, found = text.encode(), text.splitlines(), []
    where = path.relative_to(root).as_posix()
    for node, owner in _expressions(ast.parse(text), ""):
        if not isinstance(node, (ast.expr, ast.keyword)):
            continue
        first = starts[node.lineno - 1] + node.col_offset
        last = starts[(node.end_lineno or 0) - 1] + (node.end_col_offset or 0)
        for rule, became in _changes(node):
            was = data[first:last].decode()
            bar = bool(
                BARS.search(owner)
                or BARS.search(
                    re.split(r"\s*(?:[-+*/]?=)\s", lines[node.lineno - 1])[0]
                )
            )
            found.append(
                Mutant(where, node.lineno, first, last, was, f"({became})", rule, bar)
            )
    return found


def _expressions(node: ast.AST, owner: str) -> Iterator[tuple[ast.AST, str]]:
    """Every expression evaluated for its value: no annotations, refusals, messages,
    docstrings, imports.
    """
    for name, value in ast.iter_fields(node):
        if name in (
            "annotation",
            "returns",
            "decorator_list",
            "type_params",
            "bases",
            "keywords",
        ) and not isinstance(node, ast.Call):
            continue
        for child in value if isinstance(value, list) else [value]:
            if not isinstance(child, ast.AST) or isinstance(
                child, (ast.Raise, ast.JoinedStr, ast.Import, ast.ImportFrom)
            ):
                continue
            if isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant):
                continue
            if isinstance(child, ast.If) and _refuses(child):
                continue
            inside = (
                child.name
                if isinstance(child, (ast.FunctionDef, ast.ClassDef))
                else owner
            )
            yield child, inside
            yield from _expressions(child, inside)


def _refuses(node: ast.If) -> bool:
    """Whether it only refuses: the limits of a check are tested by message, not by
    number.
    """
    return all(isinstance(line, ast.Raise) for line in node.body) and not node.orelse


def _changes(node: ast.AST) -> Iterator[tuple[str, str]]:
    if isinstance(node, ast.BinOp):
        yield from _binary(node)
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        yield "sign", ast.unparse(node.operand)
    elif (
        isinstance(node, ast.Compare)
        and len(node.ops) == 1
        and type(node.ops[0]) in COMPARISONS
    ):
        for sign in COMPARISONS[type(node.ops[0])]:
            yield (
                "comparison",
                f"{ast.unparse(node.left)} {sign} {ast.unparse(node.comparators[0])}",
            )
    elif isinstance(node, ast.BoolOp):
        yield "dropped term", ast.unparse(node.values[0])
    elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
        yield from _constant(node.value)
    elif isinstance(node, ast.Call):
        yield from _call(node)
    elif isinstance(node, ast.Attribute) and node.attr in (
        "nm",
        "um",
        "mm",
        "real",
        "imag",
    ):
        yield (
            ("unit" if "m" in node.attr[-1] else "axis"),
            f"{ast.unparse(node.value)}.{TWINS[node.attr]}",
        )
    elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load):
        yield from _name(node.id)
    elif (
        isinstance(node, ast.Subscript)
        and isinstance(node.slice, ast.Constant)
        and node.slice.value in (0, 1, -1, -2)
    ):
        yield (
            "axis",
            f"{ast.unparse(node.value)}[{ {0: 1, 1: 0, -1: -2, -2: -1}[node.slice.value] }]",
        )


def _binary(node: ast.BinOp) -> Iterator[tuple[str, str]]:
    left, right = (f"({ast.unparse(side)})" for side in (node.left, node.right))
    kind = type(node.op)
    if any(_words(side) for side in (node.left, node.right)):
        return
    if kind in INVERSE:
        rule = "sign" if kind in (ast.Add, ast.Sub) else "factor"
        yield rule, f"{left} {INVERSE[kind]} {right}"
        yield "dropped term" if rule == "sign" else "factor", left
        yield (
            ("dropped term", right)
            if kind is not ast.Div
            else ("factor", f"{left} / ({right}) / 2")
        )
    elif kind is ast.Pow:
        yield "factor", left
    elif kind is ast.FloorDiv:
        yield "factor", f"-(-{left} // {right})"
    elif kind is ast.MatMult:
        yield "axis", f"({left} @ {right}) * -1"


def _words(node: ast.expr) -> bool:
    return isinstance(node, ast.JoinedStr) or (
        isinstance(node, ast.Constant) and isinstance(node.value, str)
    )


def _constant(value: float) -> Iterator[tuple[str, str]]:
    if isinstance(value, int):
        yield "constant", str(value + 1)
        if value > 0:
            yield "constant", str(value - 1)
    elif value in (1e-3, 1e3, 1e6, 1e-6, 1e-9, 1e9):
        yield "unit", "1.0"
    elif (
        1e-12 < abs(value) < 1e12
    ):  # beyond: guards against 0 and infinity, of no particular size
        yield "constant", repr(value * 2)
        yield "constant", repr(value / 2)


def _call(node: ast.Call) -> Iterator[tuple[str, str]]:
    name = (
        node.func.attr
        if isinstance(node.func, ast.Attribute)
        else getattr(node.func, "id", "")
    )
    if name in DROPPED and node.args and not isinstance(node.args[0], ast.Starred):
        yield (
            ("unit" if name in ("radians", "deg2rad") else "dropped term"),
            ast.unparse(node.args[0]),
        )
    if name in TWINS and name not in ("real", "imag", "nm", "um", "mm"):
        words = ast.unparse(node)
        yield "factor", re.sub(rf"\b{name}\(", f"{TWINS[name]}(", words, count=1)
    if name == "atan2" or name == "arctan2":
        a, b = (ast.unparse(arg) for arg in node.args)
        yield "axis", f"{ast.unparse(node.func)}({b}, {a})"
    for at, keyword in enumerate(node.keywords):
        value = keyword.value
        if keyword.arg in AXES and isinstance(value, (ast.Constant, ast.UnaryOp)):
            yield "axis", _replaced(node, at)


def _replaced(node: ast.Call, at: int) -> str:
    axis = ast.literal_eval(node.keywords[at].value)
    other = {0: 1, 1: 0, -1: -2, -2: -1, "x": "y", "y": "x"}.get(axis, 0)
    words = [ast.unparse(a) for a in node.args]
    words += [
        f"{k.arg}={other!r}" if i == at else ast.unparse(k)
        for i, k in enumerate(node.keywords)
    ]
    return f"{ast.unparse(node.func)}({', '.join(words)})"


def _name(name: str) -> Iterator[tuple[str, str]]:
    if name in ("nm", "um", "mm"):
        yield "unit", TWINS[name]
    swapped = re.sub(
        r"(?<![a-z])([fk]?)([xy])(?![a-wz])",
        lambda m: m[1] + ("y" if m[2] == "x" else "x"),
        name,
    )
    if swapped != name and len(name) <= 6:
        yield "axis", swapped
