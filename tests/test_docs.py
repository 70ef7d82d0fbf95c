"""The pages of docs/: every Python block runs, every settings file is accepted, every link leads somewhere."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from metalens import config
from metalens.chain import ChainFiles
from metalens.cli import VERBS
from metalens.commands.design import Design
from metalens.commands.library import CellFile
from metalens.commands.psf import Settings

ROOT = Path(__file__).parents[1]
PAGES = sorted((ROOT / "docs").glob("*.md"))
TEXTS = [*PAGES, ROOT / "README.md", ROOT / "ARCHITECTURE.md", ROOT / "CONTRIBUTING.md"]


def _blocks(path, language):
    return re.findall(rf"^```{language}\n(.*?)^```", path.read_text(encoding="utf-8"), re.M | re.S)


def _records():
    from characterize.bench import Truth
    from characterize.pupil import PupilSpec
    from codesign.plan import PlanConfig
    from layout.process import Process

    return {
        "CELL.toml": CellFile,
        "DESIGN.toml": Design,
        "PSF.toml": Settings,
        "PROCESS.toml": Process,
        "TRUTH.toml": Truth,
        "PUPIL.toml": PupilSpec,
        "PLAN.toml": PlanConfig,
        "CHAIN.toml": ChainFiles,
    }


@pytest.mark.parametrize("page", [p for p in PAGES if _blocks(p, "python")], ids=lambda p: p.stem)
def test_python_of_a_page_runs_from_top_to_bottom(page, tmp_path):
    script = tmp_path / "page.py"
    script.write_text("\n".join(_blocks(page, "python")), encoding="utf-8")
    done = subprocess.run([sys.executable, str(script)], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.stem)
def test_settings_of_a_page_are_accepted(page):
    for text in _blocks(page, "toml"):
        name = text.splitlines()[0].removeprefix("# ")
        if name == "RUN.toml":
            continue  # read over its preset, by its own tests
        config.loads(text, _records()[name], where=f"{page.name}: {name}")


@pytest.mark.parametrize("page", TEXTS, ids=lambda p: p.stem)
def test_links_and_commands_of_a_page_exist(page):
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\((?!https?://|#)([^)#]+)", text):
        assert (page.parent / target).exists(), target
    for verb in re.findall(r"^metalens ([a-z]+)", text, re.M):
        assert verb in VERBS, verb
