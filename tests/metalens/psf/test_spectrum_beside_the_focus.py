"""Wavelengths that stand for a spectrum, beside the focus too: against a hundred of
them, equally spaced.

Light that meets a place has paths through the lens that differ by the more, the farther
from the focus it lies, and
pillars delay it by up to some micrometres more. Two wavelengths that serve a focus miss
a window beside it by a tenth.
"""

import math

import numpy as np
import pytest

from metalens.cell import Cell, Index
from metalens.lens import DiameterMap, Lens
from metalens.library import Proxy
from metalens.psf import SpectralNodes, View, from_lens, spectrum

# of diameter and wavelength: delays of 0.9 to 4.3 um
PHASE = np.array([[0.0, 1.15 * math.pi], [-0.4, -1.9]])
PROXY = Proxy(PHASE, np.array([[0.85, 0.05]]), (0.08, 0.22), (0.80, 0.90), 0.0, 0.0)
LINE = np.array([[826, 0.0], [843, 1.0], [851, 0.35], [868, 0.8], [877, 0.0]])


def lens(count, distance_um):
    """A focus of so many columns, five rows fewer, at 850 nm."""
    x, y = (np.arange(n) - (n - 1) / 2 for n in (count, count - 5))
    path = (
        np.sqrt((0.3 * x) ** 2 + (0.3 * y[:, None]) ** 2 + distance_um**2) - distance_um
    )
    wanted = np.mod(-2 * np.pi / 0.85 * path + np.pi, 2 * np.pi) - np.pi
    diameter = 0.15 + 0.07 * np.clip(wanted / (1.15 * np.pi), -0.99, 0.99)
    cell = Cell(0.3, 0.7, Index(3.6), "SiO2")
    return Lens(
        DiameterMap(diameter, 0.3), cell, PROXY, 0.85, distance_um, math.inf, "map"
    )


@pytest.fixture
def source(tmp_path):
    file = tmp_path / "led.csv"
    np.savetxt(file, LINE)
    return spectrum.read_measured_spectrum([file], within_um=PROXY.wavelengths_um)


def many():
    # a step of 0.5 nm: paths of 40 um turn by a sixth of a turn
    nm = np.linspace(826, 877, 103)
    share = np.interp(nm, *LINE.T)
    return SpectralNodes(nm * 1e-3, share / share.sum(), 0.0)


@pytest.mark.parametrize(
    ("count", "angle", "offset", "depths", "tolerance"),
    [
        (
            20,
            (0.0, 0.0),
            (0.0, 0.0),
            (90.0,),
            3e-4,
        ),  # sag of 0.3 um: the delays are what counts
        (61, (0.0, 0.0), (0.0, 21.0), (300.0, math.inf), 2e-3),
        (61, (-0.2, 0.35), (-13.0, 4.0), (math.inf, 120.0), 2e-3),
        (61, (0.0, 0.5), (0.0, 0.0), (25.0,), 1e-3),
    ],
)
def test_wavelengths_serve_wherever_the_window_lies(
    source, count, angle, offset, depths, tolerance
):
    made = lens(count, 0.9 * count)
    view = View(depths, (angle,), (7.0, 4.2), (20, 12), offset)
    found = from_lens(made, view, tolerance=tolerance, spectrum=source)
    want = from_lens(made, view, tolerance=1e-6, spectrum=many())
    error = np.linalg.norm(found.intensity - want.intensity) / np.linalg.norm(
        want.intensity
    )
    assert found.budget.spectrum <= tolerance / 2
    assert found.converged
    assert error <= found.error


def test_given_wavelengths_are_judged_by_where_their_light_falls(source):
    """Two wavelengths: an error that is said, not hidden, and twice as large at least
    beside the focus.
    """
    um, share = source.wavelengths_um, source.share
    two = SpectralNodes(*spectrum.discrete_gauss_rule(um, share, 2), 0.0, source)
    errors = []
    for offset in ((0.0, 0.0), (0.0, 21.0)):
        view = View((300.0,), ((0.0, 0.0),), (7.0, 4.2), (20, 12), offset)
        found, want = (
            from_lens(lens(61, 55.0), view, tolerance=1e-3, spectrum=one)
            for one in (two, many())
        )
        error = np.linalg.norm(found.intensity - want.intensity) / np.linalg.norm(
            want.intensity
        )
        assert error <= found.budget.spectrum
        errors.append(found.budget.spectrum)
    assert errors[1] > 2 * errors[0]
