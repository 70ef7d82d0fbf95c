"""When two ends of a search are the same lens: distance in sigma of the end's own
parabola.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from characterize.inference import search
from metalens.core.errors import FitError

COVARIANCE = np.array([[0.04, 0.03], [0.03, 0.25]])


def end(value, merit):
    return SimpleNamespace(value=np.array(value), merit=merit, covariance=COVARIANCE)


def test_distance_of_two_ends_is_mahalanobis():
    step = np.array([0.3, -0.2])
    got = search._apart(np.array([1.3, 4.8]), end([1.0, 5.0], 0.0))
    assert got == pytest.approx(math.sqrt(step @ np.linalg.inv(COVARIANCE) @ step))


def test_ends_are_kept_best_first_where_they_lie_a_sigma_apart_and_explain_as_much():
    best, twin, other = (
        end([1.0, 5.0], 10.0),
        end([1.05, 5.1], 10.5),
        end([2.0, 5.0], 11.0),
    )
    far = end([-2.0, 5.0], 10.0 + search.MODES_WITHIN + 0.1)
    assert search.distinct_modes([far, other, twin, best]) == [best, other]


def test_a_wider_search_that_leaves_the_model_s_range_is_none(monkeypatch):
    """From the one begin that it is given; faults that are no refusal of a fit are not
    hidden.
    """
    asked = []

    def searched(task, begins):
        asked.append((task, [one.tolist() for one in begins]))
        if task == "refused":
            raise FitError("beyond the library")
        if task == "broken":
            raise ZeroDivisionError
        return ["an end"]

    monkeypatch.setattr(search, "search_modes", searched)
    assert search.widen_search("more parameters", np.array([1.0, 2.0])) == ["an end"]
    assert asked == [("more parameters", [[1.0, 2.0]])]
    assert search.widen_search("refused", np.array([1.0, 2.0])) is None
    with pytest.raises(ZeroDivisionError):
        search.widen_search("broken", np.array([1.0, 2.0]))
