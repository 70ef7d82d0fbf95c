"""Commands that are killed, run twice at once or out of room, a few of each;
``benchmarks.hardness`` does hundreds.
"""

import os
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

POINTS = """
from benchmarks._hardness_points import Sweep
from benchmarks._hardness_runs import bench
with bench(("export",)) as made:
    made.prepare()
    for number in (0, 1) if made.fills else ():
        sweep = Sweep(made, "export", number, fresh=number == 1)
        sweep.run()
        assert sweep.counts["kills"] > 50, sweep.counts
        print(*sweep.found.items(), sep="\\n", end="")
"""


@pytest.mark.slow
@pytest.mark.parametrize("code", [STRIKE, POINTS], ids=["drawn", "every_operation"])
def test_nothing_is_mixed_lost_or_left(tmp_path, code):
    root, told = (
        Path(__file__).parents[2],
        os.environ | {"XDG_CACHE_HOME": str(tmp_path), "OMP_NUM_THREADS": "1"},
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=root,
        env=told,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout) == (0, ""), done.stderr
