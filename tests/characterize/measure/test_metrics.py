"""Metrics against closed forms: Gaussian beams, the Airy pattern, a diffraction-limited
edge.
"""

import math

import numpy as np
import pytest
from scipy import special

from characterize.measure import metrics
from metalens.core.errors import CaptureError

STEP = 0.5
AXIS = (np.arange(129) - 64) * STEP


def gauss(sx, sy=None, angle=0.0, x0=0.0, y0=0.0):
    sy = sx if sy is None else sy
    x, y = AXIS[None] - x0, AXIS[:, None] - y0
    u = x * math.cos(angle) + y * math.sin(angle)
    v = -x * math.sin(angle) + y * math.cos(angle)
    return np.exp(-(u**2) / (2 * sx**2) - v**2 / (2 * sy**2))


def test_gaussian_widths_in_closed_form():
    found = metrics.measure_spot(gauss(3.0, x0=1.3, y0=-0.7), step_um=STEP)
    assert abs(found.fwhm_um - 2 * 3.0 * math.sqrt(2 * math.log(2))) < 0.01
    assert abs(found.ee80_um - 3.0 * math.sqrt(2 * math.log(5))) < 0.02
    assert abs(found.d4sigma_um[0] - 12) < 0.01
    assert np.allclose(found.centroid_um, (1.3, -0.7), atol=1e-3)


def test_d4sigma_follows_the_principal_axes():
    wide, narrow = metrics.measure_spot(
        gauss(4.0, 2.0, angle=0.5), step_um=STEP
    ).d4sigma_um
    assert abs(wide - 16) < 0.02
    assert abs(narrow - 8) < 0.02


def test_airy_mtf_and_strehl():
    radius_um = 1.22  # first zero; cut-off at 1 / um for lambda N = 1
    r = np.hypot(*np.meshgrid(AXIS / 2, AXIS / 2))
    v = np.maximum(math.pi * r, 1e-9)
    psf = (2 * special.j1(v) / v) ** 2
    found = metrics.mtf_of_psf(psf, step_um=STEP / 2)
    f = found.frequency_per_um
    want = np.where(
        f < 1,
        2
        / math.pi
        * (np.arccos(np.minimum(f, 1)) - f * np.sqrt(np.maximum(1 - f**2, 0))),
        0,
    )
    assert abs(found.modulation - want).max() < 0.02  # rings outside the window
    assert abs(found.mtf50_per_um - 0.404) < 0.01
    assert abs(metrics.strehl_ratio(psf, psf) - 1) < 1e-12
    assert metrics.measure_spot(psf, step_um=STEP / 2).fwhm_um == pytest.approx(
        1.029, abs=0.01
    )
    assert radius_um > 1


def test_strehl_of_a_blurred_spot():
    assert abs(metrics.strehl_ratio(gauss(4.0), gauss(2.0)) - 0.25) < 1e-3


def test_slanted_edge_gives_the_mtf_of_its_blur_and_pixel():
    sigma, n = 0.7, 80
    y, x = np.mgrid[:n, :n] - n / 2.0
    fine = (np.arange(9) - 4) / 9
    edge = np.zeros((n, n))
    for dx in fine:
        for dy in fine:
            edge += special.ndtr(
                ((x + dx) + (y + dy) * math.tan(math.radians(5)))
                * math.cos(math.radians(5))
                / sigma
            )
    for image in (edge / 81, edge.T / 81):
        found = metrics.mtf_of_edge(100 + 800 * image, pixel_um=1.0)
        f = found.frequency_per_um
        want = np.exp(-2 * (math.pi * f * sigma) ** 2) * np.abs(np.sinc(f))
        keep = f < 0.4
        assert abs(found.modulation - want)[keep].max() < 0.02
    with pytest.raises(CaptureError, match="tilted by"):
        metrics.mtf_of_edge(np.tile(np.arange(60) > 30, (60, 1)) * 1.0, pixel_um=1.0)


def test_efficiency_needs_its_aperture():
    image = gauss(2.0) * 60
    reference = np.full((129, 129), image.sum() * 2 / 129**2)
    radius = 2.0 * math.sqrt(2 * math.log(2))
    found = metrics.focusing_efficiency(
        image, reference, step_um=STEP, aperture_um=2 * radius
    )
    # half the light within the half-maximum circle, half the reference
    assert abs(found - 0.25) < 0.01


def test_through_focus_grows_with_defocus():
    widths = [
        metrics.measure_spot(gauss(s), step_um=STEP).d4sigma_um[0] for s in (2, 3, 4)
    ]
    assert np.allclose(widths, [8, 12, 16], atol=0.02)


def test_no_light_is_refused():
    with pytest.raises(CaptureError, match="light"):
        metrics.measure_spot(np.zeros((9, 9)), step_um=1.0)
    with pytest.raises(CaptureError, match="light"):
        metrics.mtf_of_psf(np.zeros((9, 9)), step_um=1.0)
