"""Commands that are killed, run twice at once or out of room, a few of each; ``benchmarks.hardness`` does hundreds."""

import subprocess
import sys
from pathlib import Path

import pytest

STRIKE = """
from benchmarks._hardness_runs import bench
with bench(("export", "check", "view")) as made:
    made.prepare()
    for kind, count in (("kills", 4), ("writers", 1), ("disks", 3)):
        for verb in made.verbs:
            for number in range(count):
                print(*made.trial(kind, verb, number), sep="\\n", end="")
"""


@pytest.mark.slow
def test_nothing_is_mixed_lost_or_left():
    root = Path(__file__).parents[2]
    done = subprocess.run([sys.executable, "-c", STRIKE], cwd=root, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, ""), done.stderr
