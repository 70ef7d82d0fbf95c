"""Metrics at unlike widths, pixels that are not 1, unlike exposures: what a swapped
axis or a lost factor changes.
"""

import math

import numpy as np
import pytest
from scipy import special

from characterize.measure import metrics

STEP = 0.4
X, Y = (np.arange(111) - 55) * STEP, (np.arange(91) - 45) * STEP


def gauss(sx, sy, x0=0.0, y0=0.0):
    return np.exp(-((X - x0) ** 2) / (2 * sx**2) - (Y[:, None] - y0) ** 2 / (2 * sy**2))


def test_mtf_of_an_oblong_spot_along_each_axis():
    spot = gauss(2.1, 1.3, x0=2.7, y0=-1.9)
    for axis, sigma in (("x", 2.1), ("y", 1.3)):
        found = metrics.mtf_of_psf(spot, step_um=STEP, axis=axis)
        want = np.exp(-2 * (math.pi * sigma * found.frequency_per_um) ** 2)
        assert found.modulation == pytest.approx(want, abs=1e-6)
        assert found.mtf50_per_um == pytest.approx(
            math.sqrt(math.log(2) / 2) / (math.pi * sigma), rel=2e-3
        )


def test_mtf50_is_where_it_falls_through_one_half():
    falling = metrics.EdgeMtf(
        np.array([0.0, 0.2, 0.5, 0.9]), np.array([1.0, 0.8, 0.3, 0.6])
    )
    assert falling.mtf50_per_um == pytest.approx(0.2 + 0.3 * 0.3 / 0.5)
    assert math.isnan(
        metrics.EdgeMtf(np.array([0.0, 0.2]), np.array([1.0, 0.8])).mtf50_per_um
    )


@pytest.mark.parametrize("degrees", [-8.0, 11.0])
def test_edge_of_either_lean_on_pixels_of_their_own_size(degrees):
    """Blur and pixel of 0.37 um steps: modulation against frequency in 1/um, off the
    middle of the frame.
    """
    sigma, pixel, lean = 0.31, 0.37, math.radians(degrees)
    y, x = np.mgrid[:70, :84] - np.array([31.0, 47.0])[:, None, None]
    fine = (np.arange(9) - 4) / 9
    edge = np.mean(
        [
            special.ndtr(
                ((x + a) + (y + b) * math.tan(lean)) * math.cos(lean) * pixel / sigma
            )
            for a in fine
            for b in fine
        ],
        axis=0,
    )
    found = metrics.mtf_of_edge(30 + 500 * edge, pixel_um=pixel)
    f = found.frequency_per_um
    want = np.exp(-2 * (math.pi * f * sigma) ** 2) * abs(
        np.sinc(f * pixel * math.cos(lean)) * np.sinc(f * pixel * math.sin(lean))
    )
    # bins and window, as of the upright case
    assert abs(found.modulation - want)[f < 0.4 / pixel].max() < 0.025


def test_spot_of_an_oblong_beam_off_the_middle():
    found = metrics.measure_spot(gauss(2.1, 1.3, x0=2.7, y0=-1.9), step_um=STEP)
    assert found.centroid_um == pytest.approx((2.7, -1.9), abs=1e-3)
    assert found.d4sigma_um == pytest.approx((8.4, 5.2), rel=1e-3)
    # light within r of an oblong Gaussian, by quadrature over the angle
    u = np.linspace(0, 12, 60001)
    angle = (np.arange(360) + 0.5) * 2 * math.pi / 360
    slope = (
        np.exp(
            -(u[:, None] ** 2)
            * (np.cos(angle) ** 2 / 2.1**2 + np.sin(angle) ** 2 / 1.3**2)
            / 2
        )
    ).mean(1) * u
    share = np.cumsum(slope) / slope.sum()
    # samples cut by the rim
    assert found.ee80_um == pytest.approx(float(np.interp(0.8, share, u)), abs=0.03)
    radii = np.array([1.1, 2.3, 3.9])
    inside = metrics.encircled_energy(
        gauss(2.1, 1.3, x0=2.7, y0=-1.9), step_um=STEP, radius_um=radii
    )
    assert inside == pytest.approx(np.interp(radii, u, share), abs=0.01)


def test_efficiency_counts_exposures():
    image, reference = 3.0 * gauss(2.0, 2.0), np.full((91, 111), 0.7)
    inside = 1 - math.exp(-(2.6**2) / (2 * 2.0**2))
    want = inside * image.sum() / reference.sum() / 3.7
    found = metrics.focusing_efficiency(
        image, reference, step_um=STEP, aperture_um=5.2, exposure_ratio=3.7
    )
    assert found == pytest.approx(want, rel=0.01)
