"""Widths of an Airy disc on pixels against its closed forms, blurred by one pixel as a
sensor does.
"""

import numpy as np
import pytest
from scipy import special
from scipy.ndimage import uniform_filter

from characterize.measure import metrics

CUT_PER_UM, FINE = 2 * 0.21 / 0.85, 9  # 2 NA / wavelength; samples a pixel


def airy(r_um):
    v = np.pi * CUT_PER_UM * np.asarray(r_um) + 1e-12
    return np.pi * (CUT_PER_UM / 2) ** 2 * (2 * special.j1(v) / v) ** 2


def on_pixels(pixel_um, x_um, y_um):
    """Means over pixels of a disc off the middle, and the fine map, blurred by a pixel
    and centred, with its radii.
    """
    ny = round(73 / pixel_um) | 1
    nx = round(84 / pixel_um) | 1
    step = pixel_um / FINE
    y, x = ((np.arange(n * FINE) - (n * FINE - 1) / 2) * step for n in (ny, nx))
    shot = (
        airy(np.hypot(x[None] - x_um, y[:, None] - y_um))
        .reshape(ny, FINE, nx, FINE)
        .mean((1, 3))
        * pixel_um**2
    )
    side = np.arange(-6, 6 + step, step)
    radius = np.hypot(side[None], side[:, None])
    return shot, uniform_filter(airy(radius), FINE), radius, step


def test_encircled_energy_beyond_the_core_is_the_closed_form():
    """1 - J0² - J1² of 2 pi NA r / wavelength, over what the window holds; pixels blur
    rings alone.
    """
    shot = on_pixels(0.45, 0.31, -0.44)[0]
    r = np.array([4.0, 8.0, 16.0])
    v = np.pi * CUT_PER_UM * r
    got = metrics.encircled_energy(shot, step_um=0.45, radius_um=r) * shot.sum()
    assert got == pytest.approx(1 - special.j0(v) ** 2 - special.j1(v) ** 2, abs=2e-3)
