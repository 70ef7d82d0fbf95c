"""Pillars of one size that answer x and y apart: their library holds one light, and
what is made of it says which.
"""

from dataclasses import replace

import numpy as np
import pytest

from metalens.cell import Cell, Index, Lattice
from metalens.cell.shapes.round import Circle, Ellipse
from metalens.cell.shapes.straight import Cross, Rectangle, RegularPolygon
from metalens.cli import main
from metalens.commands import design_words
from metalens.core.errors import PropagationError
from metalens.lens import DiameterMap, Lens, save
from metalens.pillars import Proxy
from metalens.psf import View, from_lens

PROXY = Proxy(
    np.array([[6.0, 9.0]]),
    np.array([[0.9, -0.03]]),
    (0.08, 0.22),
    (0.85, 0.85),
    1e-6,
    1e-6,
)
VIEW = View((3e3,), ((0.04, -0.09),), window_um=9.0, samples=16)


def lens(shape):
    x = (np.arange(31) - 15) * 0.4
    diameter = np.where(
        np.hypot(x, x[:, None]) < 5.7,
        0.14 + 0.05 * np.cos(x) * np.sin(0.7 * x[:, None]),
        0.0,
    )
    cell = Cell(0.4, 0.7, Index(3.6), Index(1.45), shape=shape)
    return Lens(DiameterMap(diameter, 0.4), cell, PROXY, 0.85, 41.0, 3e3, "map")


@pytest.mark.parametrize(
    "shape", [Rectangle(ratio=0.6), Ellipse(ratio=1.3), RegularPolygon(sides=3)]
)
def test_psfs_of_one_light_say_so_and_are_not_called_those_of_both(shape):
    made = lens(shape)
    found = from_lens(made, VIEW, tolerance=1e-3, polarisation="auto")
    assert "of light along x: these pillars answer x and y apart" in found.reason
    for counted in ("flux", "vector"):
        with pytest.raises(PropagationError, match="knows light along x alone"):
            from_lens(made, VIEW, tolerance=1e-3, polarisation=counted)
    assert "all of it for light along x" in design_words.pillar_accuracy_text(made)
    assert (
        f"within {made.proxy.max_phase_error_rad:.1e} rad"
        in design_words.pillar_accuracy_text(made)
    )


@pytest.mark.parametrize(
    "shape", [Circle(), Rectangle(ratio=1.0), Cross(angle_rad=0.3)]
)
def test_pillars_alike_for_both_take_both(shape):
    """A quarter turn leaves them as they are, so that light along x and along y meets
    the same pillar.
    """
    made = lens(shape)
    found = from_lens(made, VIEW, tolerance=1e-3, polarisation="flux")
    assert "light along" not in found.reason
    assert "all of it" not in design_words.pillar_accuracy_text(made)


def test_at_angles_the_library_holds_the_mean_of_both_in_one_plane_of_incidence():
    """Rectangles answer light that is tilted along y otherwise than along x, where
    their rows were solved.
    """
    alike = {
        name: getattr(PROXY, name)[None]
        for name in ("phase_coefficients", "transmission_coefficients")
    }
    made = replace(
        lens(Rectangle(ratio=0.6)), proxy=replace(PROXY, max_angle_rad=0.3, **alike)
    )
    found = from_lens(made, VIEW, tolerance=1e-3)
    assert "of the mean of both polarisations, tilted along x" in found.reason


def test_round_pillars_of_unlike_periods_are_of_one_light_too():
    assert (
        replace(
            lens(Circle()), cell=Cell(0.4, lattice=Lattice("rectangular", 1.2))
        ).one_light
        == "light along x"
    )


def test_the_light_that_is_asked_for_is_refused_for_its_own_reason(tmp_path, capsys):
    """x of a rectangle is what its library holds; y is not in it; of round pillars both
    are the same.
    """

    def psfs(made, light):
        save(tmp_path / "lens.h5", made)
        words = f"psf {tmp_path}/lens.h5 -o {tmp_path}/psf.h5 --sources-mm 3 --angles-deg 2 --window-um 9 --samples 16"
        code = main(
            [*words.split(), "--tolerance", "1e-3", "--force", "--light", light]
        )
        said = capsys.readouterr()
        return code, said.out + said.err

    oblong = lens(Rectangle(ratio=0.6))
    code, said = psfs(oblong, "x")
    assert code < 2  # its window holds what it holds
    assert "light along x" in said
    code, said = psfs(oblong, "y")
    assert code == 2
    assert "these know light along x alone" in said
    code, said = psfs(lens(Circle()), "x")
    assert code == 2
    assert "these treat x and y alike" in said
