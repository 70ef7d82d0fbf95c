"""Coarse nodes: interpolation of order 4, its transpose, and the convolution against the plain sum over pillars."""

import numpy as np
import pytest

from layout.dose.bodies import Body
from layout.dose.exposure import PointExposure
from layout.dose.nodes import Axis, Grid, convolution, gather, spread

RNG = np.random.default_rng(0)
GRID = Grid(Axis.over(-7.3, 21.9, 1.7), Axis.over(3.1, 26.5, 1.7))
PLACES = RNG.uniform(3.1, 26.5, 90), RNG.uniform(-7.3, 21.9, 90)


def test_deposit_is_the_transpose_of_sample():
    mass, nodes = RNG.normal(size=90), RNG.normal(size=GRID.shape)
    there, back = (GRID.deposit(*PLACES, mass) * nodes).sum(), (mass * GRID.sample(nodes, *PLACES)).sum()
    assert there == pytest.approx(back)
    assert GRID.deposit(*PLACES, mass).sum() == pytest.approx(mass.sum())  # the weights of each place sum to 1


def test_cubics_are_interpolated_exactly_and_the_rest_to_fourth_order():
    cubic = np.polynomial.Polynomial([1, -2, 0.3, 0.07])
    at = np.linspace(0.4, 35.0, 50)
    error = []
    for step in (2.0, 1.0):
        axis = Axis.over(0.0, 36.0, step)
        nodes = axis.origin_um + step * np.arange(axis.count)
        first, weights = axis.at(at)
        around = first[:, None] + np.arange(4)
        assert (cubic(nodes)[around] * weights).sum(1) == pytest.approx(cubic(at))
        bell = np.exp(-(((nodes - 17.3) / 9.0) ** 2))
        error.append(abs((bell[around] * weights).sum(1) - np.exp(-(((at - 17.3) / 9.0) ** 2))).max())
    assert error[0] / error[1] == pytest.approx(16, rel=0.25)


def test_rows_of_a_lattice_are_deposits_at_its_sites():
    index = RNG.integers(0, 4, (13, 9)).astype(np.uint8)
    body = Body(13, 9, 1.3, 4.0, 20.1, lambda first, end: index[first:end])
    value = np.array([[0.0, 1.7, 2.9, 0.4]])
    out, nodes = np.zeros((1, *GRID.shape)), RNG.normal(size=GRID.shape)
    lines = *GRID.y.at(body.rows_um(0, 13)), *GRID.x.at(body.columns_um)
    gather(index, value, *lines, out)
    y, x = np.meshgrid(body.rows_um(0, 13), body.columns_um, indexing="ij")
    assert out[0] == pytest.approx(GRID.deposit(x.ravel(), y.ravel(), value[0][index].ravel()))
    sites = np.empty((13, 9), np.float32)
    spread(nodes, *lines, sites)
    assert sites.ravel() == pytest.approx(GRID.sample(nodes, x.ravel(), y.ravel()), rel=1e-5, abs=1e-6)


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
