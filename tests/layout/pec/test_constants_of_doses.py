"""What the constants of doses promise: how many pieces marks are cut to, and how finely
a measured spread is fitted.
"""

import numpy as np
import pytest

from layout.pec import fracture
from layout.pec.bodies import PillarArray
from layout.pec.nodes import NodeAxis, NodeGrid, gather_to_nodes, interpolate_from_nodes
from layout.pec.psf import PointExposure, fit_point_spread

RNG = np.random.default_rng(8)
NOTHING = np.empty((0, 4))
BACK_UM = 6.4
POINT = PointExposure(np.array([0.02, BACK_UM]), np.array([1.0, 0.6]) / 1.6)


@pytest.mark.parametrize(("halvings", "side"), [(16, 0.5), (17, 1.0)])
def test_large_marks_are_cut_to_a_hundred_thousand_pieces_at_most(halvings, side):
    """A bar too long for its background to change but at its ends: 2^16 = 65 536 pieces
    of half a range are few, and
    of twice the length 131 072 are many, which are halved by going to whole ranges."""
    step = 0.1
    length = round(0.5 * BACK_UM / step) * 2**halvings
    made, _ = fracture.fracture_boxes(
        np.array([[0, 0, length, 3]]),
        NOTHING,
        step_um=step,
        point=POINT,
        tolerance=0.05,
    )
    assert 1.0 <= len(made) / 2**16 < 1.1  # a few more at its ends
    middle = made[len(made) // 2]
    assert (middle[2] - middle[0]) * step == pytest.approx(side * BACK_UM)


def test_pieces_next_to_a_lens_are_as_long_as_its_background_lets_them_be():
    """Along the normal of a straight edge the background of weight w falls by w / √π of
    a range at most: over an eighth
    by 2.6 %, and half of it to either side of the middle, of which a sixteenth would be
    a needless quarter of a million
    pieces a square millimetre of marks."""
    made, _ = fracture.fracture_boxes(np.array([[0, 0, 6400, 3200]]), np.array([[6.5, -50.0, 90.0, 50.0]]), step_um=1e-3,
                         point=POINT, tolerance=0.2)  # fmt: skip
    sides = (made[:, 2:] - made[:, :2]).max(1) * 1e-3
    assert (sides <= BACK_UM / 8).all()
    assert np.median(sides) > BACK_UM / 16
    assert len(made) == 32  # 6.4 by 3.2 um in squares of 0.8


def test_a_table_that_begins_far_inside_its_second_radius_is_fitted_as_finely_as_any():
    """Widths a quarter of an octave apart from the first radius on: a Gaussian between
    two of them is met to 2 %.
    """
    radius = np.r_[0.01, np.geomspace(4.0, 60.0, 40)]
    width = 17.3
    found = fit_point_spread(
        radius, np.exp(-((radius / width) ** 2)) / (np.pi * width**2) + 1e-7
    )
    assert found.widths_um.min() > 0
    steps = np.log2(found.widths_um / 0.01)
    spacing = np.log2(60.0 / 0.01) / np.ceil(4 * np.log2(60.0 / 0.01))
    assert steps / spacing == pytest.approx(np.rint(steps / spacing), abs=1e-6)


@pytest.mark.parametrize("tall", [True, False])
def test_nodes_wider_than_tall_and_taller_than_wide_serve_alike(tall):
    """Sites by the compiled loops, against the interpolation at each place."""
    short, long = NodeAxis.over(-3.1, 4.9, 1.7), NodeAxis.over(2.3, 41.5, 1.7)
    grid = NodeGrid(long, short) if tall else NodeGrid(short, long)
    index = RNG.integers(0, 3, (23, 4) if tall else (4, 23)).astype(np.uint8)
    left, bottom = (-1.2, 5.0) if tall else (5.0, -1.2)
    body = PillarArray(
        *index.shape, 1.3, left, bottom, lambda first, end: index[first:end]
    )
    y, x = np.meshgrid(body.rows_um(0, len(index)), body.columns_um, indexing="ij")
    lines = *grid.y.at(body.rows_um(0, len(index))), *grid.x.at(body.columns_um)
    nodes, sites = RNG.normal(size=grid.shape), np.empty(index.shape, np.float32)
    interpolate_from_nodes(nodes, *lines, sites)
    assert sites.ravel() == pytest.approx(
        grid.sample(nodes, x.ravel(), y.ravel()), rel=1e-5, abs=1e-5
    )
    value, out = np.array([[0.0, 1.3, 0.4]]), np.zeros((1, *grid.shape))
    gather_to_nodes(index, value, *lines, out)
    assert out[0] == pytest.approx(
        grid.deposit(x.ravel(), y.ravel(), value[0][index].ravel()), abs=1e-9
    )
