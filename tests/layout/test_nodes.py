"""Coarse nodes: interpolation of order 4, its transpose, and the convolution against the plain sum over pillars."""

import numpy as np
import pytest

from layout.exposure import PointExposure
from layout.nodes import Axis, convolution
from layout.pattern import pattern

RNG = np.random.default_rng(0)


@pytest.mark.parametrize("step", [1, 2, 5, 12])
def test_gather_is_the_transpose_of_spread(step):
    axis = Axis(7, step)
    sites, nodes = RNG.normal(size=(3, axis.sites)), RNG.normal(size=(3, axis.nodes))
    assert (axis.gather(sites) * nodes).sum() == pytest.approx((sites * axis.spread(nodes)).sum())
    assert axis.gather(sites).sum() == pytest.approx(sites.sum())  # the weights of each site sum to 1


def test_cubics_are_interpolated_exactly_and_the_rest_to_fourth_order():
    axis = Axis(9, 4)
    at_nodes, at_sites = np.arange(-1, axis.nodes - 1), np.arange(axis.sites) / 4
    cubic = np.polynomial.Polynomial([1, -2, 0.3, 0.07])
    assert axis.spread(cubic(at_nodes)) == pytest.approx(cubic(at_sites))
    error = []
    for wide in (8.0, 16.0):
        error.append(abs(axis.spread(np.exp(-((at_nodes / wide) ** 2))) - np.exp(-((at_sites / wide) ** 2))).max())
    assert error[0] / error[1] == pytest.approx(16, rel=0.15)


def test_step_one_makes_nodes_of_sites():
    axis = Axis(6, 1)
    sites = RNG.normal(size=6)
    assert axis.gather(sites)[1:-2] == pytest.approx(sites)


@pytest.mark.parametrize("hollow", [True, False])
def test_convolution_is_the_plain_sum_of_gaussians(hollow):
    point = PointExposure(np.array([0.9, 4.0]), np.array([0.7, 0.3]))
    mass = RNG.uniform(size=(17, 23))
    field = convolution((17, 23), 0.5, point=point, hollow=hollow)(mass)
    y, x = np.mgrid[:17, :23] * 0.5
    for row, column in ((0, 0), (16, 22), (8, 3)):
        weight = point.density(np.hypot(y - y[row, column], x - x[row, column]))
        if hollow:
            weight[row, column] = 0
        assert field[row, column] == pytest.approx((weight * mass).sum(), rel=1e-9)


def test_sums_over_pillars_keep_mass_and_its_moments_whatever_the_edge():
    index = (RNG.random((61, 47)) < 0.4).astype(np.uint16)
    point = PointExposure(np.array([0.01, 20.0]), np.array([0.6, 0.4]))
    drawn = pattern(index, np.array([0.0, 0.2]), 0.4, point=point)
    y, x = drawn.axes
    assert y.step == 8  # 20 um / 6 / 0.4 um
    (nodes,) = drawn.gather(drawn.area_um2)
    rows, columns = np.nonzero(index)
    at_y, at_x = ((np.arange(axis.nodes) - 1.0) * axis.step for axis in (y, x))
    area = np.pi / 4 * 0.04
    for power_y, power_x in ((0, 0), (1, 0), (0, 2), (1, 1), (3, 0)):
        want = area * (rows.astype(float) ** power_y * columns.astype(float) ** power_x).sum()
        assert (nodes * at_y[:, None] ** power_y * at_x**power_x).sum() == pytest.approx(want, rel=1e-5)
