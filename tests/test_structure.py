"""The direction of imports, lazy start-up, and what the repository may hold."""

import ast
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("metalens", "layout", "characterize", "codesign")
MAY_IMPORT = {
    "metalens": set(),
    "layout": {"metalens"},
    "characterize": {"metalens"},
    "codesign": {"metalens", "characterize"},
}


def _imports(path):
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module or ""


@pytest.mark.parametrize("package", PACKAGES)
def test_imports_run_one_way(package):
    found = {
        (path.relative_to(ROOT).as_posix(), name)
        for path in (ROOT / package).rglob("*.py")
        for name in _imports(path)
        if name.split(".")[0] in PACKAGES and name.split(".")[0] != package
    }
    wrong = {(path, name) for path, name in found if name.split(".")[0] not in MAY_IMPORT[package]}
    assert not wrong


@pytest.mark.parametrize("package", PACKAGES)
def test_shipped_code_never_imports_gdstk_or_klayout(package):
    names = {name.split(".")[0] for path in (ROOT / package).rglob("*.py") for name in _imports(path)}
    assert not names & {"gdstk", "klayout", "gdspy", "pickle"}


def test_no_module_takes_the_name_of_a_standard_one():
    names = {path.stem for package in PACKAGES for path in (ROOT / package).rglob("*.py")} - {"__init__"}
    # `profiles`-like near misses are fine; an equal name would shadow the library when run as a script
    assert not names & (sys.stdlib_module_names - {"test"}) - {"bench"}


IMPORTED_AS = {  # the last three come with the package that they are named after here
    "cv2": "opencv-contrib-python-headless",
    "colour": "colour-science",
    "OCP": "build123d",
    "cycler": "matplotlib",
    "mpl_toolkits": "matplotlib",
}


def _declared(table):
    return {re.split(r"[<>=\[; ]", entry)[0].lower() for entry in table}


def test_every_dependency_is_declared_and_every_declared_one_is_used():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    needed = _declared(project["dependencies"])
    extras = _declared(entry for table in project["optional-dependencies"].values() for entry in table)
    outside = {
        name.split(".")[0]
        for package in PACKAGES
        for path in (ROOT / package).rglob("*.py")
        for name in _imports(path)
        if name and name.split(".")[0] not in {*sys.stdlib_module_names, *PACKAGES}
    }
    used = {IMPORTED_AS.get(name, name).lower().replace("_", "-") for name in outside}
    assert used <= needed | extras
    assert needed <= used


def _loaded(code):
    script = f"{code}\nimport sys\nprint(' '.join(sys.modules))"
    return set(
        subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout.split()
    )


def test_layout_never_loads_torch_nor_the_solid_kernels():
    assert not _loaded("import layout, metalens.lens") & {"torch", "build123d", "manifold3d", "matplotlib", "scipy"}


def test_help_loads_neither_numpy_nor_torch():
    code = (
        "import contextlib, io\nfrom metalens.cli import main\n"
        "with contextlib.redirect_stdout(io.StringIO()):\n    main(['--help'])"
    )
    assert not _loaded(code) & {"numpy", "torch", "tyro", "matplotlib"}


def test_test_files_have_unique_names():
    names = [path.name for path in (ROOT / "tests").rglob("test_*.py")]
    assert len(names) == len(set(names))


def test_the_demo_and_the_examples_show_the_same_process():
    example, shipped = ROOT / "examples" / "process.toml", ROOT / "metalens" / "data" / "demo" / "process.toml"
    assert example.read_bytes() == shipped.read_bytes()
