"""The command line: exit codes, refusals in one line, nothing half-written, and the
main job end to end.
"""

import json
import os
import textwrap
from importlib import resources

import pytest

from metalens import cli
from tests import small
from tests.command_line import process, run


def test_help_lists_every_verb():
    done = process("--help")
    assert done.returncode == cli.SUCCESS
    for verb in cli.VERBS:
        assert f"  {verb}" in done.stdout


def test_no_command_and_unknown_command_are_bad_input():
    assert run().returncode == cli.BAD_INPUT
    done = process("desing")
    assert done.returncode == cli.BAD_INPUT
    assert "did you mean 'design'?" in done.stderr


@pytest.mark.parametrize(
    "verb", sorted(set(cli.VERBS) - {"evaluate"} | {"evaluate optics"})
)
def test_every_verb_has_help_and_names_its_options(verb):
    done = run(*verb.split(), "--help")
    assert done.returncode == 0, done.stderr
    assert "--json" in done.stdout


def test_verb_with_verbs_of_its_own_lists_them():
    done = run("evaluate --help")
    assert done.returncode == cli.SUCCESS
    assert "  optics" in done.stdout
    assert run("evaluate").returncode == cli.BAD_INPUT
    assert "did you mean 'optics'?" in run("evaluate opticz").stderr


def test_evaluate_takes_lens_files_and_run_folders_as_they_are(tmp_path):
    lens = run(f"evaluate {tmp_path}/absent.h5")
    assert (lens.returncode, "no such file" in lens.stderr) == (cli.BAD_INPUT, True)
    folder = run(f"evaluate {tmp_path} -o {tmp_path}/out")
    assert folder.returncode == cli.BAD_INPUT
    assert str(tmp_path) in folder.stderr


def test_version():
    assert process("--version").stdout.startswith("metalens ")


def test_misspelt_key_names_the_nearest_and_writes_nothing(tmp_path):
    (tmp_path / "d.toml").write_text('profil = "cubic"\n')
    done = process("design d.toml -o lens.h5", cwd=tmp_path)
    assert done.returncode == cli.BAD_INPUT
    assert "unknown key 'profil'; did you mean 'profile'?" in done.stderr
    assert "Traceback" not in done.stderr
    assert os.listdir(tmp_path) == ["d.toml"]


def test_missing_files_are_bad_input(tmp_path):
    for words in (
        ("design", "absent.toml"),
        ("info", "absent.h5"),
        ("library", "absent.toml"),
    ):
        done = run(*words, cwd=tmp_path)
        assert done.returncode == cli.BAD_INPUT
        assert "no such file" in done.stderr
    assert os.listdir(tmp_path) == []


def test_info_shows_kind_and_provenance(tmp_path):
    import numpy as np

    from metalens.core import store

    made = store.Provenance(config="x = 1\n", inputs={"a.toml": "0" * 64})
    store.save(
        tmp_path / "f.h5",
        "psf",
        {"image": np.eye(20)},
        attributes={"pitch_um": 0.4},
        provenance=made,
    )
    text = run(f"info {tmp_path}/f.h5").stdout
    assert "psf version 1" in text
    assert "config: x = 1" in text
    values = json.loads(run(f"info {tmp_path}/f.h5 --json").stdout)
    assert values["kind"] == "psf"
    assert values["arrays"]["image"] == "float64 (20, 20)"


# The shipped chain trains and measures a lens of 1 mm for minutes; here one of 0.02 mm
# that nobody measures (tests/golden does), and a network that hardly trains.
CHAIN = {
    "run.toml": small.SETTINGS["run.toml"],
    "psf.toml": """
        depths_mm = [18.0, 23.0, 5.0]
        angles_deg = [4.0]
        samples = 24
        tolerance = 0.01
    """,
    "chain.toml": """
        cell = "cell.toml"
        design = "design.toml"
        process = "process.toml"
        psf = "psf.toml"
        run = "run.toml"
        budget = false
    """,
}


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """The whole chain on a 20 µm lens, run as a user would, with a small co-design run."""
    folder = tmp_path_factory.mktemp("demo")
    for name in ("cell.toml", "design.toml", "process.toml"):
        (folder / name).write_text(
            resources.files("metalens").joinpath("data", "demo", name).read_text()
        )
    for name, text in CHAIN.items():
        (folder / name).write_text(textwrap.dedent(text))
    done = run(
        f"demo {folder}/out --config {folder}/chain.toml --aperture-mm 0.02 --json"
    )
    return folder / "out", done


def test_the_chain_runs_from_cell_to_checked_mask(demo):
    folder, done = demo
    assert done.returncode == cli.SUCCESS, done.stderr
    values = json.loads(done.stdout)
    assert values["library"]["max_error"] <= 1e-3
    assert values["library"]["turns"] >= 1
    assert values["design"]["focus_passed"]
    assert values["psf"]["converged"]
    assert values["layout"]["ok"]
    assert values["layout"]["pillars"] >= values["design"]["pillars"]
    for name in (
        "library.h5",
        "lens.h5",
        "psf.h5",
        "mask/mask.oas",
        "mask/mask.gds",
        "mask/report.html",
    ):
        assert (folder / name).stat().st_size > 0
    page = (folder / "report.html").read_text(encoding="utf-8")
    # library, lens, three of the PSFs, mask, training
    assert page.count("data:image/png") == 7
    assert not [p.name for p in folder.rglob("*.part")]


def test_every_artefact_of_the_chain_tells_where_it_comes_from(demo):
    folder, _ = demo
    for name, kind in (
        ("library.h5", "library"),
        ("lens.h5", "lens"),
        ("psf.h5", "psf"),
    ):
        assert run(f"info {folder}/{name}").stdout.startswith(f"{kind} version")
    assert "library.h5 (SHA-256" in run(f"info {folder}/lens.h5").stdout


def test_a_run_with_the_same_input_gives_the_same_bytes(demo, tmp_path):
    folder, _ = demo
    for name in ("design.toml", "library.h5"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    assert run("design design.toml -o lens.h5", cwd=tmp_path).returncode == 0
    assert (tmp_path / "lens.h5").read_bytes() == (folder / "lens.h5").read_bytes()


def test_a_filled_folder_is_not_written_into_without_force(demo):
    folder, _ = demo
    done = run(f"demo {folder}")
    assert done.returncode == cli.BAD_INPUT
    assert "exists; give --force" in done.stderr


def test_a_truncated_lens_is_refused_by_every_stage(demo, tmp_path):
    folder, _ = demo
    whole = (folder / "lens.h5").read_bytes()
    (tmp_path / "lens.h5").write_bytes(whole[: len(whole) // 2])
    for words in (
        ("psf", "lens.h5", "-o", "psf.h5"),
        ("layout", "lens.h5", "-o", "mask"),
    ):
        done = run(*words, cwd=tmp_path)
        assert done.returncode == cli.BAD_INPUT, done.stdout
        assert "truncated" in done.stderr
    assert os.listdir(tmp_path) == ["lens.h5"]
    (tmp_path / "lens.h5").write_bytes((folder / "library.h5").read_bytes())
    assert (
        "holds 'library' version 1, need 'lens'"
        in run("psf lens.h5 -o psf.h5", cwd=tmp_path).stderr
    )
