"""Phases of a lens assembled wrong: by the paths of light, and how much light the haze takes."""

import math

import numpy as np
import pytest
import torch

from codesign.optics import lens_errors
from codesign.optics import stack as optics
from codesign.optics.lens_errors import LensError

SETTINGS = optics.OpticsConfig()


def phase(**amounts):
    """Over the lens, with its places in units of its radius."""
    x, y = (c.double() / SETTINGS.pupil.radius_um for c in (optics._seen(SETTINGS).x_um, optics._seen(SETTINGS).y_um))
    inside = torch.hypot(x, y) <= 1
    return optics._error_phase(SETTINGS, LensError(amounts))[inside], x[inside], y[inside]


def test_a_sensor_too_far_is_the_change_of_the_path_to_it():
    """k (sqrt(r² + z²) - z) at z + 13 um less that at z; the quadratic of it errs by (3/4) (r/z)² of itself."""
    got, x, y = phase(focus_um=13.0)
    r2, z = (x**2 + y**2) * SETTINGS.pupil.radius_um**2, SETTINGS.pupil.sensor_distance_um
    path = [r2 / (torch.sqrt(r2 + d**2) + d) for d in (z, z + 13.0)]
    want = 2 * math.pi / SETTINGS.pupil.wavelength_um * (path[1] - path[0])
    steep = (SETTINGS.pupil.radius_um / z) ** 2
    assert float((got - want).abs().max()) < (0.8 * steep + 1.2 * 13 / z) * float(want.abs().max())
    assert float(want.abs().max()) > 1e-2


def test_tilt_and_astigmatism_are_waves_at_the_rim():
    got, x, y = phase(tilt_waves=0.3)
    assert torch.allclose(got, 2 * math.pi * 0.3 * (x**2 + y**2) * x)
    got, x, y = phase(astigmatism_waves=-0.2)
    assert torch.allclose(got, -2 * math.pi * 0.2 * (x**2 - y**2))


def test_haze_takes_the_share_of_marechal_and_spreads_it_over_the_shadow():
    light = torch.rand(2, 5, 5, dtype=torch.float64)
    got = optics.hazy(SETTINGS, light, 0.31)
    kept = math.exp(-0.31)
    haze = (1 - kept) * SETTINGS.sample_um**2 / (math.pi * (1e3 * SETTINGS.aperture_mm / 2) ** 2)
    assert torch.allclose(got, kept * light + haze)


def test_variance_of_a_bowed_bias_by_plain_quadrature():
    """c00 <b²> + 2 <b> c0·a + a·c·a over the disc, the means by rings of equal area."""
    state = LensError({"bias_nm": 2.3, "gradient_nm": 3.1, "bow_nm": -1.7, "height_nm": 4.0}, 0.7).state()
    radius = np.sqrt((np.arange(400) + 0.5) / 400)[:, None]
    turn = 2 * np.pi * np.arange(64) / 64
    bias = state.bias_um(radius * np.cos(turn), radius * np.sin(turn))
    c, answers = lens_errors._answers()[1], state.answers()
    want = c[0, 0] * (bias**2).mean() + 2 * bias.mean() * c[0, 1:] @ answers + answers @ c[1:, 1:] @ answers
    assert lens_errors.variance_rad2(state) == pytest.approx(want, rel=1e-4)  # rings: 1 / 400² of the curvature
