"""Errors of dose classes by hand: two pieces of a mark, a lens of two rows, and the
weights of three Gaussians.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from layout.dose import assign
from layout.dose.assign import Fields, Ladder
from layout.dose.exposure import CLEARS, PointExposure, point_exposure
from layout.process.process import Exposure


class Plane:
    """Nodes where the background is a plane; what is laid on them is kept."""

    def __init__(self):
        self.laid = []

    def sample(self, field, x, y):
        return field[0] + field[1] * x + field[2] * y

    def deposit(self, x, y, mass):
        self.laid += zip(x.tolist(), y.tolist(), mass.tolist(), strict=True)
        return np.array([mass.sum(), (mass * x).sum()])


def marks():
    """Two pieces with three and one outer edges, a background that rises to +x and
    falls to +y.
    """
    spots = (
        np.array([[0.3, 1.0], [0.7, 1.1], [5.0, -2.0]]),
        np.array([0.25, 0.5, 1.5]),
        np.array([0, 0, 1]),
    )
    return SimpleNamespace(
        grid=Plane(),
        far=np.array([0.11, 0.007, -0.004]),
        own=np.array([0.37, 0.29]),
        points=np.array([[0.1, 1.0], [0.5, 1.5], [0.9, 1.0], [5.0, -1.0]]),
        piece=np.array([0, 0, 0, 1]),
        spots=spots,
        rects=SimpleNamespace(goal=np.array([1.0, 0.93])),
    )


def test_the_error_of_pieces_is_at_their_worst_edge_relative_to_what_clears():
    fields, dose, chosen, mass = (
        marks(),
        np.array([0.8, 1.25, 1.7]),
        np.array([2, 1]),
        np.zeros(2),
    )
    found = assign._rect_error(fields, chosen, dose, mass)
    edges = [
        1.7 * 0.37 + 0.11 + 0.007 * x - 0.004 * y
        for x, y in ((0.1, 1.0), (0.5, 1.5), (0.9, 1.0))
    ]
    last = 1.25 * 0.29 + 0.11 + 0.007 * 5 + 0.004
    want = max(*(abs(e / CLEARS - 1) for e in edges), abs(last / (CLEARS * 0.93) - 1))
    assert found == pytest.approx(want, rel=1e-12)
    assert fields.grid.laid == [
        (0.3, 1.0, 0.25 * 1.7),
        (0.7, 1.1, 0.5 * 1.7),
        (5.0, -2.0, 1.5 * 1.25),
    ]
    assert mass == pytest.approx(
        [0.75 * 1.7 + 1.5 * 1.25, 1.7 * (0.25 * 0.3 + 0.5 * 0.7) + 1.25 * 7.5]
    )
    assert assign._rect_error(fields, np.zeros(0, int), dose, mass) == 0
    low = assign._rect_error(
        marks(), np.array([0, 0]), dose, np.zeros(2)
    )  # too little light counts as too much does
    assert low == pytest.approx(
        1 - (0.8 * 0.37 + 0.11 + 0.0007 - 0.004) / CLEARS, rel=1e-12
    )


def test_the_background_of_a_piece_is_the_mean_over_its_edges():
    of = Fields.of_rects(marks(), marks().far)
    assert of == pytest.approx(
        [0.11 + 0.007 * 0.5 - 0.004 * 3.5 / 3, 0.11 + 0.035 + 0.004], rel=1e-12
    )


def test_the_mean_edge_with_one_dose_weighs_pillars_by_their_area():
    """Two blocks of a row each; entry 0 is an empty site."""
    own, area = np.array([0.0, 0.31, 0.44]), np.array([0.0, 0.02, 0.07])
    rows = [np.array([[1, 0, 2]]), np.array([[2, 2, 1]])]
    far = np.array([[0.1, 0.9, 0.2], [0.13, 0.17, 0.05]])
    fields = SimpleNamespace(
        table=SimpleNamespace(own=own, area_um2=area),
        bodies=[SimpleNamespace(blocks=lambda: iter([(0, rows[0]), (1, rows[1])]))],
        alone=far,
        near_alone=[],
        at=lambda field, number, first, count, near: field[first : first + count],
    )
    sites = [(1, 0.1), (2, 0.2), (2, 0.13), (2, 0.17), (1, 0.05)]
    want = np.average(
        [own[k] + f for k, f in sites], weights=[area[k] for k, _ in sites]
    )
    assert assign._mean_edge(fields) == pytest.approx(want, rel=1e-12)


def test_doses_stand_in_equal_ratios_and_the_nearest_ratio_is_taken():
    steps = Ladder(0.7 * 1.1 ** np.arange(6))
    assert steps.per_log == pytest.approx(1 / math.log(1.1), rel=1e-12)
    edge = 0.7 * 1.1**2.5
    asked = [0.0, 0.2, 0.7 * 1.1**0.49, edge * 0.999, edge * 1.001, 0.7 * 1.1**4.2, 9.0]
    assert steps.nearest(np.array(asked)).tolist() == [0, 0, 0, 2, 3, 4, 5]
    assert Ladder(np.array([0.8])).nearest(np.array([0.1, 3.0])).tolist() == [0, 0]


def test_energies_of_three_gaussians_have_the_stated_ratios():
    found = point_exposure(
        Exposure(alpha_um=0.02, beta_um=9.0, eta=0.6, gamma_um=0.4, nu=0.15)
    )
    assert found.widths_um.tolist() == [0.02, 9.0, 0.4]
    assert found.weights == pytest.approx(np.array([1.0, 0.6, 0.15]) / 1.75, rel=1e-12)
    r = 0.7
    want = sum(
        e / 1.75 * math.exp(-((r / w) ** 2)) / (math.pi * w**2)
        for e, w in ((1, 0.02), (0.6, 9.0), (0.15, 0.4))
    )
    assert found.density(np.array([r])) == pytest.approx([want], rel=1e-12)
    inside = sum(
        e / 1.75 * (1 - math.exp(-((r / w) ** 2)))
        for e, w in ((1, 0.02), (0.6, 9.0), (0.15, 0.4))
    )
    assert found.within(np.array([r])) == pytest.approx([inside], rel=1e-12)


def test_an_edge_is_as_steep_as_the_error_functions_of_all_its_ranges():
    """0.7 nm of width is 0.35 nm at each edge, where half a plane gives erf / 2:
    relative to the half that clears.
    """
    alphas, weights = np.array([0.03, 0.5]), np.array([0.8, 0.2])
    rise = sum(
        w * math.erf(0.35e-3 / a) / 2 for a, w in zip(alphas, weights, strict=True)
    )
    # an error function is straight to (x / range)^2 / 3, 5e-5 here
    assert assign.straight_edge_error(PointExposure(alphas, weights)) == pytest.approx(
        rise / CLEARS, rel=1e-4
    )


def test_the_span_of_doses_is_that_of_every_pillar_with_the_closest_tolerance():
    """Beside those of a block before: doses, and the share that a pillar's dose may be
    off by its own goal.
    """
    own, goal, soft = (
        np.array([9.0, 0.31, 0.44]),
        np.array([9.0, 1.0, 0.93]),
        np.array([9.0, 0.05, 0.011]),
    )
    block, field = (
        np.array([[1, 0, 2], [2, 1, 0]]),
        np.array([[0.1, 0.9, 0.2], [0.31, 0.17, 0.05]]),
    )
    lit = [(1, 0.1), (2, 0.2), (2, 0.31), (1, 0.17)]
    doses = [(goal[k] - f) / own[k] for k, f in lit]
    shares = [
        (goal[k] - f) / goal[k] / min(0.03, soft[k] * d / goal[k])
        for (k, f), d in zip(lit, doses, strict=True)
    ]
    span = getattr(assign._span, "py_func", assign._span)
    for before, want in (
        ((np.inf, 0.0, 0.0), (min(doses), max(doses), max(shares))),
        ((0.7, 5.0, 900.0), (0.7, 5.0, 900.0)),
    ):
        found = np.array(before)
        span(block, field, own, goal, soft, 0.03, found)
        assert found == pytest.approx(want, rel=1e-12)
