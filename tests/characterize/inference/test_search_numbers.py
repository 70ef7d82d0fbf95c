"""When two ends of a search are the same lens: distance in sigma of the end's own parabola."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from characterize.inference import search

COVARIANCE = np.array([[0.04, 0.03], [0.03, 0.25]])


def end(value, merit):
    return SimpleNamespace(value=np.array(value), merit=merit, covariance=COVARIANCE)


def test_distance_of_two_ends_is_mahalanobis():
    step = np.array([0.3, -0.2])
    got = search._apart(np.array([1.3, 4.8]), end([1.0, 5.0], 0.0))
    assert got == pytest.approx(math.sqrt(step @ np.linalg.inv(COVARIANCE) @ step))


def test_ends_are_kept_best_first_where_they_lie_a_sigma_apart_and_explain_as_much():
    best, twin, other = end([1.0, 5.0], 10.0), end([1.05, 5.1], 10.5), end([2.0, 5.0], 11.0)
    far = end([-2.0, 5.0], 10.0 + search.MODES_WITHIN + 0.1)
    assert search.distinct([far, other, twin, best]) == [best, other]
