"""The direction of imports, lazy start-up, and what the repository may hold."""

import ast
import functools
import graphlib
import importlib
import importlib.util
import json
import re
import subprocess
import sys
import textwrap
import tomllib
from pathlib import Path

import pytest

from metalens import cli

ROOT = Path(__file__).parents[1]
_SPEC = importlib.util.spec_from_file_location("size", ROOT / "tests" / "size.py")
size = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(size)
PACKAGES = ("metalens", "layout", "characterize", "codesign")
MAY_IMPORT = {
    "metalens": set(),
    "layout": {"metalens"},
    "characterize": {"metalens"},
    "codesign": {"metalens", "characterize"},
}


MODULES = {
    path.relative_to(ROOT)
    .with_suffix("")
    .as_posix()
    .replace("/", ".")
    .removesuffix(".__init__"): path
    for package in PACKAGES
    for path in (ROOT / package).rglob("*.py")
}
# names the verbs of every package: the one place that knows them all
TABLES = {"metalens.cli"}


def _folder(module):
    return (
        module if MODULES[module].name == "__init__.py" else module.rpartition(".")[0]
    )


@functools.cache
def _tree(module):
    return ast.parse(MODULES[module].read_text(encoding="utf-8"))


@functools.cache
def _nodes(module):
    return list(ast.walk(_tree(module)))


def _of(package):
    return [module for module in MODULES if module.split(".")[0] == package]


def _imports(module):
    for node in _nodes(module):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module or ""


@functools.cache
def _face(package):
    """{public name: module that defines it} of a folder, from its stub."""
    stub = MODULES[package].with_suffix(".pyi")
    lines = ast.parse(stub.read_text(encoding="utf-8")).body if stub.exists() else []
    return {
        alias.name: f"{package}.{line.module or alias.name}"
        for line in lines
        if isinstance(line, ast.ImportFrom)
        for alias in line.names
    }


FACES = [name for name in MODULES if _face(name)]


@functools.cache
def _uses(module):
    """(where the import points, module that defines it, name) of what one module takes
    from the project.
    """
    found = []
    for node in _nodes(module):
        if isinstance(node, ast.Import):
            found += [
                (alias.name, alias.name, "")
                for alias in node.names
                if alias.name in MODULES
            ]
        elif isinstance(node, ast.ImportFrom) and node.module in MODULES:
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                table = _face(node.module)
                home = full if full in MODULES else table.get(alias.name, node.module)
                found.append((node.module, home, alias.name))
    return found


def _arrows(of):
    """{from: {to}} over the modules (faces aside), each mapped by ``of``."""
    out = {}
    for module, path in MODULES.items():
        if path.name != "__init__.py":
            here = {
                of(home)
                for _, home, _ in _uses(module)
                if home not in (module, *PACKAGES)
            }
            out.setdefault(of(module), set()).update(here - {of(module)})
    return out


@pytest.mark.parametrize("of", [str, _folder], ids=["files", "folders"])
def test_nothing_imports_in_a_circle(of):
    graphlib.TopologicalSorter(_arrows(of)).prepare()  # CycleError names the circle


@pytest.mark.parametrize("package", PACKAGES)
def test_imports_run_one_way(package):
    found = {
        (module, name)
        for module in _of(package)
        for name in _imports(module)
        if name.split(".")[0] in PACKAGES and name.split(".")[0] != package
    }
    wrong = {
        (module, name)
        for module, name in found
        if name.split(".")[0] not in MAY_IMPORT[package]
    }
    assert not wrong


def test_no_string_names_a_module_of_a_package_above():
    up = {
        (module, node.value)
        for module in MODULES.keys() - TABLES
        for node in _nodes(module)
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
        for name in re.findall(
            r"\b(?:metalens|layout|characterize|codesign)(?:\.\w+)+", node.value
        )
        if name in MODULES
        and name.split(".")[0]
        not in {module.split(".")[0], *MAY_IMPORT[module.split(".")[0]]}
        and not re.search(r"\s", node.value)  # prose may point anywhere
    }
    assert not up


def test_every_room_is_drawn_on_the_plan_and_says_what_it_is():
    plan = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    for folder in {_folder(module) for module in MODULES}:
        name = folder.rpartition(".")[2]
        assert re.fullmatch(r"[a-z]+(_[a-z]+)?", name), (
            f"{folder}: one plain word, or two"
        )
        assert re.search(rf"\b{name}\b", plan), f"{folder} is not in ARCHITECTURE.md"
        assert ast.get_docstring(_tree(folder)), (
            f"{folder}/__init__.py does not say what the folder is"
        )


def _public(tree, names):
    """Public functions, classes and their methods; ``forward`` is documented by its
    class.
    """
    for node in tree.body:
        if isinstance(
            node, (ast.FunctionDef, ast.ClassDef)
        ) and not node.name.startswith("_"):
            yield f"{names}.{node.name}", node
            if isinstance(node, ast.ClassDef):
                yield from (
                    (n, m)
                    for n, m in _public(node, f"{names}.{node.name}")
                    if m.name != "forward"
                )


@pytest.mark.parametrize("package", PACKAGES)
def test_what_is_public_is_documented(package):
    modules = _of(package)
    assert not [module for module in modules if not ast.get_docstring(_tree(module))]
    public = [pair for module in modules for pair in _public(_tree(module), module)]
    assert not [name for name, node in public if not ast.get_docstring(node)]


def test_what_crosses_folders_is_public():
    wrong = set()
    for module in MODULES:
        for source, home, name in _uses(module):
            folder = _folder(home)
            if folder in (_folder(module), *PACKAGES) or _folder(module) in PACKAGES:
                continue
            public, last = _face(folder), home.rpartition(".")[2]
            offered = (
                not public  # a folder without a face offers all its public names
                or name in public
                or last in public
                or MODULES[home].name == "__init__.py"
            )
            if name.startswith("_") or not offered:
                wrong.add((module, source, name))
    assert not wrong


@pytest.mark.parametrize("package", FACES)
def test_a_face_shows_what_is_public_and_nothing_else(package):
    table = _face(package)
    loaded = importlib.import_module(package)
    assert dir(loaded) == sorted(table) == loaded.__all__
    for name, module in table.items():
        shadowed = f"{package}.{name}" in MODULES and module != f"{package}.{name}"
        assert not shadowed, (
            f"{package}.{name} is a module and a public name: whoever loads one hides the other"
        )
        assert getattr(loaded, name) is not None


@pytest.mark.parametrize("package", PACKAGES)
def test_shipped_code_never_imports_gdstk_or_klayout(package):
    names = {name.split(".")[0] for module in _of(package) for name in _imports(module)}
    assert not names & {"gdstk", "klayout", "gdspy", "pickle"}


def test_no_module_takes_the_name_of_a_standard_one():
    names = {
        path.stem for package in PACKAGES for path in (ROOT / package).rglob("*.py")
    } - {"__init__"}
    # `profiles`-like near misses are fine; an equal name would shadow the library when
    # run as a script
    assert not names & (sys.stdlib_module_names - {"test"}) - {"bench"}


IMPORTED_AS = {  # the last three come with the package that they are named after here
    "cv2": "opencv-contrib-python-headless",
    "colour": "colour-science",
    "OCP": "build123d",
    "cycler": "matplotlib",
    "mpl_toolkits": "matplotlib",
    "yaml": "PyYAML",
}


def _declared(table):
    return {re.split(r"[<>=\[; ]", entry)[0].lower() for entry in table}


def test_every_dependency_is_declared_and_every_declared_one_is_used():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))[
        "project"
    ]
    needed = _declared(project["dependencies"])
    extras = _declared(
        entry for table in project["optional-dependencies"].values() for entry in table
    )
    outside = {
        name.split(".")[0]
        for module in MODULES
        for name in _imports(module)
        if name and name.split(".")[0] not in {*sys.stdlib_module_names, *PACKAGES}
    }
    used = {IMPORTED_AS.get(name, name).lower().replace("_", "-") for name in outside}
    assert used <= needed | extras
    assert needed <= used


def _loaded(code):
    script = f"{code}\nimport sys\nprint(' '.join(sys.modules))"
    return set(
        subprocess.run(
            [sys.executable, "-c", script], capture_output=True, text=True, check=True
        ).stdout.split()
    )


def test_layout_never_loads_torch_nor_the_solid_kernels():
    assert not _loaded("import layout, metalens.lens") & {
        "torch",
        "build123d",
        "manifold3d",
        "matplotlib",
        "scipy",
    }


def test_commands_of_the_base_install_and_of_the_bench_do_without_torch():
    """Of the bench, only images of an as-built lens at other places need it."""
    names = {
        "metalens": ("library", "study", "design", "export", "view", "info"),
        "characterize": ("fit", "capture", "measure", "view"),
    }
    imports = [
        f"import {package}.commands.{name}"
        for package, some in names.items()
        for name in some
    ]
    assert "torch" not in _loaded("\n".join(imports))


def test_help_loads_neither_numpy_nor_torch():
    code = (
        "import contextlib, io\nfrom metalens.cli import main\n"
        "with contextlib.redirect_stdout(io.StringIO()):\n    main(['--help'])"
    )
    assert not _loaded(code) & {"numpy", "torch", "tyro", "matplotlib"}


EXTRAS = {  # what only some commands need
    *(
        "torch",
        "cv2",
        "tifffile",
        "colour",
        "safetensors",
        "build123d",
        "ezdxf",
        "OCP",
        "astropy",
    ),
    *("mitsuba", "onnx", "onnxruntime"),
}


def test_the_help_of_every_command_needs_no_extra():
    """Each in turn, in a process where importing one of them fails; the options are in
    what is shown.
    """
    verbs = [
        [verb]
        for verb, (module, _) in cli.VERBS.items()
        if not hasattr(importlib.import_module(module), "PARTS")
    ]
    verbs += [
        ["evaluate", part]
        for part in importlib.import_module(cli.VERBS["evaluate"][0]).PARTS
    ]
    code = textwrap.dedent(
        f"""
        import contextlib, io, sys
        class Missing:
            def find_spec(self, name, path=None, target=None):
                if name.partition(".")[0] in {EXTRAS}:
                    raise ModuleNotFoundError(name, name=name)
        sys.meta_path.insert(0, Missing())
        from metalens.cli import main
        for words in {verbs}:
            with contextlib.redirect_stdout(io.StringIO()) as shown:
                try:
                    main([*words, "--help"])
                except SystemExit as end:
                    assert end.code == 0, words
            assert "--json" in shown.getvalue(), words
        """
    )
    assert _loaded(code)


def test_test_files_have_unique_names():
    names = [path.name for path in (ROOT / "tests").rglob("test_*.py")]
    assert len(names) == len(set(names))


def test_the_demo_and_the_examples_show_the_same_process():
    example = ROOT / "examples" / "process.toml"
    shipped = ROOT / "metalens" / "data" / "demo" / "process.toml"
    assert example.read_bytes() == shipped.read_bytes()


def test_sizes_stay_below_limits_that_only_fall():
    """Lowered by ``python tests/size.py --lower``."""
    limits = json.loads((ROOT / "tests" / "size_limits.json").read_text())
    found = size.measured()
    above = {
        (folder, key): (found[folder][key], limit)
        for folder, row in limits.items()
        for key, limit in row.items()
        if found[folder][key] > limit
    }
    assert not above
