"""``metalens retrain``: its files, what it overwrites, what a resume refuses."""

import dataclasses
import json
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from characterize.bench import HiddenLens
from characterize.inference import AsBuilt
from codesign.adapt import retrained_network
from codesign.evaluate import gaze_experiment as experiment
from codesign.optics import MadeLens, image_formation
from layout.process import process
from metalens import lens
from metalens.cli import main
from metalens.core import config
from tests.codesign import made_lens as m
from tests.command_line import call, printed, run

DIES = """
import os, signal, sys
from metalens.cli import main
def meet(event, arguments):
    if event == "os.rename" and os.path.basename(arguments[1]) == "nominal.safetensors":
        os.kill(os.getpid(), signal.SIGKILL)
sys.addaudithook(meet)
main(sys.argv[1:])
"""
TRUTH = "depths_um = [3000.0]\n" + "".join(
    f'[[parameter]]\nname = "{n}"\nvalue = {v}\n' for n, v in m.TRUE.items()
)
SHORT = ["--steps", "2", "--draws", "2", "--judge", "1", "--test-batches", "1"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("command_retrain")
    m.finished_run(path / "run")
    m.asbuilt().save(path / "asbuilt.h5")
    m.asbuilt(problems=("chi2 is 3",)).save(path / "refused.h5")
    (path / "truth.toml").write_text(TRUTH)
    return path


def _command(folder, *words, record="asbuilt.h5", out="out"):
    return [
        "retrain",
        folder / "run",
        "--asbuilt",
        folder / record,
        "-o",
        folder / out,
        *SHORT,
        *words,
    ]


def _retrain(folder, *words, **files):
    return main([str(word) for word in _command(folder, *words, **files)])


@pytest.fixture(scope="module")
def told(folder):
    """What a retraining whose truth is known says; its folder is ``out``."""
    done = run(*_command(folder, "--json", "--truth", folder / "truth.toml"))
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def bowed(folder):
    """The same of a lens whose truth nobody knows and whose bow is known to 5 nm, all
    else to 0.1: ``bowed``.
    """
    made = m.asbuilt()
    covariance = made.covariance.copy()
    covariance[made.names.index("bias_r_nm")] *= 2500.0  # on the diagonal alone
    dataclasses.replace(made, covariance=covariance).save(folder / "bowed.h5")
    done = run(*_command(folder, "--json", record="bowed.h5", out="bowed"))
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_files_report_and_rules_of_overwriting(folder, told, capsys, monkeypatch):
    truth = ["--truth", str(folder / "truth.toml")]
    assert set(told["cases"]) == {"designed", "nominal", "before", "after", "known"}
    assert told["next_lens"][0]["name"] == "as made"
    page = (folder / "out" / "report.html").read_text()
    assert "The next mask" in page
    assert "http" not in page.replace("http://www.w3.org", "")
    assert lens.load(folder / "out" / "lens_corrected.h5").profile.endswith("corrected")
    assert process.load_process(folder / "out" / "bias.toml").bias.table_nm
    kept = (folder / "out" / "retrained.safetensors").read_bytes()

    assert _retrain(folder, *truth) == 2
    assert "exists; give --force" in capsys.readouterr().err
    with (
        monkeypatch.context() as patched
    ):  # images that miss what the run asks for, of every lens that judges
        patched.setattr(
            image_formation,
            "image_tolerance_problem",
            lambda settings, image: "the image's error is too large",
        )
        # everything is there: the same story again
        assert _retrain(folder, *truth, "--resume") == 1
    assert capsys.readouterr().out.endswith(
        "\n  FAILED: the image's error is too large\n"
    )
    assert (folder / "out" / "retrained.safetensors").read_bytes() == kept
    assert _retrain(folder, *truth, "--resume", "--rate", "0.5") == 2
    assert "settings.rate: 0.0015 -> 0.5" in capsys.readouterr().err


@pytest.mark.slow
def test_killed_while_the_nominal_networks_file_was_written_a_resume_ends_in_the_same_bytes(
    folder, monkeypatch
):
    words = [
        "retrain",
        str(folder / "run"),
        "--asbuilt",
        str(folder / "asbuilt.h5"),
        "-o",
        "out",
        *SHORT,
        "--quiet",
    ]
    for name in ("whole", "killed"):
        (folder / name).mkdir()
    monkeypatch.chdir(folder / "whole")
    assert main(words) == 0
    monkeypatch.chdir(folder / "killed")
    assert (
        subprocess.run([sys.executable, "-c", DIES, *words], check=False).returncode
        == -signal.SIGKILL
    )
    assert [path.name[:20] for path in Path("out.unfinished").glob(".*.part")] == [
        ".nominal.safetensors"
    ]
    assert call(*words, "--resume") == 0
    whole, resumed = (
        {
            path.name: path.read_bytes()
            for path in (folder / name / "out").iterdir()
            if path.name != "manifest.json"
        }
        for name in ("whole", "killed")
    )  # the manifest has the words of the command, --resume among them
    assert resumed == whole
    assert [path.name for path in Path().iterdir()] == ["out"]


def test_refusals_leave_nothing_behind(folder, capsys):
    assert _retrain(folder, record="refused.h5", out="bad") == 2
    assert "refused by its own checks" in capsys.readouterr().err
    assert _retrain(folder, record="run/lens.h5", out="bad") == 2
    assert "need 'asbuilt'" in capsys.readouterr().err
    assert _retrain(folder, "--resume", out="bad") == 2
    assert "no retraining to resume" in capsys.readouterr().err
    assert not (folder / "bad").exists()


def test_a_foreign_folder_is_not_overwritten_by_force(folder, capsys):
    (folder / "thesis").mkdir()
    (folder / "thesis" / "chapter.txt").write_text("years of work")
    assert _retrain(folder, "--force", out="thesis") == 2
    assert "not made by metalens" in capsys.readouterr().err
    assert (folder / "thesis" / "chapter.txt").exists()


def test_where_the_map_alone_is_open_the_table_is_written(folder, bowed):
    assert bowed["correction_refused"] == ""
    assert "what varies over the lens" in bowed["map_refused"]
    assert (folder / "bowed" / "bias.toml").exists()
    assert not (folder / "bowed" / "lens_corrected.h5").exists()
    assert (
        "No lens_corrected.h5 is written"
        in (folder / "bowed" / "report.html").read_text()
    )


@pytest.mark.slow
def test_a_correction_that_the_posterior_leaves_open_is_said_and_not_written(
    folder, capsys
):
    m.asbuilt(sigma=5.0).save(folder / "wide.h5")
    assert (
        _retrain(
            folder,
            "--json",
            "--truth",
            str(folder / "truth.toml"),
            record="wide.h5",
            out="open",
        )
        == 0
    )
    told = printed(capsys)
    assert "no correction" in told["correction_refused"]
    assert not (folder / "open" / "bias.toml").exists()
    assert not (folder / "open" / "lens_corrected.h5").exists()
    page = (folder / "open" / "report.html").read_text()
    assert "No correction" in page
    assert "Written to no file" in page


LOOK = ["--subjects", "1", "--grid", "3", "3", "--share", "0.3", "--people", "2"]
LOOK += ["--axial-mm", "2.5", "--lateral-mm", "1.5"]


def _shown(folder, *runs, out):
    places = [str(folder / run) for run in runs]
    return call(
        "evaluate experiment", *places, f"-o {folder}/{out}", *LOOK, "--json --force"
    )


@pytest.mark.usefixtures("told")
def test_a_retrained_network_is_shown_to_the_experiment_before_the_lens_as_made(
    folder, capsys
):
    """What the run read through its design, the unwarned and the retrained network read
    through the lens as made.
    """
    assert _shown(folder, "run", "out/nominal.safetensors", "out", out="shown") == 0
    seen = printed(capsys)
    assert [row["name"] for row in seen["runs"]] == ["run", "out nominal", "out"]
    assert list(seen["lenses"].values()) == ["as designed", "as made", "as made"]
    assert (
        "out: through the lens as made"
        in (folder / "shown" / "report.html").read_text()
    )
    made = retrained_network.load_retrained(folder / "out")
    plain = retrained_network.load_retrained(folder / "run")
    design = lens.load_plain(folder / "run" / "lens.h5")
    response = AsBuilt.load(folder / "asbuilt.h5").response
    true = config.load(folder / "truth.toml", HiddenLens)
    wanted = MadeLens(design, made.settings.optics, response=response).stack(
        true.vector()
    )
    assert torch.equal(made.made.intensity, wanted.intensity)
    assert plain.made is None
    kept = load_file(folder / "out" / "retrained.safetensors")
    before = plain.run.trainer.model.net.state_dict()
    moved = {
        n: w
        for n, w in made.run.trainer.model.net.state_dict().items()
        if not torch.equal(w, before[n])
    }
    assert moved
    assert all(
        any(torch.equal(weights, tensor) for tensor in kept.values())
        for weights in moved.values()
    )
    through = [experiment.prepare_run(source, image="true") for source in (plain, made)]
    assert not torch.equal(through[0].stack, through[1].stack)


@pytest.mark.usefixtures("bowed")
def test_a_retraining_whose_run_or_fit_is_another_now_is_not_shown(
    folder, tmp_path, capsys
):
    for name in ("run", "bowed", "bowed.h5"):
        (shutil.copytree if (folder / name).is_dir() else shutil.copy)(
            folder / name, tmp_path / name
        )
    shown = retrained_network.load_retrained(tmp_path / "bowed")
    assert shown.lens == "as fitted"
    assert _shown(tmp_path, "bowed/known.safetensors", out="shown") == 2
    assert (
        "it holds nominal.safetensors, retrained.safetensors" in capsys.readouterr().err
    )
    m.asbuilt(sigma=0.2).save(tmp_path / "bowed.h5")
    assert _shown(tmp_path, "bowed", out="shown") == 2
    assert "bowed.h5 is not what it was retrained from" in capsys.readouterr().err
    (tmp_path / "run").rename(tmp_path / "away")
    assert _shown(tmp_path, "bowed", out="shown") == 2
    assert "its run is no longer at" in capsys.readouterr().err
