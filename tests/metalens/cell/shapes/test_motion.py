"""Fourier factors of a rim that moves, against differences of the factors themselves,
and integrals done by hand.
"""

import dataclasses

import numpy as np
import pytest

from metalens.cell.shapes import (
    Circle,
    Cross,
    Ellipse,
    Outline,
    Polygon,
    PolygonLoop,
    Rectangle,
    RegularPolygon,
    Ring,
    motion,
)
from metalens.core.errors import CellError

KITE = Polygon(((0.5, -0.3), (-0.5, -0.2), (0.1, 0.6)), 0.3)  # clockwise
SHAPES = (
    Circle(),
    Ellipse(0.6, 0.3),
    Ring(0.4),
    Rectangle(0.5, 0.2),
    Cross(0.3, 0.1),
    RegularPolygon(5, 0.2),
    KITE,
)
rng = np.random.default_rng(3)
GX, GY = rng.normal(size=(2, 40)) * 20  # per um, of orders of pitches from 0.1 um on


def differenced(made, step):
    """Of fourth order."""
    ends = [made(k * step) for k in (-2, -1, 1, 2)]
    return (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * step)


def moving(shape, name):
    """The outline as one number of the shape changes."""
    if name == "size":
        return lambda x: shape.outline(0.23 + x, grow_um=0.011)
    if name == "grow":
        return lambda x: shape.outline(0.23, grow_um=0.011 + x)
    return lambda x: dataclasses.replace(
        shape, **{name: getattr(shape, name) + x}
    ).outline(0.23, grow_um=0.011)


@pytest.mark.parametrize("shape", SHAPES, ids=lambda s: s.kind)
@pytest.mark.parametrize("name", ["size", "grow", "ratio", "angle_rad"])
def test_a_moving_rim_changes_the_factors_as_their_differences(shape, name):
    if name in ("ratio", "angle_rad") and not hasattr(shape, name):
        pytest.skip("the shape has no such number")
    made = moving(shape, name)
    rates = motion.sixth_order_difference(
        lambda x: motion.shape_parameters(made(x)), 1e-4
    )
    want = differenced(lambda x: made(x).fourier(GX, GY), 3e-4)
    got = motion.fourier_shape_derivative(made(0.0), GX, GY, rates)
    assert (
        np.abs(got - want).max() < 1e-7 * np.abs(want).max()
    )  # step^4 of the differences


def test_at_no_wave_number_it_is_the_change_of_area():
    """And a polygon that moves as a whole only turns the phases of its factors."""
    for shape in SHAPES:
        made = moving(shape, "size")
        rates = motion.sixth_order_difference(
            lambda x, made=made: motion.shape_parameters(made(x)), 1e-4
        )
        area = differenced(lambda x, made=made: made(x).area_um2, 1e-3)
        small = np.array([0.0, 4e-3])  # s of 5e-4, whose square is left
        assert motion.fourier_shape_derivative(
            made(0.0), small, small, rates
        ).real == pytest.approx(area, rel=1e-6)
    loop = Outline((PolygonLoop(((0.1, -0.3), (-0.1, 0.2), (0.25, 0.3)), sign=-1),))
    got = motion.fourier_shape_derivative(loop, GX, GY, np.tile([0.3, -0.7], 3))
    assert got == pytest.approx(
        -1j * (0.3 * GX - 0.7 * GY) * loop.fourier(GX, GY), rel=1e-9, abs=1e-12
    )


def test_a_hole_that_is_just_closing_is_refused():
    made = moving(Ring(0.4), "grow")
    closed = 0.4 * 0.23 - 0.011
    with pytest.raises(CellError, match="losing or gaining a part"):
        motion.sixth_order_difference(
            lambda x: motion.shape_parameters(made(closed + x)), 1e-4
        )
