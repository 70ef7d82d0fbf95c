"""How far apart in delay the pillars of a lens are for a diode: slopes of their phase
over the wave number.
"""

import math

import numpy as np
import pytest

from metalens.cell import Cell, Index
from metalens.lens import DiameterMap, Lens
from metalens.library import Proxy
from metalens.psf import Source, of_lens

PHASE = np.array([[0.0, 1.15 * math.pi], [-0.4, -1.9]])
PROXY = Proxy(PHASE, np.array([[0.85, 0.05]]), (0.08, 0.22), (0.80, 0.90), 0.0, 0.0)


def test_delays_are_slopes_of_phase_over_wave_number_of_pillars_that_are_there():
    """d phase / d k by differences twenty times as wide, at the middle of a Gaussian
    and 1.645 sigma to both sides.
    """
    size = np.random.default_rng(7).uniform(0.16, 0.21, (12, 9))
    size[3, 4] = size[7, 1] = 0.0  # whose delay of 0 would be farthest from the others
    lens = Lens(
        DiameterMap(size, 0.3),
        Cell(0.3, 0.7, Index(3.6)),
        PROXY,
        0.85,
        200.0,
        math.inf,
        "map",
    )
    there, want = size[size > 0], []
    for off in (-1.645, 0.0, 1.645):
        middle = 0.845 + off * 0.02 / 2.3548
        low, high = middle * (1 - 2e-3), middle * (1 + 2e-3)
        turn = PROXY.phase_rad(there, low) - PROXY.phase_rad(there, high)
        delay = turn / (2 * np.pi) / (1 / low - 1 / high)
        assert (np.sign(delay) == np.sign(delay[0])).all()
        want.append(np.ptp(delay))
    found = of_lens._delay_um(lens, (0.0, 0.0), Source(845.0, 20.0))
    assert found == pytest.approx(
        max(want), rel=5e-3
    )  # sigmas of a spectrum in steps, 1 % of a delay's change
