"""The command line: exit codes, refusals in one line, nothing half-written, and the main job end to end."""

import json
import os
import subprocess
import sys

import pytest

from metalens import cli


def run(*words, cwd=None):
    return subprocess.run(
        [sys.executable, "-m", "metalens", *map(str, words)], capture_output=True, text=True, cwd=cwd, check=False
    )


def test_help_lists_every_verb():
    done = run("--help")
    assert done.returncode == cli.SUCCESS
    for verb in cli.VERBS:
        assert f"  {verb}" in done.stdout


def test_no_command_and_unknown_command_are_bad_input():
    assert run().returncode == cli.BAD_INPUT
    done = run("desing")
    assert done.returncode == cli.BAD_INPUT
    assert "did you mean 'design'?" in done.stderr


@pytest.mark.parametrize("verb", sorted(cli.VERBS))
def test_every_verb_has_help_and_names_its_options(verb):
    done = run(verb, "--help")
    assert done.returncode == 0, done.stderr
    assert "--json" in done.stdout


def test_version():
    assert run("--version").stdout.startswith("metalens ")


def test_misspelt_key_names_the_nearest_and_writes_nothing(tmp_path):
    (tmp_path / "d.toml").write_text('profil = "cubic"\n')
    done = run("design", "d.toml", "-o", "lens.h5", cwd=tmp_path)
    assert done.returncode == cli.BAD_INPUT
    assert "unknown key 'profil'; did you mean 'profile'?" in done.stderr
    assert "Traceback" not in done.stderr
    assert os.listdir(tmp_path) == ["d.toml"]


def test_missing_files_are_bad_input(tmp_path):
    for words in (("design", "absent.toml"), ("info", "absent.h5"), ("library", "absent.toml")):
        done = run(*words, cwd=tmp_path)
        assert done.returncode == cli.BAD_INPUT
        assert "no such file" in done.stderr
    assert os.listdir(tmp_path) == []


def test_an_existing_file_is_kept_without_force(tmp_path):
    (tmp_path / "d.toml").write_text("aperture_mm = 0.02\n")
    (tmp_path / "lens.h5").write_text("precious")
    done = run("design", "d.toml", "-o", "lens.h5", cwd=tmp_path)
    assert done.returncode == cli.BAD_INPUT
    assert "--force" in done.stderr
    assert (tmp_path / "lens.h5").read_text() == "precious"


def test_info_shows_kind_and_provenance(tmp_path):
    import numpy as np

    from metalens import store

    made = store.Provenance(config="x = 1\n", inputs={"a.toml": "0" * 64})
    store.save(tmp_path / "f.h5", "psf", {"image": np.eye(20)}, attributes={"pitch_um": 0.4}, provenance=made)
    text = run("info", tmp_path / "f.h5").stdout
    assert "psf version 1" in text
    assert "config: x = 1" in text
    assert "@" in text
    values = json.loads(run("info", tmp_path / "f.h5", "--json").stdout)
    assert values["kind"] == "psf"
    assert values["arrays"]["image"] == "float64 (20, 20)"
