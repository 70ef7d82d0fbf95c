"""A read-only installation without a home, a lost terminal, an ASCII locale, a folder
with its manifest.
"""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from metalens.cli import BAD_INPUT, SUCCESS
from metalens.core import transaction
from tests.command_line import call

ROOT = Path(__file__).parents[1]


def test_compiled_loops_of_a_read_only_copy_run_without_a_home(tmp_path):
    """A copy that cannot be written, a home that does not exist; root may write
    anywhere, so it is skipped there.
    """
    if os.geteuid() == 0:
        pytest.skip("root may write into a read-only folder")
    loops = tmp_path / "loops.py"
    loops.write_text(
        "import numba\n@numba.njit(cache=True)\ndef one(x):\n    return x + 1\n"
    )
    tmp_path.chmod(0o555)
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); from metalens import cli; cli.main(['info', 'x.h5'])"
    code += "; import loops; print(loops.one(2))"
    words = {
        "PATH": os.environ["PATH"],
        "HOME": "/nonexistent",
        "PYTHONPATH": str(ROOT),
    }
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env=words,
        check=False,
    )
    tmp_path.chmod(0o755)
    assert done.stdout.split()[-1:] == ["3"], done.stderr


def _heard():
    """A child of tests that run under nohup hears of a lost terminal all the same."""
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


def test_a_lost_terminal_ends_a_command_and_leaves_nothing_but_its_journal(tmp_path):
    """Of a command that has claimed its output and would go on for minutes."""
    (tmp_path / "study.toml").write_text("pitches_um = [0.3]\nheights_um = [0.7]\n")
    words = [sys.executable, "-m", "metalens", "study", "study.toml", "-o", "out"]
    # not a pipe: workers hold its end while they last
    told = tmp_path.with_name(tmp_path.name + ".told")
    with open(told, "w") as said:
        child = subprocess.Popen(
            words,
            cwd=tmp_path,
            preexec_fn=_heard,
            stderr=said,
            stdout=subprocess.DEVNULL,
        )
    while child.poll() is None and not list(tmp_path.glob(".out.new")):
        time.sleep(0.05)
    child.send_signal(signal.SIGHUP)
    child.wait()
    told = told.read_text()
    # where the interrupt meets Python at certain places it ends itself by SIGINT when
    # all is done: 130 to a shell, too
    assert child.returncode in (130, -signal.SIGINT), told
    assert "interrupted; the output is as it was before" in told
    # by where it was
    assert {"study.toml"} <= set(os.listdir(tmp_path)) <= {"study.toml", "out.resume"}


WORDS = f"{sys.executable} -m metalens info ."


def _made(tmp_path):
    with transaction.claim_folder(tmp_path / "out") as draft:
        (draft.path / "a.txt").write_text("first")
    return tmp_path / "out"


@pytest.mark.parametrize(
    ("streams", "status", "told"),
    [
        (">&-", SUCCESS, ""),
        ("<&- >&- 2>&-", SUCCESS, ""),
        (
            "--json >/dev/full",
            BAD_INPUT,
            "metalens: error: standard output: No space left on device\n",
        ),
        ("| true; exit ${PIPESTATUS[0]}", SUCCESS, ""),
    ],
)
def test_a_standard_stream_that_is_closed_full_or_left_is_no_traceback(
    tmp_path, streams, status, told
):
    """The work goes on where nobody listens; where the words cannot be written that is
    said.
    """
    words = ["bash", "-c", f"{WORDS} {streams}"]
    done = subprocess.run(
        words, cwd=_made(tmp_path), capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (status, told)


def test_words_that_an_ascii_locale_lacks_are_shown_as_codes(tmp_path):
    ascii_only = {
        **os.environ,
        "LC_ALL": "C",
        "PYTHONUTF8": "0",
        "PYTHONCOERCECLOCALE": "0",
        "PYTHONIOENCODING": "ascii",
    }
    words = [sys.executable, "-m", "metalens", "info", "größe.h5"]
    done = subprocess.run(
        words, cwd=tmp_path, env=ascii_only, capture_output=True, check=False
    )
    assert done.returncode == BAD_INPUT
    assert b"Traceback" not in done.stderr
    assert b"no such file" in done.stderr


def test_info_shows_what_a_folder_holds_and_refuses_a_changed_one(tmp_path, capsys):
    with transaction.claim_folder(tmp_path / "out") as draft:
        (draft.path / "a.txt").write_text("first")
    assert call(f"info {tmp_path}/out --json") == SUCCESS
    told = json.loads(capsys.readouterr().out)
    assert told["files"]["a.txt"]["bytes"] == 5
    assert call(f"info {tmp_path}/out") == SUCCESS
    assert "1 files, each as it was written" in capsys.readouterr().out
    (tmp_path / "out" / "a.txt").write_text("other")
    assert call(f"info {tmp_path}/out") == BAD_INPUT
    assert "SHA-256 differs" in capsys.readouterr().err


@pytest.mark.parametrize("words", ["--help", "info --help"])
def test_help_that_nobody_reads_to_its_end_is_no_error(words):
    line = f"{sys.executable} -m metalens {words} | true; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(
        ["bash", "-c", line], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (SUCCESS, "")


@pytest.mark.parametrize(
    "words",
    ["info", "export", "psf", "check", "layout", "view", "evaluate optics", "budget"],
)
def test_a_pipe_in_place_of_an_artefact_is_refused_not_waited_for(
    tmp_path, monkeypatch, capsys, words
):
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe.h5")
    output = (
        []
        if words == "info"
        else ["-o", {"export": "a.mat", "view": "a.html"}.get(words, "a.h5")]
    )
    assert call(*words.split(), "pipe.h5", *output) == BAD_INPUT
    assert "pipe.h5: no plain file (a pipe or a device)" in capsys.readouterr().err
    assert os.listdir() == ["pipe.h5"]
