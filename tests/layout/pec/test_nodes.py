"""Coarse nodes: interpolation of order 4, its transpose, and the convolution against
the plain sum over pillars.
"""

import numpy as np
import pytest

from layout.pec import nodes
from layout.pec.bodies import PillarArray
from layout.pec.nodes import (
    NodeAxis,
    NodeGrid,
    gather_to_nodes,
    gaussian_convolution,
    interpolate_from_nodes,
)
from layout.pec.psf import PointExposure

RNG = np.random.default_rng(0)
GRID = NodeGrid(NodeAxis.over(-7.3, 21.9, 1.7), NodeAxis.over(3.1, 26.5, 1.7))
PLACES = RNG.uniform(3.1, 26.5, 90), RNG.uniform(-7.3, 21.9, 90)


def test_deposit_is_the_transpose_of_sample():
    mass, nodes = RNG.normal(size=90), RNG.normal(size=GRID.shape)
    there, back = (
        (GRID.deposit(*PLACES, mass) * nodes).sum(),
        (mass * GRID.sample(nodes, *PLACES)).sum(),
    )
    assert there == pytest.approx(back)
    assert GRID.deposit(*PLACES, mass).sum() == pytest.approx(
        mass.sum()
    )  # the weights of each place sum to 1


def test_cubics_are_interpolated_exactly_and_the_rest_to_fourth_order():
    cubic = np.polynomial.Polynomial([1, -2, 0.3, 0.07])
    at = np.linspace(0.4, 35.0, 50)
    error = []
    for step in (2.0, 1.0):
        axis = NodeAxis.over(0.0, 36.0, step)
        nodes = axis.origin_um + step * np.arange(axis.count)
        first, weights = axis.at(at)
        around = first[:, None] + np.arange(4)
        assert (cubic(nodes)[around] * weights).sum(1) == pytest.approx(cubic(at))
        bell = np.exp(-(((nodes - 17.3) / 9.0) ** 2))
        error.append(
            abs(
                (bell[around] * weights).sum(1) - np.exp(-(((at - 17.3) / 9.0) ** 2))
            ).max()
        )
    assert error[0] / error[1] == pytest.approx(16, rel=0.25)


WIDE = NodeGrid(NodeAxis.over(-7.3, 21.9, 1.7), NodeAxis.over(-9.9, 46.5, 1.7))


@pytest.mark.parametrize("grid", [GRID, WIDE])
def test_rows_of_a_lattice_are_deposits_at_its_sites(grid):
    index = RNG.integers(0, 4, (13, 9)).astype(np.uint8)
    body = PillarArray(13, 9, 1.3, 4.0, 20.1, lambda first, end: index[first:end])
    value = np.array([[0.0, 1.7, 2.9, 0.4]])
    out, nodes = np.zeros((1, *grid.shape)), RNG.normal(size=grid.shape)
    lines = *grid.y.at(body.rows_um(0, 13)), *grid.x.at(body.columns_um)
    gather_to_nodes(index, value, *lines, out)
    y, x = np.meshgrid(body.rows_um(0, 13), body.columns_um, indexing="ij")
    assert out[0] == pytest.approx(
        grid.deposit(x.ravel(), y.ravel(), value[0][index].ravel())
    )
    sites = np.empty((13, 9), np.float32)
    interpolate_from_nodes(nodes, *lines, sites)
    assert sites.ravel() == pytest.approx(
        grid.sample(nodes, x.ravel(), y.ravel()), rel=1e-5, abs=1e-6
    )


@pytest.mark.parametrize("hollow", [True, False])
def test_convolution_is_the_plain_sum_of_gaussians(hollow):
    point = PointExposure(np.array([0.9, 4.0]), np.array([0.7, 0.3]))
    mass = RNG.uniform(size=(17, 23))
    field = gaussian_convolution((17, 23), (0.7, 0.5), point=point, hollow=hollow)(mass)
    assert field.shape == (17, 23)
    y, x = np.meshgrid(np.arange(17) * 0.7, np.arange(23) * 0.5, indexing="ij")
    for row, column in ((0, 0), (16, 22), (8, 3)):
        weight = point.density(np.hypot(y - y[row, column], x - x[row, column]))
        if hollow:
            weight[row, column] = 0
        assert field[row, column] == pytest.approx((weight * mass).sum(), rel=1e-9)


def test_a_narrow_gaussian_does_not_reach_round_to_the_other_border():
    """Five of its widths, 4.5 um, are added to 40 and 31 nodes."""
    point, mass = PointExposure(np.array([0.9]), np.array([1.0])), np.zeros((40, 31))
    mass[0, 0] = mass[-1, 7] = 1.0
    field = gaussian_convolution((40, 31), (0.5, 0.5), point=point, hollow=False)(mass)
    y, x = np.mgrid[:40, :31] * 0.5
    want = point.density(np.hypot(y, x)) + point.density(np.hypot(y - 19.5, x - 3.5))
    assert field == pytest.approx(want, abs=1e-9 * want.max())  # exp(-25)


def test_every_place_lies_between_the_middle_two_of_its_four_nodes():
    axis = NodeAxis.over(-3.1, 11.0, 1.7)
    at = np.linspace(-3.1, 11.0, 200)
    first, _ = axis.at(at)
    place = (at - axis.origin_um) / 1.7 - first
    assert (place.min() >= 1, place.max() < 2) == (True, True)
    assert (first.min() >= 0, first.max() + 3 < axis.count) == (True, True)


def test_nodes_of_a_die_are_as_fine_as_its_gaussian_asks():
    made, half = (
        NodeGrid.over((2.0, -5.0, 30.0, 9.0), 4.0),
        NodeGrid.over((2.0, -5.0, 30.0, 9.0), 2.0),
    )
    assert made.x.spacing_um == made.y.spacing_um == 2 * half.x.spacing_um
    assert made.x.spacing_um == pytest.approx(4.0 / nodes._PER_WIDTH)
    assert (made.y.count, made.x.count) == made.shape
    assert made.x.count > 1.7 * made.y.count  # 28 um by 14
