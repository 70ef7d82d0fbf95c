"""What all pillars answer, by compiled loops: against the series of the proxy summed by
numpy.
"""

import math

import numpy as np
import pytest
from numpy.polynomial import chebyshev

from metalens.cell import Cell, Index
from metalens.lens import DiameterMap, Lens, response
from metalens.library import Proxy

DRAW = np.random.default_rng(17)
# angle, wavelength, diameter
SERIES = np.round(DRAW.normal(size=(3, 2, 5)), 2) * np.array([5.0, 3.0, 1.5, 0.7, 0.2])
LEVEL = np.array([[[0.72, 0.1, -0.05]], [[-0.06, 0.03, 0.02]]])
PROXY = Proxy(
    SERIES, LEVEL, (0.09, 0.31), (0.80, 0.93), 0.0, 0.0, power=3, max_angle_rad=0.4
)
WAVE, TILT = 0.871, 0.23


def lens(
    rows=7, columns=1100, proxy=PROXY
):  # more columns than a loop takes at once, and no whole number of parts
    sizes = DRAW.uniform(0.09, 0.31, (rows, columns)) * (
        DRAW.random((rows, columns)) > 0.2
    )
    return Lens(
        DiameterMap(sizes, 0.4),
        Cell(0.4, 0.7, Index(3.6), "SiO2"),
        proxy,
        0.85,
        300.0,
        math.inf,
        "map",
    )


def series(coefficients, d):
    """Eq. 2 at WAVE and TILT, by numpy's own sums."""
    a, b = PROXY.domain_um
    x = (2 * d**3 - a**3 - b**3) / (b**3 - a**3)
    angle = 2 * (math.sin(TILT) / math.sin(0.4)) ** 2 - 1
    wave = (2 * WAVE - 0.80 - 0.93) / (0.93 - 0.80)
    return chebyshev.chebval(
        x, chebyshev.chebval(wave, chebyshev.chebval(angle, np.asarray(coefficients)))
    )


@pytest.mark.parametrize(
    ("dtype", "most"), [(np.float32, 4e-7), (np.float64, 1e-13)]
)  # a few digits of π
def test_phase_and_transmission_are_the_series_wrapped(dtype, most):
    made = lens()
    d = made.diameters.diameter_um
    phase, level = (np.full(d.shape, 7.7, dtype) for _ in range(2))
    response.fill_response(made, (WAVE, TILT), phase, level)
    lit = d > 0
    want = np.exp(1j * series(SERIES, d))
    assert np.abs(np.exp(1j * phase.astype(float)) - want)[lit].max() < most
    assert np.abs(phase).max() <= np.pi * (1 + 1e-7)
    assert np.abs(level - series(LEVEL, d))[lit].max() < most
    assert not phase[~lit].any()
    assert not level[~lit].any()
