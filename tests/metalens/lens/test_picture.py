"""The picture of a lens shows what a microscope of its resolution would: no lens where
there is none.
"""

from dataclasses import replace

import numpy as np
import pytest

from metalens.cell import Cell
from metalens.core import report
from metalens.lens import DiameterMap, Layers, Lens, Stop
from metalens.lens.picture import _phase, lens_picture, mean_field
from metalens.proxy import Proxy

LINEAR = Proxy(
    np.array([[22.0, 7.0]]), np.array([[0.95]]), (0.1, 0.3), (0.85, 0.85), 0.0, 0.0
)  # phase 22 + 70 (d - 0.2)


def lens(diameter):
    return Lens(
        DiameterMap(diameter, 0.4),
        Cell(0.4),
        LINEAR,
        0.85,
        500.0,
        float("inf"),
        "hyperbolic",
    )


def test_a_slope_fades_as_the_mean_of_its_phases():
    """Sites of one block lie δ apart: the mean is sin(nδ/2) / (n sin(δ/2)) at the phase
    of their middle.
    """
    step, n = 0.0071, 5
    diameter = 0.12 + step * np.arange(15) + np.zeros((11, 1))
    diameter[:, 14] = 0  # a hole: one site of five in the last block is dark
    found = mean_field(lens(diameter), n)
    delta = 70 * step
    want = np.sin(n * delta / 2) / (n * np.sin(delta / 2))
    assert found.shape == (3, 3)
    assert np.abs(found[0, :2]) == pytest.approx(want, rel=1e-12)
    middle = 22 + 70 * (0.12 + step * np.array([2, 7]) - 0.2)
    assert np.angle(found[0, :2] * np.exp(-1j * middle)) == pytest.approx(0, abs=1e-12)
    assert np.abs(found[2, 0]) == pytest.approx(want / 5, rel=1e-12)  # one row of five
    four = np.sin(4 * delta / 2) / (5 * np.sin(delta / 2))
    assert np.abs(found[0, 2]) == pytest.approx(four, rel=1e-12)


def test_a_stop_is_drawn_at_its_radius():
    stopped = replace(lens(np.full((40, 40), 0.2)), layers=Layers(stop=Stop(5.5, 30.0)))
    for one, radii in ((stopped, [5.5]), (lens(np.full((40, 40), 0.2)), [])):
        figure, axes = report.make_figure(1, 2)
        _phase(figure, axes[0], one)
        assert [patch.get_radius() for patch in axes[0].patches] == radii
        report.figure_png(figure)


def test_a_phase_that_turns_within_a_pixel_is_not_drawn_as_a_slow_one():
    """A slope of one turn in 21 sites, read at every 20th site, would look like one
    turn in 420.
    """
    x = np.arange(840)
    diameter = 0.12 + 2 * np.pi / 70 * ((x / 21) % 1) + np.zeros((840, 1))
    assert np.abs(mean_field(lens(diameter), 21)).max() < 1e-12
    assert lens_picture(lens(diameter)).startswith(b"\x89PNG")
