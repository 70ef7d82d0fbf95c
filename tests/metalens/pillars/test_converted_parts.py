"""Which sizes a lens for circular light may use: far enough from resonances, and on the widest run that a fit meets."""

from types import SimpleNamespace

import numpy as np
import pytest

from metalens.pillars import converted
from metalens.pillars.fit import Data

SIZES = np.linspace(0.1, 0.2, 101)


def test_sizes_within_two_half_widths_of_a_sharp_resonance_are_left_out():
    """Of half-widths 2.2 and 0.6 nm where 3 nm are the least, each to either side; broad ones are smooth."""
    rows = np.array([[0, 0.0, 0.85, 0.1303, 2.2e-3], [1, 0.0, 0.85, 0.1652, 0.6e-3], [0, 0.0, 0.85, 0.18, 3.1e-3]])
    near = converted._sharp(SimpleNamespace(diameter_um=SIZES, resonances=rows), 3e-3)
    want = (np.abs(SIZES - 0.1303) <= 4.4e-3) | (np.abs(SIZES - 0.1652) <= 1.2e-3)
    assert near.tolist() == want.tolist()
    assert (near[:40].sum(), near[40:].sum()) == (9, 2)


def test_the_run_shrinks_about_the_best_size_until_the_fit_meets_its_tolerance():
    """A straight phase up to 0.16 um and a step of a radian there: runs about 0.14 that reach it are not met."""
    phase = 30 * (SIZES - 0.1) + (SIZES > 0.1605)
    data = Data(phase[None, None], np.ones((1, 1, 101)), SIZES, np.array([0.85]), np.zeros(1))
    wanted = SimpleNamespace(coefficients=4, phase_tolerance_rad=1e-3, transmission_tolerance=1e-2)
    proxy = converted._widest(data, 40, wanted)
    low, high = proxy.domain_um
    assert high <= 0.1605
    assert (low + high) / 2 == pytest.approx(0.14, abs=1e-9)
    assert high - 0.14 > 0.9 * 0.02 - 2e-3  # a tenth less at a time
    assert proxy.max_phase_error_rad < 1e-3
    never = SimpleNamespace(coefficients=4, phase_tolerance_rad=-1.0, transmission_tolerance=1e-2)
    low, high = converted._widest(data, 40, never).domain_um
    assert round((high - low) / 1e-3) + 1 in (12, 13)  # the least that is fitted
