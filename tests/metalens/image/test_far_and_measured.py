"""Scenes that reach to infinity, and spectra as measured, against plane waves and the
diode that a curve samples.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from metalens.core.errors import SceneError
from metalens.design import Focus
from metalens.image import Frames, Grid, Optics, SmoothWave, imager, plan
from metalens.optics import Layers
from metalens.psf import Source, spectrum
from tests.referees.true_image import Referee

DISTANCE, RADIUS, STEP, WINDOW = 240.0, 50.0, 4.8, 15
WAVE = SmoothWave(Focus(0.85, DISTANCE, math.inf), RADIUS)
DIODE = Source(850.0, 60.0)


def frames(grid, points, depth_um):
    """One far sheet, dark but for (row, column, light)."""
    rows, columns = (n + 2 * grid.margin for n in grid.samples)
    light = torch.zeros(1, 2, rows, columns)
    for row, column, level in points:
        light[0, 1, row, column] = level
    cover = torch.cat(
        [torch.zeros(1, 1, rows, columns), torch.ones(1, 1, rows, columns)], 1
    )
    return Frames(light, cover, torch.full_like(light, depth_um))


def test_points_at_infinity_lie_where_and_are_as_bright_as_plane_waves_make_them():
    """A scene from 4 mm to infinity; a lens for infinity. The referee's source lies 1e6
    lens distances away.
    """
    grid = Grid((9, 7), STEP, (4e3, math.inf), margin=WINDOW // 2, window=WINDOW)
    made = imager(WAVE, grid, field=(0.15, -0.08), tolerance=1e-2)
    assert float(made.plan.depths_um[-1]) == math.inf
    points = [(9, 11, 7.3), (14, 8, 2.1)]
    got = made(frames(grid, points, math.inf))[0].double().numpy()
    judge = Referee(
        radius=RADIUS,
        distance=DISTANCE,
        focus=1e9,
        design_wavelength=0.85,
        fine=0.6,
        count=256,
    )
    light = np.zeros((9 + 14, 7 + 14))
    for row, column, level in points:
        light[row, column] = level
    middle = DISTANCE * math.tan(0.15), DISTANCE * math.tan(-0.08)
    about = {"step": STEP, "window": WINDOW, "waves": [(0.85, 1.0)], "middle": middle}
    want = judge.image(light, np.full_like(light, 1e9), **about)[7:-7, 7:-7]
    # points hold more of the fine detail than the texture of the stated error
    assert np.linalg.norm(got - want) / np.linalg.norm(want) < 2.5 * made.error
    np.testing.assert_allclose(
        got, made(frames(grid, points, 1e12))[0].numpy(), rtol=1e-5, atol=1e-6
    )


def waves(source, tolerance):
    grid = Grid((9, 7), STEP, (3e3, 9e3), margin=3, window=WINDOW)
    return plan.waves_of(
        Optics(WAVE, Layers(), DISTANCE),
        grid,
        source,
        (30.0, -20.0),
        grid.half_um,
        tolerance,
    )


def test_a_measured_curve_gets_the_wavelengths_of_the_diode_it_samples():
    """The same points and shares; what a curve leaves out beside the known range is
    added to the error, or refused.
    """
    curve = spectrum.MeasuredSpectrum(*spectrum.spectral_weight(DIODE))
    want, got = waves(DIODE, 5e-3), waves(curve, 5e-3)
    np.testing.assert_array_equal(got.wavelengths_um, want.wavelengths_um)
    np.testing.assert_array_equal(got.weights, want.weights)
    assert len(want.weights) > 1
    cut = waves(replace(curve, outside=1e-3), 5e-3)
    assert cut.error == pytest.approx(want.error + 1e-3)
    with pytest.raises(SceneError, match="wavelengths leave"):
        waves(replace(curve, outside=6e-3), 5e-3)
