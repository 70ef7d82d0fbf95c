"""Killed at twenty random steps, a run ends in the same bytes as one that nobody
touched; two whole runs are equal.
"""

import os
import signal

import numpy as np
import pytest

from codesign.train import run

STEPS = """
preset = "smoke"
checkpoint_every = 3
[scenes]
pixels = 48
pool = 6
[inner]
steps = 60
batch = 2
[inner.optics]
rate = 0.02
start = 0.0
end = 0.9
[inner.pitch]
rate = 0.01
[optics]
image = "uniform"
aperture_mm = 0.3
sensor_distance_mm = 1.0
depth_count = 4
window_samples = 9
[optics.spread]
focus_um = 1.0
bias_nm = 3.0
"""


def _train(settings, path, die_at=None):
    """Train in a process of its own, from the checkpoint where there is one; whether it
    came to its end.
    """
    child = os.fork()
    if child == 0:
        going = (
            run.resume_run(path, settings) if path.exists() else run.start_run(settings)
        )
        for record in run.train_run(going, path):
            if die_at is not None and record.step >= die_at:
                os.kill(os.getpid(), signal.SIGKILL)
        os._exit(0)
    _, status = os.waitpid(child, 0)
    return os.WIFEXITED(status) and os.WEXITSTATUS(status) == 0


@pytest.mark.slow
def test_twenty_kills_at_random_steps_change_no_byte(tmp_path):
    (tmp_path / "run.toml").write_text(STEPS)
    settings = run.load_run_settings(tmp_path / "run.toml")
    assert _train(settings, tmp_path / "whole")
    assert _train(settings, tmp_path / "again")
    assert (tmp_path / "whole").read_bytes() == (tmp_path / "again").read_bytes()
    generator, reached = np.random.default_rng(0), 0
    for _ in range(20):
        reached += int(generator.integers(0, 3)) + 1
        assert not _train(settings, tmp_path / "killed", die_at=reached)
    assert _train(settings, tmp_path / "killed")
    assert (tmp_path / "killed").read_bytes() == (tmp_path / "whole").read_bytes()
