"""Solved pillars between their diameters, of functions that a cubic holds exactly."""

import numpy as np
import pytest

from metalens.made.solved import Solved

D = np.array([0.08, 0.11, 0.15, 0.18, 0.22])


def test_a_cubic_of_the_diameter_is_held_in_every_power_of_every_cause():
    """(causes, orders, diameters): unlike counts, so that none of the axes can be taken
    for another.
    """
    factors = np.array([[1.0, 2.0 - 0.5j], [0.3j, 4.0], [-1.1, 0.7j]])

    def curve(d):
        return 0.4 + 3 * d - 20j * d**2 + 55 * d**3

    solved = Solved(0.83, D, factors[:, :, None] * curve(D))
    asked = np.array([[0.09, 0.13], [0.2, 0.08], [0.215, 0.1]])
    found = solved.series(asked)
    assert found.shape == (3, 2, 3, 2)
    assert found == pytest.approx(
        factors[:, :, None, None] * curve(asked), rel=1e-12
    )  # rounding of the spline
