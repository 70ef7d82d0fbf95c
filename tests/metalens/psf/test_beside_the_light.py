"""Exact sums where little is left of them: windows beside the light, far away, phases
of many turns.
"""

import numpy as np
import pytest

from metalens import propagate, psf

LONG = np.longdouble
PITCH, WAVE = 0.43, 0.83


def summed(phase, level, case):
    """(y, x) light of sum 1 in extended precision, from the same places, one point
    after the other.
    """
    y, x = (v.astype(LONG) for v in case.pillars_um)
    x, y = (g[level != 0] for g in np.meshgrid(x, y))
    k = LONG(case.wavenumber)
    d = LONG(case.sensor_distance_um)
    inverse = LONG(case.inverse_depths_per_um[0])
    tx, ty = (LONG(t) for t in case.tangents)
    top = (x * x + y * y) * inverse + 2 * (x * tx + y * ty)
    steep = 1 + tx * tx + ty * ty
    given = phase[level != 0].astype(LONG) + k * top / (
        np.sqrt(top * inverse + steep) + np.sqrt(steep)
    )
    out = np.zeros(case.samples, LONG)
    for i, down in enumerate(case.window_um[0]):
        for j, across in enumerate(case.window_um[1]):
            away = (
                LONG(across + case.centre_um[0]) - x,
                LONG(down + case.centre_um[1]) - y,
            )
            r = np.sqrt(away[0] ** 2 + away[1] ** 2 + d * d)
            wave = level[level != 0] / r**2
            c, s = np.cos(k * r + given), np.sin(k * r + given)
            out[i, j] = (wave * (c / r + k * s)).sum() ** 2 + (
                wave * (s / r - k * c)
            ).sum() ** 2
    return (out / out.sum()).astype(float)


@pytest.mark.skipif(
    np.finfo(LONG).eps > 1e-18,
    reason="needs numbers longer than float64 to judge its rounding",
)
@pytest.mark.parametrize(
    ("distance", "offset", "turns"),
    [
        (21900.0, (-8700.0, 4100.0), 1),
        (8600.0, (0.0, 2.0), 1),
        (1760.0, (-700.0, 90.0), 40),
    ],
)
def test_the_error_of_an_exact_sum_beside_the_light_is_told(distance, offset, turns):
    about = dict(
        pitch_um=PITCH,
        wavelength_um=WAVE,
        sensor_distance_um=distance,
        depths_um=3e4,
        angle_rad=(0.2, -0.11),
    )
    about |= dict(window_um=4 * WAVE, samples=4, offset_um=offset)
    case = propagate.make_case((67, 61), **about)
    y, x = case.pillars_um
    level = (np.hypot(x, y[:, None]) < 13.0) * np.random.default_rng(5).uniform(
        0.5, 1, (67, 61)
    )
    phase = -case.wavenumber * np.sqrt(x**2 + y[:, None] ** 2 + 400.0**2) * turns / 10
    want = summed(phase, level, case)
    got = psf.psf_stack(phase, level, **about, integrate=False)
    assert got.reason.startswith("exact")
    error = np.linalg.norm(got.intensity[0] - want) / np.linalg.norm(want)
    assert error < got.error < 100 * error + 8e-12
    assert got.error < 1e-8
