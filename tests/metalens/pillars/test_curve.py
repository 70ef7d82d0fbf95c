"""The error of a curve between its nodes, by its four parts, on curves that are
straight lines.
"""

import dataclasses

import numpy as np
import pytest

from metalens.pillars.curve import Curve, Nodes
from metalens.pillars.rational import Rational


def line(slope, at, residual=0.0):
    """t = slope D + at and r = 0.2, as a rational function of two support points."""
    support = np.array([0.1, 0.4])
    values = np.stack([slope * support + at, [0.2, 0.2]], 1)
    return Rational(support, values, np.array([1.0, -1.0], complex), residual)


SOLVED = np.array([0.30, 0.10, 0.40, 0.20])  # in the order they were made
ERROR = np.array([4e-4, 1e-4, 9e-4, 7e-4])
BEST, RIVALS = (
    line(0.9 - 0.7j, 0.1, 3e-5),
    (line(0.9 - 0.69j, 0.1), line(0.92 - 0.7j, 0.1)),
)
NODES = Nodes(SOLVED, BEST(SOLVED) + 0.01, ERROR, np.ones(4), True, "met")


def test_between_nodes_the_parts_of_the_error_add_up():
    """Worst rival (0.02 D), residual, a tenth of the tolerance, and the larger of the
    neighbours' own errors.
    """
    curve = Curve(NODES, BEST, RIVALS, 2e-3)
    at = np.array([0.13, 0.27, 0.34])
    value, error = curve(at)
    beside = np.array([7e-4, 7e-4, 9e-4])  # of 0.1 and 0.2, 0.2 and 0.3, 0.3 and 0.4
    assert value == pytest.approx(BEST(at))
    assert error == pytest.approx(0.02 * at + 3e-5 + 2e-4 + beside, rel=1e-5)


def test_no_bar_is_wider_than_a_passive_pillar_can_be_wrong():
    """|t| and the true |t| are 1 at most: of |t| below 1 the bar ends at 2, of a t of 1.6 at 2.6."""
    wrong = dataclasses.replace(NODES, error=np.full(4, 9.0))
    assert Curve(wrong, BEST, RIVALS, 2e-3)(np.array([0.13, 0.27]))[1] == pytest.approx(
        [2.0, 2.0]
    )
    bright = line(0.0, 1.6j)
    assert Curve(wrong, bright, (bright, bright), 2e-3)(np.array([0.27]))[
        1
    ] == pytest.approx([2.6])


def test_at_a_node_value_and_error_are_those_of_the_solve():
    value, error = Curve(NODES, BEST, RIVALS, 2e-3)(SOLVED)
    assert value == pytest.approx(BEST(SOLVED) + 0.01)
    assert error == pytest.approx(ERROR)


def test_a_steep_place_carries_more_of_the_solver_s_shift():
    """Nodes on a flat piece, a point on a steep one: the error of a node is a shift of
    the diameter.
    """
    bend = Rational(
        np.array([0.1, 0.2, 0.3, 0.4]),
        np.stack([[0.1, 0.12, 0.6, 0.62], np.zeros(4)], 1).astype(complex),
        np.array([1, -3, 3, -1], complex),  # the cubic through four even points
        0.0,
    )
    nodes = Nodes(
        np.array([0.1, 0.4]),
        bend(np.array([0.1, 0.4])),
        np.array([1e-4, 5e-4]),
        np.ones(2),
        True,
        "",
    )
    curve = Curve(nodes, bend, (bend,), 1e-3)

    def steep(d):
        h = 1e-4
        return (
            abs((bend(np.array([d + h])) - bend(np.array([d - h])))[0, 0]) / (2 * h)
            + 2 / 0.3
        )

    _, error = curve(np.array([0.25]))
    shift = max(1e-4 / steep(0.1), 5e-4 / steep(0.4))
    assert error[0] == pytest.approx(1e-4 + shift * steep(0.25), rel=1e-3)


def test_each_place_takes_the_larger_error_of_its_own_two_neighbours():
    """Errors fall and rise from node to node; the curve is straight, so that they are
    carried as they are.
    """
    solved = np.array([0.10, 0.20, 0.28, 0.34, 0.40])
    nodes = Nodes(
        solved,
        BEST(solved),
        np.array([9e-4, 2e-4, 7e-4, 1e-4, 5e-4]),
        np.ones(5),
        True,
        "met",
    )
    at = np.array([0.15, 0.24, 0.31, 0.39])
    _, error = Curve(nodes, BEST, (BEST,), 2e-3)(at)
    assert error == pytest.approx(
        3e-5 + 2e-4 + np.array([9e-4, 7e-4, 7e-4, 5e-4]), rel=1e-5
    )
