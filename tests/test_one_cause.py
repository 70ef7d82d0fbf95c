"""A cause is one row of a table: a new one arrives in fit, mask study, budget, training
and correction.
"""

import subprocess
import sys
from pathlib import Path

READERS = ["fit", "mask_study", "budget", "training", "correction"]


def test_a_new_row_arrives_in_all_five():
    script = Path(__file__).with_name("one_cause.py")
    # -P: the tests' folders mirror the packages' and must not be taken for them
    done = subprocess.run(
        [sys.executable, "-P", str(script)], capture_output=True, text=True, check=False
    )
    assert done.stdout.split() == READERS, done.stderr[-3000:]
