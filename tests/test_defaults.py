"""A default is a promise: who leaves a key or an argument out gets tomorrow what he
gets today.

``tests/defaults.txt`` is the list that was promised, of numbers and of names that stand
for one; whoever changes a
default changes its line there too, and says so in the change log. What is new need not
stand in it; a name that goes
takes its line along. So are priors, by which the intervals of every fit without
metrology are what they are:
``tests/priors.txt``.
"""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PROMISED = dict(
    line.split(" = ", 1)
    for line in (Path(__file__).parent / "defaults.txt").read_text().splitlines()
)


def constants(tree: ast.Module) -> dict[str, ast.expr]:
    """Values of the names that a module gives, by which a default may stand."""
    found = {}
    for node in tree.body:
        if isinstance(node, ast.Assign) and len(node.targets) == 1:
            target, value = node.targets[0], node.value
            pairs = [(target, value)]
            if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
                pairs = list(zip(target.elts, value.elts, strict=True))
            found |= {name.id: of for name, of in pairs if isinstance(name, ast.Name)}
    return found


def number(node: ast.expr | None) -> bool:
    """Whether an expression is a number, or a tuple that holds one."""
    if isinstance(node, ast.Tuple):
        return any(number(part) for part in node.elts)
    node = node.operand if isinstance(node, ast.UnaryOp) else node
    return isinstance(node, ast.Constant) and type(node.value) in (int, float)


def given(node: ast.AST, where: str) -> Iterator[tuple[str, ast.expr]]:
    """(name, default) of the fields of a public class and of the arguments of a public
    function, and inside them.
    """
    name = getattr(node, "name", "_")
    if isinstance(node, ast.ClassDef) and name[0] != "_":
        for part in node.body:
            yield from given(part, f"{where}.{name}")
    elif isinstance(node, ast.FunctionDef) and (name[0] != "_" or name == "__init__"):
        about = node.args
        own = (*about.posonlyargs, *about.args)
        pairs = [
            *zip(own[len(own) - len(about.defaults) :], about.defaults, strict=True)
        ]
        pairs += [
            (a, d)
            for a, d in zip(about.kwonlyargs, about.kw_defaults, strict=True)
            if d is not None
        ]
        yield from (
            (f"{where}.{name}({argument.arg})", default) for argument, default in pairs
        )
    elif (
        isinstance(node, ast.AnnAssign)
        and isinstance(node.target, ast.Name)
        and node.value is not None
    ):
        value = node.value
        if isinstance(value, ast.Call) and getattr(value.func, "id", "") == "field":
            value = next((k.value for k in value.keywords if k.arg == "default"), value)
        yield f"{where}.{node.target.id}", value


def found(package: str) -> dict[str, str]:
    """{name: default} of all numbers that a package gives where nothing is said."""
    out = {}
    for path in sorted((ROOT / package).rglob("*.py")):
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        tree = ast.parse(path.read_text(encoding="utf-8"))
        named = constants(tree)
        for node in tree.body:
            if not isinstance(
                node, ast.AnnAssign
            ):  # a constant of the module is no default
                defaults = [
                    (name, named.get(getattr(value, "id", ""), value))
                    for name, value in given(node, module)
                ]
                out |= {
                    name: ast.unparse(value)
                    for name, value in defaults
                    if number(value)
                }
    return out


@pytest.mark.parametrize("package", ["metalens", "layout", "characterize", "codesign"])
def test_defaults_are_the_promised_ones(package):
    here = found(package)
    known = {
        name: value
        for name, value in PROMISED.items()
        if name.startswith(f"{package}.")
    }
    assert {name: here[name] for name in known if name in here} == {
        n: v for n, v in known.items() if n in here
    }
    assert len(known.keys() - here.keys()) < 0.05 * len(
        known
    )  # lines of names that are gone: strike them out
    assert len(known) > 0.8 * len(here)


@pytest.mark.parametrize("package", ["metalens", "layout", "characterize", "codesign"])
def test_what_must_be_above_a_number_must_be_above_nothing(package):
    """A length, a tolerance, a count: 0 is the one limit that needs no unit."""
    limits = []
    for path in (ROOT / package).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            told = (
                node.value
                if isinstance(node, ast.keyword) and node.arg == "metadata"
                else None
            )
            if isinstance(told, ast.Dict):
                pairs = zip(told.keys, told.values, strict=True)
                limits += [
                    ast.literal_eval(v)
                    for k, v in pairs
                    if isinstance(k, ast.Constant) and k.value == "above"
                ]
    assert set(limits) <= {0}


def test_priors_are_the_promised_ones():
    """Of every parameter of lens and bench: sigma, bounds, start, what is reckoned with
    where it is held, the step.
    """
    from characterize.model.parameters import PARAMETERS, UNFITTED

    here = [
        f"{p.name}: {p.start:g} +- {p.sigma:g} within {p.low:g} to {p.high:g}, {'fitted' if p.free else 'held'}, "
        f"unstated {p.unstated:g}, scale {p.scale:g}"
        for p in PARAMETERS
    ]
    here += [f"{row.name}: 0 +- {row.sigma:g}, never fitted" for row in UNFITTED]
    assert (
        here
        == (Path(__file__).parent / "priors.txt")
        .read_text(encoding="utf-8")
        .splitlines()
    )


def test_a_default_by_name_is_the_number_that_the_module_gives_it():
    """Of a name alone and of two at once; what a call makes is no number."""
    tree = ast.parse(
        "LEAST = 0.03\nNODES, MOST = 17, make()\n(A, B) = pair()\ndef at(x=LEAST, n=NODES, m=MOST): ...\n"
    )
    named = constants(tree)
    read = {
        name: named[value.id]
        for name, value in given(tree.body[-1], "m")
        if isinstance(value, ast.Name)
    }
    assert {
        name: ast.unparse(value) for name, value in read.items() if number(value)
    } == {
        "m.at(x)": "0.03",
        "m.at(n)": "17",
    }


def test_defaults_are_read_from_fields_arguments_and_methods():
    source = (
        "class Lens:\n    pitch_um: float = 0.37\n    name: str = 'a'\n    shift_um: tuple = field(default=(1.5, -2))\n"
        "    def at(self, z, y=3, *, x: float = -0.5): ...\ndef _own(a=1): ...\nclass _Own:\n    b: int = 2\n"
    )
    read = {
        name: ast.unparse(value)
        for node in ast.parse(source).body
        for name, value in given(node, "m")
        if number(value)
    }
    assert read == {
        "m.Lens.pitch_um": "0.37",
        "m.Lens.shift_um": "(1.5, -2)",
        "m.Lens.at(y)": "3",
        "m.Lens.at(x)": "-0.5",
    }
