"""How a tolerance is shared between sums and the integration over cells, and when cells
are made finer.
"""

import math

import numpy as np
import pytest

from metalens import psf
from metalens.psf import direction

PITCH, WAVELENGTH, DISTANCE = 0.3, 0.85, 19.0


def maps():
    """A lens of NA 0.5, its aperture beside the axis."""
    axis = (np.arange(80) - 39.5) * PITCH
    x, y = axis, axis[:, None]
    phase = -2 * np.pi / WAVELENGTH * np.sqrt(x**2 + y**2 + DISTANCE**2) + 0.9 * x / 11
    return phase, (np.hypot(x + 0.4, y) < 11.0).astype(float)


def stack(tolerance, **more):
    about = dict(
        pitch_um=PITCH,
        wavelength_um=WAVELENGTH,
        sensor_distance_um=DISTANCE,
        depths_um=[np.inf],
    )
    return psf.psf_stack(
        *maps(), **about | dict(window_um=6.0, samples=5) | more, tolerance=tolerance
    )


@pytest.fixture(scope="module")
def coarsest():
    """Error of the integration over the coarsest cells, where the tolerance asks for no
    better.
    """
    made = stack(0.3)
    assert (
        "cells of 6 x 6 points" in made.reason
    )  # 1.2 um: three of Nyquist's steps, two points in each
    return made.budget.sampling


@pytest.mark.parametrize(("share", "points"), [(0.49, 6), (0.51, 12)])
def test_cells_are_made_finer_where_they_would_take_more_than_half_the_tolerance(
    coarsest, share, points
):
    made = stack(coarsest / share)
    assert f"cells of {points} x {points} points" in made.reason
    assert made.budget.sampling <= made.tolerance / 2
    assert made.converged


def test_sums_have_what_cells_leave_of_the_tolerance(monkeypatch):
    """Errors add as squares: √(1 - 1/4) of it; all of it where samples are close
    enough, or are asked for.
    """
    asked, plain = [], direction.compute_intensity
    monkeypatch.setattr(
        direction,
        "compute_intensity",
        lambda *a, **k: asked.append(k["tolerance"]) or plain(*a, **k),
    )
    stack(8e-3)
    assert asked == pytest.approx([8e-3 * math.sqrt(0.75)] * len(asked), rel=1e-12)
    assert asked
    asked.clear()
    stack(8e-3, integrate=False)
    stack(8e-3, samples=20)
    assert asked == [8e-3, 8e-3]
