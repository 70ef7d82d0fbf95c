"""Derivatives from those of the field, beside differences of the images; and what they
rest on, by itself.
"""

import math
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.inference import leastsquares, residual
from characterize.inference.leastsquares import FitImages, SolverSettings
from characterize.model import forward, moments
from characterize.model.detector import DetectorGrid
from characterize.model.forward import ForwardModel, FrameSetting
from characterize.model.parameters import PLACE, parameter_vector
from characterize.model.window import derivative_operators
from metalens import design, profiles
from metalens.cell.record import Cell

BAND = 1.7
SECANT = SolverSettings(secant=True)
VALUES = {
    "bias_nm": 4.0, "bias_x_nm": 2.0, "height_nm": -8.0, "wavelength_nm": 0.4, "distance_um": 3.0,
    "decentre_x_um": 0.8, "stage_zero_um": 9.0, "coma_x_rad": 0.2, "spherical_rad": 0.15, "log_gain": 9.0,
}  # fmt: skip
STEPS = {
    "bias_nm": 0.1, "bias_x_nm": 0.1, "bias_r_nm": 0.1, "height_nm": 0.2, "wavelength_nm": 0.02, "distance_um": 0.05,
    "decentre_y_um": 0.02, "tilt_x_deg": 0.01, "stage_zero_um": 0.5, "stage_scale": 1e-4, "astigmatism_rad": 0.01,
    "coma_y_rad": 0.01, "trefoil_x_rad": 0.01, "light_x": 0.02,
}  # fmt: skip


def test_powers_of_the_direction_are_derivatives_of_the_field():
    """A wave of one direction t within the band: t^a times itself, to 3e-4; 24 samples
    1.3 times as fine as needed.
    """
    step = math.pi / BAND / 1.3
    coarse, fine = (np.arange(44) - 21.5) * step, np.linspace(-9.3, 8.1, 37)
    ways = derivative_operators(fine, coarse, BAND, 4)
    for t in (-0.93, 0.21, 0.77):
        for a, way in enumerate(ways):
            found = 1j ** (a % 2) * (way @ np.exp(1j * BAND * t * coarse))
            assert np.abs(found - t**a * np.exp(1j * BAND * t * fine)).max() < 3e-4


def lens():
    """150 um wide and NA 0.1, so that pixels of 1 um are small beside it."""
    focus = profiles.Focus(0.85, 700.0, 3000.0)
    phase = design.phase_of(None, focus, radius_um=75.0)
    return design.make(
        phase, focus, aperture_um=150.0, cell=Cell(pitch_um=0.5), proxy=b.proxy()
    )[0]


def test_derivatives_from_those_of_the_field_are_differences_of_images(monkeypatch):
    """Slopes are asked to 8e-3, factors to 5e-3 of themselves; coefficients change by
    1.3 % a pixel: 2e-2 in all.
    """
    monkeypatch.setattr(moments, "_COARSE_PIXEL", 0.02)
    angle = np.array([[0.0, 0.0], [0.0, 0.0], [0.02, -0.03]])
    setting = FrameSetting(
        np.array([2500.0, 3000.0, 3700.0]), angle, np.ones(3), 1.0, 40, 36
    )
    model = ForwardModel(lens(), setting, b.RESPONSE)
    x, names = parameter_vector(VALUES), list(STEPS)
    made, rates = [], moments.light_derivatives

    def counted(*given):
        made.append(rates(*given))
        return made[-1]

    monkeypatch.setattr(moments, "light_derivatives", counted)
    found = model.images(x, names)[1]
    assert len(made) == 2  # one for each angle
    assert {
        "bias_x_nm",
        "height_nm",
        "distance_um",
        "stage_zero_um",
        "coma_y_rad",
    } <= set(made[0])
    for name, slope in zip(names, found, strict=True):
        ends = []
        for sign in (1, -1):
            moved = x.copy()
            moved[PLACE[name]] += sign * STEPS[name]
            ends.append(model.images(moved)[0])
        want = (ends[0] - ends[1]) / (2 * STEPS[name])
        assert np.linalg.norm(slope - want) < 0.02 * np.linalg.norm(want), name


def test_pixels_are_small_while_coefficients_change_less_across_one_than_slopes_are_asked_to():
    """A pixel off, the middle of the lens is seen from another direction: by its sine,
    over that of the rim.
    """
    radius, distance = 510.0, 1030.0

    def changed(pixel):
        return (
            pixel
            / math.hypot(pixel, distance)
            / (radius / math.hypot(radius, distance))
        )

    pixels = np.linspace(0.5, 12.0, 400)
    small = [
        moments.fine_enough(DetectorGrid(32, 32, pixel, 4, 4), radius)
        for pixel in pixels
    ]
    most = max(changed(pixel) for pixel, one in zip(pixels, small, strict=True) if one)
    assert 0.7 * forward._SLOPE_TOLERANCE < most < forward._SLOPE_TOLERANCE


def test_a_fit_ends_where_one_with_slopes_of_their_own_does(monkeypatch):
    """Slopes wrong by e move an estimate by about e sigma, and its sigma by e or more
    where parameters go together.
    """
    model = ForwardModel(
        lens(),
        FrameSetting(
            np.array([2500.0, 3000.0, 3700.0]),
            np.zeros((3, 2)),
            np.ones(3),
            1.0,
            40,
            36,
        ),
        b.RESPONSE,
    )
    names = (
        "bias_nm", "bias_x_nm", "bias_r_nm", "distance_um", "decentre_x_um", "stage_zero_um", "astigmatism_rad",
        "coma_x_rad", "spherical_rad", "log_gain", "background_e",
    )  # fmt: skip
    truth = parameter_vector(VALUES)
    truth[PLACE["log_gain"]] += math.log(6000 / model.images(truth)[0].max())
    seen = model.images(truth)[0]
    seen = seen + np.random.default_rng(3).normal(0, np.sqrt(seen + 9))
    everywhere = np.ones(seen.shape, bool)
    data = FitImages(
        seen, everywhere, ~everywhere, np.full(seen.shape, 9.0), np.ones(seen.shape)
    )
    begin = truth[[PLACE[name] for name in names]] * np.where(
        np.array(names) == "log_gain", 1.0, 0.9
    )
    found = []
    for pixel in (0.02, 0.0):
        monkeypatch.setattr(moments, "_COARSE_PIXEL", pixel)
        found.append(
            leastsquares.fit_levenberg_marquardt(
                residual.residual_phase_problem(model, names, truth),
                data,
                begin,
                settings=SECANT,
            )
        )
    quick, alone = found
    sigma = np.sqrt(np.diag(alone.covariance))
    assert not np.array_equal(quick.slopes, alone.slopes)
    assert np.abs((quick.value - alone.value) / sigma).max() < 0.04
    assert np.sqrt(np.diag(quick.covariance)) == pytest.approx(sigma, rel=0.04)


def test_a_factor_that_is_no_polynomial_is_left_to_itself():
    t, s = np.random.default_rng(2).uniform(-1, 1, (2, 90))
    shapes = np.linalg.qr(
        np.stack([t**a * s**b for a, b in moments.monomial_powers(5)], -1)[None]
    )
    sharp, smooth = (t > 0.13).astype(complex)[None], (0.3 + 0.7j * s)[None]
    amounts = moments._amounts(shapes[0], [sharp, smooth])
    assert amounts[1] == pytest.approx(
        shapes[0].transpose(0, 2, 1) @ smooth.T, abs=1e-12
    )
    assert moments._fitted(shapes, sharp, amounts[0], np.zeros((1, 1)), 5e-3) is None
    degree, table = moments._fitted(shapes, smooth, amounts[1], (0.2j * t)[None], 5e-3)
    assert degree == 1
    assert table[0, :, 0] == pytest.approx([0.3, 0.2j, 0.7j], abs=1e-9)  # 1, t, s
