"""Model code as loops over the lanes of a tile of pixels, in the form that compilers
turn into vector instructions.

Every function of :mod:`codesign.eye.model` is assignments and one return, so a call can
be replaced by the lines of
its body. Left are loops of arithmetic on local names, without calls, branches or
look-ups. Textures are looked up
between two such loops: the first finds the coordinates, the second goes on with the
samples.
"""

import ast
import inspect
from collections.abc import Mapping
from typing import Any

from codesign.eye import model

_OPERATORS: dict[type[ast.operator], str] = {
    ast.Add: "add",
    ast.Sub: "sub",
    ast.Mult: "mul",
    ast.Div: "div",
}
_FUNCTIONS = {
    f.name: f
    for f in ast.parse(inspect.getsource(model)).body
    if isinstance(f, ast.FunctionDef)
}
_CONSTANTS = {
    name: value for name, value in vars(model).items() if isinstance(value, int)
}


def loops(source: str, slots: Mapping[str, int], *, lanes: int, dual: bool) -> str:
    """Source of ``run(p, t, x, words)``: the assignments of ``source`` for every lane
    of the tile ``x``.

    Args:
        source: assignments that call functions of the model; names in ``slots`` live in
            the tile.
        slots: first lane of every name, and of ``u of sample 0``, ... as many as the
            assignments sample textures.
        dual: operators become calls of add, sub, mul, div, neg.

    Returns:
        Source that also calls: number, load and fixed (parameters that move or do not),
        fetch and store (a lane),
        placed and sampled (coordinates and value of a texture), look_up, and the
        functions of render_ops.
    """
    code = _Lines(dual)
    read, written = set[str](), set[str]()
    for line in ast.parse(source).body:
        if isinstance(line, ast.Assign):
            read |= (_names(line.value) & slots.keys()) - written
            written |= _names(line.targets[0]) & slots.keys()
            code.add(line.targets[0], line.value)
    out = ["def run(p, t, x, words):"]
    out += [
        f"    p{k} = {'load' if moving else 'fixed'}(p, {k})"
        for k, moving in sorted(code.parameters.items())
    ]
    given = {name: f"fetch(x, {slots[name]} + lane)" for name in read}
    places = [
        f"x, {slots[f'u of sample {k}']} + lane, words, {2 * k * lanes} + lane"
        for k in range(len(code.samples))
    ]
    if places:
        wanted = {
            ", ".join(map(ast.unparse, s)): f"placed({{}}, {at})"
            for s, at in zip(code.samples, places, strict=True)
        }
        out += _loop(code.lines, given, wanted, lanes)
        out += [f"    look_up(t, words, {2 * len(places) * lanes})"]
        given |= {f"texture{k}": f"sampled({at})" for k, at in enumerate(places)}
    out += _loop(
        code.lines,
        given,
        {name: f"store({{}}, x, {slots[name]} + lane)" for name in sorted(written)},
        lanes,
    )
    return "\n".join(out) + "\n"


def _loop(
    lines: list[ast.Assign],
    given: Mapping[str, str],
    wanted: Mapping[str, str],
    lanes: int,
) -> list[str]:
    """The loop over lanes from the expressions of given names to the calls on wanted
    ones, by the lines it takes.
    """
    needed, kept = (
        {name for names in wanted for name in names.split(", ")},
        list[ast.Assign](),
    )
    for line in reversed(lines):
        target = ast.unparse(line.targets[0])
        if target in needed and target not in given:
            kept.append(line)
            needed |= _names(line.value)
    body = [
        f"{name} = {value}" for name, value in sorted(given.items()) if name in needed
    ]
    body += [ast.unparse(line) for line in reversed(kept)]
    body += [call.format(names) for names, call in wanted.items()]
    return [f"    for lane in range({lanes}):", *(f"        {line}" for line in body)]


class _Lines(ast.NodeTransformer):
    """Collects lines in which every name is assigned once, with the bodies of model
    functions in place of their calls.

    parameters: indices in ``p``, True where they move; they become names p0, p1, ...
    samples: (index, u, v) of every texture sample; its value becomes the name texture0,
    texture1, ...
    """

    def __init__(self, dual: bool) -> None:
        self.dual, self.calls = dual, 0
        self.lines: list[ast.Assign] = []
        self.parameters: dict[int, bool] = {}
        self.samples: list[tuple[ast.expr, ...]] = []

    def add(self, target: ast.expr, value: ast.expr) -> None:
        """Append target = value, tuples part by part."""
        value = self.visit(value)
        if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
            for part, number in zip(target.elts, value.elts, strict=True):
                self.lines.append(_assign(part, number))
        else:
            self.lines.append(_assign(target, value))

    def visit_Call(self, node: ast.Call) -> ast.expr:
        name = ast.unparse(node.func)
        arguments = [self.visit(part) for part in node.args]
        if name == "tex":
            names = [self._named(part) for part in arguments[2:]]
            self.samples.append((arguments[1], *names))
            return ast.Name(f"texture{len(self.samples) - 1}")
        function = _FUNCTIONS.get(name)
        return self._body(function, arguments) if function else _call(name, *arguments)

    def _named(self, value: ast.expr) -> ast.expr:
        name = ast.Name(f"coordinate{len(self.lines)}")
        self.lines.append(_assign(name, value))
        return name

    def _body(self, function: ast.FunctionDef, arguments: list[ast.expr]) -> ast.expr:
        self.calls += 1
        local = _Local(self.calls)
        for argument, value in zip(function.args.args, arguments, strict=True):
            if isinstance(value, ast.Name):
                local.stands_for(argument.arg, value.id)
            else:
                self.lines.append(_assign(local.fresh(argument.arg), value))
        for line in function.body:
            if isinstance(line, ast.Assign):
                value = local.visit(_copy(line.value))
                self.add(local.target(line.targets[0]), value)
            elif isinstance(line, ast.Return):
                out: ast.expr = self.visit(local.visit(_copy(line.value)))
                return out
        raise TypeError(f"{function.name} of the model returns nothing")

    def visit_Subscript(self, node: ast.Subscript) -> ast.expr:
        index = eval(ast.unparse(node.slice), dict(_CONSTANTS))
        self.parameters[index] = bool(_names(node.slice) & model.MOVING)
        return ast.Name(f"p{index}")

    def visit_BinOp(self, node: ast.BinOp) -> ast.expr:
        left, right = self.visit(node.left), self.visit(node.right)
        return (
            _call(_OPERATORS[type(node.op)], left, right)
            if self.dual
            else ast.BinOp(left, node.op, right)
        )

    def visit_UnaryOp(self, node: ast.UnaryOp) -> ast.expr:
        value = self.visit(node.operand)
        return _call("neg", value) if self.dual else ast.UnaryOp(node.op, value)

    def visit_Constant(self, node: ast.Constant) -> ast.expr:
        return _call("number", node)


class _Local(ast.NodeTransformer):
    """Names of one call of a function: a suffix for the call, and one for every
    assignment of the same name.
    """

    def __init__(self, call: int) -> None:
        self._call, self._count, self._now = call, 0, dict[str, str]()

    def fresh(self, name: str) -> ast.Name:
        self._count += 1
        self._now[name] = f"{name}_{self._call}_{self._count}"
        return ast.Name(self._now[name])

    def stands_for(self, name: str, outer: str) -> None:
        self._now[name] = outer

    def target(self, node: ast.expr) -> ast.expr:
        if isinstance(node, ast.Tuple):
            return ast.Tuple([self.fresh(ast.unparse(part)) for part in node.elts])
        return self.fresh(ast.unparse(node))

    def visit_Name(self, node: ast.Name) -> ast.Name:
        return ast.Name(self._now.get(node.id, node.id))


def _names(node: ast.AST) -> set[str]:
    return {part.id for part in ast.walk(node) if isinstance(part, ast.Name)}


def _assign(target: ast.expr, value: ast.expr) -> ast.Assign:
    return ast.Assign(targets=[target], value=value, lineno=1)


def _call(name: str, *arguments: ast.expr) -> ast.Call:
    return ast.Call(ast.Name(name), list(arguments), [])


def _copy(node: Any) -> Any:
    return ast.parse(ast.unparse(node), mode="eval").body
