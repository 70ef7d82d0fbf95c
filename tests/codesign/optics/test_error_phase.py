"""Phases of a lens assembled wrong: by the paths of light, and how much light the haze
takes.
"""

import dataclasses
import math

import numpy as np
import pytest
import torch

from codesign.optics import lens_errors
from codesign.optics import stack as optics
from codesign.optics.lens_errors import DrawnLensErrors
from metalens.cell import Incidence, Index
from metalens.image.pupil import coordinates
from metalens.library import DEFAULT_CELL, workers

SETTINGS = optics.OpticsConfig()
BARE, NONE = dataclasses.replace(SETTINGS, polynomials=0), torch.zeros(0)


def phase(**amounts):
    """Over the lens, with its places in units of its radius."""
    x, y = (c.double() / SETTINGS.pupil.radius_um for c in coordinates(SETTINGS.pupil))
    inside, rim = torch.hypot(x, y) <= 1, SETTINGS.pupil.radius_um
    error = DrawnLensErrors(amounts)
    return (
        optics.phase_at(BARE, NONE, x * rim, y * rim, error=error)[inside],
        x[inside],
        y[inside],
    )


def test_a_sensor_too_far_is_the_change_of_the_path_to_it():
    """k (sqrt(r² + z²) - z) at z + 13 um less that at z; the quadratic of it errs by
    (3/4) (r/z)² of itself.
    """
    got, x, y = phase(focus_um=13.0)
    r2 = (x**2 + y**2) * SETTINGS.pupil.radius_um**2
    z = SETTINGS.pupil.sensor_distance_um
    path = [r2 / (torch.sqrt(r2 + d**2) + d) for d in (z, z + 13.0)]
    want = 2 * math.pi / SETTINGS.pupil.wavelength_um * (path[1] - path[0])
    steep = (SETTINGS.pupil.radius_um / z) ** 2
    assert float((got - want).abs().max()) < (0.8 * steep + 1.2 * 13 / z) * float(
        want.abs().max()
    )
    assert float(want.abs().max()) > 1e-2


def test_tilt_and_astigmatism_are_waves_at_the_rim():
    got, x, y = phase(tilt_waves=0.3)
    assert torch.allclose(got, 2 * math.pi * 0.3 * (x**2 + y**2) * x)
    got, x, y = phase(astigmatism_waves=-0.2)
    assert torch.allclose(got, -2 * math.pi * 0.2 * (x**2 - y**2))


def test_haze_takes_the_share_of_marechal_and_spreads_it_over_the_shadow():
    light = torch.rand(2, 5, 5, dtype=torch.float64)
    got = optics.scatter_loss(SETTINGS, light, 0.31)
    kept = math.exp(-0.31)
    haze = (
        (1 - kept)
        * SETTINGS.sample_um**2
        / (math.pi * (1e3 * SETTINGS.aperture_mm / 2) ** 2)
    )
    assert torch.allclose(got, kept * light + haze)


def test_variance_of_a_bowed_bias_by_plain_quadrature():
    """c00 <b²> + 2 <b> c0·a + a·c·a over the disc, the means by rings of equal area."""
    state = DrawnLensErrors(
        {"bias_nm": 2.3, "gradient_nm": 3.1, "bow_nm": -1.7, "height_nm": 4.0}, 0.7
    ).state()
    radius = np.sqrt((np.arange(400) + 0.5) / 400)[:, None]
    turn = 2 * np.pi * np.arange(64) / 64
    bias = state.bias_um(radius * np.cos(turn), radius * np.sin(turn))
    c, answers = SETTINGS.phase_rates.covariance, state.response_amounts()
    want = (
        c[0, 0] * (bias**2).mean()
        + 2 * bias.mean() * c[0, 1:] @ answers
        + answers @ c[1:, 1:] @ answers
    )
    assert lens_errors.variance_rad2(state, SETTINGS.phase_rates) == pytest.approx(
        want, rel=1e-4
    )  # rings: 1 / 400² of the curvature


def test_a_wave_front_bends_by_what_the_bias_differs_from_that_on_the_axis():
    """By the mean of d phase / d diameter over a turn of phases, here the turn over the
    range that it takes.
    """
    state = DrawnLensErrors(
        {"bias_nm": 6.0, "gradient_nm": 3.1, "bow_nm": -1.7}, 0.7
    ).state()
    u = torch.tensor([0.0, 0.8, -0.3], dtype=torch.float64)
    v = torch.tensor([0.0, 0.1, 0.55], dtype=torch.float64)
    turn = SETTINGS.proxy.phase_rad
    lens = np.linspace(*SETTINGS.proxy.domain_um, 40_001)
    phase = np.asarray(turn(lens, 0.85))
    inside = phase - phase[0] <= 2 * math.pi
    rate = np.gradient(phase, lens)[inside]
    # phases fill the turn evenly
    mean = np.trapezoid(rate, phase[inside]) / (2 * math.pi)
    bias = state.bias_um(u.numpy(), v.numpy())
    got = lens_errors.wave_front_rad(state, u, v, SETTINGS.phase_rates).numpy()
    assert got[0] == pytest.approx(0, abs=1e-12)
    # 400 phases of the turn
    assert got == pytest.approx(mean * (bias - bias[0]), rel=0.01, abs=1e-12)


@pytest.mark.parametrize(
    ("height_um", "pitch_um", "wavelength_nm"),
    [(None, None, 850.0), pytest.param(1.1, 0.4, 940.0, marks=pytest.mark.slow)],
)
def test_taller_pillars_turn_in_proportion_to_the_phase_that_they_have(
    height_um, pitch_um, wavelength_nm
):
    """phase = k n_eff h: a height off by d turns each by d / h of its phase. Phases
    fill a turn evenly, so about what
    they share they scatter by 2π / √12 of d / h (400 phases of the turn: 0.3 %). Of the
    lens's own cell: a lower one turns more."""
    settings = SETTINGS
    if height_um is not None:
        cell = dataclasses.replace(
            DEFAULT_CELL,
            pitch_um=pitch_um,
            height_um=height_um,
            pillar=Index(3.7),
            substrate=Index(1.45),
        )
        settings = dataclasses.replace(SETTINGS, cell=cell, wavelength_nm=wavelength_nm)
    state = DrawnLensErrors({"height_nm": 8.0}).state()
    want = (2 * math.pi / math.sqrt(12) * 8e-3 / settings.cell.height_um) ** 2
    got = lens_errors.variance_rad2(state, settings.phase_rates)
    assert got == pytest.approx(want, rel=0.01)


def test_the_phases_that_training_takes_are_those_of_the_solver():
    """The fit's 1e-3 rad and the solver's 1e-4 over the diameters that training looks
    at, both ends among them.
    """
    low, high = SETTINGS.proxy.domain_um
    solve = workers.solver_at_common_discretization(
        DEFAULT_CELL, Incidence(0.85), (low, high), tolerance=1e-3, engine="modal"
    )
    diameter = low + (high - low) * np.array([0.0, 0.11, 0.31, 0.5, 0.73, 0.9, 1.0])
    told = np.exp(1j * np.asarray(SETTINGS.proxy.phase_rad(diameter, 0.85)))
    assert np.abs(np.angle([solve(float(d)).t for d in diameter] / told)).max() < 1.1e-3
