"""Commands that are killed at a random moment, run twice at once, or given too little
room: what they leave is whole or absent, and the next run ends well.
"""

import os
import resource
import shutil
import signal
import sys
import time

import pytest

from metalens import cli, lens, psf
from tests.command_line import call

pytestmark = pytest.mark.skipif(
    not hasattr(os, "fork"), reason="processes are forked here"
)
# target, the words that make it, and what reads it whole
COMMANDS = {
    "design": ("lens.h5", ("design", "design.toml"), lens.load),
    "psf": ("psf.h5", ("psf", "lens.h5", "--config", "psf.toml"), psf.load),
    "layout": (
        "mask",
        ("layout", "lens.h5", "--process", "process.toml", "--oasis", "--gds"),
        None,
    ),
}


@pytest.fixture
def place(small_chain, tmp_path, monkeypatch):
    """Inputs of the small lens in a folder of the test's own."""
    for name in ("library.h5", "lens.h5", "psf.h5"):
        shutil.copy(small_chain[name], tmp_path)
    for path in small_chain.folder.glob("*.toml"):
        shutil.copy(path, tmp_path)
    shutil.copy(small_chain.folder / "phase.npy", tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def begin(*words, limit_bytes=None):
    """Process number of a fork that runs a command, mute; its status is the command's."""
    child = os.fork()
    if child:
        return child
    status = 99
    try:
        quiet = os.open(os.devnull, os.O_WRONLY)
        os.dup2(quiet, 1)
        os.dup2(quiet, 2)
        sys.stdout = sys.stderr = os.fdopen(quiet, "w", closefd=False)
        if limit_bytes is not None:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, limit_bytes))
        status = call(*map(str, words), "--quiet")
    finally:
        sys.stdout.flush()
        os._exit(status)


def end(child):
    """Exit status, or minus the number of the signal."""
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def whole(path, read):
    """Whether a result is there, and every byte of it."""
    if not path.exists():
        return False
    if read is None:
        assert (path / "report.html").read_text().rstrip().endswith("</html>")
        assert (path / "mask.gds").stat().st_size > 1000
    else:
        read(path)
    return True


@pytest.mark.parametrize("verb", ["psf", "layout"])
def test_a_killed_command_leaves_all_or_nothing(place, rng, verb):
    target, words, read = COMMANDS[verb]
    output = place / f"new_{target}"
    before = time.monotonic()
    assert end(begin(*words, "-o", output)) == 0
    takes = time.monotonic() - before
    assert whole(output, read)
    for _ in range(2):
        child = begin(*words, "-o", output, "--force")
        time.sleep(rng.uniform(0, takes))
        os.kill(child, signal.SIGKILL)
        end(child)
        whole(output, read)  # the old one, the new one, or none: never a part
    assert end(begin(*words, "-o", output, "--force")) == 0
    assert whole(output, read)


@pytest.mark.parametrize("verb", ["design", "layout"])
def test_a_command_without_room_says_so_and_leaves_what_was_there(place, rng, verb):
    target, words, _ = COMMANDS[verb]
    output = place / f"new_{target}"
    for _ in range(2):
        limit = int(rng.integers(0, 4000))
        status = end(begin(*words, "-o", output, limit_bytes=limit))
        assert status == cli.BAD_INPUT, limit
        assert not output.exists()
    assert not [path for path in place.rglob("*.part")]


def test_of_two_writers_one_wins_and_the_result_is_whole(place):
    target, words, read = COMMANDS["psf"]
    output = place / f"new_{target}"
    children = [begin(*words, "-o", output) for _ in range(2)]
    status = sorted(end(child) for child in children)
    assert status[0] == 0
    assert status[1] in (0, cli.BAD_INPUT)
    assert whole(output, read)
