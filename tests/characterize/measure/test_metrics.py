"""Metrics against closed forms: oblong Gaussian beams off the middle, the Airy pattern,
slanted edges of a known blur.
"""

import math

import numpy as np
import pytest
from scipy import special

from characterize.measure import metrics
from metalens.core.errors import CaptureError

STEP = 0.4
X, Y = (np.arange(111) - 55) * STEP, (np.arange(91) - 45) * STEP


def gauss(sx, sy, angle=0.0):
    """An oblong Gaussian about (2.7, -1.9), its axes turned from +x to +y."""
    x, y = X - 2.7, Y[:, None] + 1.9
    u = x * math.cos(angle) + y * math.sin(angle)
    v = y * math.cos(angle) - x * math.sin(angle)
    return np.exp(-(u**2) / (2 * sx**2) - v**2 / (2 * sy**2))


def test_widths_of_a_round_beam_in_closed_form():
    found = metrics.measure_spot(gauss(1.7, 1.7), step_um=STEP)
    assert found.fwhm_um == pytest.approx(
        2 * 1.7 * math.sqrt(2 * math.log(2)), abs=0.01
    )
    assert found.ee80_um == pytest.approx(1.7 * math.sqrt(2 * math.log(5)), abs=0.02)
    assert found.d4sigma_um == pytest.approx((6.8, 6.8), abs=0.01)
    assert found.centroid_um == pytest.approx((2.7, -1.9), abs=1e-3)


@pytest.mark.parametrize("angle", [0.0, 0.5])
def test_an_oblong_beam_has_its_own_widths_and_encircled_energy(angle):
    spot = gauss(2.1, 1.3, angle)
    found = metrics.measure_spot(spot, step_um=STEP)
    assert found.d4sigma_um == pytest.approx((8.4, 5.2), rel=1e-3)
    # light within r of an oblong Gaussian, by quadrature over the angle
    u = np.linspace(0, 12, 12001)
    turn = (np.arange(360) + 0.5) * 2 * math.pi / 360
    decay = np.cos(turn) ** 2 / 2.1**2 + np.sin(turn) ** 2 / 1.3**2
    slope = np.exp(-(u[:, None] ** 2) * decay / 2).mean(1) * u
    share = np.cumsum(slope) / slope.sum()
    # samples cut by the rim
    assert found.ee80_um == pytest.approx(float(np.interp(0.8, share, u)), abs=0.03)
    radii = np.array([1.1, 2.3, 3.9])
    inside = metrics.encircled_energy(spot, step_um=STEP, radius_um=radii)
    assert inside == pytest.approx(np.interp(radii, u, share), abs=0.01)


def test_mtf_of_an_oblong_spot_along_each_axis():
    for axis, sigma in (("x", 2.1), ("y", 1.3)):
        found = metrics.mtf_of_psf(gauss(2.1, 1.3), step_um=STEP, axis=axis)
        want = np.exp(-2 * (math.pi * sigma * found.frequency_per_um) ** 2)
        assert found.modulation == pytest.approx(want, abs=1e-6)
        assert found.mtf50_per_um == pytest.approx(
            math.sqrt(math.log(2) / 2) / (math.pi * sigma), rel=2e-3
        )


def test_airy_mtf_and_width():
    """Of lambda N = 1: the MTF is 2 / pi (acos f - f sqrt(1 - f²)) up to 1 / um."""
    axis = (np.arange(129) - 64) / 4
    v = np.maximum(math.pi * np.hypot(axis, axis[:, None]), 1e-9)
    psf = (2 * special.j1(v) / v) ** 2
    found = metrics.mtf_of_psf(psf, step_um=0.25)
    f = np.minimum(found.frequency_per_um, 1)
    want = 2 / math.pi * (np.arccos(f) - f * np.sqrt(1 - f**2))
    assert abs(found.modulation - want).max() < 0.02  # rings outside the window
    assert found.mtf50_per_um == pytest.approx(0.404, abs=0.01)
    spot = metrics.measure_spot(psf, step_um=0.25)
    assert spot.fwhm_um == pytest.approx(1.029, abs=0.01)


def test_strehl_of_a_blurred_spot():
    ratio = metrics.strehl_ratio(gauss(3.4, 1.8), gauss(1.7, 1.5))
    assert ratio == pytest.approx(1.7 * 1.5 / (3.4 * 1.8), abs=1e-3)


def test_mtf50_is_where_it_falls_through_one_half():
    falling = metrics.EdgeMtf(
        np.array([0.0, 0.2, 0.5, 0.9]), np.array([1.0, 0.8, 0.3, 0.6])
    )
    assert falling.mtf50_per_um == pytest.approx(0.2 + 0.3 * 0.3 / 0.5)
    high = metrics.EdgeMtf(np.array([0.0, 0.2]), np.array([1.0, 0.8]))
    assert math.isnan(high.mtf50_per_um)


@pytest.mark.parametrize("is_transposed", [False, True])
@pytest.mark.parametrize("degrees", [-8.0, 5.0, 11.0])
def test_slanted_edge_gives_the_mtf_of_its_blur_and_pixel(degrees, is_transposed):
    """Blur and pixel of 0.37 um: modulation against frequency in 1/um, off the middle
    of the frame.
    """
    sigma, pixel, lean = 0.31, 0.37, math.radians(degrees)
    y, x = np.mgrid[:70, :84] - np.array([31.0, 47.0])[:, None, None]
    fine = (np.arange(9) - 4) / 9
    across = [x + a + (y + b) * math.tan(lean) for a in fine for b in fine]
    scale = math.cos(lean) * pixel / sigma
    edge = np.mean([special.ndtr(distance * scale) for distance in across], axis=0)
    image = 30 + 500 * (edge.T if is_transposed else edge)
    found = metrics.mtf_of_edge(image, pixel_um=pixel)
    f = found.frequency_per_um
    square = np.sinc(f * pixel * math.cos(lean)) * np.sinc(f * pixel * math.sin(lean))
    want = np.exp(-2 * (math.pi * f * sigma) ** 2) * abs(square)
    # bins and window
    assert abs(found.modulation - want)[f < 0.4 / pixel].max() < 0.02


def test_an_upright_edge_is_refused():
    with pytest.raises(CaptureError, match="tilted by"):
        metrics.mtf_of_edge(np.tile(np.arange(60) > 30, (60, 1)) * 1.0, pixel_um=1.0)


def test_efficiency_counts_aperture_and_exposures():
    image, reference = 3.0 * gauss(2.0, 2.0), np.full((91, 111), 0.7)
    inside = 1 - math.exp(-(2.6**2) / (2 * 2.0**2))
    want = inside * image.sum() / reference.sum() / 3.7
    found = metrics.focusing_efficiency(
        image, reference, step_um=STEP, aperture_um=5.2, exposure_ratio=3.7
    )
    assert found == pytest.approx(want, rel=0.01)


def test_no_light_is_refused():
    for measure in (metrics.measure_spot, metrics.mtf_of_psf):
        with pytest.raises(CaptureError, match="light"):
            measure(np.zeros((9, 9)), step_um=1.0)
