"""The focus of a good lens passes, and a lens that focuses elsewhere does not."""

from dataclasses import replace

import numpy as np
import pytest

from metalens import design
from metalens.cell.record import Cell, Index
from metalens.design.focus_check import check_focus
from metalens.design.profiles import Focus, hyperbolic_phase
from tests.proxies import proxy_of

CELL = Cell(pitch_um=0.35, pillar=Index(3.6), substrate=Index(1.45))
FOCUS = Focus(0.85, 200.0, 2000.0)


@pytest.fixture(scope="module")
def proxy():
    """A transparent pillar of 1.4 turns over 80-290 nm."""
    return proxy_of([0.0, 4.5], [0.95], (0.08, 0.29), 0.85)


def _lens(proxy, phase=None):
    return design.make(
        phase or design.phase_of(None, FOCUS, radius_um=50.0),
        FOCUS,
        aperture_um=100.0,
        cell=CELL,
        proxy=proxy,
    )[0]


def test_a_hyperbolic_lens_focuses_on_the_axis_in_the_sensor_plane(proxy):
    found = check_focus(_lens(proxy))
    assert found.passed
    assert max(abs(found.x_um), abs(found.y_um)) < 0.01 * found.resolution_um
    # The brightest point of the axis lies 12 d / (pi N)² before the focus (Li and Wolf
    # 1981), N = R² / (lambda d); the scan leaves out light beyond its window.
    fresnel_number = 50.0**2 / (0.85 * 200.0)
    assert found.z_um == pytest.approx(
        -12 * 200.0 / (np.pi * fresnel_number) ** 2, abs=0.03 * found.depth_um
    )
    # every pillar makes its phase within 2e-5 rad; the parabola of the peak leaves 4e-5
    assert found.figures.strehl == pytest.approx(1.0, abs=1e-4)


def test_a_lens_that_focuses_to_the_side_is_told_which_side(proxy):
    tilt = 0.4 / FOCUS.sensor_distance_um
    lens = _lens(
        proxy,
        lambda x, y: (
            hyperbolic_phase(x, y[:, None], FOCUS) + 2 * np.pi / 0.85 * tilt * x
        ),
    )
    found = check_focus(lens, axial=False)
    assert found.x_um == pytest.approx(0.4, abs=0.05)
    assert abs(found.y_um) < 0.02
    assert np.isnan(found.z_um)
    half_micron_further = replace(
        lens, sensor_distance_um=lens.sensor_distance_um - 8.0
    )
    assert not check_focus(half_micron_further).passed


def test_a_lens_of_less_than_a_fresnel_zone_is_judged_in_the_sensor_plane_only(proxy):
    tiny = design.make(
        design.phase_of(None, FOCUS, radius_um=5.0),
        FOCUS,
        aperture_um=10.0,
        cell=CELL,
        proxy=proxy,
    )[0]
    found = check_focus(tiny)
    assert np.isnan(found.z_um)
    assert found.passed
