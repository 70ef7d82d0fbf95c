"""Every command from end to end where little is given: a locale of ASCII, a home and an
installation to read only.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks._hardness_commands import VERBS

ROOT = Path(__file__).parents[2]
# Names of inputs and outputs begin with a letter that ASCII lacks: its bytes are lone
# surrogates there.
MAKE = """
import os, sys
from pathlib import Path
from benchmarks import _hardness_commands as commands
from metalens import cli
here, verbs = Path.cwd(), tuple(sys.argv[1:])
commands.settings(here)
for words in commands.inputs(verbs):
    assert cli.main(words.split()) in (0, 1), words
commands.found(here, verbs)
for path in list(here.iterdir()):
    path.with_name(os.fsdecode(bytes([0xC2, 0xB5])) + path.name).symlink_to(path)
"""
RUN = """
import contextlib, io, os, sys
from pathlib import Path
from benchmarks import _hardness_mounts as mounts
from metalens import cli
assert sys.getfilesystemencoding() == "ascii"
if mounts.own():
    for place in {os.environ["ROOT"], os.path.expanduser("~")}:
        mounts.read_only(Path(place))
cli.main(["info", "absent.h5"])  # before the compiler of loops is loaded, which then looks for its place
from benchmarks import _hardness_commands as commands
letter = os.fsdecode(bytes([0xC2, 0xB5]))
for verb in sys.argv[1:]:
    words, output = commands.VERBS[verb]
    changed = {word: letter + word for word in words.split() if Path(word.format(0)).exists()}
    changed[output] = f"{letter}of_{verb}{Path(output).suffix}"
    said = io.StringIO()
    with contextlib.redirect_stderr(said):
        status = cli.main(" ".join(changed.get(word, word) for word in words.split()).format(0).split())
    if status not in (0, 1):
        print("FAILED", verb, status, said.getvalue())
"""


@pytest.mark.slow
def test_every_command_ends_well_in_an_ascii_locale_and_a_read_only_home(tmp_path):
    (tmp_path / "home").mkdir()
    told = os.environ | {
        "LC_ALL": "C",
        "PYTHONUTF8": "0",
        "PYTHONCOERCECLOCALE": "0",
        "PYTHONIOENCODING": "ascii",
    }
    told |= {
        "HOME": str(tmp_path / "home"),
        "ROOT": str(ROOT),
        "PYTHONPATH": str(ROOT),
        "OMP_NUM_THREADS": "1",
    }
    told.pop("XDG_CACHE_HOME", None)
    (tmp_path / "work").mkdir()
    for code in (MAKE, RUN):
        words = [sys.executable, "-c", code, *VERBS]
        done = subprocess.run(
            words, cwd=tmp_path / "work", env=told, capture_output=True, check=False
        )
        bad = [line for line in done.stdout.splitlines() if b"FAILED" in line]
        assert (done.returncode, bad) == (0, []), done.stderr[-2000:]
