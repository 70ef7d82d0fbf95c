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


@pytest.mark.parametrize(
    ("pixel_um", "fwhm", "ee80"), [(0.9, 0.06, 0.09), (0.45, 0.004, 0.02)]
)
def test_widths_are_those_of_the_light_on_pixels_and_wider_by_what_a_pixel_is_taken_as_even(
    pixel_um, fwhm, ee80
):
    """Of twelve places on the pixels the widest errors: 5.5 and 8.2 % at 2.3 pixels a
    FWHM, 0.3 and 1.95 % at 4.6.
    """
    shot, seen, radius, step = on_pixels(pixel_um, 0.31, -0.44)
    found = metrics.measure_spot(shot, step_um=pixel_um)
    middle = seen[len(seen) // 2]
    half = 2 * np.interp(
        -middle.max() / 2,
        -middle[len(middle) // 2 :],
        radius[len(middle) // 2, len(middle) // 2 :],
    )
    order = np.argsort(radius, axis=None)
    held = np.cumsum(seen.ravel()[order]) * step**2
    wanted = np.interp(0.8 * shot.sum(), held, radius.ravel()[order])
    assert 0 <= found.fwhm_um / half - 1 < fwhm
    assert 0 <= found.ee80_um / wanted - 1 < ee80
    assert found.centroid_um == pytest.approx(
        (0.31, -0.44), abs=0.02
    )  # rings that the window's edge cuts


def test_encircled_energy_beyond_the_core_is_the_closed_form():
    """1 - J0² - J1² of 2 pi NA r / wavelength, over what the window holds; pixels blur
    rings alone.
    """
    shot = on_pixels(0.45, 0.31, -0.44)[0]
    r = np.array([4.0, 8.0, 16.0])
    v = np.pi * CUT_PER_UM * r
    got = metrics.encircled_energy(shot, step_um=0.45, radius_um=r) * shot.sum()
    assert got == pytest.approx(1 - special.j0(v) ** 2 - special.j1(v) ** 2, abs=2e-3)
