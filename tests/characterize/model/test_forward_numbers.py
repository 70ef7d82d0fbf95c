"""Numbers of the forward model that have a formula: the lines of a spectrum, the true place of a source."""

from types import SimpleNamespace

import numpy as np
import pytest

from characterize.model.forward import spectrum, true_depth
from characterize.model.parameters import vector


def test_lines_of_a_spectrum_have_the_moments_of_a_gaussian():
    """Five Gauss-Hermite nodes: moments to the ninth exact, here 1, 0, s², 0, 3 s⁴, 15 s⁶."""
    offset, weight = np.array(spectrum(2.7)).T
    for power, want in ((0, 1.0), (1, 0.0), (2, 2.7**2), (3, 0.0), (4, 3 * 2.7**4), (6, 15 * 2.7**6)):
        assert (weight * offset**power).sum() == pytest.approx(want, rel=1e-12, abs=1e-9)
    assert spectrum(0.0) == [(0.0, 1.0)]


def test_a_stage_is_off_by_its_zero_and_by_its_scale_about_its_middle():
    setting = SimpleNamespace(depth_um=np.array([21e3, 26e3, 34e3]))
    x = vector({"stage_zero_um": 310.0, "stage_scale": 0.013})
    assert true_depth(x, setting, 27e3) == pytest.approx([21e3 + 310 - 78, 26e3 + 310 - 13, 34e3 + 310 + 91])
    behind = true_depth(vector({"stage_zero_um": -20e3}), setting, 27e3)
    assert behind == pytest.approx([4.2e3, 6e3, 14e3])  # never nearer than a fifth of what was stated
