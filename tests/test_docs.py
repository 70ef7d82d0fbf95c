"""The pages of docs/: every Python block runs, every settings file is accepted, every
link leads somewhere.
"""

import functools
import importlib
import importlib.util
import re
import textwrap
from pathlib import Path

import pytest

from characterize.captures.stage import read_about
from characterize.model import PARAMETERS
from metalens.cli import VERBS
from metalens.commands.chain import ChainFiles
from metalens.commands.design import DesignSettings
from metalens.commands.library import CellFile
from metalens.commands.psf import PsfSettings
from metalens.core import config
from tests.command_line import call

ROOT = Path(__file__).parents[1]
PAGES = sorted(
    [*(ROOT / "docs").glob("*.md"), *(ROOT / "docs" / "tutorials").glob("*.md")]
)
# pages that the site makes from the code
MADE = re.compile(r"(\.\./)?reference/(\w+)\.md")
OF_A_CAPTURE = {
    "pixel_um",
    "pixel_sigma_um",
    "wavelength_um",
    "wavelength_sigma_nm",
    "bits",
    "gain_e",
    "channel",
}
TEXTS = [*PAGES, ROOT / "README.md", ROOT / "ARCHITECTURE.md", ROOT / "CONTRIBUTING.md"]


def _blocks(path, language):
    found = re.findall(
        rf"^ *```{language}\n(.*?)^ *```", path.read_text(encoding="utf-8"), re.M | re.S
    )
    return [textwrap.dedent(block) for block in found]


def _records():
    from characterize.bench.bench import HiddenLens
    from characterize.bench.protocol import BenchProtocol
    from characterize.pupil.model import PupilSpec
    from codesign.commands.evaluate_optics import OpticsSettings as Optics
    from layout.arrange.record import DieFloorplan
    from layout.process.process import Process
    from metalens.library.study import CellStudy

    return {
        "CELL.toml": CellFile,
        "STUDY.toml": CellStudy,
        "DESIGN.toml": DesignSettings,
        "PSF.toml": PsfSettings,
        "PROCESS.toml": Process,
        "TRUTH.toml": HiddenLens,
        "PROTOCOL.toml": BenchProtocol,
        "PUPIL.toml": PupilSpec,
        "CHAIN.toml": ChainFiles,
        "ARRANGEMENT.toml": DieFloorplan,
        "OPTICS.toml": Optics,
    }


@functools.cache
def _site():
    """The module that makes pages of the site from the code."""
    pytest.importorskip("mkdocs")
    spec = importlib.util.spec_from_file_location(
        "site_reference", ROOT / "docs" / "site" / "reference.py"
    )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_reference_of_the_checkout_is_that_of_the_code():
    for name, text in _site().reference_pages().items():
        page = ROOT / "docs" / "reference" / name
        assert page.read_text(encoding="utf-8") == text, (
            f"{name}: run python docs/site/reference.py"
        )


def test_every_key_of_every_settings_page_has_a_text():
    for name in _site().SETTINGS:
        page = _site().settings_page(name)
        assert page.startswith(f"# {name}")
        rows = [line for line in page.splitlines() if line.startswith("| `")]
        assert rows
        assert not [
            row for row in rows if not row.removesuffix("|").rpartition("|")[2].strip()
        ], name


def test_every_settings_file_that_texts_name_has_its_page():
    named = {
        name
        for page in TEXTS
        for name in re.findall(r"\b[A-Z]{3,}\.toml\b", page.read_text(encoding="utf-8"))
    }
    assert named <= set(_site().SETTINGS)
    nav = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    assert not [
        name
        for name in _site().SETTINGS
        if f"{name}: reference/{name[:-5].lower()}.md" not in nav
    ]


def test_the_page_of_commands_has_every_option_as_its_help_does(capsys):
    page = _site().commands_page()
    for verb in ("check", "capture", "psf", "scene", "evaluate optics"):
        part = page.partition(f"## metalens {verb}\n")[2].partition("\n## ")[0]
        told = {
            flag
            for row in re.findall(r"^\| (.*?) \|", part, re.M)
            for flag in re.findall(r"`(-[\w-]+)`", row)
        }
        with pytest.raises(SystemExit):
            call(*verb.split(), "--help")
        text = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out)
        heads = [
            line for line in text.splitlines() if re.match(r"^[│ ] ?-{1,2}[a-z]", line)
        ]
        shown = {
            flag
            for line in heads
            for flag in re.findall(r"(?<![\w-])(--?[a-z][\w-]*)", line)
        }
        assert told == {flag for flag in shown if not flag.startswith("--no-")} - {
            "-h",
            "--help",
        }, verb


@pytest.mark.parametrize(
    "page", [p for p in PAGES if _blocks(p, "python")], ids=lambda p: p.stem
)
def test_python_of_a_page_runs_from_top_to_bottom(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(
        compile("\n".join(_blocks(page, "python")), page.name, "exec"),
        {"__name__": "__main__"},
    )


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.stem)
def test_settings_of_a_page_are_accepted(page, tmp_path):
    for text in _blocks(page, "toml"):
        name = text.splitlines()[0].removeprefix("# ")
        if name == "RUN.toml":
            continue  # read over its preset, by its own tests
        if name == "capture.toml":
            (tmp_path / name).write_text(text, encoding="utf-8")
            assert read_about(tmp_path).keys() <= OF_A_CAPTURE | {
                p.name for p in PARAMETERS
            }
            continue
        config.loads(text, _records()[name], where=f"{page.name}: {name}")


NAMED = [*TEXTS, ROOT / "docs" / "fisher" / "README.md"]
OURS = r"(?:metalens|layout|characterize|codesign)"


@pytest.mark.parametrize("page", NAMED, ids=lambda p: f"{p.parent.name}-{p.stem}")
def test_files_modules_and_benchmarks_that_a_page_names_exist(page):
    text = page.read_text(encoding="utf-8")
    files = set(
        re.findall(rf"`((?:{OURS}|benchmarks|tests|docs|examples)/[\w/.\-]+)`", text)
    )
    assert not [name for name in files if not (ROOT / name).exists()]
    parts = set(re.findall(r"python -m benchmarks(?:\.\w+\.| )([a-z]\w*)", text))
    assert not [
        name for name in parts if not list((ROOT / "benchmarks").rglob(f"{name}.py"))
    ]
    assert not [
        name for name in re.findall(rf"`({OURS}(?:\.\w+)+)", text) if not _there(name)
    ]


def _there(name):
    """Whether a dotted name is a module of ours, or something in one; a file such as
    ``layout.json`` is none.
    """
    found, *rest = name.split(".")
    if rest[-1] == "json":
        return True
    made = importlib.import_module(found)
    for part in rest:
        if (
            not hasattr(made, part)
            and importlib.util.find_spec(f"{found}.{part}") is not None
        ):
            importlib.import_module(f"{found}.{part}")
        made, found = getattr(made, part, None), f"{found}.{part}"
        if made is None:
            return False
    return True


@pytest.mark.parametrize("page", TEXTS, ids=lambda p: p.stem)
def test_links_and_commands_of_a_page_exist(page):
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\((?!https?://|#)([^)#]+)", text):
        made = MADE.fullmatch(target)
        if made:
            assert f"{made[2].upper()}.toml" in _site().SETTINGS or made[2] in (
                "commands",
                "api",
            ), target
        else:
            assert (page.parent / target).exists(), target
    for verb in re.findall(r"^ *metalens ([a-z-]+)", text, re.M):
        assert verb in VERBS, verb


def test_the_reference_holds_what_the_packages_show():
    named = set(
        re.findall(
            r"^::: ([\w.]+)$",
            (ROOT / "docs/reference/api.md").read_text(encoding="utf-8"),
            re.M,
        )
    )
    for name in named:
        where, _, last = name.rpartition(".")
        assert getattr(importlib.import_module(where), last).__doc__, name
    for package in ("layout", "characterize", "codesign"):
        assert {
            f"{package}.{one}" for one in dir(importlib.import_module(package))
        } <= named
