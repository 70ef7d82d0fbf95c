"""Transfer functions over the field: against squared plane-wave fields and a closed
form.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

from metalens.aberrations import over_field
from tests.metalens.aberrations.hyperbolic import CASES, PITCH, WAVE, made

PER_UM = np.array([0.031, 0.077, 0.19, 0.33])
K = 2 * math.pi / WAVE


def _squared(case, angle, sensor_um, frequencies):
    """Own plane waves on a lattice three times as wide, squared in space: (2,
    frequencies) MTF of all light; in air, without a stop.
    """
    rays, depth = CASES[case]
    lens = made(case)
    phase = lens.phase_rad()
    level = (lens.diameters.diameter_um > 0).astype(float)
    place, n = lens.diameters.x_um, 3 * len(lens.diameters.x_um)
    x, y = np.meshgrid(place, place)
    if math.isinf(depth):
        come = x * math.sin(math.radians(angle))
    else:
        sx, sy = rays.source(angle, depth)
        come = np.sqrt((x - sx) ** 2 + (y - sy) ** 2 + depth**2)
    f = np.fft.fftfreq(n, PITCH)
    along = WAVE**-2 - f**2 - f[:, None] ** 2
    goes = np.exp(2j * np.pi * sensor_um * np.sqrt(np.maximum(along, 0.0))) * (
        along > 0
    )
    light = (
        np.abs(
            np.fft.ifft2(
                np.fft.fft2(level * np.exp(1j * (phase + K * come)), (n, n)) * goes
            )
        )
        ** 2
    )
    lines = light.sum(0), light.sum(1)
    at = np.arange(n) * PITCH
    mtf = [
        [abs(line @ np.exp(-2j * np.pi * v * at)) / level.sum() for v in frequencies]
        for line in lines
    ]
    return np.array(mtf)


@pytest.mark.parametrize(
    ("case", "angle", "sensor_um"),
    [("plain", 0.0, 287.0), ("plain", 14.0, 310.0), ("off-centre", -9.0, 287.0)],
)
def test_transfer_is_that_of_the_squared_field(case, angle, sensor_um):
    """Frequencies off the lattice of either; what is left is light that zone borders
    scatter, which comes back over the lattice's ends there.
    """
    lens = replace(made(case), sensor_distance_um=sensor_um)
    want = _squared(case, angle, sensor_um, PER_UM)
    found = over_field(
        lens, (angle,), depth_um=CASES[case][1], frequencies=tuple(1e3 * PER_UM)
    )
    assert found.mtf[0] == pytest.approx(want, abs=3e-3)
    assert 0.97 < found.window_share[0] <= 1.0


def test_an_even_round_pupil_has_the_transfer_function_of_the_books():
    """(2/π)(arccos s - s √(1 - s²)), s = ν λ / 2 NA, of all the light that is not
    scattered by zone borders (0.8 %); rays of this lens are even over directions to
    NA²/2 = 0.02 at the rim, most of which the edge of s² has.
    """
    share = np.array([0.07, 0.21, 0.4, 0.66, 0.9, 1.04])
    cutoff = 2e3 * 62.0 / math.hypot(62.0, 310.0) / WAVE
    below = share.clip(0, 1)
    want = 2 / math.pi * (np.arccos(below) - below * np.sqrt(1 - below**2))
    found = over_field(
        made("plain"), (0.0,), depth_um=math.inf, frequencies=tuple(share * cutoff)
    )
    assert found.mtf[0, 0] == pytest.approx(want, abs=0.015)
    assert found.mtf[0, 1, -1] < 0.01
