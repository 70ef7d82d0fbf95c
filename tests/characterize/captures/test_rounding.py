"""Counts coarser than their noise, against scipy's normal distribution, draws, and the
likelihood maximised by hand.
"""

import numpy as np
import pytest

from characterize.captures.rounding import DarkStatistics


@pytest.mark.parametrize(("level", "noise"), [(9.31, 0.13), (9.5, 0.21), (8.72, 0.27)])
def test_dark_level_and_noise_are_found_below_a_count(level, noise):
    rng = np.random.default_rng(3)
    true = level + 0.08 * rng.standard_normal((31, 27))
    found = DarkStatistics.of(np.rint(true + noise * rng.standard_normal((9, 31, 27))))
    off = found.level - true
    # 7500 draws, of which a sixth tell: 0.01
    assert found.noise == pytest.approx(noise, abs=0.025)
    # the mean of the counts is off by 0.1 to 0.27 but at 9.5
    assert abs(off.mean()) < 0.05
    assert off.std() < 1.25 * np.sqrt((found.error**2).mean())


def test_dark_frames_that_all_read_the_same_leave_the_level_open():
    counts = np.full((4, 9, 8), 7.0)
    counts[:, 3, 4] = 61.0  # a hot pixel stays as it reads
    found = DarkStatistics.of(counts)
    assert found.level[3, 4] == 61.0
    assert np.abs(np.delete(found.level, 3 * 8 + 4) - 7).max() < 0.1
    assert 0.05 < found.noise < 0.3
    assert 0.04 < found.error[0, 0] < 0.2
